"""Reading: what a sample says of the time between two samples.

An input is held, runs in straight lines, or is the mean of the period that ends or begins with its
stamp. An output is a value at its stamp, or the mean of such a period. Each is a column ŷ(other
reading) - ŷ.
"""

from collections.abc import Callable, Iterator

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.holds import MEANS, Hold
from sysid.judgement.residual_context import Candidate, ResidualContext
from sysid.kernels.signals.past_reads import is_difference


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
                "mean",
                _keep,
                "is the mean of the period that ends at its stamp",
            ),
            "as lines between its changes": (
                "first",
                _join_changes,
                "runs in straight lines from one change to the next",
            ),
        }
        for word, (hold, change, text) in others.items():
            is_regular = channel.sampling.is_regular
            if change is _keep and hold == channel.effective_hold:
                continue
            if hold == "mean" and not is_regular:
                continue
            records = context.replace_input(name, change, hold=hold)
            moved = context.compute_effect(records)
            if moved is not None:
                is_sure = change is _keep and is_regular
                yield Candidate(
                    "reading of an input",
                    "reading",
                    context.weigh(moved),
                    f"{name} is better read {word}",
                    f"the data say that {name} {text}",
                    setting=f"Use hold: {{{name}: {hold}}}." if is_sure else "",
                    change={"records": records},
                    is_whole=True,
                )
    yield from _propose_means(context)


def _propose_means(context: ResidualContext) -> Iterator[Candidate]:
    """Propose that outputs are means of the period after or before their stamps."""
    outputs = [channel for record in context.problem.records for channel in record.outputs]
    if any(channel.hold in MEANS for channel in outputs):
        return
    if not all(channel.sampling.is_regular for channel in outputs):
        return
    names = dict.fromkeys(channel.name for channel in outputs)
    words: tuple[tuple[Hold, str], ...] = (("mean-after", "begins"), ("mean", "ends"))
    for hold, word in words:
        holds = dict.fromkeys(names, hold)
        first, *others = names
        more = "".join(f", {name}: {hold}" for name in others)
        records = [record.replace_holds(holds) for record in context.problem.records]
        moved = context.compute_effect(records)
        if moved is not None:
            yield Candidate(
                "mean of a period",
                "reading",
                context.weigh(moved),
                "the output is a mean",
                f"the output is the mean of the period that {word} at its stamp",
                setting=f"Use hold: {{{first}: {hold}{more}}}.",
                change={"records": records},
                is_whole=True,
            )


def _keep(values: FloatArray) -> FloatArray:
    return values


def _join_changes(values: FloatArray) -> FloatArray:
    """Join the values at which a held signal changes by straight lines."""
    changes = np.flatnonzero(np.diff(values, prepend=np.nan) != 0)
    return np.interp(np.arange(values.size), changes, values[changes])
