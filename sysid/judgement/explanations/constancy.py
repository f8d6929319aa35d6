"""Constancy: a parameter or a clock that changes during the record.

Columns S·1(t > τ) and S·t beside S (Nyblom, J. Am. Stat. Assoc. 84 (1989) 223; Andrews,
Econometrica 61 (1993) 821; Chow 1960). A clock that drifts moves the output along its own slope:
dŷ/dt·t and dŷ/dt·1(t > τ). Of one time lag that acts on all inputs no record tells the two apart.
"""

from collections.abc import Iterator

import numpy as np

from sysid.core.types import FloatArray
from sysid.judgement.residual_context import CUT_THERE, Candidate, ResidualContext
from sysid.judgement.residual_model import ColumnFit
from sysid.uncertainty.analysis import compute_physical_scale

_SAME_COLUMN = 0.99  # correlation: a lag and a clock that move the output alike


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose that a parameter, or the offset of the clocks, changes or drifts."""
    clock = context.weigh(context.slope)[:, 0]
    offsets = [context.weight * rows for _, rows, _ in context.iterate_outputs()]
    is_lag_a_clock = False
    for number, name in context.parameter_numbers:
        column = context.residual_model.columns[:, number]
        if not column.any() or any(_are_alike(column, offset) for offset in offsets):
            continue  # an offset of an output: a step or a drift of its sensor
        is_clock = name in context.delays and _are_alike(column, clock)
        is_lag_a_clock |= is_clock
        yield from _propose_changes(context, number, name, is_clock=is_clock)
    if not is_lag_a_clock and context.problem.is_free_run:
        yield from _propose_clocks(context, clock)


def _propose_changes(
    context: ResidualContext, number: int, name: str, *, is_clock: bool
) -> Iterator[Candidate]:
    """Propose that a parameter changes, drifts, or follows a signal."""
    column = context.residual_model.columns[:, number]
    scale = float(compute_physical_scale(context.problem, context.theta)[number])
    kind = "a time lag" if name in context.delays else "a parameter"
    subject = f"{name}, or the offset between the clocks," if is_clock else name
    for at, late, moment in context.find_breaks(column):
        yield Candidate(
            f"change of {kind}",
            "constancy",
            late[:, None],
            f"{name} changes at about {moment}",
            f"{subject} changes at about {moment}",
            CUT_THERE,
            counted=1,
            describe=_describe_change(context, number, scale),
            varies=(number, 0.0, 1.0),
            moment=at,
        )
    yield Candidate(
        f"drift of {kind}",
        "constancy",
        (column * _centre_times(context))[:, None],
        f"{name} drifts",
        f"{subject} drifts over the record",
        describe=_describe_drift(context, number, scale),
        varies=(number, -0.5, 0.5),
    )
    for signal, values in _list_signals(context):
        yield Candidate(
            f"change of {kind} with a signal",
            "constancy",
            (column * values)[:, None],
            f"{name} follows {signal}",
            f"{subject} is no constant: it follows {signal}",
            f"Write how {name} depends on {signal} in the model's document.",
            counted=1,
            describe=_describe_drift(context, number, scale),
            varies=(number, -0.5, 0.5),
        )


def _propose_clocks(context: ResidualContext, clock: FloatArray) -> Iterator[Candidate]:
    """Propose that the clocks jump or drift, which moves the outputs along a column (n,)."""
    for at, late, moment in context.find_breaks(clock):
        yield Candidate(
            "jump of a clock",
            "clocks",
            late[:, None],
            f"the clocks jump at about {moment}",
            f"the offset between the clocks of input and output jumps at about {moment}, or "
            "rows are missing",
            f"Look for lost rows there. {CUT_THERE}",
            counted=1,
            moment=at,
            doubtful=context.delays,
        )
    yield Candidate(
        "drift of a clock",
        "clocks",
        (clock * _centre_times(context))[:, None],
        "the clocks drift apart",
        "the clocks of input and output drift apart",
        "Put both channels on one clock.",
        doubtful=context.delays,
    )


def _list_signals(context: ResidualContext) -> Iterator[tuple[str, FloatArray]]:
    """List the outputs and inputs (n,) that a parameter may follow, from about -0.5 to 0.5."""
    for name, rows, _ in context.iterate_outputs():
        values = np.where(rows, context.simulation, 0.0)
        span = float(np.ptp(context.simulation[rows]))
        if span > 0:
            yield name, np.where(rows, (values - np.mean(context.simulation[rows])) / span, 0.0)
    for channel in context.moving_inputs:
        values = context.read_input(channel.name)
        span = float(np.ptp(values))
        if span > 0:
            yield channel.name, (values - np.mean(values)) / span


def _centre_times(context: ResidualContext) -> FloatArray:
    """Compute the times (n,) from -0.5 to 0.5 over all experiments."""
    times = context.times
    return np.asarray((times - np.mean(times)) / max(float(np.ptp(times)), 1e-300))


def _are_alike(first: FloatArray, second: FloatArray) -> bool:
    size = float(np.linalg.norm(first) * np.linalg.norm(second))
    return size > 0 and abs(float(first @ second)) > _SAME_COLUMN * size


def _describe_change(context: ResidualContext, number: int, scale: float) -> "_Describe":
    return _Describe(context, number, scale, "It is about {} before and {} after.", (0.0, 1.0))


def _describe_drift(context: ResidualContext, number: int, scale: float) -> "_Describe":
    return _Describe(context, number, scale, "It goes from about {} to {}.", (-0.5, 0.5))


class _Describe:
    """Describes two values of a parameter by the coefficient of its column.

    It says nothing if one of them is out of bounds: the linear step was too long then.
    """

    def __init__(
        self,
        context: ResidualContext,
        number: int,
        scale: float,
        text: str,
        shares: tuple[float, float],
    ) -> None:
        self._context, self._number, self._scale = context, number, scale
        parameter = context.problem.free_parameters[number]
        self._unit, self._bounds = parameter.unit, (parameter.lower, parameter.upper)
        self._text, self._shares = text, shares

    def __call__(self, fit: ColumnFit) -> str:
        middle = float(fit.coefficients[self._number]) * self._scale
        change = float(fit.coefficients[-1]) * self._scale
        unit = "" if self._unit == "1" else f" {self._unit}"
        ends = [
            self._context.move_value(self._number, middle + share * change)
            for share in self._shares
        ]
        if not all(self._bounds[0] <= end <= self._bounds[1] for end in ends):
            return ""  # too far for a linear step
        first, second = (f"{end:.4g}{unit}" for end in ends)
        return self._text.format(first, second)
