"""Time limit of a run, for the steps that follow its search."""

from collections.abc import Callable

from sysid.core.jit import read_clock

Clock = Callable[[], float]
"""Seconds since an arbitrary moment."""

_GRACE_SHARE, _MIN_GRACE_SECONDS, _MAX_GRACE_SECONDS = 0.1, 0.2, 10.0  # of the limit; s
_STEPS_AFTER_DEADLINE = 20_000_000
"""Steps of integration or recursion that are allowed after the time limit: about 0.2 s."""
_MIN_MEASURED_SECONDS = 1e-3  # s: a shorter search does not measure the cost of a simulation


class Deadline:
    """End of a run's time, and a grace period after it in which least squares may end.

    Parameters
    ----------
    limit : float or None
        Time limit of the run in s; None: no limit.
    used : float
        Seconds that its search has taken.
    clock : callable
        Returns seconds.
    """

    def __init__(self, limit: float | None, used: float, clock: Clock = read_clock) -> None:
        self._clock = clock
        self._is_limited = limit is not None
        limit = float("inf") if limit is None else limit
        self._end = clock() + (limit - used)
        self._grace = min(max(_GRACE_SHARE * limit, _MIN_GRACE_SECONDS), _MAX_GRACE_SECONDS)

    @property
    def seconds_left(self) -> float:
        """Seconds left until the end, 0 or more."""
        return max(0.0, self._end - self._clock())

    def is_over(self) -> bool:
        """Whether the end is reached."""
        return self._clock() >= self._end

    def is_past_grace(self) -> bool:
        """Whether the grace period is over as well."""
        return self._clock() >= self._end + self._grace

    def count_simulations_left(self, seconds: float, evaluations: int, steps: int) -> int | None:
        """Count the simulations that the time limit still allows; None: no limit.

        Their cost is measured by the search: `evaluations` simulations in `seconds`. A small
        number of short simulations is always allowed.
        """
        if not self._is_limited:
            return None
        each = max(seconds, _MIN_MEASURED_SECONDS) / max(evaluations, 1)
        return max(_STEPS_AFTER_DEADLINE // max(steps, 1), int(self.seconds_left / each))
