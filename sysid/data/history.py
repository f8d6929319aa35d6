"""History: the samples before a recording that was cut out of a longer one.

For t < L a model reads u(t - L) from before the record's first sample. If the record was cut out
of a longer one, these samples were measured. They are stored as history. Delays read it; the loss
does not.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.records import Channel, History, Recording, Segment

INTERPOLATION_MARGIN = 128
"""Samples beyond the longest delay, for the interpolation of a band-limited input."""


def attach_history(part: Recording, whole: Recording) -> Recording:
    """Attach to a part of a recording the samples before it as history.

    The history is as long as the part, because no delay may be longer than its record. With
    segments it is limited to the segment that is cut, since each was measured on its own.
    """
    earliest = part.start - part.duration
    segment_start = -np.inf
    if part.segments:
        segment_start = _find_segment_start(whole.segments, part.segments[0].start)
    channels = tuple(
        _limit_history(
            channel.prepend_history(whole.channel(channel.name)), earliest, segment_start
        )
        for channel in part.channels
    )
    return replace(part, channels=channels)


def drop_history(recording: Recording) -> Recording:
    """Remove the history of all channels."""
    return replace(
        recording, channels=tuple(replace(channel, history=None) for channel in recording.channels)
    )


def change_values(
    channel: Channel, change: Callable[[FloatArray, FloatArray], FloatArray]
) -> Channel:
    """Change the values of a channel and of its history by the same rule.

    Parameters
    ----------
    change : callable
        Maps times (N,) and values (N,) to new values (N,).
    """
    history = channel.history
    if history is not None:
        history = history._replace(values=change(*history))
    return replace(channel, values=change(channel.times, channel.values), history=history)


def _find_segment_start(segments: tuple[Segment, ...], start: float) -> float:
    """Find where the segment at a time starts; -inf for the first, which has its own history."""
    if start <= segments[0].stop:
        return -np.inf
    return max(segment.start for segment in segments if segment.start <= start)


def _limit_history(channel: Channel, earliest: float, segment_start: float) -> Channel:
    if channel.history is None:
        return channel
    times, values = channel.history
    reached = max(int(np.searchsorted(times, earliest)) - INTERPOLATION_MARGIN, 0)
    first = max(reached, int(np.searchsorted(times, segment_start)))
    if first == times.size:
        return replace(channel, history=None)
    return replace(channel, history=History(times[first:].copy(), values[first:].copy()))
