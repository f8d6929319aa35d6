"""What recordings that are cut out of others keep of what was recorded before them.

For t < L a model reads u(t - L) from before the record's first sample. Where a record was cut out
of a longer one that input is known, so it goes with the record: as history, which lags read and
nothing is compared with.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.records import Channel, History, Recording, Segment

INTERPOLATION_MARGIN = 128
"""Samples besides those that a lag can reach: between them a band-limited input is interpolated."""


def attach_history(part: Recording, whole: Recording) -> Recording:
    """A recording with what the one it was cut out of holds before it.

    As long as the part itself: no lag may be longer than the record it is found from. Where the
    recording has segments, of the segment that is cut only, since each was measured on its own.
    """
    earliest = part.start - part.duration
    since = -np.inf
    if part.segments:
        since = _find_segment_start(whole.segments, part.segments[0].start)
    channels = tuple(
        _limit_history(one.prepend_history(whole.channel(one.name)), earliest, since)
        for one in part.channels
    )
    return replace(part, channels=channels)


def drop_history(recording: Recording) -> Recording:
    """The recording as if nothing were known of what was before it."""
    return replace(
        recording, channels=tuple(replace(one, history=None) for one in recording.channels)
    )


def change_values(
    channel: Channel, change: Callable[[FloatArray, FloatArray], FloatArray]
) -> Channel:
    """The channel with other values, those of its history changed by the same rule.

    Parameters
    ----------
    change : callable
        From times (N,) and values (N,) to values (N,).
    """
    history = channel.history
    if history is not None:
        history = history._replace(values=change(*history))
    return replace(channel, values=change(channel.times, channel.values), history=history)


def _find_segment_start(segments: tuple[Segment, ...], start: float) -> float:
    """From when on the segment goes that holds this time; the first one's history is its own."""
    if start <= segments[0].stop:
        return -np.inf
    return max(one.start for one in segments if one.start <= start)


def _limit_history(channel: Channel, earliest: float, since: float) -> Channel:
    if channel.history is None:
        return channel
    times, values = channel.history
    reached = max(int(np.searchsorted(times, earliest)) - INTERPOLATION_MARGIN, 0)
    first = max(reached, int(np.searchsorted(times, since)))
    if first == times.size:
        return replace(channel, history=None)
    return replace(channel, history=History(times[first:].copy(), values[first:].copy()))
