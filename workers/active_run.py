"""State of one run on the driver's side, and its next items of work."""

from dataclasses import dataclass, field, replace

from sysid.identification.run import (
    count_generations,
    exchange_migrants,
    find_next_border,
    is_finished,
)
from sysid.islands.run_state import RunState
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
"""A run on which this many workers died, without progress in between, fails."""


@dataclass(slots=True, eq=False)
class ActiveRun:
    """One run between its first item of work and its result.

    Attributes
    ----------
    has_begun : bool
        Whether this driver sent it to a worker.
    is_reported : bool
        Whether the observer was told its state. A checkpoint from the queue is not told.
    slices : int
        Time slices done; 0 before the first.
    kills : int
        How often a worker died on this run alone, since its last progress.
    is_suspect : bool
        Whether a worker died on it and others. From then on it is sent alone.
    seconds : float
        Compute time so far, over all workers.
    generation_seconds : float
        Measured cost of one generation of one island; 0 while unknown.
    islands : dict
        While the run is spread: the present state of its islands, by number.
    awaited_islands : set
        Numbers of the islands that are with the workers.
    pack_handles : set
        Handles of the packs that it waits for. Any other pack belongs to an epoch that was
        restarted, and is ignored.
    """

    run: str
    spec: RunSpec
    state: RunState | None
    has_begun: bool = False
    is_reported: bool = False
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
        """Create the run from its entry in the queue."""
        return cls(queued.run, queued.spec, queued.state, kills=queued.kills)

    @property
    def needs_own_pack(self) -> bool:
        """Whether it shares no pack, because it is long or may kill workers."""
        return self.slices > 0 or self.kills > 0 or self.is_suspect

    def should_spread(self, idle: int) -> bool:
        """Whether its islands should go to several workers, given `idle` cores."""
        algorithm = self.spec.algorithm
        if self.state is None or is_finished(algorithm, self.state):
            return False
        epoch = self.generation_seconds * algorithm.n_islands * algorithm.migration.every
        return is_worth_spreading(epoch, algorithm.n_islands, idle)

    def make_slice(self, cost: MeanCost | None = None) -> WorkItem:
        """Make the next time slice of the whole run; `cost` is that of a run of its job."""
        return AdvanceRun(
            self.run,
            self.spec,
            self.state,
            choose_slice_seconds(self.slices, cost),
            self.seconds,
            self.is_reported,
        )

    def split_islands(self) -> list[EvolveIsland]:
        """Make one item for each island that is not at the next border; at least one."""
        assert self.state is not None
        target = find_next_border(self.spec.algorithm, self.state)
        self.islands = dict(enumerate(self.state.islands))
        behind = [i for i, island in self.islands.items() if island.generation < target]
        self.awaited_islands = set(behind)
        return [EvolveIsland(self.run, self.spec, self.islands[i], target) for i in behind]

    def absorb_slice(self, state: RunState, seconds: float) -> None:
        """Record a time slice of the whole run."""
        before = 0 if self.state is None else count_generations(self.state)
        done = count_generations(state) - before
        if done > 0:
            self.generation_seconds = seconds / done
        self.state = state
        self.slices += 1

    def absorb_island(self, evolved: IslandProgress, seconds: float) -> bool:
        """Record an island; return whether it was the last, so that the run is at its border."""
        assert self.state is not None
        index = evolved.island.index
        spent = self.state.seconds + seconds / len(self.islands)  # as if all ran in parallel
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
        """Discard the islands that are with the workers, and restart the epoch."""
        self.islands, self.awaited_islands, self.pack_handles = {}, set(), set()
