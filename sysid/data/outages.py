"""Outages: stretches of a record in which a signal is silent, and the experiments between them.

Empty cells and missing rows are the same here: a sample without a value is no sample. Rows that are
lost one by one leave gaps of a geometric length. If each is lost with probability q, a gap has k
rows or more with probability qᵏ (Feller, Introduction to Probability I, 1968, VI.8). A gap that is
longer than all N intervals explain is an outage. The gaps are taken from the shortest on, so that
one outage does not hide another. Others of its size count with them, so that bursts have none.

An input that may have moved unseen in an outage leaves the states and its own past unknown. So the
record ends there, and another begins after it. Its first part is kept as the past of the inputs, as
long as time lags may reach back, and is not compared.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np

from sysid.core.errors import InvalidRecord
from sysid.core.types import FloatArray, IntArray
from sysid.data.records import Channel, Record, Recording, select_known

_UNLIKELY = 1e-3  # probability that lost rows leave such a gap: one in a thousand records
_MIN_SAMPLES = 10
_SAME_SIZE = 2  # times as long: of seven bursts of samples, the gaps are up to 1.3 times
_MIN_DOUBLES = 4  # lost rows: fewer may keep in step by chance
_UNSEEN_SHARE = 0.1
"""Of an input's variance: mean square error of its values across such a gap, elsewhere in the
record. Measured with `benchmarks.judgement`: of 80 records of `rows_deleted` 53 are cut, and half
and twice the share cut 55 and 52. Of 192 sound records that lost 1 to 20 % of their rows, none is.
"""
_LAGS = 16  # distances from the begin of a gap that are tried
_PACED_SHARE = 0.7  # of the intervals, up to 1.5 medians; waiting times without memory have 65 %
_LEAD_SHARE = 0.25  # of an experiment after an outage: past of its inputs, at most
_LAG_SHARE = 0.5  # of the shortest experiment: longest time lag that is searched
_SHORT_SHARE = 0.25  # of the longest experiment: a shorter one is left out


class Outage(NamedTuple):
    """A gap of a signal: the sample before it, the one after it (s), and missing rows between."""

    start: float
    stop: float
    rows: int


class Cut(NamedTuple):
    """Experiments of a recording, each from a time to a time (s), and where the inputs are known.

    An experiment is compared from `start` on; its inputs are known from `known_from` on.
    """

    known_from: float
    start: float
    stop: float


def count_lost_rows(times: FloatArray) -> IntArray:
    """Count the rows that are missing after each sample but the last, by the median interval.

    Intervals of one and two periods that keep in step with an even clock are stamps that were
    rounded, and no lost rows: those come at random.
    """
    steps = np.diff(times)
    period = float(np.median(steps)) if steps.size else 0.0
    if not period > 0:
        return np.zeros(steps.size, dtype=np.int64)
    lost = np.maximum(np.rint(steps / period).astype(np.int64) - 1, 0)
    if np.count_nonzero(lost) >= _MIN_DOUBLES and keeps_step(times):
        return np.zeros(steps.size, dtype=np.int64)
    return lost


def keeps_step(times: FloatArray) -> bool:
    """Whether times (s) stay within a mean interval of an even clock."""
    even = np.linspace(times[0], times[-1], times.size)
    return bool(np.max(np.abs(times - even)) * (times.size - 1) <= times[-1] - times[0])


def find_outages(times: FloatArray) -> list[Outage]:
    """Find the gaps in times (s) that rows lost one by one do not explain.

    Examples
    --------
    >>> find_outages(np.r_[0.0:100.0, 900.0:1000.0])
    [Outage(start=99.0, stop=900.0, rows=800)]
    """
    if times.size < _MIN_SAMPLES:
        return []
    lost = count_lost_rows(times)
    gaps = np.flatnonzero(lost > 1)
    if not gaps.size:
        return []
    gaps = gaps[np.argsort(lost[gaps], kind="stable")]
    last = np.searchsorted(lost[gaps], _SAME_SIZE * lost[gaps], side="right") - 1
    smaller = int(np.count_nonzero(lost == 1)) + np.cumsum(lost[gaps])[last] - lost[gaps]
    rate = (smaller + 1.0) / (smaller + 1.0 + lost.size)
    is_outage = np.log(lost.size) + lost[gaps] * np.log(rate) < np.log(_UNLIKELY)
    if not is_outage.any():
        return []
    found = np.sort(gaps[int(np.argmax(is_outage)) :])
    return [Outage(float(times[k]), float(times[k + 1]), int(lost[k])) for k in found]


def is_paced(times: FloatArray) -> bool:
    """Whether samples come at a pace, so that silence is an outage and not the lack of a change."""
    steps = np.diff(times)
    return bool(np.mean(steps <= 1.5 * np.median(steps)) >= _PACED_SHARE)


def find_unseen(channel: Channel, recording: Recording) -> list[Outage]:
    """Find the outages of an input in which it may have moved.

    The recording may begin before the input, and end after it. An input that is logged at its
    changes is silent only where all channels are.
    """
    if channel.repeats is not None or channel.times.size < _MIN_SAMPLES:
        return []
    known = select_known(channel)
    heard = known.times
    if known.times.size > 1 and not is_paced(known.times):
        heard = np.unique(
            np.concatenate([one.times[np.isfinite(one.values)] for one in recording.channels])
        )
    ends = ([at] for at in (recording.start, recording.stop) if not heard[0] <= at <= heard[-1])
    outages = find_outages(np.sort(np.concatenate([heard, *ends])))
    if not outages:
        return []
    variance = float(np.var(known.values))
    edges = np.searchsorted(known.times, [one.stop for one in outages])
    stretches = [part for part in np.split(known.values, edges) if part.size]
    return [
        one
        for one in outages
        if _measure_bridging(stretches, one.rows, channel.hold_choice.hold == "zero")
        > _UNSEEN_SHARE * variance
    ]


def _measure_bridging(stretches: list[FloatArray], rows: int, is_held: bool) -> float:
    """Measure the mean square error of values across a gap of some rows, where they are known.

    Infinite where no stretch is longer than the gap, unless nothing ever moves.
    """
    width = rows + 1
    lags = np.unique(np.linspace(1, rows, min(rows, _LAGS)).astype(int))
    total, count = 0.0, 0
    for values in stretches:
        if values.size <= width:
            continue
        before, after = values[:-width], values[width:]
        for lag in lags.tolist():
            told = before if is_held else before + (lag / width) * (after - before)
            error = values[lag : lag + before.size] - told
            total, count = total + float(error @ error), count + error.size
    if count:
        return total / count
    return inf if any(np.ptp(values) > 0 for values in stretches) or _differ(stretches) else 0.0


def _differ(stretches: list[FloatArray]) -> bool:
    return len({float(values[0]) for values in stretches}) > 1


def find_cuts(recording: Recording, inputs: Collection[str]) -> tuple[Cut, ...]:
    """Find the experiments of one measurement, cut where an input may have moved unseen.

    Empty if there is one, the whole.
    """
    outages = [
        (one.start, one.stop)
        for channel in recording.channels
        if channel.name in inputs
        for one in find_unseen(channel, recording)
    ]
    return list_cuts(recording.start, recording.stop, outages)


def list_cuts(start: float, stop: float, outages: Sequence[tuple[float, float]]) -> tuple[Cut, ...]:
    """List the experiments between outages of a measurement (s); empty if there is none.

    Experiments that are far shorter than the longest are left out: they would bound the time lags
    that are searched.
    """
    if not outages:
        return ()
    spans = list(_list_spans(start, stop, outages))
    longest = max(last - first for first, last in spans)
    kept = [(a, b) for a, b in spans if b - a >= _SHORT_SHARE * longest and b > a]
    reach = _LAG_SHARE * min((b - a for a, b in kept), default=0.0)
    return tuple(
        Cut(a, a if a == start else a + min(_LEAD_SHARE * (b - a), reach), b) for a, b in kept
    )


def list_unseen(recording: Recording) -> dict[str, list[tuple[float, float]]]:
    """List the spans (s) in which each channel may have moved unseen, of those that have some.

    Every segment is looked at by itself.
    """
    spans: dict[str, list[tuple[float, float]]] = {}
    for part in cut_segments(recording):
        for channel in part.channels:
            if np.isfinite(channel.values).any() and (found := find_unseen(channel, part)):
                spans.setdefault(channel.name, []).extend((one.start, one.stop) for one in found)
    return spans


def count_experiments(
    unseen: Mapping[str, Sequence[tuple[float, float]]],
    measurements: Sequence[tuple[float, float]],
    inputs: Collection[str],
) -> int:
    """Count the experiments of measurements, each from a time to a time (s).

    `unseen` is that of `list_unseen`.
    """
    spans = [(a, b) for name in inputs for a, b in unseen.get(name, ())]
    return sum(
        max(len(list_cuts(start, stop, [one for one in spans if start <= one[0] <= stop])), 1)
        for start, stop in measurements
    )


def cut_segments(recording: Recording) -> list[Recording]:
    """Cut a recording into its segments, on its own time axis; itself if there is none."""
    if not recording.segments:
        return [recording]
    return [
        replace(
            recording,
            segments=(),
            channels=tuple(
                channel.slice_time(segment.start, segment.stop)
                for channel in recording.channels
                if np.any((channel.times >= segment.start) & (channel.times <= segment.stop))
            ),
        )
        for segment in recording.segments
    ]


def _list_spans(
    start: float, stop: float, outages: Collection[tuple[float, float]]
) -> Iterator[tuple[float, float]]:
    """List the spans (s) between outages, which may overlap."""
    since = start
    for begin, end in sorted(outages):
        if begin >= since:
            yield since, begin
        since = max(since, end)
    yield since, max(stop, since)


def extract_records(
    recording: Recording, inputs: Mapping[str, str], outputs: Mapping[str, str], name: str = ""
) -> tuple[Record, ...]:
    """Extract the experiments of a recording as records of a model.

    Every segment is one, on its own times. So is every part between outages of the inputs, whose
    samples before the part become its history. Without both there is one experiment.

    Parameters
    ----------
    inputs, outputs : mapping of str to str
        Assignment of channels to signals: model's name → channel's name.

    Raises
    ------
    InvalidRecord
        If a channel is missing, or is both an input and an output. If a channel has no value.
    """
    used = {*inputs.values(), *outputs.values()}
    return tuple(
        experiment.to_record(inputs, outputs, name)
        for part in recording.split_segments()
        for experiment in _cut_out(part, find_cuts(part, inputs.values()), used)
    )


def _cut_out(recording: Recording, cuts: Sequence[Cut], used: set[str]) -> list[Recording]:
    """Cut out the experiments in which all used channels have values; the whole without cuts."""
    if not cuts:
        return [recording]
    parts = [[*_cut_channels(recording.channels, cut)] for cut in cuts]
    kept = [part for part in parts if used <= {channel.name for channel in part}]
    return [replace(recording, channels=tuple(part)) for part in kept] or [recording]


def _cut_channels(channels: Sequence[Channel], cut: Cut) -> Iterator[Channel]:
    """Cut channels; those without a value in the experiment are left out."""
    for channel in channels:
        with suppress(InvalidRecord):
            part = channel.slice_time(cut.known_from, cut.stop)
            if cut.start > cut.known_from:
                part = part.slice_with_history(cut.start, cut.stop)
            select_known(part)
            yield part
