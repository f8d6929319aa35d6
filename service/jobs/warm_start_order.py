"""Order of warm starts in a sweep: which run ``"warm_start": "previous"`` refers to."""

from collections.abc import Sequence
from dataclasses import dataclass

from service.jobs.axes import count_values, group_axes
from service.jobs.job_schemas import SweepAxisIn


@dataclass(frozen=True, slots=True)
class ChainLayout:
    """Chains of runs that differ in one group of axes only, in the order of its values.

    Attributes
    ----------
    stride : int
        Difference between the numbers of a run and of the previous one.
    length : int
        Number of values of that group.
    """

    stride: int
    length: int

    @classmethod
    def from_axes(cls, axes: Sequence[SweepAxisIn]) -> "ChainLayout | None":
        """Choose the chain axis: the one with labels, else the one over datasets, else the first.

        The values of the other axes give parallel chains. None without axes.
        """
        groups = group_axes(axes)
        if not groups:
            return None
        chosen = min(range(len(groups)), key=lambda g: _rank_axes([axes[n] for n in groups[g]]))
        lengths = [count_values(axes[numbers[0]]) for numbers in groups]
        stride = 1
        for length in lengths[chosen + 1 :]:
            stride *= length
        return cls(stride, lengths[chosen])

    def find_chain(self, number: int) -> int:
        """Return the chain number of a run. Chains are numbered by their first runs."""
        block, offset = divmod(number, self.stride * self.length)
        return block * self.stride + offset % self.stride

    def list_runs(self, chain: int) -> range:
        """List the numbers of the runs of a chain, in order."""
        block, offset = divmod(chain, self.stride)
        first = block * self.stride * self.length + offset
        return range(first, first + self.stride * self.length, self.stride)


def _rank_axes(axes: Sequence[SweepAxisIn]) -> int:
    if any(axis.labels for axis in axes):
        return 0
    return 1 if any(axis.path == "/datasets" for axis in axes) else 2
