"""Division of the cores of one cluster between the dispatchers that have joined it."""

from collections.abc import Mapping
from typing import Protocol


class SharedCluster(Protocol):
    """A cluster that several dispatchers may have joined."""

    @property
    def identity(self) -> str | None:
        """Name of the cluster, equal in all dispatchers; None if nobody else can join it."""

    @property
    def n_cores(self) -> int:
        """Cores of the whole cluster."""

    def limit_slots(self, n_cores: int) -> None:
        """Use that many cores at most."""


def divide_cores(n_cores: int, wanted: Mapping[str, int]) -> dict[str, int]:
    """Divide cores between dispatchers, by need and otherwise equally; each gets one at least.

    Nobody gets more than it wants, as long as another one wants more.

    Parameters
    ----------
    wanted : mapping
        Cores that each dispatcher has work for, by name.

    Examples
    --------
    >>> divide_cores(10, {"a": 2, "b": 100, "c": 100})
    {'a': 2, 'b': 4, 'c': 4}
    """
    shares: dict[str, int] = {}
    left = n_cores
    for index, name in enumerate(sorted(wanted, key=lambda name: (wanted[name], name))):
        share = min(wanted[name], left // (len(wanted) - index))
        shares[name] = max(share, 1)
        left -= share
    return shares
