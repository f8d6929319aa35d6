"""Onset delay: the time from the onset of an input to the onset of its output, without a model.

In an *event* the input leaves a rest. At rest a signal stays within a tolerance, the larger of 1 %
of its range and four standard deviations of its noise. The excursion of a signal is its largest
distance from its level at rest, up to the next event. Its onset is the time from which it stays
farther from that level than a threshold. The threshold is 2 % of the excursion, or four standard
deviations of the noise if that is more. The onset delay is the output's onset minus the input's,
the median over all clear events of a record.

An event is clear under four conditions:

* The input moves by at least 10 % of its range.
* The output was at rest. Extrapolated from its rest, it would not get half way to its threshold.
* The threshold is at most 5 % of the excursion.
* No other input moves in between.

The input's onset is determined in the same way, so a ramp does not count as delay. A held input
moves at its samples. A median needs a limited number of events. If there are more, some are chosen,
evenly spread over the record and out of step with any pattern in it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sysid.core.robust import estimate_deviation
from sysid.core.types import BoolArray, FloatArray
from sysid.data.records import Channel, Record
from sysid.models.model import Model

ONSET_SHARE = 0.02
"""Share of the excursion at which a signal has left its level."""

_NOISE_DEVIATIONS = 4.0  # standard deviations: noise may reach so far without an onset
_MAX_ONSET_SHARE = 0.05  # of the excursion: a higher threshold defines no onset
_REST_TOLERANCE = 0.01  # of the range: a signal at rest stays within it
_NOTABLE_STEP = 0.1  # of the input's range: a step that counts
_REST_SAMPLES = 10  # samples at least
_LEVEL_SHARE = 0.25  # of a rest: its last part, which defines the level
_MAX_CREEP = 0.5  # of the threshold: a signal with more drift is not at rest
_STAY_SAMPLES = 3  # samples beyond the threshold that make an onset
_SPIKE_REACH = 2  # neighbours on either side
_MAX_EVENTS = 500  # limit on the events examined
_GOLDEN_RATIO = 0.5 * (sqrt(5.0) - 1.0)


@dataclass(frozen=True, slots=True)
class OnsetDelay:
    """Onset delay of one output behind one input in one experiment.

    Attributes
    ----------
    experiment : int
        Record, from 0.
    input : str
        Input of the model.
    output : str
        Output of the model.
    delay : float or None
        Median over the events, s; if there is none, `reason` says why.
    spread : float or None
        Standard deviation over the events, s; none with fewer than two.
    events : int
        Number of clear events among those examined.
    threshold : float or None
        Largest share of the excursion at which the output counted as moving.
    reason : str
        Why there is no delay; empty with one.
    unit : str
        Unit of delay and spread: s.
    """

    experiment: int
    input: str
    output: str
    delay: float | None
    spread: float | None = None
    events: int = 0
    threshold: float | None = None
    reason: str = ""
    unit: str = "s"


class _InputEvent(NamedTuple):
    """The input rests from `rest_start` to `rest_end`; responses end at `response_end` (s)."""

    rest_start: float
    rest_end: float
    response_end: float


class _Onset(NamedTuple):
    time: float
    excursion: float
    share: float


def estimate_onset_delays(model: Model, records: Sequence[Record]) -> tuple[OnsetDelay, ...]:
    """Estimate the onset delay of every output behind every input, record by record."""
    inputs = {channel.name for channel in model.inputs}
    outputs = {channel.name for channel in model.outputs}
    return tuple(
        _estimate_pair_delay(
            number, cause, response, [channel for channel in moving if channel is not cause]
        )
        for number, record in enumerate(records)
        for moving in [[one.acting for one in record.inputs if one.name in inputs]]
        for cause in moving
        for response in record.outputs
        if response.name in outputs
    )


def find_unprompted_output(
    record: Record, spans: Mapping[str, float] | None = None
) -> tuple[str, float] | None:
    """Find the first output that moves before any input, and when (s); None if there is none.

    A record that begins with the step itself looks like this, because the step precedes all
    samples. The output must move a tenth of its range before an input moves a hundredth of its own.
    If both grow slowly from nothing, either can be the first to leave its rest. `spans` are the
    ranges of the outputs over all records: in one in which nothing moves, noise has all the range.
    """
    first_input_move = min(
        (_find_first_move(channel.acting.history_and_samples) for channel in record.inputs),
        default=-inf,
    )
    early_outputs = []
    for output in record.outputs:
        is_measured = np.isfinite(output.values)
        times, values = output.times[is_measured], _remove_spikes(output.values[is_measured])
        rest_end = _find_rest_end(times, values)
        if not rest_end < first_input_move:
            continue
        rest = times <= rest_end
        distance = np.abs(values[times <= first_input_move] - np.mean(values[rest]))
        span = max(float(np.ptp(values)), (spans or {}).get(output.name, 0.0))
        if float(np.max(distance)) < _NOTABLE_STEP * span:
            continue
        if _extrapolate_creep(
            times[rest], values[rest], rest_end
        ) <= _MAX_CREEP * _compute_tolerance(values):
            early_outputs.append((rest_end, output.name))
    return None if not early_outputs else (min(early_outputs)[1], min(early_outputs)[0])


def _remove_spikes(values: FloatArray) -> FloatArray:
    """Replace each sample by the median of five neighbours: one or two outliers are no move."""
    if values.size < 2 * _SPIKE_REACH + 1:
        return values
    padded = np.pad(values, _SPIKE_REACH, mode="edge")
    return np.asarray(np.median(sliding_window_view(padded, 2 * _SPIKE_REACH + 1), axis=1))


def _find_first_move(channel: Channel) -> float:
    """Find when (s) an input has moved 1 % of its range, with its noise; inf if constant."""
    has_moved = np.abs(channel.values - channel.values[0]) > _REST_TOLERANCE * float(
        np.ptp(channel.values)
    )
    return float(channel.times[np.argmax(has_moved)]) if np.any(has_moved) else inf


def _find_rest_end(times: FloatArray, values: FloatArray) -> float:
    """Find the end of the initial rest of a signal; inf if it has none or never leaves it."""
    first = next(iter(_find_rests(values)), None)
    if first is None or first[0] > 0:
        return inf
    return inf if first[1] >= values.size else float(times[first[1] - 1])


def _estimate_pair_delay(
    number: int, cause: Channel, response: Channel, others: Sequence[Channel]
) -> OnsetDelay:
    is_measured = np.isfinite(response.values)
    times, values = response.times[is_measured], response.values[is_measured]
    if np.any(np.diff(times) <= 0):
        return OnsetDelay(
            number,
            cause.name,
            response.name,
            None,
            reason="several samples share a time: repeats were pooled",
        )
    events = list(_find_input_events(cause))
    if not events:
        reason = "the input does not rest before it moves"
        return OnsetDelay(number, cause.name, response.name, None, reason=reason)
    noise = (_estimate_noise(cause.values), _estimate_noise(values))
    notable = _NOTABLE_STEP * float(np.ptp(cause.values))
    resting = [(item, _compute_tolerance(item.values)) for item in others]
    onsets: list[tuple[float, float]] = []
    for event in _thin_events(events):
        pair = _find_event_onsets(event, cause, (times, values), noise, notable)
        if pair is not None and not any(
            _has_moved(*item, event.rest_start, pair[1].time) for item in resting
        ):
            onsets.append((pair[1].time - pair[0].time, pair[1].share))
    if not onsets:
        reason = "the output does not rest before any step of the input, or its step is not clear"
        return OnsetDelay(number, cause.name, response.name, None, reason=reason)
    delays = np.array([delay for delay, _ in onsets])
    spread = float(np.std(delays, ddof=1)) if delays.size > 1 else None
    share = max(share for _, share in onsets)
    return OnsetDelay(
        number, cause.name, response.name, float(np.median(delays)), spread, len(onsets), share
    )


def _thin_events(events: Sequence[_InputEvent]) -> Sequence[_InputEvent]:
    """Return all events, or a limited number of them, evenly chosen from the first on.

    Multiples of the golden ratio are as even as possible and follow no pattern. Every second event
    of a square wave, for example, would be a rising edge.
    """
    if len(events) <= _MAX_EVENTS:
        return events
    turns = (_GOLDEN_RATIO * np.arange(len(events))) % 1.0
    return [events[i] for i in np.sort(np.argsort(turns, kind="stable")[:_MAX_EVENTS])]


def _find_event_onsets(
    event: _InputEvent,
    cause: Channel,
    output: tuple[FloatArray, FloatArray],
    noise: tuple[float, float],
    notable: float,
) -> tuple[_Onset, _Onset] | None:
    """Find the onsets of input and output at one event; None if one is not clear."""
    is_held = cause.effective_hold == "zero"
    input_onset = _find_onset(cause.times, cause.values, event, noise[0], held=is_held)
    if input_onset is None or input_onset.excursion < notable:
        return None
    output_onset = _find_onset(*output, event, noise[1], held=False)
    # An output that moves before its input is not moved by it.
    return (
        None
        if output_onset is None or output_onset.time < input_onset.time
        else (input_onset, output_onset)
    )


def _find_onset(
    times: FloatArray, values: FloatArray, event: _InputEvent, noise: float, *, held: bool
) -> _Onset | None:
    """Find when a signal leaves its level of rest before an event; None if not clear."""
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
    if not 0 < threshold <= _MAX_ONSET_SHARE * excursion:
        return None
    onset = _find_crossing(times[after], distance, threshold, excursion, held=held)
    if (
        onset is None
        or _extrapolate_creep(times[before], rest, onset.time) > _MAX_CREEP * threshold
    ):
        return None
    return onset


def _extrapolate_creep(times: FloatArray, rest: FloatArray, until: float) -> float:
    """Extrapolate how far the trend at rest moves a signal from its mean at rest."""
    centre = float(np.mean(times))
    ahead = times - centre
    slope = float(ahead @ (rest - np.mean(rest))) / float(ahead @ ahead)
    return abs(slope * (until - centre))


def _find_crossing(
    times: FloatArray, distance: FloatArray, threshold: float, excursion: float, *, held: bool
) -> _Onset | None:
    """Find when a distance passes a threshold and stays beyond it for a few samples."""
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
    """Iterate over the events of an input, each with the end of its response."""
    rests = _find_cached_rests(np.asarray(channel.values, dtype=np.float64).tobytes())
    times = channel.times
    for number, (start, stop) in enumerate(rests):
        if stop >= times.size:
            break
        following = rests[number + 1][1] if number + 1 < len(rests) else times.size
        # The last sample at rest: an onset may lie between it and the next sample.
        end = float(times[following - 1])
        yield _InputEvent(float(times[start]), float(times[stop - 1]), end)


@lru_cache(maxsize=2)
def _find_cached_rests(values: bytes) -> tuple[tuple[int, int], ...]:
    """Find the rests of an input from its bytes; cached for sweeps, where only outputs differ."""
    return tuple(_find_rests(np.frombuffer(values)))


def _find_rests(values: FloatArray) -> list[tuple[int, int]]:
    """Find stretches (first, beyond the last) of at least ten samples within the tolerance."""
    if values.size <= _REST_SAMPLES:
        return []
    tolerance = _compute_tolerance(values)
    is_still = (
        _compute_running_extreme(values, np.maximum) - _compute_running_extreme(values, np.minimum)
        <= tolerance
    )
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_still, [False]]).astype(np.int8)))
    return [
        (int(a), int(b) - 1 + _REST_SAMPLES) for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _compute_running_extreme(values: FloatArray, extreme: np.ufunc) -> FloatArray:
    """Compute the extreme of every ten neighbours, from those of two, four and eight."""
    for reach in (1, 2, 4, _REST_SAMPLES - 8):
        values = extreme(values[:-reach], values[reach:])
    return values


def _compute_tolerance(values: FloatArray) -> float:
    """Compute the tolerance of a rest; once for a channel, because it reads every sample."""
    return max(
        _REST_TOLERANCE * float(np.ptp(values)), 2.0 * _NOISE_DEVIATIONS * _estimate_noise(values)
    )


def _has_moved(channel: Channel, tolerance: float, start: float, stop: float) -> bool:
    """Return whether an input leaves its tolerance between two times."""
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
    """Estimate the standard deviation of white noise on a signal from second differences.

    The few samples at which the signal itself bends do not affect their median.
    """
    if values.size < _REST_SAMPLES:
        return 0.0
    return estimate_deviation(np.diff(values, 2)) / sqrt(6.0)
