"""Draw a simulated run: the outputs with their reference, then inputs and command."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from service.control.control_schemas import ControllerOut, RunSimulationOut, StepMetricsOut
from service.datasets.dataset_schemas import SeriesOut
from sysid.core.text import bracket_unit
from sysid.figures import theme
from sysid.figures.data import SignalTrace
from sysid.figures.plotly import Figure
from sysid.figures.signal_figures import axis_id, name_axis, signal_line, stack_plots

_OUTPUT_PX, _INPUT_PX = 260, 120
_LEAD = 0.1
"""Share of the time after a step that is shown before it."""
_WHOLE_SPAN = slice(None)
_LINE_STYLE = {"layer": "below", "line": {"color": theme.HAIRLINE, "width": 1, "dash": "dot"}}


def plot_simulation(simulation: RunSimulationOut, step_time: float | None = None) -> Figure:
    """Draw outputs over time with the reference and the settling band, then the inputs.

    Parameters
    ----------
    step_time : float, optional
        Time (s) of the reference's step; the settling time counts from it.
    """
    below = list(simulation.inputs)
    if simulation.command is not None and _command_differs(simulation, simulation.command):
        below.append(simulation.command)
    figure = stack_plots([_OUTPUT_PX] * len(simulation.outputs) + [_INPUT_PX] * len(below))
    controlled = simulation.metrics.output if simulation.metrics else None
    for number, output in enumerate(simulation.outputs, 1):
        if simulation.reference is not None and controlled in (None, output.name):
            figure["data"].append(
                _signal_trace(simulation.reference, number, theme.GREY, dash="dash")
            )
        figure["data"].append(_signal_trace(output, number, theme.BLUE))
        name_axis(figure, number, f"{output.name}{bracket_unit(output.unit)}")
        if simulation.metrics is not None and output.name == controlled:
            figure["layout"]["shapes"] = [
                *_settling_shapes(simulation.metrics, number, step_time or 0.0)
            ]
    for number, signal in enumerate(below, len(simulation.outputs) + 1):
        is_command = signal is simulation.command
        colour = theme.VERMILLION if is_command else theme.GREEN
        figure["data"].append(_signal_trace(signal, number, colour))
        if simulation.command is not None and signal.values == simulation.command.values:
            figure["layout"].setdefault("shapes", []).extend(
                _limit_lines(simulation.controller, number)
            )
        name = "command" if is_command else signal.name
        name_axis(figure, number, f"{name}{bracket_unit(signal.unit)}")
    return figure


def begin_near_step(figure: Figure, step_time: float) -> None:
    """Leave out what was long before the step of the reference, such as the start of the loop."""
    for trace in figure["data"]:
        times = np.asarray(trace["x"], dtype=np.float64)
        if not times.size or step_time >= times[-1]:
            continue
        first = int(np.searchsorted(times, step_time - _LEAD * (times[-1] - step_time)))
        trace["x"], trace["y"] = trace["x"][first:], trace["y"][first:]


def apply_units(simulation: RunSimulationOut, units: Mapping[str, str]) -> RunSimulationOut:
    """Set the units of signals for which the model declares none."""

    def with_unit(series: SeriesOut) -> SeriesOut:
        return series.model_copy(update={"unit": units.get(series.name, series.unit)})

    changes: dict[str, Any] = {
        "outputs": [with_unit(output) for output in simulation.outputs],
        "inputs": [with_unit(signal) for signal in simulation.inputs],
    }
    if simulation.metrics is not None:
        unit = units.get(simulation.metrics.output, simulation.metrics.unit)
        changes["metrics"] = simulation.metrics.model_copy(update={"unit": unit})
    return simulation.model_copy(update=changes)


def _command_differs(simulation: RunSimulationOut, command: SeriesOut) -> bool:
    """Whether the command differs from all inputs, as with a transport between them."""
    return all(
        signal.values != command.values or signal.times != command.times
        for signal in simulation.inputs
    )


def _signal_trace(
    signal: SeriesOut, number: int, colour: str, dash: str = "solid"
) -> dict[str, Any]:
    values = np.array([np.nan if v is None else v for v in signal.values], dtype=np.float64)
    trace = SignalTrace(signal.name, signal.unit, np.array(signal.times, dtype=np.float64), values)
    drawn = signal_line(trace, _WHOLE_SPAN, axis_id(f"y{number}"), colour, legend=True)
    drawn["line"] = {**drawn["line"], "width": 1.6, "dash": dash}
    return drawn


def _limit_lines(controller: ControllerOut | None, number: int) -> Iterator[dict[str, Any]]:
    """Draw the lower and the upper limit of the controller."""
    if controller is None:
        return
    for limit in (controller.lower, controller.upper):
        if limit is not None:
            yield _horizontal_line(axis_id(f"y{number}"), limit)


def _horizontal_line(axis: str, height: float) -> dict[str, Any]:
    """Draw a dotted horizontal line over the whole width."""
    return {
        "type": "line",
        "xref": "paper",
        "x0": 0,
        "x1": 1,
        "yref": axis,
        "y0": height,
        "y1": height,
        **_LINE_STYLE,
    }


def _settling_shapes(
    metrics: StepMetricsOut, number: int, since: float
) -> Sequence[dict[str, Any]]:
    """Draw the 2 % band about the final value, and the settling time."""
    if metrics.final_value is None or metrics.settling_time is None:
        return []
    axis = axis_id(f"y{number}")
    edges = (metrics.final_value - metrics.band, metrics.final_value + metrics.band)
    band = [_horizontal_line(axis, y) for y in edges]
    settled = since + metrics.settling_time
    return [
        *band,
        {
            "type": "line",
            "x0": settled,
            "x1": settled,
            "yref": f"{axis} domain",
            "y0": 0,
            "y1": 1,
            **_LINE_STYLE,
        },
    ]
