"""Schedule the runs of several jobs fairly on the workers, and report their results."""

import logging
import time
from collections.abc import Hashable, Iterable
from typing import Generic, TypeVar

from workers.errors import PackFailed, PackLost
from workers.fair_share import FairShare
from workers.job_queue import JobQueue
from workers.packing import PACKS_PER_CPU
from workers.protocol import Executor, JobSource, PackHandle, RunObserver

_log = logging.getLogger(__name__)

GRACE_SECONDS = 1.0
"""After this time, the worker of a cancelled pack is killed."""

PREFETCH_RUNS_PER_CORE = 64
"""Runs read ahead for each core; the jobs share them."""

MIN_PREFETCH_RUNS = 128
"""Least runs that each job reads ahead: enough for a pack of short ones."""

READ_SECONDS = 0.05
"""Time that a step spends on reading runs: reused ones need no worker, and may be many."""

Key = TypeVar("Key", bound=Hashable)


class Scheduler(Generic[Key]):
    """Driver of an executor: add jobs, then call `run_step` until they have ended.

    The caller chooses the key of a job, which must not be in use. `workers.fair_share` decides
    which job is next. `project_cores` is the largest number of packs of one project in flight.
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
        self._shares: FairShare[Key] = FairShare()
        self._jobs: dict[Key, JobQueue] = {}
        self._stopped: dict[Key, float] = {}  # time of the stop request; inf once forced

    @property
    def is_saturated(self) -> bool:
        """Whether every core has a pack."""
        return self._n_in_flight >= self._executor.slots

    def add_job(
        self,
        job: Key,
        source: JobSource,
        observer: RunObserver,
        *,
        priority: int = 0,
        project: str = "",
    ) -> None:
        """Add a job."""
        assert job not in self._jobs
        self._jobs[job] = JobQueue(source, observer, self._executor)
        self._shares.open_account(job, priority=priority, project=project)

    def run_step(self, timeout: float) -> tuple[Key, ...]:
        """Send packs, wait at most `timeout` seconds, collect; return the jobs that ended.

        Raises
        ------
        ClusterLost
            If the cluster does not respond.
        """
        self._stop_cancelled_jobs()
        self._send_packs()
        for handle in self._executor.wait_for_packs(timeout):
            self._collect_pack(handle)
        self._send_packs()
        self._executor.check_cluster_alive()
        ended = tuple(job for job, work in self._jobs.items() if work.is_done)
        for job in ended:
            del self._jobs[job]
            self._shares.close_account(job)
            self._stopped.pop(job, None)
        return ended

    def stop_jobs(self, jobs: Iterable[Key] | None = None) -> None:
        """Stop jobs (all if not given): soft now, by force after the grace period."""
        for job in tuple(self._jobs if jobs is None else jobs):
            if job in self._jobs and job not in self._stopped:
                self._stopped[job] = time.monotonic()
                self._jobs[job].stop_sending()
                self._cancel_packs(job, force=False)

    @property
    def _n_in_flight(self) -> int:
        return sum(len(work.in_flight) for work in self._jobs.values())

    def _send_packs(self) -> None:
        deadline = time.monotonic() + READ_SECONDS
        while self._n_in_flight < PACKS_PER_CPU * self._executor.slots:
            chosen = self._choose_job(deadline)
            if chosen is None:
                return
            self._shares.record_pack(chosen)
            self._jobs[chosen].send_next_pack(self._count_idle_cores(chosen))

    def _choose_job(self, deadline: float) -> Key | None:
        """Choose the job that gets the next slot, if it has work.

        If all cores are busy (`is_saturated`), a job with packs in flight keeps its turn. Otherwise
        its next slice would wait behind a pack of another job.
        """
        active = {job: work for job, work in self._jobs.items() if job not in self._stopped}
        wanted = max(
            MIN_PREFETCH_RUNS, PREFETCH_RUNS_PER_CORE * self._executor.slots // max(len(active), 1)
        )
        for job in self._shares.order_jobs(
            {job: len(work.in_flight) for job, work in active.items()}
        ):
            if not self._has_project_core(job):
                continue
            if active[job].read_ahead(wanted, deadline):
                return job
            if active[job].in_flight and self.is_saturated:
                return None
        return None

    def _has_project_core(self, job: Key) -> bool:
        if self._project_cores is None:
            return True
        project = self._shares.get_project(job)
        in_flight = (
            len(work.in_flight)
            for other, work in self._jobs.items()
            if self._shares.get_project(other) == project
        )
        return sum(in_flight) < self._project_cores

    def _count_idle_cores(self, chosen: Key) -> int:
        """Count cores that one run of this job may take in addition, without delaying others."""
        rank = self._shares.compute_rank(chosen)
        taken = 0
        for job, work in self._jobs.items():
            if self._shares.compute_rank(job) <= rank:
                taken += len(work.in_flight)
                if job != chosen and work.has_waiting_runs:
                    return 0
        return self._executor.slots - taken

    def _collect_pack(self, handle: PackHandle) -> None:
        owner = next((j for j, work in self._jobs.items() if handle in work.in_flight), None)
        try:
            pack = self._executor.fetch_results(handle)
        except PackLost as error:
            if owner is not None:
                self._record_lost_task(owner, self._jobs[owner], handle, error)
            return
        self.compile_seconds += pack.compile_seconds
        if owner is None:  # its job has ended
            _log.warning("a pack of no job came back")
            return
        self._shares.charge_seconds(owner, sum(result.seconds for result in pack.results))
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
        now = time.monotonic()
        for job, since in self._stopped.items():
            if now - since > self._grace:
                self._stopped[job] = float("inf")
                self._cancel_packs(job, force=True)

    def _cancel_packs(self, job: Key, *, force: bool) -> None:
        for handle in self._jobs[job].in_flight:
            self._executor.cancel_pack(handle, force=force)
