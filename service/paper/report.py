"""Render the study as one HTML file that needs no server and no network."""

from collections.abc import Sequence
from datetime import UTC, datetime

from markupsafe import Markup

from service.figures.embed import strip_template, templates_json, to_script_json
from service.pages.render import (
    draw_script,
    load_stylesheet,
    plotly_script,
    render_template,
    security_policy,
)
from service.paper.document import Plot, Section, describe_check


def render_report(sections: Sequence[Section], *, quick: bool) -> str:
    """Render the report: tables, figures with captions, and checks."""
    return render_template(
        "paper.html",
        sections=sections,
        made=datetime.now(UTC),
        quick=quick,
        policy=security_policy(),
        style=load_stylesheet(),
        plotly_code=plotly_script(),
        draw=draw_script(),
        templates=templates_json(),
        figure_json=_figure_json,
        verdict=describe_check,
    )


def _figure_json(plot: Plot) -> Markup:
    return to_script_json(strip_template(dict(plot.figure)))
