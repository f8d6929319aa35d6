"""Schedule the runs of several jobs fairly on the workers, and report their results."""

import logging
import time
from collections.abc import Hashable, Iterable, Mapping
from typing import Generic, TypeVar

from sysid.core.awake_clock import read_awake_seconds
from workers.errors import PackFailed, PackLost, WorkerDied
from workers.fair_share import FairShare
from workers.job_queue import JobQueue, SharedWork
from workers.pack_watch import PackWatch
from workers.packing import PACKS_PER_CPU
from workers.protocol import Executor, JobSource, PackHandle, RunObserver

_log = logging.getLogger(__name__)

GRACE_SECONDS = 1.0
"""After this time, the worker of a cancelled pack is killed."""

CHECK_SECONDS = 1.0
"""Interval at which packs that do not come back are looked for."""

ABANDON_SECONDS = 10.0
"""A killed worker that has not ended after this time is not waited for."""

PREFETCH_RUNS_PER_CORE = 64
"""Runs read ahead for each core; the jobs share them."""

MIN_PREFETCH_RUNS = 128
"""Least runs that each job reads ahead: enough for a pack of short ones."""

READ_SECONDS = 0.05
"""Time that a step spends on reading runs: reused ones need no worker, and may be many."""

SENT_PACKS = 32
"""Packs that a step sends at least, if there are cores; then, if that time is over, it looks for
results."""

Key = TypeVar("Key", bound=Hashable)


class Scheduler(Generic[Key]):
    """Driver of an executor: add jobs, then call `run_step` until they have ended.

    The caller chooses the key of a job, which must not be in use. `workers.fair_share` decides
    which job is next. A job may come in several parcels: each is added by itself, under a key of
    its own, and they share one account. `project_cores` is the largest number of packs of one
    project in flight.
    `compile_seconds` is the time in which workers compiled kernels so far.
    """

    def __init__(
        self,
        executor: Executor,
        *,
        grace_seconds: float = GRACE_SECONDS,
        project_cores: int | None = None,
    ) -> None:
        self.compile_seconds = 0.0
        self._executor = executor
        self._grace, self._project_cores = grace_seconds, project_cores
        self._shares: FairShare[Hashable] = FairShare()
        self._jobs: dict[Key, JobQueue] = {}
        self._accounts: dict[Key, Hashable] = {}
        self._shared: dict[Hashable, SharedWork] = {}  # by account
        self._stopped: dict[Key, float] = {}  # time of the stop request; inf once forced
        self._watch: PackWatch[PackHandle] = PackWatch()
        self._checked_at = read_awake_seconds()
        self._killed: dict[PackHandle, float] = {}  # packs whose workers were killed, and when
        self._silent: dict[PackHandle, str] = {}  # those of them that were overdue, and how
        self._abandoned: set[PackHandle] = set()  # those of them that no job waits for

    @property
    def is_saturated(self) -> bool:
        """Whether every core has a pack."""
        return self._n_in_flight >= self._executor.slots

    def count_wanted_cores(self) -> int | None:
        """Count the cores that have work; None if runs wait, so that there is work for any."""
        if any(work.n_waiting for work in self._jobs.values()):
            return None
        return self._n_in_flight

    def add_job(
        self,
        job: Key,
        source: JobSource,
        observer: RunObserver,
        *,
        priority: int = 0,
        project: str = "",
        account: Hashable | None = None,
    ) -> None:
        """Add a job, or a parcel of the job that has this `account`."""
        assert job not in self._jobs
        account = self._accounts[job] = job if account is None else account
        if account not in self._shared:
            self._shared[account] = SharedWork()
            self._shares.open_account(account, priority=priority, project=project)
        self._jobs[job] = JobQueue(source, observer, self._executor, self._shared[account])

    def run_step(self, timeout: float) -> tuple[Key, ...]:
        """Send packs, wait at most `timeout` seconds, collect; return the jobs that ended.

        Raises
        ------
        ClusterLost
            If the cluster does not respond.
        """
        self._stop_cancelled_jobs()
        has_more = self._send_packs()
        for handle in self._executor.wait_for_packs(0.0 if has_more else timeout):
            self._collect_pack(handle)
        self._replace_silent_workers()
        self._send_packs()
        self._executor.check_cluster_alive()
        ended = tuple(job for job, work in self._jobs.items() if work.is_done)
        for job in ended:
            self._remove_job(job)
        return ended

    def _remove_job(self, job: Key) -> None:
        self._jobs.pop(job).leave()
        self._stopped.pop(job, None)
        account = self._accounts.pop(job)
        if not self._shared[account].queues:
            del self._shared[account]
            self._shares.close_account(account)

    def stop_jobs(self, jobs: Iterable[Key] | None = None) -> None:
        """Stop jobs (all if not given): soft now, by force after the grace period."""
        for job in tuple(self._jobs if jobs is None else jobs):
            if job in self._jobs and job not in self._stopped:
                self._stopped[job] = read_awake_seconds()
                self._jobs[job].stop_sending()
                self._cancel_packs(job, force=False)

    @property
    def _n_in_flight(self) -> int:
        return sum(len(work.in_flight) for work in self._jobs.values())

    def _send_packs(self) -> bool:
        """Send packs while there are cores for them; return whether the time was too short.

        To fill a thousand cores takes seconds. Meanwhile the results of the first ones come back.
        """
        deadline, n_sent = time.monotonic() + READ_SECONDS, 0
        while self._n_in_flight < PACKS_PER_CPU * self._executor.slots:
            if n_sent >= SENT_PACKS and time.monotonic() > deadline:
                return True
            chosen = self._choose_job(deadline)
            if chosen is None:
                return False
            self._shares.record_pack(self._accounts[chosen])
            self._jobs[chosen].send_next_pack(self._count_idle_cores(chosen))
            n_sent += 1
        return False

    def _choose_job(self, deadline: float) -> Key | None:
        """Choose the job that gets the next slot, if it has work.

        If all cores are busy (`is_saturated`), a job with packs in flight keeps its turn. Otherwise
        its next slice would wait behind a pack of another job.
        """
        active: dict[Hashable, list[Key]] = {}
        for job in self._jobs:
            if job not in self._stopped:
                active.setdefault(self._accounts[job], []).append(job)
        wanted = max(
            MIN_PREFETCH_RUNS, PREFETCH_RUNS_PER_CORE * self._executor.slots // max(len(active), 1)
        )
        in_flight = self._count_in_flight()
        for account in self._shares.order_jobs({key: in_flight[key] for key in active}):
            if not self._has_project_core(account, in_flight):
                continue
            for job in active[account]:
                if self._jobs[job].read_ahead(wanted, deadline):
                    return job
            if in_flight[account] and self.is_saturated:
                return None
        return None

    def _count_in_flight(self) -> dict[Hashable, int]:
        """Count the packs in flight of each account."""
        counts: dict[Hashable, int] = dict.fromkeys(self._shared, 0)
        for job, work in self._jobs.items():
            counts[self._accounts[job]] += len(work.in_flight)
        return counts

    def _has_project_core(self, account: Hashable, in_flight: Mapping[Hashable, int]) -> bool:
        if self._project_cores is None:
            return True
        project = self._shares.get_project(account)
        of_project = (
            count for key, count in in_flight.items() if self._shares.get_project(key) == project
        )
        return sum(of_project) < self._project_cores

    def _count_idle_cores(self, chosen: Key) -> int:
        """Count cores that one run of this job may take in addition, without delaying others."""
        own = self._accounts[chosen]
        rank, taken = self._shares.compute_rank(own), 0
        for account, count in self._count_in_flight().items():
            if self._shares.compute_rank(account) <= rank:
                taken += count
                if account != own and self._shared[account].count_waiting():
                    return 0
        return self._executor.slots - taken

    def _collect_pack(self, handle: PackHandle) -> None:
        owner = self._find_owner(handle)
        self._killed.pop(handle, None)
        silence = self._silent.pop(handle, None)
        is_abandoned = handle in self._abandoned
        self._abandoned.discard(handle)
        try:
            pack = self._executor.fetch_results(handle)
        except PackLost as error:
            if owner is not None:
                lost = error if silence is None else WorkerDied(silence)
                self._record_lost_task(owner, self._jobs[owner], handle, lost)
            return
        self.compile_seconds += pack.compile_seconds
        if owner is None:  # its job has ended, or did not wait for it
            if not is_abandoned:
                _log.warning("a pack of no job came back")
            return
        self._shares.charge_seconds(
            self._accounts[owner], sum(result.seconds for result in pack.results)
        )
        if owner in self._stopped:
            del self._jobs[owner].in_flight[handle]
        else:
            self._jobs[owner].absorb_pack(handle, pack)

    def _record_lost_task(
        self, job: Key, work: JobQueue, handle: PackHandle, error: PackLost
    ) -> None:
        if job in self._stopped:
            del work.in_flight[handle]
        elif isinstance(error, PackFailed):
            _log.error("a pack of %s failed: %s", job, error)
            work.fail_pack(handle, f"internal error: {str(error).strip().splitlines()[-1]}")
        else:
            _log.warning("a worker of %s died: %s", job, error)
            work.requeue_lost_pack(handle, str(error))

    def _stop_cancelled_jobs(self) -> None:
        self.stop_jobs([job for job, work in self._jobs.items() if work.observer.should_stop()])
        now = read_awake_seconds()
        for job, since in self._stopped.items():
            if now - since > self._grace:
                self._stopped[job] = float("inf")
                self._cancel_packs(job, force=True)

    def _cancel_packs(self, job: Key, *, force: bool) -> None:
        for handle in self._jobs[job].in_flight:
            self._executor.cancel_pack(handle, force=force)
            if force:
                self._killed.setdefault(handle, read_awake_seconds())

    def _replace_silent_workers(self) -> None:
        """Kill workers that have a pack beyond its time limit, and give their packs away."""
        now = read_awake_seconds()
        if now - self._checked_at < CHECK_SECONDS:
            return
        self._checked_at = now
        limits = {
            handle: work.compute_time_limit(handle)
            for work in self._jobs.values()
            for handle in work.in_flight
        }
        n_cores = self._executor.slots - len(self._abandoned)
        for handle in self._watch.find_overdue(limits, n_cores, now):
            if handle not in self._killed:
                self._killed[handle] = now
                self._executor.cancel_pack(handle, force=True)
                self._tell_silence(handle, limits[handle])
        for handle, killed_at in tuple(self._killed.items()):
            if now - killed_at > ABANDON_SECONDS:
                self._abandon_pack(handle)

    def _tell_silence(self, handle: PackHandle, limit: float) -> None:
        owner = self._find_owner(handle)
        assert owner is not None
        work = self._jobs[owner]
        runs = sorted({item.run for item in work.in_flight[handle]})
        others = f" and {len(runs) - 1} others" if len(runs) > 1 else ""
        self._silent[handle] = f"it did not answer for {limit:.0f} s"
        text = f"a worker did not answer for {limit:.0f} s. Another one computes {runs[0]}{others}"
        _log.warning("%s: %s", owner, text)
        work.observer.record_silent_worker(text)

    def _abandon_pack(self, handle: PackHandle) -> None:
        """Go on without a pack whose worker does not even end."""
        owner = self._find_owner(handle)
        del self._killed[handle]
        self._abandoned.add(handle)
        if owner is not None:
            error = WorkerDied(self._silent.pop(handle, "it did not end"))
            self._record_lost_task(owner, self._jobs[owner], handle, error)

    def _find_owner(self, handle: PackHandle) -> Key | None:
        return next((job for job, work in self._jobs.items() if handle in work.in_flight), None)
