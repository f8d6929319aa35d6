"""Embed figures in a page: their JSON in script elements that are not executed."""

import json

from markupsafe import Markup

from sysid.figures.plotly import Figure
from sysid.figures.theme import plotly_template


def strip_template(figure: Figure) -> Figure:
    """Remove the template, which a report stores once for all its figures."""
    layout = {name: value for name, value in figure["layout"].items() if name != "template"}
    return {"data": figure["data"], "layout": layout}


def to_script_json(value: object) -> Markup:
    """Write JSON for a script element; no text in it can end the element."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def templates_json() -> Markup:
    """Write the light and the dark template, once for all figures of a page."""
    return to_script_json({"light": plotly_template("light"), "dark": plotly_template("dark")})
