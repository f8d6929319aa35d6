"""The loop that a request closes around a run's model: its controller, and what is told of it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from service.control.schemas import (
    ControlIn,
    ControllerOut,
    MarginsOut,
    StepMetricsOut,
    TuningIn,
    TuningOut,
)
from service.core.errors import FieldError, InvalidRequest
from service.core.text import plain_unit
from service.datasets.schemas import StepInput
from service.datasets.simulated import check_finite
from sysid.core.errors import InvalidSettings, nearest
from sysid.core.types import FloatArray
from sysid.data.records import Channel
from sysid.models.model import Model

if TYPE_CHECKING:  # the compiler comes with these, and most requests never need it
    from sysid.control.controllers import PidControl, Transport
    from sysid.control.linear_form import Identified


_SMALL = 0.02  # of a step: what moves or differs by less is at rest
_AT_LIMIT = 1e-9  # of the limit
_MORE = (
    "the measures tell of how it settles too, not of the step alone; give the states' starts, "
    "such as x(0), or a later step"
)


@dataclass(frozen=True, slots=True)
class Loop:
    """What a closed loop does: outputs, what enters the plant, what the controller gives."""

    outputs: list[Channel]
    entered: Channel
    command: Channel
    notes: list[str]
    metrics: StepMetricsOut | None
    controller: ControllerOut
    tuning: TuningOut | None
    margins: MarginsOut | None


def closed(
    model: Model, values: Mapping[str, float], times: FloatArray, reference: Channel,
    inputs: Sequence[Channel], control: ControlIn,
) -> Loop:  # fmt: skip
    """The model in the loop.

    Parameters
    ----------
    values : mapping of str to float
        Of the model's parameters and starts.
    times : FloatArray, shape (N,)
        In s.
    inputs : sequence of Channel
        Those that are not controlled.

    Raises
    ------
    InvalidRequest
        If the controller cannot be, or the loop diverges.
    """
    from sysid.control.closed_loop import close_loop

    solver = model.solver
    step = (solver.step or float(times[1] - times[0])) / solver.substeps
    identified = _identified(model, values)
    try:
        used, tuning = _controller(identified, control)
        loop = close_loop(model, used, step)
    except InvalidSettings as error:
        raise InvalidRequest.at(f"/control{error.pointer}", error.detail) from None
    found = loop.simulate([replace(reference, name=loop.reference), *inputs], values, times=times)
    margins = _margins(identified, used)
    outputs = [found.channel(one.name) for one in model.outputs]
    _check_finite(outputs, times, used.gain, step, margins, is_tuned=tuning is not None)
    command = found.channel(loop.command)
    metrics = _metrics(times, outputs, control)
    notes = [] if tuning is None or used.differentiates else list(_tuning_notes(tuning))
    if loop.steps_late:
        notes.append(
            f"the output answers at once, so the controller acts {step:.4g} s late, as a sampled "
            "one does"
        )
    told = _controller_told(used, command.values)
    notes += [*_start_notes(times, outputs, control), *_stability_notes(metrics, margins, told)]
    return Loop(outputs, found.channel(loop.input), command, notes, metrics, told, tuning, margins)


def control_faults(model: Model, control: ControlIn) -> Iterator[FieldError]:
    """Signals that the model has not, and a controller by hand and by a rule at once."""
    for role, name, signals in (
        ("input", control.input, [one.name for one in model.inputs]),
        ("output", control.output, [one.name for one in model.outputs]),
    ):
        if name not in signals:
            detail = f"the model has no {role} {name!r}{nearest(name, signals)}"
            yield FieldError(f"/control/{role}", detail)
    if control.tuning is None:
        if control.gain is None:
            yield FieldError("/control/gain", "is missing; give it, or a rule as tuning")
        return
    for name in ("gain", "integral_time", "derivative_time"):
        if getattr(control, name) != ControlIn.model_fields[name].default:
            detail = "the rule of tuning chooses this; leave it out, or leave out tuning"
            yield FieldError(f"/control/{name}", detail)


def check_transport(control: ControlIn | None, duration: float) -> None:
    """Refuse a dead time that is longer than the simulation."""
    if control is not None and control.transport is not None:
        delay = control.transport.delay
        if delay >= duration:
            raise InvalidRequest.at(
                "/control/transport/delay",
                f"found {delay:g} s; the simulation lasts {duration:g} s, give more samples or a "
                "shorter delay",
            )


def _identified(model: Model, values: Mapping[str, float]) -> "Identified":
    from sysid.control.linear_form import Identified, Value
    from sysid.simulation.simulate import completed

    known = completed(model, values)
    return Identified(model, tuple(Value(name, value) for name, value in known.items()))


def _controller(
    identified: "Identified", control: ControlIn
) -> tuple["PidControl", TuningOut | None]:
    """The controller, its numbers given or by a rule."""
    from sysid.control.controllers import PidControl, Transport

    transport = None if control.transport is None else Transport(**control.transport.model_dump())
    gain, integral_time, derivative_time = (
        control.gain, control.integral_time, control.derivative_time
    )  # fmt: skip
    told = None
    if control.tuning is not None:
        gain, integral_time, derivative_time, told = _tuned(
            identified, control, control.tuning, transport
        )
    assert gain is not None
    return PidControl(
        control.input, control.output, gain, control.limit, transport,
        integral_time=integral_time, derivative_time=derivative_time,
        derivative_filter=control.derivative_filter, derivative_on=control.derivative_on,
        setpoint_weight=control.setpoint_weight, lower=control.lower, upper=control.upper,
        anti_windup=control.anti_windup, tracking_time=control.tracking_time,
    ), told  # fmt: skip


def _tuned(
    identified: "Identified", control: ControlIn, tuning: TuningIn, transport: "Transport | None"
) -> tuple[float, float, float, TuningOut]:
    from sysid.control.tuning import tuned

    found = tuned(
        identified, control.input, control.output, rule=tuning.rule, controller=tuning.controller,
        closed_loop_time_constant=tuning.closed_loop_time_constant, transport=transport,
    )  # fmt: skip
    process = found.process
    told = TuningOut.from_source(
        found,
        process_gain=process.gain,
        process_delay=process.delay,
        process_time_constant=process.time_constant,
        process_second_time_constant=process.second_time_constant,
    )
    return found.gain, found.integral_time, found.derivative_time, told


def _margins(identified: "Identified", control: "PidControl") -> MarginsOut | None:
    """Margins, where the model has a transfer function in s."""
    from sysid.control.linear_form import NotLinear
    from sysid.control.margins import margins

    try:
        return MarginsOut.from_source(margins(identified, control))
    except NotLinear:
        return None


def _controller_told(used: "PidControl", command: FloatArray) -> ControllerOut:
    low, high = used.range
    at_limit = np.zeros(command.size, dtype=np.bool_)
    for limit, sign in ((low, -1.0), (high, 1.0)):
        if limit is not None:
            at_limit |= sign * command >= sign * limit - _AT_LIMIT * abs(limit)
    return ControllerOut.from_source(
        used,
        integral_time=used.integral_time if used.integrates else None,
        lower=low,
        upper=high,
        tracking_time=used.tracking,
        command_min=float(np.min(command)),
        command_max=float(np.max(command)),
        saturated_percent=100.0 * float(np.mean(at_limit)),
    )


def _check_finite(
    outputs: Sequence[Channel], times: FloatArray, gain: float, step: float,
    margins: MarginsOut | None, *, is_tuned: bool,
) -> None:  # fmt: skip
    """Refuse a loop that diverges: its gain is to blame, or steps (s) too long for a stable one."""
    try:
        check_finite(outputs, times)
    except InvalidRequest as error:
        [fault] = error.errors
        detail = fault.detail.removeprefix("with these values ").partition("; ")[0]
        if margins is not None and margins.is_stable:
            raise InvalidRequest.at(
                "/sample_time",
                f"{detail}: the loop is stable, but steps of {step:.4g} s are too long to simulate "
                "it; give a smaller sample_time",
            ) from None
        raise InvalidRequest.at(
            "/control/tuning" if is_tuned else "/control/gain",
            f"found {gain:g}; with it the loop runs away: {detail}; choose a smaller "
            "gain, a longer integral_time, a limit, or another sign",
        ) from None


def _metrics(
    times: FloatArray, outputs: Sequence[Channel], control: ControlIn
) -> StepMetricsOut | None:
    """Judge the controlled output, if the reference is a step."""
    from sysid.control.step_response import step_metrics

    if not isinstance(control.reference, StepInput):
        return None
    step = control.reference
    if step.amplitude == 0 or np.count_nonzero(times >= step.time) < 2:
        return None
    [output] = [one for one in outputs if one.name == control.output]
    found = step_metrics(
        times, output.values, at=step.time, before=step.offset, after=step.offset + step.amplitude
    )
    return StepMetricsOut.from_source(found, output=output.name, unit=output.unit)


def _tuning_notes(tuning: TuningOut) -> Iterator[str]:
    if tuning.controller == "PID":
        yield "the model has no second time constant, so the rule gives a PI controller"


def _start_notes(
    times: FloatArray, outputs: Sequence[Channel], control: ControlIn
) -> Iterator[str]:
    """What to mind where the loop may not be at rest when its reference steps."""
    if not isinstance(control.reference, StepInput):
        return
    step = control.reference
    [output] = [one for one in outputs if one.name == control.output]
    band, earlier = _SMALL * abs(step.amplitude), output.values[times < step.time]
    if earlier.size:
        if np.ptp(earlier[-max(earlier.size // 4, 2) :]) > band:
            yield f"{output.name} still moves when the reference steps: {_MORE}"
        return
    start = float(output.values[0])
    if abs(start - step.offset) <= band:
        return
    unit = plain_unit(output.unit)
    yield (
        f"{output.name} starts at {start:.4g}{unit} with a reference of {step.offset:.4g}{unit} "
        f"before the step: unless the loop rests there, {_MORE}"
    )


def _stability_notes(
    metrics: StepMetricsOut | None, margins: MarginsOut | None, controller: ControllerOut
) -> Iterator[str]:
    """That a loop is unstable or keeps swinging, said plainly."""
    if metrics is not None and metrics.swing is not None:
        unit = plain_unit(metrics.unit)
        decays = margins is not None and margins.is_stable and not controller.saturated_percent
        yield (
            f"{metrics.output} keeps swinging and does not settle: {metrics.swing:.4g}{unit} from "
            f"peak to peak, every {metrics.swing_period:.4g} s"
            + ("; by its transfer function it decays, too slowly for this record" if decays else "")
        )
    if margins is not None and not margins.is_stable:
        yield (
            "the loop is unstable (by its transfer function, without the limits of the "
            "controller): choose a smaller gain, a longer integral_time, or another sign"
        )
