"""Draw samples of a posterior: a corner plot of pairs of parameters, with 95 % regions."""

from collections.abc import Sequence
from itertools import combinations
from math import isfinite, pi, sqrt
from typing import Any, NamedTuple

import numpy as np

from sysid.core.text import append_unit
from sysid.figures import theme
from sysid.figures.data import Floats
from sysid.figures.figure_grid import add_axes
from sysid.figures.plotly import Figure, base_layout, empty_figure, to_json_numbers
from sysid.figures.theme import stride_indices
from sysid.uncertainty.estimates import CorrelationMatrix, Estimate, Posterior, PosteriorParameter

MAX_SHOWN = 6
"""Parameters that a corner plot shows."""
_CELL_PX, _GAP = 176, 0.02
_MARGIN = {"l": 84, "r": 16, "t": 30, "b": 54}
_NARROW_MARGIN = {**_MARGIN, "l": 62, "t": 112}  # room for the legend above all cells
_MAX_POINTS = 500  # of a pair: more would hide each other
_CELLS = 40  # of a density in each direction
_ROOM = 3.0  # bandwidths around the samples
_BINS = 30
_ELLIPSE_RADIUS, _ELLIPSE_POINTS = sqrt(5.991), 60  # 95 % of χ² with two degrees of freedom
_DASHED = {"color": theme.VERMILLION, "width": 1.4, "dash": "dash"}


class Corner(NamedTuple):
    """A free parameter: its estimate, its posterior, and the samples (n,) of that."""

    estimate: Estimate
    sampled: PosteriorParameter
    samples: Floats


def posterior_height(n_parameters: int) -> int:
    """Compute the height (px) of the corner plot, so that a page can reserve its room."""
    return min(n_parameters, MAX_SHOWN) * _CELL_PX + _MARGIN["t"] + _MARGIN["b"]


def plot_posterior(
    posterior: Posterior | None,
    estimates: Sequence[Estimate],
    correlation: CorrelationMatrix | None,
    *,
    is_narrow: bool = False,
) -> Figure:
    """Draw histograms on the diagonal, and pairs of samples with their 95 % regions below.

    The `correlation` of the estimates, with their standard errors, gives the dashed ellipses. Of
    many parameters only those that are most correlated are shown. On a narrow page the legend is
    above the cells, which have fewer ticks. Without samples the figure is empty.
    """
    if posterior is None or not posterior.parameters:
        return empty_figure()
    by_name = {estimate.name: estimate for estimate in estimates}
    parameters = [
        Corner(by_name[sampled.name], sampled, posterior.samples[:, column])
        for column, sampled in enumerate(posterior.parameters)
    ]
    matrix = np.eye(len(parameters)) if correlation is None else correlation.matrix
    chosen = choose_shown(parameters)
    shown = [parameters[i] for i in chosen]
    margin = _NARROW_MARGIN if is_narrow else _MARGIN
    beside = {"x": 1, "xanchor": "right", "y": 1, "yanchor": "top"}
    figure: Figure = {
        "data": [],
        "layout": base_layout(
            posterior_height(len(shown)) + margin["t"] - _MARGIN["t"],
            margin=margin,
            shapes=[],
            bargap=0,
            **({} if is_narrow else {"legend": beside}),
        ),
    }
    for column, row in combinations(range(len(shown)), 2):
        names = _add_cell(figure, shown, row, column)
        pair = shown[column], shown[row]
        figure["data"] += _draw_samples(*pair, names)
        figure["data"] += _draw_ellipse(*pair, float(matrix[chosen[column], chosen[row]]), names)
    for index, parameter in enumerate(shown):
        names = _add_cell(figure, shown, index, index)
        figure["data"].append(_draw_histogram(parameter, names))
        figure["layout"]["shapes"] += _draw_interval(parameter, names)
    _show_legend_once(figure)
    if is_narrow:
        _thin_ticks(figure)
    if len(shown) < len(parameters):
        title = f"the {len(shown)} most correlated of {len(parameters)} parameters"
        figure["layout"]["title"] = {
            "text": title,
            "font": {"size": 12},
            "x": 0.5,  # clear of the first histogram and of the buttons at the right
            "xanchor": "center",
        }
    return figure


def _thin_ticks(figure: Figure) -> None:
    """Let narrow cells have two level labels, which do not meet their neighbours."""
    for name, axis in figure["layout"].items():
        if name.startswith("xaxis"):
            axis |= {"nticks": 2, "tickangle": 0, "tickfont": {"size": 10}}


def choose_shown(parameters: Sequence[Corner]) -> list[int]:
    """Choose the parameters to show: all, or those whose samples are most correlated with another.

    Returned are their indices in the original order.
    """
    if len(parameters) <= MAX_SHOWN:
        return list(range(len(parameters)))
    with np.errstate(invalid="ignore", divide="ignore"):  # samples that are all equal
        correlation = np.corrcoef([parameter.samples for parameter in parameters])
    strength = np.abs(np.nan_to_num(correlation - np.eye(len(parameters))))
    return sorted(np.argsort(-np.max(strength, axis=0), kind="stable")[:MAX_SHOWN].tolist())


def _add_cell(figure: Figure, shown: Sequence[Corner], row: int, column: int) -> dict[str, str]:
    """Add the axes of a cell; titles and ticks only on the left and at the bottom."""
    n = len(shown)
    width = (1.0 - _GAP * (n - 1)) / n
    left, top = column * (width + _GAP), 1.0 - row * (width + _GAP)
    is_histogram = row == column
    x: dict[str, Any] = {"nticks": 4, "showticklabels": row == n - 1}
    y: dict[str, Any] = {"nticks": 4, "showticklabels": column == 0 and not is_histogram}
    if row == n - 1:
        x["title"] = {"text": append_unit(shown[column].sampled.name, shown[column].sampled.unit)}
    if column == 0 and not is_histogram:
        y["title"] = {"text": append_unit(shown[row].sampled.name, shown[row].sampled.unit)}
    x["range"] = _find_range(shown[column])
    y |= (
        {"visible": False, "rangemode": "tozero"}
        if is_histogram
        else {"range": _find_range(shown[row])}
    )
    domain = (left, min(left + width, 1.0)), (max(top - width, 0.0), top)
    return add_axes(figure, row * n + column, domain, x, y)


def _find_range(parameter: Corner) -> list[float]:
    """Find the range of an axis: that of the samples and the estimate, with room."""
    values = [*parameter.samples.tolist(), parameter.estimate.value]
    low, high = min(values), max(values)
    room = 0.05 * (high - low) or 0.5 * abs(high) or 0.5
    return [low - room, high + room]


def _draw_samples(across: Corner, upward: Corner, names: dict[str, str]) -> list[dict[str, Any]]:
    """Draw samples of a pair, and the region of highest density that has 95 % of them."""
    chosen = stride_indices(across.samples.size, _MAX_POINTS)
    points = {
        "type": "scatter",
        "mode": "markers",
        "name": "samples",
        "x": to_json_numbers(across.samples[chosen]),
        "y": to_json_numbers(upward.samples[chosen]),
        **names,
        "marker": {"color": theme.BLUE, "size": 3, "opacity": 0.45},
        "hovertemplate": f"{across.sampled.name} = %{{x:.5g}}<br>"
        f"{upward.sampled.name} = %{{y:.5g}}<extra></extra>",
    }
    estimate = {
        "type": "scatter",
        "mode": "markers",
        "name": "estimate",
        "x": to_json_numbers([across.estimate.value]),
        "y": to_json_numbers([upward.estimate.value]),
        **names,
        "marker": {"color": theme.VERMILLION, "size": 8, "symbol": "cross"},
        "hoverinfo": "skip",
    }
    if not (np.ptp(across.samples) > 0 and np.ptp(upward.samples) > 0):
        return [points, estimate]
    x, y, density, level = estimate_region(across, upward)
    region = {
        "type": "contour",
        "name": "95 % region",
        "x": to_json_numbers(x),
        "y": to_json_numbers(y),
        "z": [[round(value, 4) for value in row] for row in density.tolist()],
        **names,
        "contours": {"start": level, "end": level, "size": 1, "coloring": "none"},
        "line": {"color": theme.BLUE, "width": 1.8},
        "showscale": False,
        "hoverinfo": "skip",
    }
    return [points, region, estimate]


def estimate_region(across: Corner, upward: Corner) -> tuple[Floats, Floats, Floats, float]:
    """Estimate the density of a pair on a grid, and its level that 95 % of the samples exceed.

    Returned are the grid between the bounds, the density (y, x), 1 at most, and the level. The
    density is that of Gaussian kernels (Scott 1992).
    """
    x, y = _lay_grid(across), _lay_grid(upward)
    density = _compute_kernels(upward, y) @ _compute_kernels(across, x).T
    highest = float(np.max(density))
    own = _compute_kernels(across, across.samples) * _compute_kernels(upward, upward.samples)
    level = float(np.quantile(np.sum(own, axis=1), 0.05))
    return x, y, density / highest, level / highest


def _lay_grid(parameter: Corner) -> Floats:
    room = _ROOM * _find_bandwidth(parameter.samples)
    low, high = float(np.min(parameter.samples)) - room, float(np.max(parameter.samples)) + room
    lower, upper = parameter.estimate.lower, parameter.estimate.upper
    return np.linspace(max(low, lower), min(high, upper), _CELLS)


def _compute_kernels(parameter: Corner, points: Floats) -> Floats:
    """Compute the kernels (P, n) of all samples at points (P,)."""
    distances = (points[:, None] - parameter.samples) / _find_bandwidth(parameter.samples)
    return np.asarray(np.exp(-0.5 * distances**2))


def _find_bandwidth(values: Floats) -> float:
    """Find Scott's width for two dimensions; grid cells are never much wider."""
    low, high = np.quantile(values, [0.25, 0.75])
    spread = min(float(np.std(values)), float(high - low) / 1.349 or np.inf)
    return float(max(spread * values.size ** (-1.0 / 6.0), np.ptp(values) / _CELLS))


def _draw_ellipse(
    across: Corner, upward: Corner, correlation: float, names: dict[str, str]
) -> list[dict[str, Any]]:
    """Draw the 95 % ellipse of the standard errors, if both parameters have one."""
    if across.estimate.stderr is None or upward.estimate.stderr is None:
        return []
    angle = np.linspace(0.0, 2.0 * pi, _ELLIPSE_POINTS)
    first = _ELLIPSE_RADIUS * np.cos(angle)
    second = correlation * first + sqrt(1.0 - correlation**2) * _ELLIPSE_RADIUS * np.sin(angle)
    return [
        {
            "type": "scatter",
            "mode": "lines",
            "name": "95 % ellipse of the standard errors",
            "x": to_json_numbers(across.estimate.value + across.estimate.stderr * first),
            "y": to_json_numbers(upward.estimate.value + upward.estimate.stderr * second),
            **names,
            "line": _DASHED,
            "hoverinfo": "skip",
        }
    ]


def _draw_histogram(parameter: Corner, names: dict[str, str]) -> dict[str, Any]:
    counts, edges = np.histogram(parameter.samples, _BINS)
    return {
        "type": "bar",
        "name": parameter.sampled.name,
        "x": to_json_numbers(0.5 * (edges[1:] + edges[:-1])),
        "y": counts.tolist(),
        **names,
        "marker": {"color": theme.BLUE, "opacity": 0.45},
        "showlegend": False,
        "hovertemplate": f"{parameter.sampled.name} = %{{x:.5g}}<extra></extra>",
    }


def _draw_interval(parameter: Corner, names: dict[str, str]) -> list[dict[str, Any]]:
    """Draw the estimate and the ends of both intervals."""
    lines = [(end, {"color": theme.BLUE, "width": 1.4}) for end in parameter.sampled.interval95]
    ends = filter(isfinite, parameter.estimate.interval95 or ())
    lines += [(end, _DASHED) for end in ends]
    lines.append((parameter.estimate.value, {"color": theme.VERMILLION, "width": 1.4}))
    return [
        {
            "type": "line",
            "xref": names["xaxis"],
            "x0": x,
            "x1": x,
            "yref": f"{names['yaxis']} domain",
            "y0": 0,
            "y1": 1,
            "line": style,
        }
        for x, style in lines
    ]


def _show_legend_once(figure: Figure) -> None:
    seen: set[str] = set()
    for trace in figure["data"]:
        trace.setdefault("showlegend", trace["name"] not in seen)
        trace["legendgroup"] = trace["name"]
        seen.add(trace["name"])
