"""Embed figures in a page: their JSON in script elements that are not executed."""

import json
from collections.abc import Iterable

from markupsafe import Markup

from sysid.figures.plotly import Figure, has_points
from sysid.figures.theme import plotly_template


def strip_template(figure: Figure) -> Figure:
    """Remove the template, which a report stores once for all its figures."""
    layout = {name: value for name, value in figure["layout"].items() if name != "template"}
    return {"data": figure["data"], "layout": layout}


def write_figures(titled: Iterable[tuple[str, Figure]]) -> list[tuple[str, int, Markup]]:
    """Title, height (px) and JSON of the figures that have data, for a report."""
    return [
        (title, figure["layout"]["height"], to_script_json(strip_template(figure)))
        for title, figure in titled
        if has_points(figure)
    ]


def to_script_json(value: object) -> Markup:
    """Write JSON for a script element; no text in it can end the element."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def templates_json() -> Markup:
    """Write the light and the dark template, once for all figures of a page."""
    return to_script_json({"light": plotly_template("light"), "dark": plotly_template("dark")})
