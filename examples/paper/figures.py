"""Draw the figures that compare the methods."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from plotly.graph_objects import Figure, Scatter
from plotly.subplots import make_subplots

from examples.paper.bench import MethodRun

# Colours of Okabe and Ito, which the colour-blind can tell apart.
BLUE, VERMILLION, GREEN = "#2a83c4", "#d55e00", "#00916a"
PURPLE, OCHRE, GREY = "#b9619b", "#b5830f", "#8a929b"
COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, OCHRE)
METHOD_LINES: Mapping[str, Mapping[str, Any]] = {
    "simple": {"color": VERMILLION, "dash": "dash", "width": 1.6},
    "improved-paper": {"color": PURPLE, "dash": "dashdot", "width": 1.6},
    "improved": {"color": BLUE, "dash": "solid", "width": 2},
}
LEVEL = {"color": GREY, "dash": "dot", "width": 1.6}
"""Line of a value that the others are compared with."""


def make_line(
    name: str,
    x: Sequence[float],
    y: Sequence[float | None],
    line: Mapping[str, Any],
    **options: Any,
) -> Scatter:
    """Make a line of a figure; None is a gap."""
    return Scatter(name=name, x=x, y=y, mode="lines", line=dict(line), **options)


def make_points(name: str, x: Sequence[float], y: Sequence[float], method: str) -> Scatter:
    """Make the points of single runs of a method."""
    marker = {"color": METHOD_LINES[method]["color"], "size": 4, "opacity": 0.45}
    return Scatter(name=name, x=x, y=y, mode="markers", marker=marker, showlegend=False)


def make_band(
    x: Sequence[float], lower: Sequence[float], upper: Sequence[float], method: str
) -> Scatter:
    """Make the area between two lines, in the colour of a method."""
    return Scatter(
        x=[*x, *reversed(x)],
        y=[*upper, *reversed(lower)],
        mode="lines",
        line={"width": 0},
        fill="toself",
        fillcolor=METHOD_LINES[method]["color"],
        opacity=0.16,
        hoverinfo="skip",
        showlegend=False,
    )


def draw_lines(traces: Sequence[Scatter], x: str, y: str, **y_axis: Any) -> Figure:
    """Draw lines in one pair of axes with these titles."""
    figure = Figure(list(traces)).update_xaxes(title=x).update_yaxes(title=y, **y_axis)
    return _set_layout(figure, 320)


def draw_rms_history(
    runs: Mapping[str, MethodRun], unit: str, noise: float | None = None, *, scale: float = 1.0
) -> Figure:
    """Draw the champion's RMS over the generations, by method, and the noise's deviation.

    `scale` converts the results' unit into `unit`, which is also the unit of `noise`.
    """
    end = _find_last_generation(runs)
    traces = [
        _draw_steps(method, run, [scale * point.rms for point in run.progress], end)
        for method, run in runs.items()
    ]
    if noise is not None:
        traces.append(make_line("noise", [0, end], [noise] * 2, LEVEL))
    log = {"type": "log", "dtick": "D2", "minorloglabels": "complete", "exponentformat": "none"}
    return draw_lines(traces, "generation", f"RMS [{unit}]", **log)


def draw_convergence(
    runs: Mapping[str, MethodRun], names: Sequence[str], true: Mapping[str, float]
) -> Figure:
    """Draw the champion's parameters over the generations, by method, one plot per parameter."""
    end = _find_last_generation(runs)
    figure = make_subplots(cols=len(names), horizontal_spacing=0.14)
    for column, name in enumerate(names, 1):
        for method, run in runs.items():
            values = [point.parameters[name] for point in run.progress]
            trace = _draw_steps(method, run, values, end).update(showlegend=column == 1)
            figure.add_trace(trace, 1, column)
        level = make_line("true value", [0, end], [true[name]] * 2, LEVEL, showlegend=column == 1)
        figure.add_trace(level, 1, column)
        unit = next(iter(runs.values())).get_parameter(name)["unit"]
        figure.update_yaxes(title=f"{name} [{unit}]", col=column)
    return _set_layout(figure.update_xaxes(title="generation"), 320)


def draw_responses(runs: Mapping[str, MethodRun]) -> Figure:
    """Draw the measured output and each method's model output; below, the residuals."""
    figure = make_subplots(rows=2, shared_xaxes=True, row_heights=[0.65, 0.35])
    experiment = next(iter(runs.values())).response["experiments"][0]
    measured = experiment["measured"][0]
    times, values = measured["times"], _to_array(measured["values"])
    dots = {"color": GREY, "size": 4}
    figure.add_trace(Scatter(name="measured", x=times, y=values, mode="markers", marker=dots), 1, 1)
    for method, run in runs.items():
        simulated = run.response["experiments"][0]["simulated"][0]
        line = METHOD_LINES[method]
        figure.add_trace(make_line(method, simulated["times"], simulated["values"], line), 1, 1)
        fitted = np.interp(times, simulated["times"], _to_array(simulated["values"]))
        rest = (values - fitted).tolist()
        figure.add_trace(make_line(method, times, rest, line, showlegend=False), 2, 1)
    unit = measured["unit"]
    figure.update_yaxes(title=f"{measured['name']} [{unit}]", row=1)
    figure.update_yaxes(title=f"residual [{unit}]", row=2).update_xaxes(title="time [s]", row=2)
    return _set_layout(figure, 420)


def _draw_steps(method: str, run: MethodRun, values: Sequence[float], end: float) -> Scatter:
    """Draw what the champion had, from its first generation to the last of all methods."""
    generations = [float(point.generation) for point in run.progress]
    line = {**METHOD_LINES[method], "shape": "hv"}
    return make_line(method, [*generations, end], [*values, values[-1]], line)


def _find_last_generation(runs: Mapping[str, MethodRun]) -> float:
    return float(max(run.run["generations"] for run in runs.values()))


def _to_array(values: Sequence[float | None]) -> "np.ndarray[Any, np.dtype[np.float64]]":
    return np.array([np.nan if v is None else v for v in values], dtype=np.float64)


def _set_layout(figure: Figure, height: int) -> Figure:
    return figure.update_layout(
        template="plotly_white",
        height=height,
        margin={"l": 64, "r": 16, "t": 28, "b": 44},
        legend={"orientation": "h", "y": 1, "yanchor": "bottom"},
    )
