"""Runs of one parcel on the driver's side: the next items of work, and their results."""

import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from workers.active_run import MAX_KILLS, ActiveRun
from workers.errors import RecordsDelayed, RecordsUnavailable
from workers.pack_watch import compute_time_limit
from workers.packing import PACKS_PER_CPU, MeanCost, balance_packs, choose_pack_size
from workers.protocol import (
    EvolveIsland,
    Executor,
    InvalidRun,
    IslandProgress,
    ItemResult,
    JobEntry,
    JobSource,
    Pack,
    PackHandle,
    PackResult,
    ReusedRun,
    RunEnd,
    RunFailure,
    RunNotReady,
    RunObserver,
    RunProgress,
    WorkItem,
)

MAX_SHARED_RECORDS = 16
"""Largest number of record sets that a job shares with the executor."""


READ_SECONDS_PER_CORE = 4.0
"""Runs that take longer than this together are not read ahead for a core."""


@dataclass(slots=True, eq=False)
class SharedWork:
    """What the parcels of one job share: the cost of a run, records, and who has runs left.

    Attributes
    ----------
    cost : MeanCost
        That of a run; it has none before the first has ended.
    longest_seconds : float
        Time of the longest item.
    records : dict
        Records that the executor has, by key.
    queues : list of JobQueue
        The parcels, the oldest first.
    """

    cost: MeanCost = field(default_factory=MeanCost)
    longest_seconds: float = 0.0
    records: dict[str, Any] = field(default_factory=dict)
    queues: "list[JobQueue]" = field(default_factory=list)

    @property
    def has_no_more(self) -> bool:
        """Whether no more runs can be read at present, in any parcel."""
        return all(queue.has_no_more for queue in self.queues)

    def count_waiting(self) -> int:
        """Count the runs that were read and wait for a worker."""
        return sum(queue.n_waiting for queue in self.queues)


class JobQueue:
    """Runs of one parcel of a job: waiting, with the workers, or done.

    Attributes
    ----------
    in_flight : dict
        Items of each pack in flight.
    has_no_more : bool
        Whether nothing more can be read at present: the next run waits for unfinished ones.
    """

    def __init__(
        self,
        source: JobSource,
        observer: RunObserver,
        executor: Executor,
        shared: SharedWork | None = None,
    ) -> None:
        self.observer = observer
        self.in_flight: dict[PackHandle, tuple[WorkItem, ...]] = {}
        self._source, self._executor = source, executor
        self._entries: Iterator[JobEntry] = iter(source.iterate_runs())
        self._ready: deque[ActiveRun] = deque()
        self._active: dict[str, ActiveRun] = {}
        self._shared = shared or SharedWork()
        self._shared.queues.append(self)
        self._exhausted = False
        self._delayed_until: float | None = None  # by the elapsed time; its records are not there
        self.has_no_more = False

    def leave(self) -> None:
        """Leave the other parcels of the job, because this one has ended."""
        self._shared.queues.remove(self)

    @property
    def is_done(self) -> bool:
        """Whether all runs were read; none waits or is with the workers."""
        return self._exhausted and not (self.in_flight or self._ready)

    @property
    def n_waiting(self) -> int:
        """Runs that were read and wait for a worker."""
        return len(self._ready)

    def read_ahead(self, wanted: int, deadline: float) -> bool:
        """Read runs until `wanted` of them wait or the time is up; return whether a run waits.

        A pack of them is read in any case, because small packs would take even more time. Long
        runs are not read far ahead: another dispatcher may take them. While the store of the
        records is away, no run waits for a worker.
        """
        if self._delayed_until is None or time.monotonic() >= self._delayed_until:
            self._read_runs(wanted, deadline)
            return bool(self._ready)
        return False

    def _read_runs(self, wanted: int, deadline: float) -> None:
        cost, cores = self._shared.cost.seconds, self._executor.slots
        if cost is not None:
            far = int(READ_SECONDS_PER_CORE * cores / max(cost, 1e-4))
            wanted = min(wanted, max(far, PACKS_PER_CPU * cores))
        left = choose_pack_size(self._shared.cost, wanted, 1) - len(self._ready)
        while not self._exhausted and len(self._ready) < wanted:
            queued = next(self._entries, None)
            self.has_no_more = queued is None or isinstance(queued, RunNotReady)
            if queued is None:
                self._exhausted = True
            elif isinstance(queued, RunNotReady):
                break
            elif isinstance(queued, InvalidRun):
                self.observer.record_failure(queued.run, queued.failure)
            elif isinstance(queued, ReusedRun):
                self.observer.record_reuse(queued.run, queued.source)
            else:
                run = ActiveRun.from_queue(queued)
                self._active[run.run] = run
                self._ready.append(run)
            left -= 1
            if left <= 0 and time.monotonic() > deadline:
                break

    def send_next_pack(self, idle: int) -> None:
        """Send the next pack, or one run's islands as several packs if `idle` cores allow."""
        run = self._ready[0]
        if run.should_spread(idle if len(self._ready) == 1 else 0):
            self._ready.popleft()
            self._spread_islands(run)
        elif run.needs_own_pack:
            self._submit_items([self._ready.popleft().make_slice()])
        else:
            cost, waiting = self._shared.cost, len(self._ready)
            size = choose_pack_size(cost, waiting, 1)
            if self._shared.has_no_more:  # else more follow
                all_waiting = self._shared.count_waiting()
                size = min(size, choose_pack_size(cost, all_waiting, self._executor.slots))
            self._submit_items([run.make_slice(cost) for run in self._take_unstarted(size)])

    def absorb_pack(self, handle: PackHandle, pack: PackResult) -> None:
        """Record the results of a pack; islands that were not processed are sent again."""
        items = self.in_flight.pop(handle)
        waiting = set(self._release_runs(handle, items))
        again: list[WorkItem] = []
        for item, result in zip(items, pack.results, strict=True):
            run = self._active.get(result.run)
            if run is None:
                continue  # it failed while another of its islands was in flight
            run.seconds += result.seconds
            self._shared.longest_seconds = max(self._shared.longest_seconds, result.seconds)
            if run not in waiting:
                continue
            if result.outcome is not None:
                self._take_result(run, result)
            elif isinstance(item, EvolveIsland):
                again.append(item)
            else:
                self._ready.appendleft(run)
        if pack.encoded is not None:
            self.observer.record_results(pack.encoded)
        again = [item for item in again if item.run in self._active]
        if again:
            self._submit_items(again)

    def requeue_lost_pack(self, handle: PackHandle, reason: str) -> None:
        """Queue the runs of a dead worker again from their last state, each alone.

        Only a run that was alone in the pack is blamed. Two packs of its islands that are lost at
        once count as one death.
        """
        items = self.in_flight.pop(handle)
        are_several = len({item.run for item in items}) > 1
        for run in self._release_runs(handle, items):
            run.restart_epoch()
            run.is_suspect = True
            if are_several or self._retry_or_fail(run, reason):
                self._ready.append(run)

    def fail_pack(self, handle: PackHandle, reason: str) -> None:
        """Fail the runs of a pack after a programming error."""
        for run in self._release_runs(handle, self.in_flight.pop(handle)):
            self._fail_run(run.run, RunFailure(reason, "InternalError"))

    def compute_time_limit(self, handle: PackHandle) -> float:
        """Compute the time after which a pack in flight is not waited for, in s."""
        names = {item.run for item in self.in_flight[handle]}
        runs = [self._active[name] for name in names if name in self._active]
        is_known = self._shared.cost.seconds is not None
        is_again = any(run.kills or run.is_suspect for run in runs)
        longest = self._shared.longest_seconds if is_known and not is_again else None
        return compute_time_limit(longest)

    def stop_sending(self) -> None:
        """Send nothing more."""
        self._ready.clear()
        self._exhausted = True

    def _take_unstarted(self, size: int) -> list[ActiveRun]:
        """Take the next `size` runs that have not started and use the same records."""
        chosen = [self._ready.popleft()]
        keys = chosen[0].spec.problem.record_keys
        while self._ready and len(chosen) < size:
            following = self._ready[0]
            if following.needs_own_pack or following.spec.problem.record_keys != keys:
                break
            chosen.append(self._ready.popleft())
        return chosen

    def _spread_islands(self, run: ActiveRun) -> None:
        items = run.split_islands()
        costs = [float(item.island.chromosomes.size) for item in items]
        for bundle in balance_packs(costs, self._executor.slots):
            self._submit_items([items[index] for index in bundle])

    def _submit_items(self, items: list[WorkItem]) -> None:
        keys = items[0].spec.problem.record_keys
        try:
            shared = {key: self._share_records(key) for key in keys}
        except RecordsDelayed as error:
            self._delay_items(items, error)
            return
        except RecordsUnavailable as error:
            for name in {item.run for item in items}:
                self._fail_run(name, RunFailure(str(error), type(error).__name__))
            return
        for name in dict.fromkeys(item.run for item in items):
            self._report_start(self._active[name])
        handle = self._executor.submit_pack(Pack(items, shared, self.observer.encoder))
        self.in_flight[handle] = tuple(items)
        for item in items:
            self._active[item.run].pack_handles.add(handle)

    def _delay_items(self, items: Sequence[WorkItem], error: RecordsDelayed) -> None:
        """Put the runs of these items back, until their records can be loaded."""
        if self._delayed_until is None:
            self.observer.record_delay(str(error))
        self._delayed_until = time.monotonic() + error.seconds
        for name in reversed(dict.fromkeys(item.run for item in items)):
            self._active[name].restart_epoch()
            self._ready.appendleft(self._active[name])

    def _release_runs(self, handle: PackHandle, items: Sequence[WorkItem]) -> list[ActiveRun]:
        """Release the runs that wait for this pack; others continued without it."""
        names = dict.fromkeys(item.run for item in items)
        runs = [self._active[name] for name in names if name in self._active]
        runs = [run for run in runs if handle in run.pack_handles]
        for run in runs:
            run.pack_handles.discard(handle)
        return runs

    def _report_start(self, run: ActiveRun) -> None:
        if not run.has_begun:
            run.has_begun = True
            self.observer.record_start(run.run)

    def _share_records(self, key: str) -> Any:
        shared = self._shared.records
        if key not in shared:
            while len(shared) >= MAX_SHARED_RECORDS:
                shared.pop(next(iter(shared)))
            shared[key] = self._executor.share_records(self._source.load_records(key))
            self._delayed_until = None
        return shared[key]

    def _take_result(self, run: ActiveRun, result: ItemResult) -> None:
        match result.outcome:
            case RunFailure() as failure:
                self._shared.cost = self._shared.cost.add_measurement(result.seconds)
                self._fail_run(run.run, failure)
            case RunEnd():
                self._shared.cost = self._shared.cost.add_measurement(run.seconds)
                del self._active[run.run]
            case RunProgress(state):
                run.absorb_slice(state, result.seconds)
                self._continue_run(run)
            case IslandProgress() as evolved:
                if run.absorb_island(evolved, result.seconds):
                    self._continue_run(run)

    def _retry_or_fail(self, run: ActiveRun, reason: str) -> bool:
        """Retry a run on which its worker died, or fail it; return whether it is retried."""
        run.kills += 1
        self.observer.record_worker_death(run.run, run.kills)
        if run.kills >= MAX_KILLS:
            text = f"its worker process died {run.kills} times; the last time: {reason}"
            self._fail_run(run.run, RunFailure(text, "WorkerDied"))
        return run.kills < MAX_KILLS

    def _continue_run(self, run: ActiveRun) -> None:
        assert run.state is not None
        if run.kills:
            run.kills = 0
            self.observer.record_worker_death(run.run, 0)
        self.observer.record_progress(run.run, run.state, run.seconds)
        run.is_reported = True
        self._ready.appendleft(run)  # finish started runs first, so that few are in progress

    def _fail_run(self, name: str, failure: RunFailure) -> None:
        if self._active.pop(name, None) is not None:
            self.observer.record_failure(name, failure)
