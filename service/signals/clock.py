"""Times of samples as MCAP's nanoseconds, such that the same bits come back.

A file's clock counts whole nanoseconds. Of most recordings that is exact, because their times
were printed with nine decimals or fewer (rule ``nanoseconds``); of computed times ``k·T`` the
period is kept (rule ``regular``); of all others each message carries the time in a field of its
own (rule ``field``).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import floor
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sysid.core.types import FloatArray

Rule = Literal["nanoseconds", "regular", "field"]
Nanoseconds = NDArray[np.uint64]
LATEST_NS = 2**63
LATEST_S = LATEST_NS / 1e9
TIME_FIELD = "time_s"


@dataclass(frozen=True, slots=True)
class Clock:
    """How the times of one topic come back from its file.

    Attributes
    ----------
    rule : {"nanoseconds", "regular", "field"}
    epoch : int
        Time (s) of the file's nanosecond 0: not 0 only when times are negative.
    start, period : float
        First time and sampling period, for ``regular``.
    """

    rule: Rule
    epoch: int = 0
    start: float = 0.0
    period: float = 0.0

    def times(self, log_times: Nanoseconds, field: FloatArray | None) -> FloatArray:
        """The times in s."""
        if self.rule == "field" and field is not None:
            return field
        if self.rule == "regular":
            grid: FloatArray = self.start + self.period * np.arange(
                log_times.size, dtype=np.float64
            )
            return grid
        return _seconds(log_times, self.epoch)

    def as_dict(self) -> dict[str, object]:
        """The entry of the file's metadata."""
        return {"rule": self.rule, "epoch": self.epoch, "start": self.start, "period": self.period}

    @classmethod
    def from_dict(cls, entry: Mapping[str, object]) -> "Clock":
        """Return the inverse of `as_dict`; ValueError for an entry that is none."""
        rule, epoch = entry.get("rule"), entry.get("epoch")
        start, period = entry.get("start"), entry.get("period")
        if rule not in ("nanoseconds", "regular", "field") or type(epoch) is not int:
            raise ValueError(f"{entry!r} is not a rule of times")
        if not isinstance(start, int | float) or not isinstance(period, int | float):
            raise ValueError(f"{entry!r} is not a rule of times")
        if not (-LATEST_S < epoch <= 0 and abs(start) < LATEST_S and 0 <= period < LATEST_S):
            raise ValueError(f"{entry!r} goes beyond the clock of a file")
        return cls(rule, epoch, float(start), float(period))


def clock_for(times: FloatArray) -> tuple[Clock, Nanoseconds]:
    """Return the clock of times (s, not decreasing), and the times on it.

    Raises
    ------
    ValueError
        If they span more than a file's clock can hold (292 years).
    """
    epoch = min(0, floor(float(times[0])))
    if epoch <= -LATEST_S or float(times[-1]) - epoch >= LATEST_S:
        raise ValueError(f"times up to {float(times[-1])!r} s do not fit into 63 bits of ns")
    log_times = np.rint((times - epoch) * 1e9).astype(np.uint64)
    if np.array_equal(_seconds(log_times, epoch), times):
        return Clock("nanoseconds", epoch), log_times
    for period in _periods(times):
        clock = Clock("regular", epoch, float(times[0]), period)
        if np.array_equal(clock.times(log_times, None), times):
            return clock, log_times
    return Clock("field", epoch), log_times


def _seconds(log_times: Nanoseconds, epoch: int) -> FloatArray:
    # A quotient of whole numbers is correctly rounded, like the decimal number it stands for.
    signed = log_times.astype(np.int64) + epoch * 10**9
    return np.asarray(signed / 1e9, dtype=np.float64)


def _periods(times: FloatArray) -> Iterator[float]:
    if times.size > 1:
        mean = float(times[-1] - times[0]) / (times.size - 1)
        yield float(times[1] - times[0])
        for digits in range(3, 18):
            yield float(f"{mean:.{digits}g}")
