"""Draw one parameter of the runs of any jobs, with its standard errors."""

from collections.abc import Sequence
from dataclasses import dataclass

from sysid.core.text import append_unit, plain_unit
from sysid.figures import theme
from sysid.figures.plotly import Figure, base_layout, to_json_numbers

HEIGHT = 340
MARGIN = {"l": 72, "r": 16, "t": 34, "b": 52}


@dataclass(frozen=True, slots=True)
class ResultPoint:
    """An estimate of one run; `x` is a number, or a date in ISO 8601."""

    x: float | str
    value: float
    stderr: float | None
    group: str
    text: str


def plot_results(
    points: Sequence[ResultPoint], name: str, unit: str, x: str, is_date: bool
) -> Figure:
    """Draw estimates with error bars of one standard error, a colour for each group."""
    figure: Figure = {
        "data": [],
        "layout": base_layout(
            HEIGHT,
            margin=MARGIN,
            xaxis={"title": {"text": x}, "type": "date" if is_date else "linear"},
            yaxis={"title": {"text": append_unit(name, unit)}, "nticks": 8},
        ),
    }
    for place, group in enumerate(dict.fromkeys(point.group for point in points)):
        members = [point for point in points if point.group == group]
        colour = theme.series_style(place)["color"]
        hover = f"%{{y:.6~g}}{plain_unit(unit)}<br>%{{text}}<extra>{group}</extra>"
        errors = [0.0 if one.stderr is None else one.stderr for one in members]
        figure["data"].append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": group,
                "showlegend": True,
                "x": [one.x for one in members],
                "y": to_json_numbers([one.value for one in members]),
                "error_y": {"type": "data", "array": to_json_numbers(errors), "thickness": 1.2},
                "text": [one.text for one in members],
                "marker": {"color": colour, "size": 7},
                "hovertemplate": hover,
            }
        )
    return figure
