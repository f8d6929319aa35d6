"""An executor that computes nothing, in a time of its own: what the order of packs does to jobs."""

import heapq
from collections import deque
from functools import cache
from typing import Any

from sysid.identification.run import begin_run
from sysid.islands.run_state import RunState
from tests.support.cluster.small_runs import RECORDS, ListedRuns, Notebook, spec
from workers.protocol import (
    AdvanceRun,
    ItemResult,
    Pack,
    PackResult,
    QueuedRun,
    Records,
    RunFailure,
    RunProgress,
    WorkItem,
)
from workers.scheduler import Scheduler
from workers.tasks import build_pack_problems


class SimulatedExecutor:
    """Workers that take packs in the order they were sent, and the time the runs say.

    A run is named ``job/number/seconds``; it goes on in slices until it has had its seconds.
    """

    def __init__(self, slots: int) -> None:
        self.slots, self.now = slots, 0.0
        self.computed: dict[str, float] = {}
        self.most_waiting = 0
        self._waiting: deque[int] = deque()
        self._computing: list[tuple[float, int]] = []
        self._packs: dict[int, tuple[WorkItem, ...]] = {}
        self._next = 0

    def share_records(self, records: Records) -> Any:
        return records

    def submit_pack(self, pack: Pack) -> int:
        self._next += 1
        self._packs[self._next] = tuple(pack.items)
        self._waiting.append(self._next)
        self._begin()
        self.most_waiting = max(self.most_waiting, len(self._waiting))
        return self._next

    def wait_for_packs(self, timeout: float) -> tuple[int, ...]:
        if not self._computing:
            return ()
        ends, handle = heapq.heappop(self._computing)
        self.now = ends
        self._begin()
        return (handle,)

    def fetch_results(self, handle: int) -> PackResult:
        return PackResult(tuple(self._done(item) for item in self._packs.pop(handle)))

    def cancel_pack(self, handle: int, *, force: bool) -> None:
        raise AssertionError("no job is cancelled here")

    def check_cluster_alive(self) -> None:
        pass

    def close(self) -> None:
        pass

    def _begin(self) -> None:
        while self._waiting and len(self._computing) < self.slots:
            handle = self._waiting.popleft()
            seconds = sum(self._seconds(item) for item in self._packs[handle])
            heapq.heappush(self._computing, (self.now + seconds, handle))

    def _seconds(self, item: WorkItem) -> float:
        assert isinstance(item, AdvanceRun)
        left = float(item.run.split("/")[2]) - self.computed.get(item.run, 0.0)
        return min(item.seconds, left)

    def _done(self, item: WorkItem) -> ItemResult:
        seconds = self._seconds(item)
        self.computed[item.run] = self.computed.get(item.run, 0.0) + seconds
        if self.computed[item.run] >= float(item.run.split("/")[2]) - 1e-9:
            return ItemResult(item.run, RunFailure("as told"), seconds)
        return ItemResult(item.run, RunProgress(_begin_state()), seconds)


@cache
def _begin_state() -> RunState:
    problem, _ = build_pack_problems(spec().problem, RECORDS)
    return begin_run(problem, spec().algorithm, 1)


class Theatre:
    """A feeder with a simulated executor, and when each of its jobs ended."""

    def __init__(self, slots: int, **options: Any) -> None:
        self.executor = SimulatedExecutor(slots)
        self.feeder: Scheduler[str] = Scheduler(self.executor, **options)
        self.ended: dict[str, float] = {}

    def add(self, job: str, runs: int, seconds: float, **rights: Any) -> None:
        """A job of equal runs that take `seconds` each."""
        one = spec()
        queued = (QueuedRun(f"{job}/{number}/{seconds}", one) for number in range(runs))
        self.feeder.add_job(job, ListedRuns(queued), Notebook(), **rights)

    def play(self, seconds: float) -> None:
        """Let so much time pass."""
        end = self.executor.now + seconds
        while self.executor.now < end and self.feeder._jobs:
            self.step()

    def until(self, job: str) -> float:
        """Play until the job has ended; gives the time it took from now."""
        begun = self.executor.now
        while job not in self.ended:
            self.step()
        return self.ended[job] - begun

    def step(self) -> None:
        for job in self.feeder.run_step(0.0):
            self.ended[job] = self.executor.now

    def had(self, job: str) -> float:
        """Compute time of a job so far."""
        return sum(
            seconds for run, seconds in self.executor.computed.items() if run.startswith(f"{job}/")
        )
