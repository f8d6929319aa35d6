"""Figure of profile likelihoods: the ratio over each parameter, and where it crosses 95 %."""

from collections.abc import Sequence
from typing import Any

from service.core.text import bracket_unit
from service.figures import theme
from service.figures.plotly import MARGIN, Figure, layout
from service.runs.schemas import ProfileOut

_ROW_PX, _GAP = 230, 0.08
_MOST = 3.0  # thresholds that are drawn: the walls of a steep profile would hide its foot


def profile(profiles: Sequence[ProfileOut], threshold: float, columns: int = 2) -> Figure:
    """Likelihood ratio of each parameter over its values, with the threshold and the interval."""
    columns = max(1, min(columns, len(profiles)))
    rows = -(-len(profiles) // columns)
    figure: Figure = {
        "data": [],
        "layout": layout(rows * _ROW_PX, showlegend=False, shapes=[], margin={**MARGIN, "b": 44}),
    }
    wide, high = (1 - _GAP * (columns - 1)) / columns, 1 / (rows + 0.35 * (rows - 1))
    for number, one in enumerate(profiles):
        row, column = divmod(number, columns)
        left, top = column * (wide + _GAP), 1 - row * 1.35 * high
        axis = "" if number == 0 else str(number + 1)
        figure["data"].append(_line(one, axis))
        figure["layout"]["shapes"] += _marks(one, axis, threshold)
        title = one.name + bracket_unit(one.unit)
        figure["layout"][f"xaxis{axis}"] = {
            "domain": [left, left + wide], "anchor": f"y{axis}", "title": {"text": title},
            "nticks": 6,
        }  # fmt: skip
        figure["layout"][f"yaxis{axis}"] = {
            "domain": [max(top - high, 0.0), top], "anchor": f"x{axis}", "nticks": 5,
            "range": [0, _MOST * threshold],
            **({"title": {"text": "likelihood ratio"}} if column == 0 else {}),
        }  # fmt: skip
    return figure


def _line(one: ProfileOut, axis: str) -> dict[str, Any]:
    return {
        "type": "scatter", "mode": "lines+markers", "name": one.name,
        "x": one.values, "y": one.ratio, "xaxis": f"x{axis}", "yaxis": f"y{axis}",
        "line": {"color": theme.BLUE, "width": 1.5}, "marker": {"color": theme.BLUE, "size": 4},
        "hovertemplate": f"{one.name} = %{{x:.6g}}: %{{y:.3g}}<extra></extra>",
    }  # fmt: skip


def _marks(one: ProfileOut, axis: str, threshold: float) -> list[dict[str, Any]]:
    """The threshold, and an upright at each end of the interval that is not open."""
    style = {"color": theme.GREY, "width": 1, "dash": "dot"}
    level = {
        "type": "line", "x0": 0, "x1": 1, "xref": f"x{axis} domain", "y0": threshold,
        "y1": threshold, "yref": f"y{axis}", "line": style,
    }  # fmt: skip
    ends = [
        {
            "type": "line", "x0": end, "x1": end, "xref": f"x{axis}", "y0": 0, "y1": threshold,
            "yref": f"y{axis}", "line": style,
        }
        for end in one.interval95
        if end is not None
    ]  # fmt: skip
    return [level, *ends]
