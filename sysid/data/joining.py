"""Join recordings that were made at the same time by several loggers, on one clock.

Nothing is resampled: each channel keeps its own times. Between its samples an input is read by its
hold, and an output is compared at its own times.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sysid.core.errors import InvalidRecord
from sysid.data.foreign_tables import find_first_start, measure_distance
from sysid.data.records import Channel, Recording


class _Joined(NamedTuple):
    """A channel on the common clock, with the name of its recording."""

    source: str
    channel: Channel


def join_recordings(recordings: Mapping[str, Recording]) -> tuple[Recording, tuple[str, ...]]:
    """Join recordings by their clocks; without clocks their times 0 s are the same moment.

    A channel that a later recording goes on with becomes longer. Channels of one name that were
    measured at the same time are called ``recording.channel``.

    Parameters
    ----------
    recordings : mapping of str to Recording
        By their names.

    Returns
    -------
    recording : Recording
    notes : tuple of str
        How the recordings lie to each other, which channels go on, and which have a new name.

    Raises
    ------
    InvalidRecord
        If only some have a clock or a time zone, one has segments, or they have no time in common.
        Also if they have the same channels at the same times: these are experiments.

    Examples
    --------
    >>> supply = Recording({"t": [0.0, 1.0, 2.0], "supply": [40.0, 41.0, 45.0]})
    >>> room = Recording({"t": [0.5, 1.7], "room": [20.0, 20.5]})
    >>> joined, notes = join_recordings({"supply": supply, "room": room})
    >>> joined.names, joined.channel("room").times.tolist()
    (('supply', 'room'), [0.5, 1.7])
    """
    _check_recordings(recordings)
    origin = find_first_start(one.started_at for one in recordings.values())
    notes = [_describe_clocks(recordings, origin)]
    parts: dict[str, list[_Joined]] = {}
    for source, recording in recordings.items():
        for channel in recording.channels:
            moved = _move_channel(channel, recording.started_at, origin)
            parts.setdefault(channel.name, []).append(_Joined(source, moved))
    _check_experiments(recordings, parts)
    channels: list[Channel] = []
    for name, same in parts.items():
        same.sort(key=lambda part: float(part.channel.times[0]))
        if len(same) == 1:
            channels.append(same[0].channel)
        elif _follow_each_other(same):
            channels.append(_append(same))
            later = ", ".join(part.source for part in same[1:])
            notes.append(f"channel {name!r} of {same[0].source} goes on in {later}")
        else:
            named = [replace(p.channel, name=f"{p.source}.{name}") for p in same]
            channels += named
            notes.append(f"channels called {name!r} are now {_list([c.name for c in named])}")
    _check_overlap(channels)
    notes.append(
        "each channel keeps its own times, and nothing is resampled. An input is read between its "
        "samples by its hold, an output is compared at its own"
    )
    return Recording(tuple(channels), started_at=origin), tuple(notes)


def _check_recordings(recordings: Mapping[str, Recording]) -> None:
    for name, recording in recordings.items():
        if recording.segments:
            raise InvalidRecord(f"{name} has segments; only one measurement can be joined")
        if any(channel.repeats is not None for channel in recording.channels):
            raise InvalidRecord(f"{name} has pooled repeats; only one measurement can be joined")
    without = [name for name, one in recordings.items() if one.started_at is None]
    if without and len(without) < len(recordings):
        dated = next(name for name in recordings if name not in without)
        raise InvalidRecord(
            f"{dated} has dates and {_list(without)} none, so their distance is not known. Write "
            "dates in all, or in all seconds from the same moment"
        )


def _describe_clocks(recordings: Mapping[str, Recording], origin: datetime | None) -> str:
    if origin is None:
        return f"{_list(list(recordings))} have no clock: time 0 s is taken for the same moment"
    shifts = {
        name: measure_distance(one.started_at or origin, origin) + one.start
        for name, one in recordings.items()
    }
    first = min(shifts, key=lambda name: shifts[name])
    told = [
        f"{name} begins {shift - shifts[first]:.6g} s later"
        for name, shift in shifts.items()
        if name != first
    ]
    return f"clocks are joined: {first} begins first, {', '.join(told)}"


def _move_channel(channel: Channel, start: datetime | None, origin: datetime | None) -> Channel:
    """Return a channel with its times from the common origin."""
    shift = 0.0 if start is None or origin is None else measure_distance(start, origin)
    history = channel.history
    if history is not None:
        history = history._replace(times=history.times + shift)
    return replace(
        channel,
        times=np.round(channel.times + shift, 9) if shift else channel.times,
        history=history,
        started_at=origin,
    )


def _check_experiments(
    recordings: Mapping[str, Recording], parts: Mapping[str, Sequence[_Joined]]
) -> None:
    """Refuse recordings of the same channels at the same times: they are experiments."""
    is_same = len({frozenset(one.names) for one in recordings.values()}) == 1
    several = [same for same in parts.values() if not _follow_each_other(same)]
    if is_same and len(several) > 1:
        names = list(recordings)
        raise InvalidRecord(
            f"{_list(names)} have the same channels at the same times, so they are experiments. "
            "Fit them jointly: identify(model, [first, second]), or a job with both datasets"
        )


def _follow_each_other(parts: Sequence[_Joined]) -> bool:
    """Whether channels of one name and unit follow each other in time."""
    ordered = sorted((part.channel for part in parts), key=lambda channel: float(channel.times[0]))
    return len({channel.unit for channel in ordered}) == 1 and all(
        before.times[-1] < after.times[0] for before, after in pairwise(ordered)
    )


def _append(parts: Sequence[_Joined]) -> Channel:
    channels = [part.channel for part in parts]
    return replace(
        channels[0],
        times=np.concatenate([channel.times for channel in channels]),
        values=np.concatenate([channel.values for channel in channels]),
    )


def _check_overlap(channels: Sequence[Channel]) -> None:
    """Refuse channels that have no time in common."""
    last = max(channels, key=lambda channel: float(channel.times[0]))
    first = min(channels, key=lambda channel: float(channel.times[-1]))
    if last.times[0] > first.times[-1]:
        raise InvalidRecord(
            f"channel {first.name!r} ends at {first.times[-1]:.6g} s, before {last.name!r} begins "
            f"at {last.times[0]:.6g} s; there is no time in common"
        )


def _list(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
