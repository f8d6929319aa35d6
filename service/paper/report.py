"""The study as one HTML file that needs no server and no network."""

from collections.abc import Sequence
from datetime import UTC, datetime

from markupsafe import Markup

from service.figures.embed import as_json, bare, templates
from service.pages import report as jobs
from service.pages.render import render, style
from service.paper.document import Plot, Section, verdict


def page(sections: Sequence[Section], *, quick: bool) -> str:
    """The report: tables, figures with captions, and what held."""
    return render(
        "paper.html", sections=sections, made=datetime.now(UTC), quick=quick,
        policy=jobs.policy(), style=style(), plotly_code=jobs.plotly(), draw=jobs.draw(),
        templates=templates(),
        figure_json=_figure_json, verdict=verdict,
    )  # fmt: skip


def _figure_json(plot: Plot) -> Markup:
    return as_json(bare(dict(plot.figure)))
