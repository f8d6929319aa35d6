"""When the time that a run may take is over, for what follows its search."""

from collections.abc import Callable
from time import perf_counter

Clock = Callable[[], float]
"""Seconds from any moment on."""

_GRACE_SHARE, _MIN_GRACE_SECONDS, _MAX_GRACE_SECONDS = 0.1, 0.2, 10.0  # of the limit; s
_STEPS_AFTER_DEADLINE = 20_000_000
"""Steps of integration or recursion that may follow where the time is over: about 0.2 s."""
_MIN_MEASURED_SECONDS = 1e-3  # s: a search that took less says nothing of what a simulation takes


class Deadline:
    """The end of a run's time, and a grace behind it, within which least squares may end.

    Parameters
    ----------
    limit : float or None
        Seconds that the run may take; None: it has no limit.
    used : float
        Seconds of it that its search has taken.
    clock : callable
    """

    def __init__(self, limit: float | None, used: float, clock: Clock = perf_counter) -> None:
        self._clock = clock
        self._is_limited = limit is not None
        limit = float("inf") if limit is None else limit
        self._end = clock() + (limit - used)
        self._grace = min(max(_GRACE_SHARE * limit, _MIN_GRACE_SECONDS), _MAX_GRACE_SECONDS)

    @property
    def seconds_left(self) -> float:
        """Seconds until the end, 0 or more."""
        return max(0.0, self._end - self._clock())

    def is_over(self) -> bool:
        """Whether the end is reached."""
        return self._clock() >= self._end

    def is_past_grace(self) -> bool:
        """Whether the grace is over as well."""
        return self._clock() >= self._end + self._grace

    def count_simulations_left(self, seconds: float, evaluations: int, steps: int) -> int | None:
        """Simulations of some steps that are left, by what those of a search took; None: no limit.

        As many as are over at once are there always.
        """
        if not self._is_limited:
            return None
        each = max(seconds, _MIN_MEASURED_SECONDS) / max(evaluations, 1)
        return max(_STEPS_AFTER_DEADLINE // max(steps, 1), int(self.seconds_left / each))
