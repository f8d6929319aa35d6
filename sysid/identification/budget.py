"""Limit on the simulations of a run, for the steps that follow its search."""


class Budget:
    """Simulations that those steps have spent, and those that the limit leaves them.

    Parameters
    ----------
    limit : int or None
        On all simulations of the run; None: no limit.
    searched : int
        Simulations that its search has taken.
    """

    def __init__(self, limit: int | None, searched: int) -> None:
        self._limit = None if limit is None else max(0, limit - searched)
        self.spent = 0
        """After the search."""

    def spend(self, simulations: int) -> None:
        """Count simulations that were run."""
        self.spent += simulations

    def count_left(self, reserved: int = 0) -> int | None:
        """Count the simulations left, less those reserved for a later step; None: no limit."""
        return None if self._limit is None else max(0, self._limit - self.spent - reserved)

    def cap(self, simulations: int, reserved: int = 0, shares: int = 1) -> int:
        """Cap a number of simulations at one of so many equal shares of those left."""
        left = self.count_left(reserved)
        return simulations if left is None else min(simulations, left // shares)
