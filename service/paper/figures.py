"""Draw the study's figures that compare methods, in the layout of `sysid.figures.plotly`."""

from collections.abc import Mapping, Sequence
from math import ceil, floor, log10
from typing import Any

import numpy as np

from service.paper.bench import MethodRun
from sysid.core.text import append_unit
from sysid.figures import theme
from sysid.figures.data import Floats
from sysid.figures.plotly import Figure, base_layout, to_json_numbers

Line = dict[str, Any]
_METHOD_STYLES: Mapping[str, dict[str, Any]] = {
    "simple": {"color": theme.VERMILLION, "dash": "dash", "width": 1.6},
    "improved-paper": {"color": theme.PURPLE, "dash": "dashdot", "width": 1.6},
    "improved": {"color": theme.BLUE, "dash": "solid", "width": 2},
}
HEIGHT_PX = 320
PLOT_GAP = 0.07  # half the gap between two plots, as a share of the width


def method_style(method: str) -> dict[str, Any]:
    """Return colour and dash of a method, the same in every figure."""
    return dict(_METHOD_STYLES[method])


def line_trace(name: str, x: Sequence[float], y: Sequence[float | None], **looks: Any) -> Line:
    """Build a line of a figure."""
    values = to_json_numbers(float("nan") if v is None else v for v in y)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": to_json_numbers(x),
        "y": values,
        **looks,
    }


def make_axis(title: str, **options: Any) -> dict[str, Any]:
    """Build an axis with its title."""
    return {"title": {"text": title}, **options}


def plot_lines(data: list[Line], x: str, y: str, **layout: Any) -> Figure:
    """Draw lines in one pair of axes."""
    return {
        "data": data,
        "layout": base_layout(
            HEIGHT_PX, **{"xaxis": make_axis(x), "yaxis": make_axis(y), **layout}
        ),
    }


def plot_convergence(
    runs: Mapping[str, MethodRun], names: Sequence[str], true: Mapping[str, float]
) -> Figure:
    """Draw the champion's parameters over the generations, by method, one plot per parameter."""
    end = _last_generation(runs)
    data: list[Line] = []
    axes: dict[str, Any] = {}
    width = 1 / len(names)
    for number, name in enumerate(names):
        tag = "" if number == 0 else str(number + 1)
        axis_names = {"xaxis": f"x{tag}", "yaxis": f"y{tag}", "showlegend": number == 0}
        for method, run in runs.items():
            x = [float(point.generation) for point in run.progress]
            y = [point.parameters[name] for point in run.progress]
            looks = {**method_style(method), "shape": "hv"}
            data.append(line_trace(method, [*x, end], [*y, y[-1]], line=looks, **axis_names))
        if name in true:
            level = {"color": theme.GREY, "dash": "dot", "width": 1.6}
            data.append(
                line_trace("true value", [0, end], [true[name]] * 2, line=level, **axis_names)
            )
        last = number + 1 == len(names)
        span = {
            "domain": [
                number * width + (PLOT_GAP if number else 0),
                (number + 1) * width - (0 if last else PLOT_GAP),
            ]
        }
        axes[f"xaxis{tag}"] = make_axis("generation", anchor=f"y{tag}", rangemode="tozero", **span)
        unit = next(iter(runs.values())).get_parameter(name)["unit"]
        axes[f"yaxis{tag}"] = make_axis(append_unit(name, unit), anchor=f"x{tag}")
    return {"data": data, "layout": base_layout(HEIGHT_PX, **axes)}


def plot_rms_history(
    runs: Mapping[str, MethodRun], unit: str, noise: float | None = None, *, scale: float = 1.0
) -> Figure:
    """Draw the champion's RMS over the generations, by method, and the noise's deviation.

    `scale` converts the results' unit into `unit`, which is also the unit of `noise`.
    """
    end = _last_generation(runs)
    data = []
    for method, run in runs.items():
        x = [float(point.generation) for point in run.progress]
        y = [scale * point.rms for point in run.progress]
        looks = {**method_style(method), "shape": "hv"}
        data.append(line_trace(method, [*x, end], [*y, y[-1]], line=looks))
    if noise is not None:
        level = {"color": theme.GREY, "dash": "dot", "width": 1.6}
        data.append(line_trace("noise", [0, end], [noise] * 2, line=level))
    values = [scale * point.rms for run in runs.values() for point in run.progress]
    marks = decade_marks(min(values), max(values))
    log = make_axis(f"RMS [{unit}]", type="log", tickvals=marks, ticktext=[f"{v:g}" for v in marks])
    return plot_lines(
        data, "generation", "", xaxis=make_axis("generation", rangemode="tozero"), yaxis=log
    )


def decade_marks(low: float, high: float) -> list[float]:
    """Compute ticks 1, 2, 5, 10 … of a logarithmic axis; Plotly's own ticks omit the zeros."""
    if not 0 < low <= high:
        return []
    first, last = floor(log10(low)) - 1, ceil(log10(high)) + 1
    marks = [float(f"{digit}e{power}") for power in range(first, last) for digit in (1, 2, 5)]
    below = max((v for v in marks if v <= low), default=marks[0])
    above = min((v for v in marks if v >= high), default=marks[-1])
    visible = [v for v in marks if below <= v <= above]
    return visible if len(visible) <= 9 else [v for v in visible if f"{v:e}".startswith("1")]


def plot_responses(runs: Mapping[str, MethodRun], experiment: int = 0) -> Figure:
    """Draw the measured output and each method's model output; below, the residuals."""
    first = next(iter(runs.values())).response["experiments"][experiment]["measured"][0]
    dots = {"mode": "markers", "marker": {"color": theme.GREY, "size": 4}}
    data = [line_trace("measured", first["times"], first["values"], **dots)]
    for method, run in runs.items():
        shown = run.response["experiments"][experiment]
        series, measured = shown["simulated"][0], shown["measured"][0]
        looks = method_style(method)
        data.append(line_trace(method, series["times"], series["values"], line=looks))
        interpolated = np.interp(measured["times"], series["times"], _to_array(series["values"]))
        rest = (_to_array(measured["values"]) - interpolated).tolist()
        thin = {**looks, "width": 1}
        data.append(
            line_trace(method, measured["times"], rest, line=thin, yaxis="y2", showlegend=False)
        )
    unit = first["unit"]
    axes = {
        "xaxis": make_axis("time [s]", anchor="y2"),
        "yaxis": make_axis(append_unit(first["name"], unit), domain=[0.42, 1]),
        "yaxis2": make_axis(append_unit("residual", unit), domain=[0, 0.32], nticks=4),
    }
    return {"data": data, "layout": base_layout(HEIGHT_PX + 100, **axes)}


def _to_array(values: Sequence[float | None]) -> Floats:
    return np.array([np.nan if v is None else v for v in values], dtype=np.float64)


def band_trace(
    x: Sequence[float], lower: Sequence[float], upper: Sequence[float], method: str
) -> Line:
    """Draw the area between two lines in the method's colour."""
    colour = theme.SHADE if method == "" else theme.fade(method_style(method)["color"], 0.16)
    around = [*x, *reversed(x)], [*upper, *reversed(lower)]
    return line_trace(
        "",
        *around,
        fill="toself",
        fillcolor=colour,
        line={"width": 0},
        hoverinfo="skip",
        showlegend=False,
    )


def marker_trace(name: str, x: Sequence[float], y: Sequence[float], method: str) -> Line:
    """Draw single runs of a method."""
    marker = {"color": method_style(method)["color"], "size": 4, "opacity": 0.45}
    return line_trace(name, x, y, mode="markers", marker=marker, showlegend=False)


def _last_generation(runs: Mapping[str, MethodRun]) -> float:
    return float(max(run.run["generations"] for run in runs.values()))
