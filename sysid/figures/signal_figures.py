"""Draw signals over time: measured against identified output, and the channels of a dataset."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np

from sysid.core.findings import Finding
from sysid.core.text import bracket_unit, plain_unit
from sysid.figures import theme
from sysid.figures.data import (
    DisturbanceTraces,
    ExperimentTraces,
    Floats,
    OutputTraces,
    SignalTrace,
)
from sysid.figures.plotly import MARGIN, Figure, base_layout, to_json_numbers
from sysid.figures.theme import MAX_POINTS, thin_indices, window_slice

T = TypeVar("T")
_GAP_PX = 20
_MOST_MARKS = 100  # of a finding in a plot
_HISTORY_FRACTION = 0.1  # drawn input history before the record, as a share of its duration
_OUTPUT_PX, _RESIDUAL_PX, _INPUT_PX, _SIGNAL_PX = 240, 84, 110, 120
_DISTURBANCE_PX = 180


def plot_response(
    experiment: ExperimentTraces, start: float | None = None, stop: float | None = None
) -> Figure:
    """Draw measured and identified outputs, residuals below each, then inputs, over one time axis.

    Parameters
    ----------
    start, stop : float, optional
        Draw only this range (s), so that a zoom shows more of the samples.
    """
    figure = stack_plots(_response_heights(len(experiment.outputs), len(experiment.inputs)))
    for number, output in enumerate(experiment.outputs):
        span = window_slice(output.measured.times, start, stop)
        figure["data"] += _band_traces(output, span, f"y{2 * number + 1}", number == 0)
        figure["data"] += _output_traces(output, span, f"y{2 * number + 1}", number == 0)
        figure["data"].append(_residual_trace(output, span, f"y{2 * number + 2}", number == 0))
        unit = bracket_unit(output.measured.unit)
        name_axis(figure, 2 * number + 1, f"{output.measured.name}{unit}")
        name_axis(figure, 2 * number + 2, f"residual<br>{unit}")
    for number, signal in enumerate(experiment.inputs, 2 * len(experiment.outputs) + 1):
        span = window_slice(signal.times, start, stop)
        figure["data"].append(signal_line(signal, span, f"y{number}", theme.GREEN, legend=True))
        history = _recent_history(signal, _HISTORY_FRACTION * _record_duration(experiment))
        figure["data"] += _history_traces(history, start, stop, f"y{number}", theme.GREEN)
        name_axis(figure, number, f"{signal.name}{bracket_unit(signal.unit)}")
    figure["layout"].update(_validation_shading(experiment), uirevision=experiment.name)
    traces = [output.measured for output in experiment.outputs] + list(experiment.inputs)
    figure["layout"]["meta"] = {"thinned": _is_thinned(traces)}
    return figure


def plot_comparison(
    compared: Sequence[tuple[str, ExperimentTraces]],
    start: float | None = None,
    stop: float | None = None,
) -> Figure:
    """Draw identified outputs of several results, each over the measured one it was fitted to.

    Results on one record share its measured output. Records that begin at different times are
    drawn from zero.

    Parameters
    ----------
    compared : sequence of (name, experiment)
        Results of one experiment each. Outputs of the same position and unit share a plot, and so
        do inputs.
    start, stop : float, optional
        Draw only this range (s).
    """
    aligned = _align_starts(compared)
    outputs = _group_plots(
        (one.measured, _Compared(index, name, number, one))
        for index, (name, experiment) in enumerate(aligned)
        for number, one in enumerate(experiment.outputs)
    )
    inputs = _group_plots(
        (one, _Compared(index, name, number, one))
        for index, (name, experiment) in enumerate(aligned)
        for number, one in enumerate(experiment.inputs)
    )
    figure = stack_plots(_response_heights(len(outputs), len(inputs)))
    for number, plot in enumerate(outputs):
        figure["data"] += _compare_outputs(plot, number, (start, stop))
        unit = bracket_unit(plot[0][0].unit)
        name_axis(figure, 2 * number + 1, f"{_join_names(plot)}{unit}")
        name_axis(figure, 2 * number + 2, f"residual<br>{unit}")
    for number, drives in enumerate(inputs, 2 * len(outputs) + 1):
        figure["data"] += _compare_inputs(drives, f"y{number}", (start, stop))
        name_axis(figure, number, f"{_join_names(drives)}{bracket_unit(drives[0][0].unit)}")
    if len({signal.times[-1] for plot in outputs for signal, _ in plot}) == 1:
        figure["layout"].update(_validation_shading(aligned[0][1]))
    if aligned is not compared:
        figure["layout"]["xaxis"]["title"]["text"] = "time since the start of each record [s]"
    measured = [signal for plot in outputs for signal, _ in plot]
    figure["layout"]["meta"] = {"thinned": _is_thinned(measured)}
    return figure


@dataclass(frozen=True, slots=True)
class _Compared(Generic[T]):
    """A signal of one of the compared results: its index among them, name, and number."""

    index: int
    name: str
    number: int
    signal: T


_Plot: TypeAlias = list[tuple[SignalTrace, list[_Compared[T]]]]
"""What shares a plot: different recorded signals, each with the results that have it."""


def _align_starts(
    compared: Sequence[tuple[str, ExperimentTraces]],
) -> Sequence[tuple[str, ExperimentTraces]]:
    """Let every record begin at zero, unless all begin at the same time."""
    starts = [_find_start(experiment) for _, experiment in compared]
    if len(set(starts)) == 1:
        return compared
    return [
        (name, _shift_times(experiment, since))
        for (name, experiment), since in zip(compared, starts, strict=True)
    ]


def _find_start(experiment: ExperimentTraces) -> float:
    # A recursion does not score its first outputs, so the inputs tell where the record begins.
    signals = experiment.inputs or [output.measured for output in experiment.outputs]
    return min((float(signal.times[0]) for signal in signals), default=0.0)


def _shift_times(experiment: ExperimentTraces, since: float) -> ExperimentTraces:
    def shift(signal: SignalTrace) -> SignalTrace:
        return replace(signal, times=signal.times - since)

    return replace(
        experiment,
        outputs=tuple(
            replace(output, measured=shift(output.measured)) for output in experiment.outputs
        ),
        inputs=tuple(map(shift, experiment.inputs)),
        validation_from=None
        if experiment.validation_from is None
        else experiment.validation_from - since,
    )


def _group_plots(entries: Iterable[tuple[SignalTrace, _Compared[T]]]) -> list[_Plot[T]]:
    """Group signals: equal samples are one signal; the same number and unit are one plot."""
    plots: dict[tuple[int, str], _Plot[T]] = {}
    for signal, entry in entries:
        for other, sharing in (pair for plot in plots.values() for pair in plot):
            if _has_same_samples(signal, other):
                sharing.append(entry)
                break
        else:
            plots.setdefault((entry.number, signal.unit), []).append((signal, [entry]))
    return list(plots.values())


def _has_same_samples(signal: SignalTrace, other: SignalTrace) -> bool:
    return np.array_equal(signal.times, other.times) and np.array_equal(
        signal.values, other.values, equal_nan=True
    )


def _join_names(plot: _Plot[T]) -> str:
    return " / ".join(dict.fromkeys(signal.name for signal, _ in plot))


def _compare_outputs(
    plot: _Plot[OutputTraces], number: int, window: tuple[float | None, float | None]
) -> Iterator[dict[str, Any]]:
    """Draw the measured signals of a plot, and over each the outputs of its results."""
    upper, lower = f"y{2 * number + 1}", f"y{2 * number + 2}"
    for signal, sharing in plot:
        span = window_slice(signal.times, *window)
        is_new = number == 0 or (len(plot) > 1 and sharing[0].number == 0)
        measured = _output_traces(sharing[0].signal, span, upper, is_new)[0]
        yield measured if len(plot) == 1 else _name_measured(measured, signal, sharing)
        for one in sharing:
            look = {"legendgroup": one.name, "line": theme.series_style(one.index)}
            hover = f"%{{y:.6~g}}{plain_unit(signal.unit)}<extra>{one.name}</extra>"
            # The legend names each result once, wherever its first output is drawn.
            identified = _output_traces(one.signal, span, upper, one.number == 0)[-1]
            yield {**identified, **look, "name": one.name, "hovertemplate": hover}
            yield {
                **_residual_trace(one.signal, span, lower, False),
                **look,
                "name": one.name,
                "hovertemplate": hover.replace("</extra>", ", residual</extra>"),
            }


def _name_measured(
    trace: dict[str, Any], signal: SignalTrace, sharing: Sequence[_Compared[OutputTraces]]
) -> dict[str, Any]:
    """Name a measured signal by the first of its results, and give it a shade of its colour."""
    first, name = sharing[0], f"measured, {sharing[0].name}"
    shade = theme.fade(theme.series_style(first.index)["color"], 0.45)
    kind = "marker" if trace["mode"] == "markers" else "line"
    hover = f"%{{y:.6~g}}{plain_unit(signal.unit)}<extra>{name}</extra>"
    return {
        **trace,
        "name": name,
        "legendgroup": first.name,
        kind: {**trace[kind], "color": shade},
        "hovertemplate": hover,
    }


def _compare_inputs(
    plot: _Plot[SignalTrace], axis: str, window: tuple[float | None, float | None]
) -> Iterator[dict[str, Any]]:
    for signal, sharing in plot:
        span, first = window_slice(signal.times, *window), sharing[0]
        colour = theme.GREY if len(plot) == 1 else theme.series_style(first.index)["color"]
        line = signal_line(signal, span, axis, colour, legend=False)
        if len(plot) > 1:
            line |= {"name": f"{signal.name}, {first.name}", "legendgroup": first.name}
            line["hovertemplate"] = line["hovertemplate"].replace(
                "</extra>", f", {first.name}</extra>"
            )
        yield line


def response_height(n_outputs: int, n_inputs: int) -> int:
    """Compute the height (px) of a response, so that a page can reserve its room."""
    return _stack_height(_response_heights(n_outputs, n_inputs))


def signals_height(n_channels: int) -> int:
    """Compute the height (px) of the channels of a dataset."""
    return _stack_height([_SIGNAL_PX] * n_channels)


def plot_signals(
    channels: Sequence[SignalTrace],
    start: float | None = None,
    stop: float | None = None,
    findings: Sequence[Finding] = (),
) -> Figure:
    """Draw the channels of a dataset, one below the other, and mark where something happened."""
    figure = stack_plots([_SIGNAL_PX] * len(channels))
    for number, signal in enumerate(channels, 1):
        span = window_slice(signal.times, start, stop)
        colour = theme.SERIES_COLOURS[(number - 1) % len(theme.SERIES_COLOURS)]
        figure["data"].append(signal_line(signal, span, f"y{number}", colour, legend=False))
        figure["data"] += _history_traces(signal.history, start, stop, f"y{number}", colour)
        name_axis(figure, number, f"{signal.name}{bracket_unit(signal.unit)}")
    figure["layout"]["meta"] = {"thinned": _is_thinned(channels)}
    numbers = {signal.name: number for number, signal in enumerate(channels, 1)}
    marks = [
        _mark_span(numbers[name], span, finding.explanation if position == 0 else "")
        for finding in findings
        for name in finding.channels
        if name in numbers
        for position, span in enumerate(finding.spans[:_MOST_MARKS])
    ]
    if marks:
        figure["layout"]["shapes"] = [shape for shape, _ in marks]
        figure["layout"]["annotations"] = [note for _, note in marks if note["text"]]
    return figure


def _mark_span(
    number: int, span: tuple[float, float], text: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Mark a span of time (s) in a numbered plot of a stack: its shade, and its name."""
    axis = f"{axis_id(f'y{number}')} domain"
    shape = {
        "type": "rect",
        "x0": span[0],
        "x1": span[1],
        "y0": 0,
        "y1": 1,
        "yref": axis,
        "fillcolor": theme.MARK,
        "line": {"width": 1, "color": theme.MARK},
        "layer": "below",
    }
    note = {
        "text": text,
        "x": span[0],
        "y": 1,
        "yref": axis,
        "xanchor": "left",
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 11},
    }
    return shape, note


def plot_disturbances(
    record: DisturbanceTraces, start: float | None = None, stop: float | None = None
) -> Figure:
    """Draw the estimated disturbances of a record with their bands, one below the other."""
    figure = stack_plots([_DISTURBANCE_PX] * len(record.disturbances))
    for number, (signal, band) in enumerate(record.disturbances, 1):
        span, axis = window_slice(signal.times, start, stop), f"y{number}"
        figure["data"] += _draw_band(
            "95 % band", signal, band, span, axis, opacity=0.3, in_legend=number == 1
        )
        line = signal_line(signal, span, axis, theme.BLUE, legend=number == 1)
        figure["data"].append({**line, "name": "estimate"})
        name_axis(figure, number, f"{signal.name}{bracket_unit(signal.unit)}")
    thinned = _is_thinned([signal for signal, _ in record.disturbances])
    figure["layout"].update(uirevision=record.name, meta={"thinned": thinned})
    return figure


def disturbance_height(count: int) -> int:
    """Compute the height (px) of so many disturbances, so that a page can reserve its room."""
    return _stack_height([_DISTURBANCE_PX] * count)


def _response_heights(n_outputs: int, n_inputs: int) -> list[int]:
    return [_OUTPUT_PX, _RESIDUAL_PX] * n_outputs + [_INPUT_PX] * n_inputs


def _stack_height(rows: Sequence[int]) -> int:
    return sum(rows) + _GAP_PX * max(len(rows) - 1, 0) + MARGIN["t"] + MARGIN["b"]


def _is_thinned(traces: Sequence[SignalTrace]) -> bool:
    """Whether the whole view omits samples that a zoom would show."""
    return any(trace.times.size > MAX_POINTS for trace in traces)


def stack_plots(heights: Sequence[int]) -> Figure:
    """Build empty plots of these heights (px), one below the other over one time axis."""
    total = sum(heights) + _GAP_PX * max(len(heights) - 1, 0)
    shared: dict[str, Any] = base_layout(
        _stack_height(heights),
        xaxis={
            "title": {"text": "time [s]"},
            "anchor": f"y{max(len(heights), 1)}",
            "showspikes": True,
            "spikemode": "across",
            "spikesnap": "cursor",
            "spikethickness": 1,
            "spikedash": "dot",
            "unifiedhovertitle": {"text": "%{x:.6~g} s"},
        },
        hovermode="x unified",
        hoversubplots="axis",  # one cursor and one box for all plots
    )
    top = total
    for number, height in enumerate(heights, 1):
        domain = [max((top - height) / total, 0.0), top / total]
        shared[f"yaxis{number if number > 1 else ''}"] = {
            "domain": domain,
            "anchor": "x",
            "nticks": 5 if height < _OUTPUT_PX else 7,
        }
        top -= height + _GAP_PX
    return {"data": [], "layout": shared}


def name_axis(figure: Figure, number: int, text: str) -> None:
    """Write the name of the numbered axis (from 1) of a stack."""
    figure["layout"][f"yaxis{number if number > 1 else ''}"]["title"] = {
        "text": text,
        "standoff": 6,
        "font": {"size": 11},
    }


def axis_id(name: str) -> str:
    """Plotly's name of an axis; the first has no number."""
    return "y" if name == "y1" else name


def _output_traces(
    output: OutputTraces, span: slice, axis: str, in_legend: bool
) -> list[dict[str, Any]]:
    times, values = output.measured.times[span], output.measured.values[span]
    shown = thin_indices(values, MAX_POINTS)
    identified, unit = output.identified[span], plain_unit(output.measured.unit)
    also = thin_indices(identified, MAX_POINTS)
    shared = {"type": "scatter", "yaxis": axis_id(axis), "showlegend": in_legend}
    return [
        {
            **shared,
            "name": "measured",
            "x": to_json_numbers(times[shown]),
            "y": to_json_numbers(values[shown]),
            **_choose_measured_style(times, shown.size),
            "hovertemplate": f"%{{y:.6~g}}{unit}<extra>measured</extra>",
        },
        {
            **shared,
            "name": "identified",
            "mode": "lines",
            "x": to_json_numbers(times[also]),
            "y": to_json_numbers(identified[also]),
            "line": {"color": theme.BLUE, "width": 1.6},
            "hovertemplate": f"%{{y:.6~g}}{unit}<extra>identified</extra>",
        },
    ]


def _band_traces(
    output: OutputTraces, span: slice, axis: str, in_legend: bool
) -> list[dict[str, Any]]:
    """Draw the bands below the lines, the wider one first."""
    if output.bands is None:
        return []
    identified = replace(output.measured, values=output.identified)
    wider, narrower = (
        _draw_band(name, identified, ends, span, axis, opacity=opacity, in_legend=in_legend)
        for name, ends, opacity in (
            ("95 % prediction band", output.bands.prediction, 0.14),
            ("95 % confidence band", output.bands.confidence, 0.4),
        )
    )
    return [*wider, *narrower]


def _draw_band(
    name: str,
    signal: SignalTrace,
    ends: Floats,
    span: slice,
    axis: str,
    *,
    opacity: float,
    in_legend: bool,
) -> list[dict[str, Any]]:
    """Draw the area between the ends (N, 2) of a band about a signal, at times of its line."""
    shown = thin_indices(signal.values[span], MAX_POINTS)
    edge = {
        "type": "scatter",
        "mode": "lines",
        "yaxis": axis_id(axis),
        "x": to_json_numbers(signal.times[span][shown]),
        "line": {"width": 0},
        "hoverinfo": "skip",
    }
    low, high = (to_json_numbers(end) for end in ends[span][shown].T)
    area = {"fill": "tonexty", "fillcolor": theme.fade(theme.BLUE, opacity)}
    return [
        {**edge, "name": f"{name}, lower end", "y": low, "showlegend": False},
        {**edge, "name": name, "y": high, "showlegend": in_legend, **area},
    ]


def _choose_measured_style(times: Floats, drawn: int) -> dict[str, Any]:
    """Choose points if single samples are distinguishable or share a time, else a line."""
    pooled = bool(np.any(np.diff(times) <= 0))
    if pooled or drawn <= 400:
        return {"mode": "markers", "marker": {"color": theme.GREY, "size": 3 if pooled else 4}}
    return {"mode": "lines", "line": {"color": theme.GREY, "width": 2.4}}


def _residual_trace(
    output: OutputTraces, span: slice, axis: str, in_legend: bool
) -> dict[str, Any]:
    times = output.measured.times[span]
    values = output.measured.values[span] - output.identified[span]
    shown = thin_indices(values, MAX_POINTS)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": "residual",
        "yaxis": axis_id(axis),
        "showlegend": in_legend,
        "x": to_json_numbers(times[shown]),
        "y": to_json_numbers(values[shown]),
        "line": {"color": theme.VERMILLION, "width": 1},
        "hovertemplate": f"%{{y:.4~g}}{plain_unit(output.measured.unit)}<extra>residual</extra>",
    }


def signal_line(
    signal: SignalTrace, span: slice, axis: str, colour: str, *, legend: bool
) -> dict[str, Any]:
    """Draw a signal as one line of a stack, thinned to what a screen shows."""
    times, values = signal.times[span], signal.values[span]
    shown = thin_indices(values, MAX_POINTS)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": signal.name,
        "yaxis": axis_id(axis),
        "showlegend": legend,
        "x": to_json_numbers(times[shown]),
        "y": to_json_numbers(values[shown]),
        "line": {"color": colour, "width": 1.2, "shape": "hv" if signal.is_held else "linear"},
        "hovertemplate": f"%{{y:.6~g}}{plain_unit(signal.unit)}<extra>{signal.name}</extra>",
    }


def _record_duration(experiment: ExperimentTraces) -> float:
    return max((float(np.ptp(output.measured.times)) for output in experiment.outputs), default=0.0)


def _recent_history(signal: SignalTrace, seconds: float) -> SignalTrace | None:
    """Cut a signal's history to its end; all of it could fill half of the plot."""
    if signal.history is None:
        return None
    first = int(np.searchsorted(signal.history.times, signal.times[0] - seconds))
    times, values = signal.history.times[first:], signal.history.values[first:]
    return replace(signal.history, times=times, values=values)


def _history_traces(
    history: SignalTrace | None, start: float | None, stop: float | None, axis: str, colour: str
) -> list[dict[str, Any]]:
    """Draw a signal's history before its first sample as a dotted line in the same row."""
    if history is None or not history.times.size:
        return []
    drawn = signal_line(
        history, window_slice(history.times, start, stop), axis, colour, legend=False
    )
    label = f"{history.name}, before the record"
    look = {**drawn["line"], "dash": "dot"}
    hover_text = f"%{{y:.6~g}}{plain_unit(history.unit)}<extra>{label}</extra>"
    return [{**drawn, "name": label, "line": look, "hovertemplate": hover_text}]


def _validation_shading(experiment: ExperimentTraces) -> dict[str, Any]:
    """Shade and label the validation part."""
    since = experiment.validation_from
    if since is None or not experiment.outputs:
        return {}
    times = experiment.outputs[0].measured.times
    first = float(max(since, times[0]))
    return {
        "shapes": [
            {
                "type": "rect",
                "x0": first,
                "x1": float(times[-1]),
                "y0": 0,
                "y1": 1,
                "yref": "paper",
                "fillcolor": theme.SHADE,
                "line": {"width": 0},
                "layer": "below",
            }
        ],
        "annotations": [
            {
                "text": "validation",
                "x": first,
                "y": 1,
                "yref": "paper",
                "xanchor": "left",
                "yanchor": "top",
                "xshift": 4,
                "showarrow": False,
                "font": {"size": 11},
            }
        ],
    }
