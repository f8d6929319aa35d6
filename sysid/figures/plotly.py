"""Draw the figures of a run as Plotly JSON: one definition for notebook, page, REST and report.

A figure is a plain ``{"data": […], "layout": {…}}``. Colours that depend on the background come
from the template (`sysid.figures.theme`). No line has more than `theme.MAX_POINTS` points.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np

from sysid.core.text import (
    append_unit,
    bracket_unit,
    find_shown_error,
    join_estimate,
    plain_unit,
)
from sysid.figures import theme
from sysid.figures.data import Floats, SearchTraces
from sysid.figures.figure_grid import PlotArea, PlotGrid, add_axes, add_caption
from sysid.figures.theme import stride_indices
from sysid.models.parameters import Parameter
from sysid.search.state import Improvement, IslandSummary
from sysid.uncertainty.estimates import CorrelationMatrix, Estimate

Figure = dict[str, Any]
Abscissa = Literal["generations", "evaluations"]

MARGIN = {"l": 64, "r": 16, "t": 28, "b": 44}
WATERFALL_HEIGHT = 280
_MAX_MARKED_EPOCHS = 80
_CROWDED_RATIO = 8.0
"""Ratio of largest to smallest value above which the digits of a log axis are crowded."""
_PHASE_MARKERS = {
    "sequence": ("sequence", "diamond-open"),
    "migration": ("migration", "triangle-up-open"),
    "refinement": ("refinement", "star"),
}


def to_json_numbers(values: Iterable[float]) -> list[float | None]:
    """Convert numbers for JSON with seven digits; None, a gap, if not finite."""
    return [float(f"{v:.7g}") if np.isfinite(v) else None for v in values]


def base_layout(height: int, **options: Any) -> dict[str, Any]:
    """Build the layout that all figures share; `uirevision` keeps a zoom during live updates."""
    shared: dict[str, Any] = {
        "height": height,
        "margin": MARGIN,
        "uirevision": "keep",
        "hovermode": "closest",
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0, "xanchor": "left"},
        "template": theme.plotly_template("light"),
    }
    return {**shared, **options}


def empty_figure() -> Figure:
    """Build a figure without data."""
    return {"data": [], "layout": base_layout(200)}


def has_points(figure: Figure) -> bool:
    """Test whether a figure has anything to show."""
    return any(len(trace["x"]) > 0 for trace in figure["data"])


def apply_theme(figure: Figure, paper: theme.Theme) -> Figure:
    """Set the template for a light or dark background."""
    return {**figure, "layout": {**figure["layout"], "template": theme.plotly_template(paper)}}


def plot_history(run: SearchTraces, abscissa: Abscissa = "generations") -> Figure:
    """Draw the fitness of every island's champion over generations or evaluations."""
    end = _last_abscissa(run, abscissa)
    lines = [
        _island_line(number, points, abscissa, end)
        for number, points in enumerate(run.history)
        if points
    ]
    data = [*lines, *_phase_markers(run, abscissa)]
    epochs = run.migrations if abscissa == "generations" and run.epoch else ()
    return {
        "data": data,
        "layout": base_layout(
            360,
            xaxis={"title": {"text": abscissa}, "rangemode": "tozero"},
            yaxis=_fitness_axis(run.unit, run.fitness_label, data),
            shapes=[_vertical_line(epoch * run.epoch) for epoch in _distinct_epochs(epochs)],
            uirevision=abscissa,
        ),
    }


def plot_convergence(run: SearchTraces, columns: int = 3) -> Figure:
    """Draw the free parameters of the islands' champions over generations, with their bounds."""
    parameters = run.parameters
    grid = _parameter_grid(len(parameters), columns)
    figure: Figure = {
        "data": [],
        "layout": base_layout(
            convergence_height(len(parameters), columns),
            showlegend=False,
            shapes=[],
            annotations=[],
        ),
    }
    figure["layout"]["margin"] = {**MARGIN, "b": 36}
    for number, parameter in enumerate(parameters):
        _add_parameter_plot(figure, run, number, parameter, grid.get_area(number))
    return figure


def convergence_height(n_parameters: int, columns: int) -> int:
    """Compute the height (px) of the small plots, so that a page can reserve their room."""
    return _parameter_grid(n_parameters, columns).n_rows * 214 + 20


def _parameter_grid(n_parameters: int, columns: int) -> PlotGrid:
    n_columns = max(1, min(columns, n_parameters))
    gap = 0.15 / (n_columns - 0.15) if n_columns > 1 else 0.0
    return PlotGrid(
        n_parameters, columns, caption=0, plot=0.66, axis=0.34, gap=gap, has_last_axis=False
    )


def correlation_height(n_parameters: int) -> int:
    """Compute the height (px) of the correlation matrix."""
    return min(130 + max(n_parameters, 3) * (46 if n_parameters <= 12 else 24), 760)


def plot_correlation(correlation: CorrelationMatrix | None) -> Figure:
    """Draw the correlation matrix of the estimates, from −1 to 1."""
    names = [] if correlation is None else list(correlation.names)
    rows = [] if correlation is None else [to_json_numbers(row) for row in correlation.matrix]
    few = len(names) <= 12
    matrix = {
        "type": "heatmap",
        "x": names,
        "y": names,
        "z": rows,
        "zmin": -1,
        "zmax": 1,
        "colorscale": theme.DIVERGING,
        "xgap": 2,
        "ygap": 2,
        "hovertemplate": "%{y} and %{x}: %{z:.3f}<extra></extra>",
        "colorbar": {"thickness": 10, "outlinewidth": 0, "tickvals": [-1, -0.5, 0, 0.5, 1]},
    }
    if few:
        matrix["texttemplate"] = "%{z:.2f}"
    return {
        "data": [matrix] if names else [],
        "layout": base_layout(
            correlation_height(len(names)),
            xaxis={"showgrid": False, "type": "category", "showline": False, "ticks": ""},
            yaxis={
                "showgrid": False,
                "type": "category",
                "autorange": "reversed",
                "showline": False,
                "ticks": "",
                "automargin": True,
            },
        ),
    }


def plot_waterfall(
    islands: Sequence[IslandSummary], unit: str, fitness_label: str = "RMS"
) -> Figure:
    """Draw the final fitness of each island, best first, before and after refinement."""
    order = sorted(range(len(islands)), key=lambda i: _find_final_fitness(islands[i]))
    ordered, rank = [islands[i] for i in order], list(range(1, len(order) + 1))
    refined = [np.nan if one.refined_rms is None else one.refined_rms for one in ordered]
    champions = [one.champion_rms for one in ordered]
    series = [("after the search", theme.GREY, "circle-open", champions)]
    if any(one.refined_rms is not None for one in islands):
        series.append(("after refinement", theme.BLUE, "circle", refined))
    data = [
        {
            "type": "scatter",
            "mode": "lines+markers",
            "name": name,
            "x": rank,
            "y": to_json_numbers(values),
            "text": [f"island {i + 1}" for i in order],
            "line": {"color": colour, "width": 1, "dash": "dot"},
            "marker": {"color": colour, "symbol": symbol, "size": 9},
            "hovertemplate": f"%{{text}}: %{{y:.5g}} {unit}<extra></extra>",
        }
        for name, colour, symbol, values in series
    ]
    return {
        "data": data if order else [],
        "layout": base_layout(
            WATERFALL_HEIGHT,
            xaxis={
                "title": {"text": "islands, best first"},
                "dtick": max(1, len(order) // 12),
                "range": [0.5, len(order) + 0.5],
            },
            yaxis=_fitness_axis(unit, fitness_label, data),
        ),
    }


def _abscissa_value(point: Improvement, abscissa: Abscissa) -> int:
    return point.generation if abscissa == "generations" else point.evaluations


def _last_abscissa(run: SearchTraces, abscissa: Abscissa) -> int:
    last = [_abscissa_value(points[-1], abscissa) for points in run.history if points]
    # A run's evaluations are the sum over its islands; each island counts only its own.
    return max([*last, run.generations if abscissa == "generations" else 0])


def _step_points(
    points: Sequence[Improvement], abscissa: Abscissa, end: int
) -> tuple[list[int], Any]:
    thinned = [points[i] for i in stride_indices(len(points), 990)]
    ahead = [end] if _abscissa_value(thinned[-1], abscissa) < end else []
    return [*(_abscissa_value(p, abscissa) for p in thinned), *ahead], [
        *thinned,
        *([thinned[-1]] if ahead else []),
    ]


def _island_line(
    number: int, points: Sequence[Improvement], abscissa: Abscissa, end: int
) -> dict[str, Any]:
    x, thinned = _step_points(points, abscissa, end)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": f"island {number + 1}",
        "x": x,
        "y": to_json_numbers(p.rms for p in thinned),
        "line": {**theme.series_style(number), "shape": "hv"},
        "hovertemplate": f"island {number + 1}<br>%{{x}} {abscissa}: %{{y:.5g}}<extra></extra>",
    }


def _phase_markers(run: SearchTraces, abscissa: Abscissa) -> list[dict[str, Any]]:
    markers = []
    for phase, (name, symbol) in _PHASE_MARKERS.items():
        marked = [
            (number, point)
            for number, points in enumerate(run.history)
            for point in points
            if point.phase == phase
        ]
        if not marked:
            continue
        marked = [marked[i] for i in stride_indices(len(marked))]
        markers.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": name,
                "x": [_abscissa_value(p, abscissa) for _, p in marked],
                "y": to_json_numbers(p.rms for _, p in marked),
                "marker": {
                    "symbol": symbol,
                    "size": 10 if phase == "refinement" else 6,
                    "color": [theme.series_style(i)["color"] for i, _ in marked],
                },
                "text": [f"island {i + 1}" for i, _ in marked],
                "hovertemplate": f"{name}, %{{text}}<br>%{{x}}: %{{y:.5g}}<extra></extra>",
            }
        )
    return markers


def _distinct_epochs(epochs: Sequence[int]) -> list[int]:
    distinct = sorted(set(epochs))
    return distinct if len(distinct) <= _MAX_MARKED_EPOCHS else []


def _fitness_axis(unit: str, label: str, data: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Build the axis of the fitness; `data` are its traces."""
    title = {"text": label + bracket_unit(unit)}
    # Below one decade the axis would show only digits and no power of ten.
    axis = {"title": title, "type": "log", "exponentformat": "e", "minorloglabels": "complete"}
    positive = [y for trace in data for y in trace["y"] if y is not None and y > 0]
    if positive and _CROWDED_RATIO <= max(positive) / min(positive) < 1000 * _CROWDED_RATIO:
        axis["dtick"] = "D2"  # 1, 2, 5: all nine digits of a decade would overlap
    return axis


def _vertical_line(x: float) -> dict[str, Any]:
    return {
        "type": "line",
        "x0": x,
        "x1": x,
        "y0": 0,
        "y1": 1,
        "yref": "paper",
        "layer": "below",
        "line": {"color": theme.HAIRLINE, "width": 1, "dash": "dot"},
    }


def _find_final_fitness(island: IslandSummary) -> float:
    """Find the fitness after refinement, or else before it; the worst if it is not finite."""
    fitness = island.champion_rms if island.refined_rms is None else island.refined_rms
    return fitness if np.isfinite(fitness) else np.inf


def _add_parameter_plot(
    figure: Figure, run: SearchTraces, number: int, parameter: Parameter, domain: PlotArea
) -> None:
    axis_names = add_axes(
        figure,
        number,
        domain,
        {
            "rangemode": "tozero",
            "nticks": 5,
            **({} if number == 0 else {"matches": "x"}),
        },
        {"nticks": 5, **_bounds_axis(parameter)},
    )
    end = _last_abscissa(run, "generations")
    for island, points in enumerate(run.history):
        if points:
            x, thinned = _step_points(points, "generations", end)
            y: Floats = np.array([p.parameters[number] for p in thinned], dtype=np.float64)
            figure["data"].append(
                {
                    "type": "scatter",
                    "mode": "lines",
                    "name": f"{parameter.name}, island {island + 1}",
                    "x": x,
                    "y": to_json_numbers(y),
                    "xaxis": axis_names["xaxis"],
                    "yaxis": axis_names["yaxis"],
                    "line": {**theme.series_style(island), "shape": "hv"},
                    "hovertemplate": f"island {island + 1}<br>%{{x}}: %{{y:.6g}}<extra></extra>",
                }
            )
    figure["layout"]["shapes"] += [
        _bound_line(bound, axis_names) for bound in (parameter.lower, parameter.upper)
    ]
    estimate = run.estimates.get(parameter.name)
    add_caption(figure, _write_caption(parameter, estimate), domain)


def _bounds_axis(parameter: Parameter) -> dict[str, Any]:
    lower, upper = parameter.lower, parameter.upper
    if parameter.scale == "log":
        lower, upper = float(np.log10(lower)), float(np.log10(upper))
    room = 0.06 * (upper - lower)
    return {"range": [lower - room, upper + room], "type": parameter.scale}


def _bound_line(y: float, axis_names: dict[str, str]) -> dict[str, Any]:
    return {
        "type": "line",
        "xref": f"{axis_names['xaxis']} domain",
        "x0": 0,
        "x1": 1,
        "yref": axis_names["yaxis"],
        "y0": y,
        "y1": y,
        "layer": "below",
        "line": {"color": theme.HAIRLINE, "width": 1, "dash": "dash"},
    }


def _write_caption(parameter: Parameter, estimate: Estimate | None) -> str:
    if estimate is None:
        return append_unit(f"<b>{parameter.name}</b>", parameter.unit)
    text = join_estimate(estimate.value, find_shown_error(estimate.stderr, estimate.status))
    return f"<b>{parameter.name}</b> = {text}{plain_unit(parameter.unit)}"
