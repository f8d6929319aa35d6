"""History: the input before the record, and the states at its start.

Before its first sample an input is assumed to be at its first value. What it was instead acts on
the samples that read it: a column for each of some spans before the record, of one simulation each.
States whose start is assumed, at a number, a measured value or a rest, have the slopes of the
outputs as columns.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sysid.data.records import Channel, History, Record
from sysid.judgement.residual_context import CUT_THERE, Candidate, ResidualContext
from sysid.judgement.start_slopes import list_assumed_starts
from sysid.judgement.unrecorded_input import GIVE_HISTORY, compute_reach, find_assumed_samples

_SPANS = 4  # of the time that lags reach back before the record


def propose(context: ResidualContext) -> Iterator[Candidate]:
    """Propose another input before the record, and other starts."""
    problem = context.problem
    if not problem.is_free_run:
        return
    skipped = _count_assumed(context)
    inputs = list(_propose_inputs(context, skipped))
    yield from inputs
    yield from _propose_restarts(context)
    states, slopes = list_assumed_starts(problem), context.fixed_start_slopes
    for before in (None, *inputs) if slopes else ():
        columns = [] if before is None else [before.columns]
        skip = 0 if before is None else skipped
        yield Candidate(
            "start",
            "start",
            np.hstack([*slopes, *columns]),
            "the record does not start as the model says",
            f"the record does not start where the model says that {', '.join(states)} does",
            is_added=True,
            setting=f"Use initial: free and skip: {skip}." if skip else "Use initial: free.",
            change={"initial": "free", **({"skip": skip} if skip else {})},
        )


def _count_assumed(context: ResidualContext) -> int:
    """Count the samples that read an input from before the record, at most of an output."""
    parts = find_assumed_samples(context.problem, context.analysis)
    return max(int(np.count_nonzero(part)) for part in parts)


def _propose_restarts(context: ResidualContext) -> Iterator[Candidate]:
    """Propose that the states jump during the record: a pulse of a load, or two records in one.

    The effect of a start, begun later, is that of a jump of the states there (innovational outlier:
    Chen and Liu, J. Am. Stat. Assoc. 88 (1993) 284).
    """
    sources = context.start_slopes
    if not sources or len(context.parts) != len(context.problem.records):
        return  # of one output only
    for position in context.find_shocks():
        columns = [context.shift_start(source, position) for source in sources]
        moved = [column for column in columns if column.any()]
        if moved and position > 0:
            moment = float(context.times[position])
            told = context.describe_moment(moment, context.find_experiment(position))
            yield Candidate(
                "jump of the states",
                "record",
                np.column_stack(moved),
                f"the plant jumps at about {told}",
                f"at about {told} the plant is elsewhere at once: by a pulse of a load, "
                "rows that are missing, or two records in one",
                CUT_THERE,
                counted=1,
                moment=moment,
                is_added=True,
            )


def _propose_inputs(context: ResidualContext, skipped: int) -> Iterator[Candidate]:
    """Propose that an input was elsewhere before its first sample, which `skipped` ones read."""
    reach = compute_reach(context.problem, context.analysis)
    for name in context.inputs if reach > 0 else ():
        changed = (_change_history(context, name, reach, span) for span in range(_SPANS))
        columns = [context.compute_effect(records) for records in changed]
        moved = [column for column in columns if column is not None]
        if moved:
            yield Candidate(
                "input before the record",
                "history",
                context.weigh(np.column_stack(moved)),
                f"{name} moved before the record",
                f"{name} was not at its first value before the record. Its first value is assumed "
                "there, and the data contradict it",
                GIVE_HISTORY,
                is_added=True,
                setting=f"Or use skip: {skipped}.",
                change={"skip": skipped},
            )


def _change_history(context: ResidualContext, name: str, reach: float, span: int) -> list[Record]:
    """Let an input be elsewhere in one of some spans before each record."""
    return [
        replace(
            record,
            inputs=tuple(
                _prepend(channel, reach, span) if channel.name == name else channel
                for channel in record.inputs
            ),
        )
        for record in context.problem.records
    ]


def _prepend(channel: Channel, reach: float, span: int) -> Channel:
    channel = channel.acting
    known = channel.history
    first = float(channel.times[0] if known is None else known.times[0])
    value = float(channel.values[0] if known is None else known.values[0])
    move = float(np.ptp(channel.values)) or abs(value) or 1.0
    width = reach / _SPANS
    begin = first - (span + 1) * width
    times = np.array([begin - width, begin - 1e-6 * width, begin, begin + width * (1 - 1e-6)])
    values = np.array([value, value, value + move, value + move])
    if known is not None:
        times, values = np.append(times, known.times), np.append(values, known.values)
    return replace(channel, hold=channel.effective_hold, history=History(times, values))
