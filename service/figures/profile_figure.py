"""Draw profile likelihoods: the ratio over each parameter, and its 95 % interval."""

from collections.abc import Sequence
from typing import Any

from service.runs.run_schemas import ProfileOut
from sysid.core.text import append_unit
from sysid.figures import theme
from sysid.figures.figure_grid import PlotGrid, add_axes
from sysid.figures.plotly import MARGIN, Figure, base_layout

_ROW_PX, _GAP = 230, 0.08
_MAX_THRESHOLDS = 3.0  # height of the axis in thresholds, so that the minimum stays visible


def plot_profiles(profiles: Sequence[ProfileOut], threshold: float, columns: int = 2) -> Figure:
    """Draw the likelihood ratio of each parameter, with the threshold and the interval."""
    grid = PlotGrid(
        len(profiles), columns, caption=0, plot=1, axis=0.35, gap=_GAP, has_last_axis=False
    )
    figure: Figure = {
        "data": [],
        "layout": base_layout(
            grid.n_rows * _ROW_PX, showlegend=False, shapes=[], margin={**MARGIN, "b": 44}
        ),
    }
    for number, profile in enumerate(profiles):
        is_first = number % grid.n_columns == 0
        axis_names = add_axes(
            figure,
            number,
            grid.get_area(number),
            {"title": {"text": append_unit(profile.name, profile.unit)}, "nticks": 6},
            {
                "nticks": 5,
                "range": [0, _MAX_THRESHOLDS * threshold],
                **({"title": {"text": "likelihood ratio"}} if is_first else {}),
            },
        )
        figure["data"].append(_profile_trace(profile, axis_names))
        figure["layout"]["shapes"] += _threshold_shapes(profile, axis_names, threshold)
    return figure


def _profile_trace(profile: ProfileOut, axis_names: dict[str, str]) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": profile.name,
        "x": profile.values,
        "y": profile.ratio,
        **axis_names,
        "line": {"color": theme.BLUE, "width": 1.5},
        "marker": {"color": theme.BLUE, "size": 4},
        "hovertemplate": f"{profile.name} = %{{x:.6g}}: %{{y:.3g}}<extra></extra>",
    }


def _threshold_shapes(
    profile: ProfileOut, axis_names: dict[str, str], threshold: float
) -> list[dict[str, Any]]:
    """Draw the threshold, and a vertical line at each end of the interval that is not open."""
    style = {"color": theme.GREY, "width": 1, "dash": "dot"}
    level = {
        "type": "line",
        "x0": 0,
        "x1": 1,
        "xref": f"{axis_names['xaxis']} domain",
        "y0": threshold,
        "y1": threshold,
        "yref": axis_names["yaxis"],
        "line": style,
    }
    ends = [
        {
            "type": "line",
            "x0": end,
            "x1": end,
            "xref": axis_names["xaxis"],
            "y0": 0,
            "y1": threshold,
            "yref": axis_names["yaxis"],
            "line": style,
        }
        for end in profile.interval95
        if end is not None
    ]
    return [level, *ends]
