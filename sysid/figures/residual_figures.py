"""Draw the residual tests: correlation functions with their bands."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sysid.figures import theme
from sysid.figures.data import CorrelationTrace, Floats
from sysid.figures.figure_grid import PlotArea, PlotGrid, add_axes, add_caption
from sysid.figures.plotly import MARGIN, Figure, base_layout, to_json_numbers

_MARGIN = {**MARGIN, "t": 34, "b": 6}
_BAND95 = "rgba(138,146,155,0.22)"


def plot_residuals(
    functions: Sequence[CorrelationTrace], columns: int = 2, names: Sequence[str] = ()
) -> Figure:
    """Draw the correlation functions of one experiment, each over its bands.

    Lag 0 of an autocorrelation is omitted: it is 1 and would dwarf the others. `names` are the
    names of all experiments.
    """
    grid = _grid(len(functions), columns)
    figure: Figure = {
        "data": [],
        "layout": base_layout(
            grid.height(_MARGIN),
            annotations=[],
            bargap=0.45,
            margin=_MARGIN,
            meta={"experiments": list(names)},
        ),
    }
    for number, function in enumerate(functions):
        _add_correlation(figure, number, function, grid.get_area(number))
    return figure


def _grid(n_functions: int, columns: int) -> PlotGrid:
    return PlotGrid(n_functions, columns, caption=24, plot=150, axis=50, gap=0.08)


def residuals_height(n_functions: int, columns: int = 2) -> int:
    """Compute the height (px) of the figure, so that a page can reserve its room."""
    return _grid(n_functions, columns).height(_MARGIN)


def _add_correlation(
    figure: Figure, number: int, correlation: CorrelationTrace, domain: PlotArea
) -> None:
    shown = (
        correlation.lags != 0 if correlation.is_auto else np.ones(correlation.lags.size, dtype=bool)
    )
    lags, values = correlation.lags[shown], correlation.values[shown]
    bands = correlation.band95[shown], correlation.band99[shown]
    reach = 1.2 * max(float(np.max(np.abs(values))), float(np.max(bands[1])), 1e-12)
    edge = 0.7
    axis_names = add_axes(
        figure,
        number,
        domain,
        {
            "nticks": 7,
            "showgrid": False,
            "range": [float(lags[0]) - edge, float(lags[-1]) + edge],
            "zeroline": False,
            "title": {"text": _lag_title(correlation), "font": {"size": 11}, "standoff": 4},
        },
        {"nticks": 5, "range": [-reach, reach]},
    )
    figure["data"] += _band_traces(lags, bands, axis_names, first=number == 0)
    figure["data"].append(_correlation_bars(correlation, lags, values, bands[1], axis_names))
    add_caption(figure, correlation.title, domain, shift=3)


def _lag_title(correlation: CorrelationTrace) -> str:
    if correlation.period is None:
        return "lag [samples]"
    return f"lag [samples of {correlation.period:.4g} s]"


def _band_traces(
    lags: Floats, bands: tuple[Floats, Floats], axis_names: dict[str, str], *, first: bool
) -> list[dict[str, Any]]:
    """Draw the 95 % band as an area and the 99 % band as dashed lines."""
    # The band extends by half a lag at each end, so that it covers the first and the last bar.
    x = to_json_numbers(np.concatenate([[lags[0] - 0.5], lags, [lags[-1] + 0.5]]))
    shared = {"type": "scatter", "mode": "lines", "x": x, **axis_names, "hoverinfo": "skip"}
    drawn = []
    for name, band, look in (
        ("95 % band", bands[0], {"line": {"width": 0}}),
        ("99 % band", bands[1], {"line": {"color": theme.GREY, "width": 1, "dash": "dash"}}),
    ):
        ends = np.concatenate([band[:1], band, band[-1:]])
        area = {"fill": "tonexty", "fillcolor": _BAND95} if look["line"]["width"] == 0 else {}
        drawn += [
            {
                **shared,
                **look,
                "name": name,
                "y": to_json_numbers(-ends),
                "legendgroup": name,
                "showlegend": first and not area,
            },
            {
                **shared,
                **look,
                **area,
                "name": name,
                "y": to_json_numbers(ends),
                "legendgroup": name,
                "showlegend": first and bool(area),
            },
        ]
    return drawn


def _correlation_bars(
    correlation: CorrelationTrace,
    lags: Floats,
    values: Floats,
    band99: Floats,
    axis_names: dict[str, str],
) -> dict[str, Any]:
    outside = np.abs(values) > band99
    return {
        "type": "bar",
        "name": correlation.title.partition("<br>")[0],
        "x": to_json_numbers(lags),
        "y": to_json_numbers(values),
        **axis_names,
        "showlegend": False,
        "marker": {"color": [theme.VERMILLION if out else theme.BLUE for out in outside]},
        "hovertemplate": "lag %{x}: %{y:.3f}<extra></extra>",
    }
