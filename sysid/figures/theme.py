"""Colours and templates of the figures, and thinning of lines.

One set of line colours serves light and dark backgrounds. The colours are those of Okabe and Ito,
darkened where they vanish on white. Each has a contrast of about 3 or more against both
backgrounds, and the colour-blind can distinguish them. Lines are thinned to what a screen can
show; extremes stay visible.
"""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sysid.figures.data import Floats
from sysid.figures.decimate import find_extremes

Theme = Literal["light", "dark"]
Indices = NDArray[np.intp]

BLUE, VERMILLION, GREEN = "#2a83c4", "#d55e00", "#00916a"
PURPLE, OCHRE, GREY = "#b9619b", "#b5830f", "#8a929b"
SERIES_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, OCHRE, GREY)
SERIES_DASHES = ("solid", "dash", "dot", "dashdot")
SHADE = "rgba(138,146,155,0.14)"
MARK = "rgba(213,94,0,0.22)"
"""Where something happened to a record."""
HAIRLINE = "rgba(138,146,155,0.55)"
DIVERGING = [[0.0, BLUE], [0.5, "rgba(138,146,155,0.10)"], [1.0, VERMILLION]]
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif"

_INK_COLOURS: dict[Theme, dict[str, str]] = {
    "light": {"text": "#303a44", "grid": "#e6e9ec", "line": "#b9c0c7", "card": "#ffffff"},
    "dark": {"text": "#c6ced6", "grid": "#2a3138", "line": "#4c565f", "card": "#20262c"},
}


def series_style(number: int) -> dict[str, Any]:
    """Return colour and dash of the numbered series; the first 24 all differ."""
    return {
        "color": SERIES_COLOURS[number % len(SERIES_COLOURS)],
        "dash": SERIES_DASHES[number // len(SERIES_COLOURS) % len(SERIES_DASHES)],
        "width": 1.6,
    }


def plotly_template(theme: Theme) -> dict[str, Any]:
    """Build the Plotly template: plain axes on a transparent background."""
    ink = _INK_COLOURS[theme]
    axis = {
        "gridcolor": ink["grid"],
        "linecolor": ink["line"],
        "tickcolor": ink["line"],
        "zerolinecolor": ink["line"],
        "zerolinewidth": 1,
        "showline": True,
        "ticks": "outside",
        "ticklen": 4,
        "automargin": False,
        "title": {"standoff": 8},
    }
    return {
        # Plotly treats a transparent cell as white and would write on it in black.
        "data": {"heatmap": [{"textfont": {"color": ink["text"]}}]},
        "layout": {
            "paper_bgcolor": "rgba(0,0,0,0)",
            "plot_bgcolor": "rgba(0,0,0,0)",
            "font": {"family": FONT, "size": 12, "color": ink["text"]},
            "colorway": list(SERIES_COLOURS),
            "xaxis": axis,
            "yaxis": axis,
            "hoverlabel": {
                "bgcolor": ink["card"],
                "bordercolor": ink["line"],
                "font": {"family": FONT, "size": 12, "color": ink["text"]},
            },
            "annotationdefaults": {"font": {"color": ink["text"], "size": 12}},
            "modebar": {
                "bgcolor": "rgba(0,0,0,0)",
                "color": ink["line"],
                "activecolor": ink["text"],
            },
        },
    }


MAX_POINTS = 1000


def thin_indices(values: Floats, max_points: int = MAX_POINTS) -> Indices:
    """Choose at most `max_points` indices: the ends, and each bin's minimum and maximum.

    A spike of one sample therefore stays visible at any zoom. Several arrays may share the indices.
    Fewer than four points have no room for a bin: they are the ends.
    """
    if values.size <= max_points:
        return np.arange(values.size)
    if max_points < 4:
        return np.array([0, values.size - 1])
    inner = find_extremes(values, max_points - 2)
    return np.unique(np.concatenate([[0, values.size - 1], inner])).astype(np.intp)


def window_slice(times: Floats, start: float | None, stop: float | None) -> slice:
    """Slice the samples between two times (s), plus one at each side so lines reach the edge."""
    first = 0 if start is None else int(np.searchsorted(times, start, "left")) - 1
    last = times.size if stop is None else int(np.searchsorted(times, stop, "right")) + 1
    return slice(max(first, 0), min(last, times.size))


def stride_indices(count: int, max_points: int = MAX_POINTS) -> Indices:
    """Choose at most `max_points` of `count` indices, including the first and the last."""
    if count <= max_points:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, max_points).round().astype(np.intp))


def fade(colour: str, opacity: float) -> str:
    """Make a colour (``#rrggbb``) transparent."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:g})"
