"""Onset delay: how long after an input begins to move its output begins to move.

An *event* is the input leaving a rest. A rest is a stretch in which it stays within a tolerance,
the larger of 1 % of its range and four standard deviations of its noise. From there on, up to the
next event, the excursion of a signal is its largest distance from its level at rest, and its onset
is the time from which on it stays further from that level than 2 % of the excursion (or four
standard deviations of its noise, if that is more). The onset delay is the output's onset less the
input's, the median over all clear events of a record.

An event is clear if the input moves by 10 % of its range or more, if the output was at rest before
it (going on as it went there, it would not have come half way to its threshold), if its threshold
is not above 5 % of its excursion, and if no other input moves in between.
The input's own onset is taken the same way, so that a ramp is not counted as delay; an input that
is held moves at its samples. Both read the measurement: no model enters. Of very many events some,
spread evenly over the record and in step with no pattern in it, are enough for a median.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from sysid.core.types import BoolArray, FloatArray
from sysid.data.records import Channel, Record
from sysid.models.model import Model

ONSET_SHARE = 0.02
"""Part of the excursion at which a signal has left its level."""

_NOISE_DEVIATIONS = 4.0  # standard deviations that noise may reach without being an onset
_LARGEST_ONSET_SHARE = 0.05  # a threshold above this part of the excursion tells no onset
_REST_TOLERANCE = 0.01  # of the range: a signal at rest stays within it
_NOTABLE_STEP = 0.1  # of the input's range: a step that counts
_REST_SAMPLES = 10  # samples at least
_LEVEL_SHARE = 0.25  # of a rest: the part from which the level is taken
_MOST_CREEP = 0.5  # of the threshold: what still moves so far by itself is not at rest
_STAY_SAMPLES = 3  # samples beyond the threshold that make an onset
_MOST_EVENTS = 500  # events that are looked at
_GOLDEN_RATIO = 0.5 * (sqrt(5.0) - 1.0)


@dataclass(frozen=True, slots=True)
class OnsetDelay:
    """Onset delay of one output behind one input in one experiment.

    Attributes
    ----------
    experiment : int
        From 0.
    delay : float or None
        Median over the events, s; None: see `reason`.
    spread : float or None
        Standard deviation over the events, s; None with fewer than two.
    events : int
        How many were clear, of those looked at.
    threshold : float or None
        Part of the excursion at which the output counted as having left, the largest of them.
    """

    experiment: int
    input: str
    output: str
    delay: float | None
    spread: float | None = None
    events: int = 0
    threshold: float | None = None
    reason: str = ""


class _InputEvent(NamedTuple):
    """The input rests from `rest` to `leaves` and may move until `until` (s)."""

    rest_start: float
    rest_end: float
    response_end: float


class _Onset(NamedTuple):
    time: float
    excursion: float
    share: float


def estimate_onset_delays(model: Model, records: Sequence[Record]) -> tuple[OnsetDelay, ...]:
    """Onset delay of every output behind every input, record by record."""
    inputs = {one.name for one in model.inputs}
    outputs = {one.name for one in model.outputs}
    return tuple(
        _estimate_pair_delay(number, first, then, [one for one in moving if one is not first])
        for number, record in enumerate(records)
        for moving in [[one for one in record.inputs if one.name in inputs]]
        for first in moving
        for then in record.outputs
        if then.name in outputs
    )


def find_unprompted_output(record: Record) -> tuple[str, float] | None:
    """The first output that leaves a rest before any input does, and when (s); None if none does.

    So a record looks that begins with the step itself: the step is then before all samples. The
    output goes a tenth of its range before an input has gone a hundredth of its own: where both
    grow slowly from nothing, either may be the first to leave its rest.
    """
    inputs = min((_find_first_move(one.history_and_samples) for one in record.inputs), default=-inf)
    found = []
    for output in record.outputs:
        there = np.isfinite(output.values)
        times, values = output.times[there], output.values[there]
        leaves = _find_rest_end(times, values)
        if not leaves < inputs:
            continue
        rest = times <= leaves
        way = np.abs(values[times <= inputs] - np.mean(values[rest]))
        if float(np.max(way)) < _NOTABLE_STEP * float(np.ptp(values)):
            continue
        if _extrapolate_creep(
            times[rest], values[rest], leaves
        ) <= _MOST_CREEP * _compute_tolerance(values):
            found.append((leaves, output.name))
    return None if not found else (min(found)[1], min(found)[0])


def _find_first_move(channel: Channel) -> float:
    """When an input has gone 1 % of its range, its noise included: s; inf if it is constant."""
    away = np.abs(channel.values - channel.values[0]) > _REST_TOLERANCE * float(
        np.ptp(channel.values)
    )
    return float(channel.times[np.argmax(away)]) if np.any(away) else inf


def _find_rest_end(times: FloatArray, values: FloatArray) -> float:
    """The last time of the rest that a signal begins with: inf without one or if all is rest."""
    first = next(iter(_find_rests(values)), None)
    if first is None or first[0] > 0:
        return inf
    return inf if first[1] >= values.size else float(times[first[1] - 1])


def _estimate_pair_delay(
    number: int, first: Channel, then: Channel, others: Sequence[Channel]
) -> OnsetDelay:
    known = np.isfinite(then.values)
    times, values = then.times[known], then.values[known]
    if np.any(np.diff(times) <= 0):
        return OnsetDelay(
            number,
            first.name,
            then.name,
            None,
            reason="several samples share a time: repeats were pooled",
        )
    events = list(_find_input_events(first))
    if not events:
        reason = "the input does not rest before it moves"
        return OnsetDelay(number, first.name, then.name, None, reason=reason)
    noise = (_estimate_noise(first.values), _estimate_noise(values))
    notable = _NOTABLE_STEP * float(np.ptp(first.values))
    still = [(one, _compute_tolerance(one.values)) for one in others]
    found: list[tuple[float, float]] = []
    for event in _thin_events(events):
        pair = _find_event_onsets(event, first, (times, values), noise, notable)
        if pair is not None and not any(
            _has_moved(*one, event.rest_start, pair[1].time) for one in still
        ):
            found.append((pair[1].time - pair[0].time, pair[1].share))
    if not found:
        reason = "the output does not rest before any step of the input, or its step is not clear"
        return OnsetDelay(number, first.name, then.name, None, reason=reason)
    delays = np.array([delay for delay, _ in found])
    spread = float(np.std(delays, ddof=1)) if delays.size > 1 else None
    share = max(share for _, share in found)
    return OnsetDelay(
        number, first.name, then.name, float(np.median(delays)), spread, len(found), share
    )


def _thin_events(events: Sequence[_InputEvent]) -> Sequence[_InputEvent]:
    """All events, or of more than are needed as many as are, from the first on.

    Their places times the golden ratio are as even as can be, and in step with no pattern: every
    second event of a square wave would be a rising edge.
    """
    if len(events) <= _MOST_EVENTS:
        return events
    turns = (_GOLDEN_RATIO * np.arange(len(events))) % 1.0
    return [events[i] for i in np.sort(np.argsort(turns, kind="stable")[:_MOST_EVENTS])]


def _find_event_onsets(
    event: _InputEvent,
    first: Channel,
    output: tuple[FloatArray, FloatArray],
    noise: tuple[float, float],
    notable: float,
) -> tuple[_Onset, _Onset] | None:
    """Onsets of input and output at one event; None if one is not clear."""
    held = first.hold == "zero"
    moved = _find_onset(first.times, first.values, event, noise[0], held=held)
    if moved is None or moved.excursion < notable:
        return None
    answered = _find_onset(*output, event, noise[1], held=False)
    # What moves before its input does is not moved by it.
    return None if answered is None or answered.time < moved.time else (moved, answered)


def _find_onset(
    times: FloatArray, values: FloatArray, event: _InputEvent, noise: float, *, held: bool
) -> _Onset | None:
    """When a signal leaves the level at which it rests before an event; None if not clear."""
    before = _slice_times(
        times, event.rest_end - _LEVEL_SHARE * (event.rest_end - event.rest_start), event.rest_end
    )
    after = _slice_times(times, event.rest_end, event.response_end)
    if before.stop - before.start < _REST_SAMPLES // 2 or after.stop - after.start < _STAY_SAMPLES:
        return None
    rest = values[before]
    level = float(np.mean(rest))
    distance = np.abs(values[after] - level)
    excursion = float(np.max(distance))
    threshold = max(ONSET_SHARE * excursion, _NOISE_DEVIATIONS * noise)
    if not 0 < threshold <= _LARGEST_ONSET_SHARE * excursion:
        return None
    found = _find_crossing(times[after], distance, threshold, excursion, held=held)
    if (
        found is None
        or _extrapolate_creep(times[before], rest, found.time) > _MOST_CREEP * threshold
    ):
        return None
    return found


def _extrapolate_creep(times: FloatArray, rest: FloatArray, until: float) -> float:
    """How far a signal would have gone from its mean at rest had it gone on as it did there."""
    centre = float(np.mean(times))
    ahead = times - centre
    slope = float(ahead @ (rest - np.mean(rest))) / float(ahead @ ahead)
    return abs(slope * (until - centre))


def _find_crossing(
    times: FloatArray, distance: FloatArray, threshold: float, excursion: float, *, held: bool
) -> _Onset | None:
    """The first time at which a distance passes a threshold and stays beyond for a few samples."""
    beyond: BoolArray = distance > threshold
    stays = beyond[: beyond.size - _STAY_SAMPLES + 1].copy()
    for later in range(1, _STAY_SAMPLES):
        stays &= beyond[later : later + stays.size]
    k = int(np.argmax(stays))
    if not stays[k]:
        return None
    time = float(times[k])
    if k > 0 and not held:
        low, high = float(distance[k - 1]), float(distance[k])
        time -= (high - threshold) / (high - low) * float(times[k] - times[k - 1])
    return _Onset(time, excursion, threshold / excursion)


def _find_input_events(channel: Channel) -> Iterator[_InputEvent]:
    """The ends of the rests of an input, each with the time up to which its response is read."""
    rests = _find_cached_rests(np.asarray(channel.values, dtype=np.float64).tobytes())
    times = channel.times
    for number, (start, stop) in enumerate(rests):
        if stop >= times.size:
            break
        following = rests[number + 1][1] if number + 1 < len(rests) else times.size
        # Its last value at rest, for an onset may lie between that and the next sample.
        end = float(times[following - 1])
        yield _InputEvent(float(times[start]), float(times[stop - 1]), end)


@lru_cache(maxsize=2)
def _find_cached_rests(values: bytes) -> tuple[tuple[int, int], ...]:
    """The rests of an input, of its values' bytes: kept for a sweep, whose outputs alone differ."""
    return tuple(_find_rests(np.frombuffer(values)))


def _find_rests(values: FloatArray) -> list[tuple[int, int]]:
    """Stretches (first, beyond the last) of ten samples or more within the tolerance."""
    if values.size <= _REST_SAMPLES:
        return []
    tolerance = _compute_tolerance(values)
    still = (
        _compute_running_extreme(values, np.maximum) - _compute_running_extreme(values, np.minimum)
        <= tolerance
    )
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    return [
        (int(a), int(b) - 1 + _REST_SAMPLES) for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _compute_running_extreme(values: FloatArray, extreme: np.ufunc) -> FloatArray:
    """Extreme of every ten neighbours: of two, of four, of eight, of ten of them."""
    for reach in (1, 2, 4, _REST_SAMPLES - 8):
        values = extreme(values[:-reach], values[reach:])
    return values


def _compute_tolerance(values: FloatArray) -> float:
    """Within which a signal rests; told once for a channel, as it reads every sample."""
    return max(
        _REST_TOLERANCE * float(np.ptp(values)), 2.0 * _NOISE_DEVIATIONS * _estimate_noise(values)
    )


def _has_moved(channel: Channel, tolerance: float, start: float, stop: float) -> bool:
    """Whether an input leaves its tolerance between two times."""
    span = _slice_times(channel.times, start, stop)
    part = channel.values[max(span.start - 1, 0) : span.stop]
    if part.size == 0:
        return False
    return bool(np.ptp(part) > tolerance)


def _slice_times(times: FloatArray, start: float, stop: float) -> slice:
    return slice(
        int(np.searchsorted(times, start, "left")), int(np.searchsorted(times, stop, "right"))
    )


def _estimate_noise(values: FloatArray) -> float:
    """Standard deviation of white noise on a signal, from its second differences.

    Their median is not moved by the few samples at which the signal itself bends.
    """
    if values.size < _REST_SAMPLES:
        return 0.0
    bend = np.diff(values, 2)
    return 1.4826 * float(np.median(np.abs(bend))) / sqrt(6.0)
