"""Where one run stands on the driver's side, and which items of work come next."""

from dataclasses import dataclass, field, replace

from sysid.identification.run import exchange_migrants, find_next_border, is_finished
from sysid.islands.state import RunState
from sysid.search.island import Island
from workers.packing import MeanCost, choose_slice_seconds, is_worth_spreading
from workers.protocol import (
    AdvanceRun,
    EvolveIsland,
    IslandProgress,
    PackHandle,
    QueuedRun,
    RunSpec,
    WorkItem,
)

MAX_KILLS = 2
"""A run over which workers died so often, and which did not go on between, is given up."""


@dataclass(slots=True, eq=False)
class ActiveRun:
    """One run between its first item of work and its result.

    Attributes
    ----------
    is_begun : bool
        Whether a worker was given it, by this driver.
    slices : int
        Time slices done; 0 before the first.
    kills : int
        How often a worker died over it and no other run, since it last went on.
    is_suspect : bool
        Whether a worker died over it and others: it goes alone from then on.
    seconds : float
        Compute time so far, over all workers.
    generation_seconds : float
        Measured cost of one generation of one island; 0 while unknown.
    islands : dict
        While the run is spread: its islands, by number, as they stand.
    awaited : set
        Numbers of the islands that are with the workers.
    packs : set
        Handles of the packs that it waits for. One that is not among them is of an epoch that
        began anew since, and tells nothing.
    """

    run: str
    spec: RunSpec
    state: RunState | None
    has_begun: bool = False
    slices: int = 0
    kills: int = 0
    is_suspect: bool = False
    seconds: float = 0.0
    generation_seconds: float = 0.0
    islands: dict[int, Island] = field(default_factory=dict)
    awaited_islands: set[int] = field(default_factory=set)
    pack_handles: set[PackHandle] = field(default_factory=set)

    @classmethod
    def from_queue(cls, queued: QueuedRun) -> "ActiveRun":
        """The run as it waits in the queue."""
        return cls(queued.run, queued.spec, queued.state, kills=queued.kills)

    @property
    def needs_own_pack(self) -> bool:
        """Whether it shares no pack: it is long, or may be what kills workers."""
        return self.slices > 0 or self.kills > 0 or self.is_suspect

    def should_spread(self, idle: int) -> bool:
        """Whether its islands should go to several workers, given `idle` cores."""
        algorithm = self.spec.algorithm
        if self.state is None or is_finished(algorithm, self.state):
            return False
        epoch = self.generation_seconds * algorithm.n_islands * algorithm.migration.every
        return is_worth_spreading(epoch, algorithm.n_islands, idle)

    def make_slice(self, cost: MeanCost | None = None) -> WorkItem:
        """The next time slice of the whole run; `cost` is that of a run of its job."""
        return AdvanceRun(self.run, self.spec, self.state, choose_slice_seconds(self.slices, cost))

    def split_islands(self) -> list[EvolveIsland]:
        """The islands that have not got to the next border, one item each; at least one."""
        assert self.state is not None
        target = find_next_border(self.spec.algorithm, self.state)
        self.islands = dict(enumerate(self.state.islands))
        behind = [i for i, island in self.islands.items() if island.generation < target]
        self.awaited_islands = set(behind)
        return [EvolveIsland(self.run, self.spec, self.islands[i], target) for i in behind]

    def absorb_slice(self, state: RunState, seconds: float) -> None:
        """Take in a time slice of the whole run."""
        before = 0 if self.state is None else _count_generations(self.state)
        done = _count_generations(state) - before
        if done > 0:
            self.generation_seconds = seconds / done
        self.state = state
        self.slices += 1

    def absorb_island(self, evolved: IslandProgress, seconds: float) -> bool:
        """Take in an island; whether it was the last, so that the run stands at its border."""
        assert self.state is not None
        index = evolved.island.index
        spent = self.state.seconds + seconds / len(self.islands)  # as if all were beside another
        self.state = replace(self.state, seconds=spent)
        self.islands[index] = evolved.island
        self.awaited_islands.discard(index)
        if self.awaited_islands:
            return False
        islands = [self.islands[i] for i in range(len(self.islands))]
        self.state = exchange_migrants(self.spec.algorithm, self.state, islands)
        self.islands = {}
        return True

    def restart_epoch(self) -> None:
        """Forget the islands that are with the workers: the epoch begins anew."""
        self.islands, self.awaited_islands, self.pack_handles = {}, set(), set()


def _count_generations(state: RunState) -> int:
    return sum(island.generation for island in state.islands)
