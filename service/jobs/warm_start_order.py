"""Which run of a sweep comes before which: what ``"warm_start": "previous"`` follows."""

from collections.abc import Sequence
from dataclasses import dataclass

from service.jobs.axes import grouped, length_of
from service.jobs.schemas import Axis


@dataclass(frozen=True, slots=True)
class Chain:
    """Runs that differ in one group of axes only, in the order of its values.

    Attributes
    ----------
    stride : int
        Between the numbers of a run and of the one before it.
    length : int
        Values of that group.
    """

    stride: int
    length: int

    @classmethod
    def along(cls, axes: Sequence[Axis]) -> "Chain | None":
        """The chain along the axis that has labels, else over datasets, else the first.

        Its other axes go in parallel, each with a chain of its own. None without axes.
        """
        groups = grouped(axes)
        if not groups:
            return None
        chosen = min(range(len(groups)), key=lambda g: _rank([axes[n] for n in groups[g]]))
        lengths = [length_of(axes[numbers[0]]) for numbers in groups]
        stride = 1
        for length in lengths[chosen + 1 :]:
            stride *= length
        return cls(stride, lengths[chosen])

    def before(self, number: int) -> int | None:
        """Number of the run before that one; None for the first of its chain."""
        first = number // self.stride % self.length == 0
        return None if first else number - self.stride

    def of(self, number: int) -> int:
        """Number of the chain of a run: chains are counted in the order of their first runs."""
        block, place = divmod(number, self.stride * self.length)
        return block * self.stride + place % self.stride

    def numbers(self, chain: int) -> range:
        """Numbers of the runs of a chain, in its order."""
        block, place = divmod(chain, self.stride)
        first = block * self.stride * self.length + place
        return range(first, first + self.stride * self.length, self.stride)


def _rank(axes: Sequence[Axis]) -> int:
    if any(axis.labels for axis in axes):
        return 0
    return 1 if any(axis.path == "/datasets" for axis in axes) else 2
