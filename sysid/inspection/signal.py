"""A signal of a recording as it is inspected: its samples with a value, and what follows from them.

The kinds of this folder ask it. They know no model: what a channel is for is known only sometimes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from sysid.core.findings import Family, Finding
from sysid.core.text import join_names
from sysid.core.types import BoolArray, FloatArray, IntArray
from sysid.core.units import format_unit
from sysid.data.records import Channel, Recording, select_known

Role = Literal["input", "output"]
_LISTED = 4  # names in a sentence
MIN_SAMPLES = 20
"""Shorter signals are not asked what their values are like."""
LIMIT_SAMPLES, LIMIT_SHARE = 5, 0.02
"""Equal readings at an end of the range, and their share of all, that make it a limit.

Measured with `benchmarks.judgement`, a record of each of 102 kinds: half and twice the share leave
all statuses.
"""


class Runs(NamedTuple):
    """Runs of equal values: the first sample of each, and how many it has."""

    starts: IntArray
    lengths: IntArray


@dataclass(frozen=True, eq=False)
class Signal:
    """A channel of a recording, and its role if that is known."""

    whole: Channel
    recording: Recording
    role: Role | None = None

    @cached_property
    def measured_part(self) -> Channel:
        """The samples with a value."""
        return select_known(self.whole)

    @property
    def name(self) -> str:
        """Name of the channel."""
        return self.whole.name

    @property
    def times(self) -> FloatArray:
        """Times (s) of the samples with a value."""
        return self.measured_part.times

    @property
    def values(self) -> FloatArray:
        """Their values."""
        return self.measured_part.values

    @cached_property
    def span(self) -> float:
        """Range of the values."""
        return float(np.ptp(self.values))

    @cached_property
    def steps(self) -> FloatArray:
        """Differences of neighbouring values."""
        return np.diff(self.values)

    @cached_property
    def levels(self) -> FloatArray:
        """Values that occur, ascending."""
        return np.unique(self.values)

    @cached_property
    def quantum(self) -> float:
        """Smallest difference between two values that differ; 0 without one."""
        gaps = np.diff(self.levels)
        real = gaps[gaps > 1e-9 * self.span]
        return float(np.min(real)) if real.size else 0.0

    @cached_property
    def runs(self) -> Runs:
        """Runs of equal values."""
        starts = np.concatenate([[0], np.flatnonzero(self.steps) + 1]).astype(np.int64)
        return Runs(starts, np.diff(np.append(starts, self.values.size)))

    @cached_property
    def is_held(self) -> bool:
        """Whether it is a command: piecewise constant, and no output."""
        return self.role != "output" and self.measured_part.effective_hold == "zero"

    @property
    def is_told(self) -> bool:
        """Whether there are enough samples that move."""
        return self.values.size >= MIN_SAMPLES and self.span > 0 and self.whole.repeats is None

    def format_value(self, value: float) -> str:
        """Format a value with its unit."""
        return f"{value:.4g}{format_unit(self.whole.unit)}"

    def take_span(self, first: int, last: int) -> tuple[float, float]:
        """Return the times (s) of two samples."""
        return float(self.times[first]), float(self.times[last])


def list_names(names: Sequence[str]) -> str:
    """List the names of channels in a sentence; the first few of many."""
    if len(names) <= _LISTED + 1:
        return join_names(names)
    return f"{', '.join(names[:_LISTED])} and {len(names) - _LISTED} more"


def build_finding(
    explanation: str,
    family: Family,
    text: str,
    channels: tuple[str, ...],
    spans: tuple[tuple[float, float], ...] = (),
    advice: str = "",
) -> Finding:
    """Build a note about channels of a recording."""
    return Finding(
        explanation, family, "note", explanation, text, advice, channels=channels, spans=spans
    )


def find_limited(values: FloatArray) -> BoolArray:
    """Find values at an end of the range that has many: a sensor at its limit."""
    limited = np.zeros(values.size, dtype=np.bool_)
    for limit in (np.max(values), np.min(values)):
        is_there = values == limit
        if are_many(int(np.count_nonzero(is_there)), values.size):
            limited |= is_there
    return limited


def are_many(readings: int, samples: int) -> bool:
    """Whether so many equal readings at an end of the range are those of a limit."""
    return readings >= max(LIMIT_SAMPLES, LIMIT_SHARE * samples)
