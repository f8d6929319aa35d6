"""Recordings: channels on their own times, segments, and the record a model is compared with."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sysid.errors import InvalidRecord, nearest
from sysid.types import FloatArray

Hold = Literal["zero", "first", "band-limited"]
HOLDS: tuple[Hold, ...] = ("zero", "first", "band-limited")


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One measured signal on its own times.

    Attributes
    ----------
    name, unit : str
    times : FloatArray, shape (N,)
        Seconds from the start of the recording, not decreasing. Samples pooled from several
        repeats may share a time.
    values : FloatArray, shape (N,)
        In `unit`; ``nan`` is a missing value.
    hold : {"zero", "first", "band-limited"}
        What an input does between its samples.

    Raises
    ------
    InvalidRecord
        If the arrays differ in length, are empty, or the times decrease or are not finite.
    """

    name: str
    times: FloatArray
    values: FloatArray
    unit: str = "1"
    hold: Hold = "first"

    def __post_init__(self) -> None:
        if self.times.ndim != 1 or self.times.shape != self.values.shape or self.times.size == 0:
            raise InvalidRecord(
                f"channel {self.name!r} has times of shape {self.times.shape} and values of shape "
                f"{self.values.shape}; need two equal one-dimensional arrays with a sample or more"
            )
        if not np.all(np.isfinite(self.times)) or np.any(np.diff(self.times) < 0):
            raise InvalidRecord(f"the times of channel {self.name!r} decrease or are not finite")


@dataclass(frozen=True, slots=True)
class Segment:
    """A part of a recording that was measured on its own, such as one repeat of a test.

    Segments lie one behind the other on the recording's time axis: a segment's own time is the
    recording's time minus `start`, plus `origin`.
    """

    start: float
    stop: float
    origin: float = 0.0
    labels: Mapping[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """All channels of one dataset, without roles. No segments: it was measured in one piece."""

    channels: tuple[Channel, ...]
    segments: tuple[Segment, ...] = ()

    def channel(self, name: str) -> Channel:
        """The channel of that name.

        Raises
        ------
        InvalidRecord
            If there is none; the message names the nearest.
        """
        for channel in self.channels:
            if channel.name == name:
                return channel
        known = [channel.name for channel in self.channels]
        raise InvalidRecord(f"the recording has no channel {name!r}{nearest(name, known)}")


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """One experiment as a model sees it: channels carry the model's signal names."""

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    name: str = ""
