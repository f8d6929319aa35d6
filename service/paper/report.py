"""The study as one HTML file that needs no server and no network."""

from collections.abc import Sequence
from datetime import UTC, datetime

from markupsafe import Markup

from service.paper.parts import Plot, Section, verdict
from service.web import report as jobs
from service.web.pages import render
from service.web.theme import template


def page(sections: Sequence[Section], *, quick: bool) -> str:
    """The report: tables, figures with captions, and what held."""
    return render(
        "paper.html", sections=sections, made=datetime.now(UTC), quick=quick,
        policy=jobs.policy(), style=jobs.style(), plotly_code=jobs.plotly(), draw=jobs.draw(),
        templates=jobs.as_json({"light": template("light"), "dark": template("dark")}),
        figure_json=_figure_json, verdict=verdict,
    )  # fmt: skip


def _figure_json(plot: Plot) -> Markup:
    return jobs.as_json(jobs.bare(dict(plot.figure)))
