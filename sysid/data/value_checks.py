"""What is wrong with the values of a channel: the same words for files and tables."""

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from sysid.core.types import FloatArray


class TimedValues(Protocol):
    """What is checked of a channel."""

    @property
    def name(self) -> str:
        """Name of the channel, for messages."""

    @property
    def times(self) -> FloatArray:
        """Times (s), shape (N,)."""

    @property
    def values(self) -> FloatArray:
        """Values at these times, shape (N,)."""


def find_infinite_value(channels: Iterable[TimedValues]) -> str | None:
    """Describe the first infinite value of channels; None if there is none."""
    for channel in channels:
        infinite = np.flatnonzero(np.isinf(channel.values))
        if infinite.size:
            return (
                f"channel {channel.name!r} is infinite at t = {channel.times[infinite[0]]:g} s; "
                "values must be finite (NaN is a missing value)"
            )
    return None
