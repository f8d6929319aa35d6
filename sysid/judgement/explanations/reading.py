"""Reading: what a sample says of the time between two samples.

An input is held, runs in straight lines, or is the mean of the period that ends or begins with its
stamp. An output is a value at its stamp, or the mean of such a period. Each is a column ŷ(other
reading) - ŷ.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from sysid.core.errors import SysidError
from sysid.core.types import FloatArray
from sysid.data.holds import Hold
from sysid.judgement.residual_context import Candidate, ResidualContext
from sysid.kernels.signals.past_reads import is_difference

_FINE = 8  # values in a period of a mean


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose other readings of inputs and outputs."""
    if is_difference(context.problem.model) or not context.problem.is_free_run:
        return  # predictions know the noise of their samples
    for channel in context.moving_inputs:
        name = channel.name
        others: dict[str, tuple[Hold, Callable[[FloatArray], FloatArray], str]] = {
            "held": ("zero", _keep, "is held between its samples"),
            "as straight lines": ("first", _keep, "runs in straight lines between its samples"),
            "as means that end at their stamps": (
                "zero",
                _shift_back,
                "is the mean of the period that ends at its stamp",
            ),
            "as lines between its changes": (
                "first",
                _join_changes,
                "runs in straight lines from one change to the next",
            ),
        }
        for word, (hold, change, text) in others.items():
            if change is _keep and hold == channel.effective_hold:
                continue
            records = context.replace_input(name, change, hold=hold)
            try:
                other = context.simulate(records)
            except SysidError:
                continue
            moved = other - context.simulation
            if np.all(np.isfinite(moved)) and moved.any():
                is_sure = change is _keep and channel.sampling.is_regular
                setting = f"Use hold: {{{name}: {hold}}}." if is_sure else ""
                yield Candidate(
                    "reading of an input",
                    "reading",
                    context.weigh(moved),
                    f"{name} is better read {word}",
                    f"the data say that {name} {text}",
                    setting,
                    records=records,
                )
    yield from _propose_means(context)


def _propose_means(context: ResidualContext) -> Iterator[Candidate]:
    """Propose that outputs are means of the period after or before their stamps."""
    for side, word in ((1.0, "begins"), (-1.0, "ends")):
        try:
            mean = _simulate_means(context, side)
        except SysidError:
            continue
        if np.all(np.isfinite(mean)):
            yield Candidate(
                "mean of a period",
                "reading",
                context.weigh(mean - context.simulation),
                "the output is a mean",
                f"the output is the mean of the period that {word} at its stamp",
                "Move the stamps of the output to the middle of the period.",
            )


def _simulate_means(context: ResidualContext, side: float) -> FloatArray:
    """Simulate the means (n,) of the periods to one side of each scored sample.

    They are ``nan`` if no more simulations are allowed.
    """
    if not context.simulations.allow(1):
        return np.full(context.times.size, np.nan)
    context.simulations.spent += 1
    problem, records = context.problem, []
    for record in problem.records:
        outputs = []
        for channel in record.outputs:
            times = _list_fine_times(channel.times, side)
            inside = (times >= record.start) & (times <= record.stop)
            distinct = np.unique(times[inside])
            outputs.append(replace(channel, times=distinct, values=np.zeros(distinct.size)))
        records.append(replace(record, outputs=tuple(outputs)))
    fine = problem.rebuild(
        records=records, weights=problem.output_weights, scored_from=None, skip=0
    )
    predicted = fine.split_by_output(fine.predict(context.theta[None])[0])
    means = np.zeros(context.times.size)
    for part in context.parts:
        [channel] = [
            one for one in fine.records[part.experiment].outputs if one.name == part.output
        ]
        values = predicted[part.experiment][part.output]
        period = float(np.median(np.diff(part.times)))
        offsets = side * period * (np.arange(_FINE) + 0.5) / _FINE
        wanted = part.times[:, None] + offsets
        means[part.rows] = np.mean(np.interp(wanted, channel.times, values), axis=1)
    return means


def _list_fine_times(times: FloatArray, side: float) -> FloatArray:
    period = float(np.median(np.diff(times)))
    return np.asarray((times[:, None] + side * period * np.arange(_FINE + 1) / _FINE).ravel())


def _keep(values: FloatArray) -> FloatArray:
    return values


def _shift_back(values: FloatArray) -> FloatArray:
    """Let each value count from the sample before it on."""
    return np.append(values[1:], values[-1])


def _join_changes(values: FloatArray) -> FloatArray:
    """Join the values at which a held signal changes by straight lines."""
    changes = np.flatnonzero(np.diff(values, prepend=np.nan) != 0)
    return np.interp(np.arange(values.size), changes, values[changes])
