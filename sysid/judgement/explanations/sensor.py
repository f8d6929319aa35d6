"""Sensor: the measured output is not what the model calls it.

Drift, steps, another unit from some moment on, a curve (RESET: Ramsey, J. R. Stat. Soc. B 31 (1969)
350), a limit, a reading that repeats an older one, and a mean of several samples. Each is a column
of the simulated output itself, so none takes a simulation.
"""

from collections.abc import Iterator

import numpy as np

from sysid.core.types import BoolArray, FloatArray
from sysid.core.units import format_unit
from sysid.inspection.resampling import find_knots, measure_drawn
from sysid.inspection.signal import LIMIT_SAMPLES, are_many, find_limited
from sysid.judgement.residual_context import (
    AS_TOLD,
    CUT_THERE,
    TO_THE_NEXT,
    Candidate,
    ResidualContext,
)

_HINGES = (0.0, 0.1, 0.2, 0.3)  # of the range, from its end
_REPEATED_SHARE = 0.2  # of the samples: readings that equal the one before
_STUCK = 10  # readings in a row that equal the one before
_MEANS = (2, 4, 8, 16)  # samples
_DRAWN_SHARE = 0.3  # of the samples: on lines
"""Measured with `benchmarks.judgement`, a record of each of 102 kinds: half and twice the shares of
repeated readings and of samples on lines leave all statuses."""


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose faults of the sensor of each output."""
    for name, rows, unit in context.iterate_outputs():
        yield from _propose_courses(context, name, rows)
        yield from _propose_curves(context, name, rows, unit)
        yield from _propose_old_readings(context, name, rows)
        yield from _propose_lines(context, name, rows)


def _propose_courses(context: ResidualContext, name: str, rows: BoolArray) -> Iterator[Candidate]:
    times, simulated = context.times, context.simulation
    share = np.where(rows, (times - np.mean(times)) / max(float(np.ptp(times)), 1e-300), 0.0)
    yield Candidate(
        "drift of a sensor",
        "sensor",
        context.weigh(share),
        f"{name} drifts",
        f"{name} drifts in a straight line beside the model",
        f"Add drift*t to output {name} in the model's document, and drift to its parameters.",
        is_added=True,
    )
    offset = context.weigh(np.where(rows, 1.0, 0.0))[:, 0]
    for moment, late, where in (*context.find_breaks(offset), *context.find_late(offset)):
        yield Candidate(
            "step of a sensor",
            "sensor",
            late[:, None],
            f"{name} jumps at about {where}",
            f"{name} jumps at about {where}, by a step of the sensor or a disturbance",
            CUT_THERE,
            counted=1,
            moment=moment,
            is_added=True,
        )
        after = np.where((late != 0) & (times >= moment), simulated, 0.0)
        yield Candidate(
            "change of a unit",
            "sensor",
            np.column_stack([late, context.weigh(after)[:, 0]]),
            f"{name} has another scale from about {where} on",
            f"from about {where} on, {name} has another scale and offset, as after a change of "
            "its unit or of its sensor",
            "Convert that part, or cut the record there and identify each part by itself.",
            counted=1,
            moment=moment,
        )


def _propose_curves(
    context: ResidualContext, name: str, rows: BoolArray, unit: str
) -> Iterator[Candidate]:
    simulated, measured = context.simulation, context.measurement
    own = simulated[rows]
    spread = float(np.std(own))
    if not spread > 0:
        return
    z = np.where(rows, (simulated - np.mean(own)) / spread, 0.0)
    yield Candidate(
        "curve of a sensor",
        "sensor",
        context.weigh(np.column_stack([z**2, z**3])),
        f"{name} is curved",
        f"{name} is a curved function of what the model says, as of a nonlinear sensor or gain",
        f"Linearise {name}, or write its curve in the model's document.",
    )
    low, high = float(np.min(measured[rows])), float(np.max(measured[rows]))
    for limit, side in ((high, 1.0), (low, -1.0)):
        count = int(np.count_nonzero(rows & (measured == limit)))
        is_seen = are_many(count, int(np.count_nonzero(rows)))
        for hinge in _HINGES:
            level = limit - side * hinge * (high - low)
            beyond = np.where(rows, np.maximum(side * (simulated - level), 0.0), 0.0)
            if np.count_nonzero(beyond) < LIMIT_SAMPLES:
                continue
            readings = f"{name} is {limit:.4g}{format_unit(unit)} in {count} samples"
            yield Candidate(
                "limit of a sensor",
                "sensor",
                context.weigh(beyond),
                f"{name} is at its limit" if is_seen else f"{name} saturates",
                f"{readings}, as a sensor at its limit"
                if is_seen
                else f"{name} does not follow the model near {limit:.4g}{format_unit(unit)}, as a "
                "sensor or plant that saturates",
                "Leave these samples out: empty cells are not compared.",
                counted=1,
            )


def _propose_lines(context: ResidualContext, name: str, rows: BoolArray) -> Iterator[Candidate]:
    """Propose that most readings were interpolated between fewer ones.

    Such readings lie on lines: their second differences vanish, as those of measured ones do not.
    """
    drawn, is_drawn = np.zeros(rows.size), False
    for part in context.parts:
        measured, simulated = context.measurement[part.rows], context.simulation[part.rows]
        if part.output != name or measured.size < LIMIT_SAMPLES:
            continue
        is_knot = find_knots(part.times, measured)
        is_drawn |= measure_drawn(measured, is_knot) > _DRAWN_SHARE
        times = part.times
        drawn[part.rows] = np.interp(times, times[is_knot], simulated[is_knot]) - simulated
    if is_drawn:
        yield Candidate(
            "interpolated reading",
            "record",
            context.weigh(drawn),
            f"{name} was interpolated",
            f"most readings of {name} lie on straight lines between others: they were interpolated "
            "and are no measurements",
            f"Keep the measured rows of {name}, and leave the others empty.",
            is_vague=True,
            most=AS_TOLD,
        )


def _propose_old_readings(
    context: ResidualContext, name: str, rows: BoolArray
) -> Iterator[Candidate]:
    """Propose readings of an earlier moment: repeated ones, and means of several samples."""
    older, is_repeated = np.zeros(rows.size), False
    for part in context.parts:
        if part.output == name:
            measured, simulated = context.measurement[part.rows], context.simulation[part.rows]
            equal = np.concatenate([[False], np.diff(measured) == 0]) & ~find_limited(measured)
            is_repeated |= bool(np.mean(equal) > _REPEATED_SHARE) or _count_longest(equal) >= _STUCK
            last = np.maximum.accumulate(np.where(equal, 0, np.arange(equal.size)))
            older[part.rows] = simulated[last] - simulated
    if is_repeated:
        yield Candidate(
            "repeated reading",
            "sensor",
            context.weigh(older),
            f"{name} repeats old readings",
            f"{name} repeats its last reading until the sensor has a new one, or is stuck",
            f"Keep the first row of equal readings of {name}, and leave the others empty.",
            most=AS_TOLD,
        )
    for samples in _MEANS:
        before = np.zeros(rows.size)
        for part in context.parts:
            if part.output == name and part.times.size > samples:
                values = context.simulation[part.rows]
                before[part.rows] = _average_before(values, samples) - values
        if before.any():
            yield Candidate(
                "filter of a sensor",
                "structure",
                context.weigh(before),
                f"{name} is filtered",
                f"{name} is a mean of about {samples} samples, or is filtered before it is stored",
                "",
                counted=1,
                doubtful=context.delays,
                most=TO_THE_NEXT,
            )


def _count_longest(flags: BoolArray) -> int:
    """Count the longest run of flags that are set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _average_before(values: FloatArray, samples: int) -> FloatArray:
    """Average each value with those before it, as many as there are."""
    totals = np.concatenate([[0.0], np.cumsum(values)])
    last = np.arange(1, values.size + 1)
    first = np.maximum(last - samples, 0)
    return np.asarray((totals[last] - totals[first]) / (last - first))
