"""Closed-loop simulation of a run's model with a PID controller, and its answer."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from service.control.control_schemas import (
    ControlIn,
    ControllerOut,
    MarginsOut,
    StepMetricsOut,
    TuningOut,
)
from service.core.errors import FieldError, InvalidRequest
from service.datasets.dataset_schemas import StepInput
from service.datasets.large_simulation import check_finite_outputs
from sysid.core.errors import InvalidSettings, suggest_name
from sysid.core.text import plain_unit
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording
from sysid.models.model import Model

if TYPE_CHECKING:  # these import the compiler, which most requests never need
    from sysid.control.controllers import PidControl
    from sysid.control.linear_form import IdentifiedModel

Simulate = Callable[[Model, Sequence[Channel], Mapping[str, float], FloatArray], Recording]
"""Simulates a model, with inputs and values, at some times."""

_REST_TOLERANCE = 0.02  # of a step: smaller movements count as rest
_LIMIT_TOLERANCE = 1e-9  # of the limit
_START_ADVICE = "the step metrics include its settling. Let the reference step later"
_STABILITY_ADVICE = "Choose a smaller gain, a longer integral time, or another sign"
_TUNING_ADVICE = "Choose another tuning rule, or set gain and times by hand"


@dataclass(frozen=True, slots=True)
class LoopResponse:
    """Response of a closed loop: outputs, plant input, controller command, and their assessment."""

    outputs: list[Channel]
    plant_input: Channel
    command: Channel
    notes: list[str]
    metrics: StepMetricsOut | None
    controller: ControllerOut
    tuning: TuningOut | None
    margins: MarginsOut | None


def simulate_closed_loop(
    model: Model,
    values: Mapping[str, float],
    times: FloatArray,
    reference: Channel,
    inputs: Sequence[Channel],
    control: ControlIn,
    simulate: Simulate,
) -> LoopResponse:
    """Simulate the model in a closed loop.

    Parameters
    ----------
    values : mapping of str to float
        Values of the model's parameters and initial states.
    times : FloatArray, shape (N,)
        Sampling times in s.
    inputs : sequence of Channel
        The inputs that are not controlled.
    simulate : callable
        Simulates a model, with inputs and values, at times.

    Raises
    ------
    InvalidRequest
        If the controller is invalid, or the loop diverges.
    """
    from sysid.control.closed_loop import close_loop
    from sysid.control.linear_form import IdentifiedModel
    from sysid.simulation.simulate import complete_values

    solver = model.solver
    step = (solver.step or float(times[1] - times[0])) / solver.substeps
    identified = IdentifiedModel.from_numbers(model, complete_values(model, values))
    try:
        used, tuning = _build_controller(identified, control)
        loop = close_loop(model, used, step)
    except InvalidSettings as error:
        raise InvalidRequest.from_fault(f"/control{error.pointer}", error.detail) from None
    signals = [replace(reference, name=loop.reference), *inputs]
    simulated = simulate(loop.model, signals, loop.complete_values(signals, values, times), times)
    margins = _compute_margins(identified, used)
    outputs = [simulated.channel(signal.name) for signal in model.outputs]
    _check_loop_finite(outputs, times, used.gain, step, margins, is_tuned=tuning is not None)
    command = simulated.channel(loop.command)
    metrics = _compute_step_metrics(times, outputs, control)
    notes = [] if tuning is None or used.has_derivative_action else list(_describe_tuning(tuning))
    if loop.controller_delay_steps:
        notes.append(
            f"the output responds without delay. The controller therefore acts {step:.4g} s late, "
            "as a sampled controller does"
        )
    controller = _to_controller_out(used, command.values)
    notes += [
        *_describe_start(times, outputs, control),
        *_describe_stability(metrics, margins, controller, is_tuned=tuning is not None),
    ]
    return LoopResponse(
        outputs, simulated.channel(loop.input), command, notes, metrics, controller, tuning, margins
    )


def find_control_faults(model: Model, control: ControlIn) -> Iterator[FieldError]:
    """Report unknown signals, and a controller that is set both by hand and by a tuning rule."""
    for role, name, signals in (
        ("input", control.input, [signal.name for signal in model.inputs]),
        ("output", control.output, [signal.name for signal in model.outputs]),
    ):
        if name not in signals:
            detail = f"the model has no {role} {name!r}{suggest_name(name, signals)}"
            yield FieldError(f"/control/{role}", detail)
    if control.tuning is None:
        if control.gain is None:
            yield FieldError(
                "/control/gain", "is missing. Give it, or give a tuning rule as 'tuning'"
            )
        return
    for name in ("gain", "integral_time", "derivative_time"):
        if getattr(control, name) != ControlIn.model_fields[name].default:
            detail = "the tuning rule chooses this value. Leave it out, or leave out 'tuning'"
            yield FieldError(f"/control/{name}", detail)


def check_transport_delay(control: ControlIn | None, duration: float) -> None:
    """Refuse a dead time that is longer than the simulation."""
    if control is not None and control.transport is not None:
        delay = control.transport.delay
        if delay >= duration:
            raise InvalidRequest.from_fault(
                "/control/transport/delay",
                f"found {delay:g} s, but the simulation lasts {duration:g} s. Simulate longer, "
                "or give a shorter delay",
            )


def suggest_controller(
    model: Model, values: Mapping[str, float], input: str, output: str
) -> dict[str, float] | None:
    """Suggest gain and integral time by SIMC for a PI controller; None if it has no answer."""
    from sysid.control.linear_form import IdentifiedModel
    from sysid.control.tuning import tune_controller

    try:
        tuned = tune_controller(IdentifiedModel.from_numbers(model, values), input, output)
    except InvalidSettings:
        return None
    return {"gain": tuned.gain, "integral_time": tuned.integral_time}


def _build_controller(
    identified: "IdentifiedModel", control: ControlIn
) -> tuple["PidControl", TuningOut | None]:
    """Build the controller from its settings or from a tuning rule."""
    from sysid.control.controllers import PidControl, Transport
    from sysid.control.tuning import tune_controller

    settings = control.model_dump(exclude={"reference", "transport", "tuning"})
    transport = None if control.transport is None else Transport(**control.transport.model_dump())
    tuning = None
    if control.tuning is not None:
        rule = control.tuning.model_dump()
        tuned = tune_controller(
            identified, control.input, control.output, transport=transport, **rule
        )
        for name in ("gain", "integral_time", "derivative_time"):
            settings[name] = getattr(tuned, name)
        process = tuned.process
        tuning = TuningOut.from_source(
            tuned,
            process_gain=process.gain,
            process_delay=process.delay,
            process_time_constant=process.time_constant,
            process_second_time_constant=process.second_time_constant,
        )
    return PidControl(transport=transport, **settings), tuning


def _compute_margins(identified: "IdentifiedModel", control: "PidControl") -> MarginsOut | None:
    """Compute the stability margins if the model has a transfer function in s."""
    from sysid.control.linear_form import NotLinear
    from sysid.control.margins import compute_margins

    try:
        return MarginsOut.from_source(compute_margins(identified, control))
    except NotLinear:
        return None


def _to_controller_out(used: "PidControl", command: FloatArray) -> ControllerOut:
    low, high = used.output_limits
    at_limit = np.zeros(command.size, dtype=np.bool_)
    for limit, sign in ((low, -1.0), (high, 1.0)):
        if limit is not None:
            at_limit |= sign * command >= sign * limit - _LIMIT_TOLERANCE * abs(limit)
    return ControllerOut.from_source(
        used,
        integral_time=used.integral_time if used.has_integral_action else None,
        lower=low,
        upper=high,
        tracking_time=used.active_tracking_time,
        command_min=float(np.min(command)),
        command_max=float(np.max(command)),
        saturated_percent=100.0 * float(np.mean(at_limit)),
    )


def _check_loop_finite(
    outputs: Sequence[Channel],
    times: FloatArray,
    gain: float,
    step: float,
    margins: MarginsOut | None,
    *,
    is_tuned: bool,
) -> None:
    """Refuse a loop that diverges.

    The cause is its gain, or simulation steps (s) that are too long for a stable loop.
    """
    try:
        check_finite_outputs(outputs, times)
    except InvalidRequest as error:
        [fault] = error.errors
        detail = fault.detail.removeprefix("with these values ").partition("; ")[0]
        if margins is not None and margins.is_stable:
            raise InvalidRequest.from_fault(
                "/sample_time",
                f"{detail}. The loop is stable, but steps of {step:.4g} s are too long to "
                "simulate it. Give a shorter sampling period",
            ) from None
        raise InvalidRequest.from_fault(
            "/control/tuning" if is_tuned else "/control/gain",
            f"found {gain:g}, with which the loop diverges: {detail}. "
            f"{_advise_stability(is_tuned)}",
        ) from None


def _compute_step_metrics(
    times: FloatArray, outputs: Sequence[Channel], control: ControlIn
) -> StepMetricsOut | None:
    """Compute the step metrics of the controlled output if the reference is a step."""
    from sysid.control.step_response import measure_step_response

    if not isinstance(control.reference, StepInput):
        return None
    step = control.reference
    if step.amplitude == 0 or np.count_nonzero(times >= step.time) < 2:
        return None
    [output] = [channel for channel in outputs if channel.name == control.output]
    metrics = measure_step_response(
        times, output.values, at=step.time, before=step.offset, after=step.offset + step.amplitude
    )
    return StepMetricsOut.from_source(metrics, output=output.name, unit=output.unit)


def _describe_tuning(tuning: TuningOut) -> Iterator[str]:
    if tuning.controller == "PID":
        yield "the model has no second time constant, so the rule gives a PI controller"


def _describe_start(
    times: FloatArray, outputs: Sequence[Channel], control: ControlIn
) -> Iterator[str]:
    """Warn if the loop may not be at rest when its reference steps."""
    if not isinstance(control.reference, StepInput):
        return
    step = control.reference
    [output] = [channel for channel in outputs if channel.name == control.output]
    band, earlier = _REST_TOLERANCE * abs(step.amplitude), output.values[times < step.time]
    if earlier.size:
        if np.ptp(earlier[-max(earlier.size // 4, 2) :]) > band:
            yield f"{output.name} still moves when the reference steps, so {_START_ADVICE}"
        return
    start = float(output.values[0])
    if abs(start - step.offset) <= band:
        return
    unit = plain_unit(output.unit)
    yield (
        f"{output.name} starts at {start:.4g}{unit} with a reference of {step.offset:.4g}{unit} "
        f"before the step. Unless the loop rests there, {_START_ADVICE}"
    )


def _advise_stability(is_tuned: bool) -> str:
    return _TUNING_ADVICE if is_tuned else _STABILITY_ADVICE


def _describe_stability(
    metrics: StepMetricsOut | None,
    margins: MarginsOut | None,
    controller: ControllerOut,
    *,
    is_tuned: bool,
) -> Iterator[str]:
    """Report a loop that is unstable or keeps oscillating."""
    if metrics is not None and metrics.swing is not None:
        unit = plain_unit(metrics.unit)
        decays = margins is not None and margins.is_stable and not controller.saturated_percent
        yield (
            f"{metrics.output} oscillates and does not settle: {metrics.swing:.4g}{unit} peak to "
            f"peak, period {metrics.swing_period:.4g} s"
            + (
                ". By its transfer function it decays, but too slowly for this record"
                if decays
                else ""
            )
        )
    if margins is not None and not margins.is_stable:
        yield (
            "the loop is unstable (by its transfer function, without the controller's limits). "
            f"{_advise_stability(is_tuned)}"
        )
