"""Gaps: outages of the logger, rows and values that are missing, and channels that start later."""

from collections.abc import Iterator, Sequence

import numpy as np

from sysid.core.findings import Finding
from sysid.core.text import join_names
from sysid.data.outages import Outage, count_lost_rows, find_outages, find_unseen, is_paced
from sysid.inspection.signal import MIN_SAMPLES, Signal, build_finding, list_names

_LISTED = 3  # outages in a sentence
_LATE = 2.0  # sampling periods: a channel that starts or ends so far from the others


def find_gaps(signals: Sequence[Signal]) -> Iterator[Finding]:
    """Find what is missing in signals of one clock, whose samples have values at the same times."""
    first = signals[0]
    names = tuple(one.name for one in signals)
    if first.whole.repeats is not None:
        return
    outages = find_outages(first.times) if _is_paced(first) else []
    if outages:
        yield _describe_outages(signals, names, outages)
    yield from _find_lost_rows(first, names, outages)
    yield from _find_missing_values(signals)
    yield from _find_late(first, names)


def _is_paced(signal: Signal) -> bool:
    return signal.times.size >= MIN_SAMPLES and is_paced(signal.times)


def _describe_outages(
    signals: Sequence[Signal], names: tuple[str, ...], outages: Sequence[Outage]
) -> Finding:
    spans = [f"{one.start:.6g} to {one.stop:.6g} s ({one.rows:,} rows)" for one in outages]
    if more := len(spans) - _LISTED:
        spans = [*spans[:_LISTED], f"{more} more"] if more > 0 else spans
    moved = [
        one.name
        for one in signals
        if one.role != "output" and find_unseen(one.whole, one.recording)
    ]
    what = "an input" if len(moved) == 1 else "inputs"
    cut = (
        f"As {what}, {list_names(moved)} may have moved there unseen: the record is cut, and "
        "another experiment begins after it with an unknown past."
        if moved
        else "No input need be cut there: outputs are not compared in it."
    )
    verb = "has" if len(names) == 1 else "have"
    return build_finding(
        "outage",
        "record",
        f"{list_names(names)} {verb} no value from {join_names(spans)}. {cut}",
        names,
        tuple((one.start, one.stop) for one in outages),
    )


def _find_lost_rows(
    signal: Signal, names: tuple[str, ...], outages: Sequence[Outage]
) -> Iterator[Finding]:
    """Find rows that are missing beside outages."""
    if not _is_paced(signal):
        return
    times = signal.whole.times
    lost = count_lost_rows(times)
    inside = np.zeros(lost.size, dtype=np.bool_)
    for outage in outages:
        inside |= (times[:-1] >= outage.start) & (times[:-1] < outage.stop)
    lost = np.where(inside, 0, lost)
    count = int(np.sum(lost))
    if not count:
        return
    places = np.flatnonzero(lost)
    yield build_finding(
        "missing rows",
        "record",
        f"{count:,} of {count + times.size:,} rows of {list_names(names)} are missing, at most "
        f"{int(np.max(lost)):,} in a row. Inputs are read across them.",
        names,
        tuple((float(times[k]), float(times[k + 1])) for k in places[:100]),
    )


def _find_missing_values(signals: Sequence[Signal]) -> Iterator[Finding]:
    for signal in signals:
        missing = np.flatnonzero(np.isnan(signal.whole.values))
        if missing.size:
            yield build_finding(
                "missing values",
                "record",
                f"channel {signal.name!r}: {missing.size} of {signal.whole.values.size} values are "
                f"missing (empty or NaN), the first at t = {signal.whole.times[missing[0]]:g} s. "
                "An output is not scored there, and an input is read across it.",
                (signal.name,),
            )


def _find_late(signal: Signal, names: tuple[str, ...]) -> Iterator[Finding]:
    """Find channels that begin later than the recording, or end earlier."""
    if not _is_paced(signal):
        return
    recording, times = signal.recording, signal.times
    least = _LATE * float(np.median(np.diff(times)))
    for wait, span, word in (
        (times[0] - recording.start, (recording.start, float(times[0])), "starts"),
        (recording.stop - times[-1], (float(times[-1]), recording.stop), "ends"),
    ):
        if wait > least:
            other = "later" if word == "starts" else "earlier"
            yield build_finding(
                "late start" if word == "starts" else "early end",
                "record",
                f"{list_names(names)} {word if len(names) == 1 else word[:-1]} {wait:.4g} s "
                f"{other} than the recording. Without a value of an input nothing is compared.",
                names,
                (span,),
            )
