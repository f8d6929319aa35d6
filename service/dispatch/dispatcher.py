"""Dispatcher: claims parcels of jobs by lease, drives the workers, and writes results.

It is a process of its own (`service.dispatch.process`). Any number of dispatchers share one queue.
"""

import gc
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from types import FrameType

from sqlalchemy.exc import SQLAlchemyError

from service.core.errors import Misconfigured
from service.core.process import service_metrics
from service.core.process.logs import bind_ids
from service.core.process.loop_watch import LoopWatch, end_if_standing
from service.core.settings import Settings
from service.dispatch.background import BackgroundJobs, DocumentMaker
from service.dispatch.held_jobs import HeldJob, choose_first_size
from service.dispatch.held_leases import HeldLeases
from service.dispatch.job_end import build_end_maker
from service.dispatch.job_parts import JobParts
from service.dispatch.job_runs import JobRuns
from service.dispatch.overlap import Overlap
from service.dispatch.recorder import JobSpeed, RunRecorder
from service.dispatch.start import DispatcherStart
from service.dispatch.supervisor import RESTART_EXIT_CODE, SUPERVISED_VARIABLE
from service.queue.admission import Admission
from service.queue.dispatchers import CLUSTER_KEY
from service.queue.leases import Claim, Lease
from service.queue.notifications import open_notifier
from service.storage.objects import ObjectStore, open_store
from service.storage.retry import retry_transient
from service.storage.sessions import Database
from service.storage.storage_errors import LeaseLost, StorageError
from sysid.kernels.compilation.limited_compilation import get_compile_seconds
from workers.core_sharing import SharedCluster, divide_cores
from workers.errors import ClusterLost, WorkersError
from workers.local_ray import LocalRay
from workers.protocol import Executor
from workers.ray_executor import ClusterSettings, RayExecutor
from workers.scheduler import Scheduler

_log = logging.getLogger("lagid.dispatcher")

IDLE_SECONDS = 1.0
"""Longest wait for work; a submission wakes the dispatcher at once."""
BUSY_SECONDS = 0.2
"""How often a busy dispatcher looks for cancelled and waiting jobs."""
STEP_SECONDS = 0.1
RELEASE_SECONDS = 5.0
"""Time limit for releasing the jobs once the parent or the workers are gone."""
MAX_JOBS = 64
"""Jobs held at a time. They share the workers, and their runs are read when needed. As many again
may be claimed if they are short or urgent: one identification need not wait for 64 sweeps."""
MAX_ENDING = 2
"""Parcels whose end is being written at most; then the dispatcher waits for the oldest."""
NEW_OBJECTS = 10_000
"""New objects after which garbage is searched among them; a run has dozens while it is open."""
SHORT_RUNS = 8
"""A job with at most this many runs is short."""


class Dispatcher:
    """Connects the queue, the workers and the recorders of several jobs."""

    def __init__(
        self,
        database: Database,
        store: ObjectStore,
        executor: Executor,
        leases: HeldLeases,
        *,
        project_cores: int | None = None,
        keeps_signals: bool = False,
        cluster: SharedCluster | None = None,
    ) -> None:
        self.stopping = threading.Event()
        self._database, self._store, self._executor = database, store, executor
        self._keeps_signals, self._cluster = keeps_signals, cluster
        self._woken = threading.Event()
        self._woken.set()  # earlier submissions sent no notification
        self._leases = leases
        # Keyed by lease: a job may return as a new attempt while packs of the old one still run.
        self._scheduler: Scheduler[Lease] = Scheduler(executor, project_cores=project_cores)
        self._overlap = Overlap(database)
        self._recorders: dict[Lease, RunRecorder] = {}
        self._jobs: dict[str, HeldJob] = {}
        self._is_filling = False
        self._side_jobs: BackgroundJobs[Lease] = BackgroundJobs()
        self._lost: set[Lease] = set()
        self._ending: list[Lease] = []  # parcels whose end is being written, the oldest first
        self._checked_at = 0.0
        self._listener = threading.Thread(
            target=self._listen_for_wakeups, name="notifier", daemon=True
        )

    def run_until_stopped(self) -> None:
        """Work until `stopping` is set. Then release every job with its checkpoints.

        Raises
        ------
        ClusterLost
            If the workers are lost. The jobs were released as lost.
        """
        details: dict[str, object] = {"cpus": self._executor.slots, "pid": os.getpid()}
        if self._cluster is not None:
            details[CLUSTER_KEY] = self._cluster.identity
        self._leases.start_heartbeat(details)
        service_metrics.cores.set_function(lambda: self._executor.slots)
        _log.info("ready: %s with %d cores", self._leases.owner, self._executor.slots)
        self._listener.start()
        try:
            with _spare_from_collection():
                while not self.stopping.is_set():
                    self._leases.loop.turn()
                    self.run_round()
        except ClusterLost:
            self._release_jobs(lost=True)
            raise
        finally:
            self._leases.loop.end()
        self._scheduler.stop_jobs()
        self._release_jobs()

    def run_round(self) -> None:
        """Run one round: check the queue, feed and collect runs, write."""
        if not self._recorders:
            self._woken.wait(IDLE_SECONDS)
        pause = time.monotonic() - self._checked_at
        if self._woken.is_set() or pause > (BUSY_SECONDS if self._recorders else 0.0):
            self._woken.clear()
            self._checked_at = time.monotonic()
            self._check_queue()
        self._share_cores()
        has_time = self._recorders and not self._is_filling
        for lease in self._scheduler.run_step(STEP_SECONDS if has_time else 0.0):
            self._end_runs(lease)
        for lease in self._list_ready_to_conclude():
            self._conclude_job(lease)
        service_metrics.record_kernel_seconds("process", get_compile_seconds())
        service_metrics.record_kernel_seconds("workers", self._scheduler.compile_seconds)
        for recorder in self._list_held_recorders():
            is_ending = recorder.lease in self._ending  # then the write itself decides
            if not is_ending and not self._leases.is_held(recorder.lease):
                continue  # the pending heartbeat, or the next one, decides
            self._write(recorder, recorder.write_due)
        for lease in tuple(self._ending):
            self._leave_parcel(lease)

    def _share_cores(self) -> None:
        """Take the part of a shared cluster that this dispatcher has, by what others told."""
        if self._cluster is None:
            return
        n_cores, owner = self._cluster.n_cores, self._leases.owner
        wanted = self._scheduler.count_wanted_cores()
        self._leases.wanted_cores = n_cores if wanted is None else wanted
        # What the others do not want is free for this one, whatever it wants now.
        shares = divide_cores(n_cores, {**self._leases.cores_of_others, owner: n_cores})
        self._cluster.limit_slots(shares[owner])

    def _check_queue(self) -> None:
        admission = self._build_admission()
        signals = retry_transient(partial(self._leases.check_queue, admission))
        for recorder in self._list_held_recorders():
            lease = recorder.lease
            is_ending = lease in self._ending  # its lease is perhaps gone because it has ended
            if self._leases.is_lost(lease) and not is_ending:
                self._drop_lost_parcel(recorder, LeaseLost(lease.job_id, lease.attempt))
            elif lease.job_id in signals.jobs_to_cancel:
                recorder.is_stopped = True
        self._is_filling = False
        for job in signals.jobs_to_extend.intersection(self._list_hungry_jobs()):
            self._claim_next(job)
        if signals.has_waiting_job and len(self._jobs) < 2 * MAX_JOBS:
            choose = partial(choose_first_size, n_cores=self._executor.slots)
            claim = retry_transient(partial(self._leases.claim_job, admission, choose_size=choose))
            if claim is not None:
                self._take_parcel(claim)
                self._is_filling = True  # one job per round, so that other dispatchers get some
                self._woken.set()

    def _list_hungry_jobs(self) -> list[str]:
        return [job for job, held in self._jobs.items() if held.wants_parcel]

    def _claim_next(self, job: str) -> None:
        """Claim another parcel of a job that is held, if there is one."""
        held = self._jobs[job]
        n_sharing = self._leases.n_alive
        claim = retry_transient(
            partial(
                self._leases.claim_job,
                only=job,
                choose_size=partial(held.choose_size, n_sharing=n_sharing),
            )
        )
        if claim is not None:
            self._take_parcel(claim)
            self._woken.set()  # it may be read out before the next look at the queue

    def _build_admission(self) -> Admission | None:
        """Return which jobs may still be claimed; None admits every job."""
        if len(self._jobs) < MAX_JOBS:
            return None
        return Admission(SHORT_RUNS, min(held.job.priority for held in self._jobs.values()))

    def _list_held_recorders(self) -> list[RunRecorder]:
        return [recorder for lease, recorder in self._recorders.items() if lease not in self._lost]

    def _listen_for_wakeups(self) -> None:
        with open_notifier(self._database, self.stopping) as notifier:
            while not self.stopping.is_set():
                if notifier.wait_for_change():
                    self._woken.set()
        self._woken.set()

    def _take_parcel(self, claim: Claim) -> None:
        """Begin to work on a claimed parcel, unless its lease is lost by then."""
        job = claim.job
        held = self._jobs.get(job.id)
        if held is None:
            parts = JobParts(self._database, job, self._store, keeps_signals=self._keeps_signals)
            held = HeldJob(parts, JobSpeed(time.monotonic(), job.n_done))
        else:
            held.complete_row(job)
        source = JobRuns(
            self._database,
            claim,
            self._store,
            parts=held.parts,
            run_beside=self._overlap.run_beside,
        )
        try:
            recorder = retry_transient(
                partial(
                    RunRecorder,
                    self._database,
                    claim,
                    self._store,
                    held.parts.encoder,
                    held.parts.warm.record_end,
                    run_beside=self._overlap.run_beside,
                    speed=held.speed,
                )
            )
        except LeaseLost as error:  # this process stood still after the claim
            service_metrics.lease_losses.labels("owner").inc()
            with bind_lease(claim.lease):
                _log.warning("the parcel is not taken: %s", error)
            self._leases.forget_lease(claim.lease)
            return
        self._jobs[job.id] = held
        held.add_parcel(claim, source)
        self._recorders[claim.lease] = recorder
        self._scheduler.add_job(
            claim.lease,
            source,
            recorder,
            priority=job.priority,
            project=job.project_id,
            account=job.id,
        )
        service_metrics.held_jobs.set(len(self._jobs))
        runs = f"runs {claim.runs.start} to {claim.runs.stop - 1} of {job.n_runs}"
        with bind_lease(claim.lease):
            _log.info("%s: %s, attempt %d", job.id, runs, claim.lease.attempt)

    def _drop_lost_parcel(self, recorder: RunRecorder, error: LeaseLost) -> None:
        service_metrics.lease_losses.labels("owner").inc()
        with bind_lease(recorder.lease):
            _log.warning("the parcel is dropped: %s", error)
        self._lost.add(recorder.lease)
        self._leases.forget_lease(recorder.lease)
        recorder.is_stopped = True

    def _end_runs(self, lease: Lease) -> None:
        """Begin to end a parcel whose runs have ended; `_leave_parcel` follows."""
        recorder = self._recorders[lease]
        if recorder.is_stopped or lease in self._lost:
            self._conclude_job(lease)
            return
        held = self._jobs[lease.job_id]
        is_whole = held.parcels[lease].has_whole_job
        if is_whole and self._build_last_steps(lease) is None:
            self._conclude_job(lease)
            return
        self._ending.append(lease)
        if not is_whole and all(other in self._ending for other in held.parcels):
            self._claim_next(lease.job_id)  # so that the job does not wait in between
        self._write(recorder, recorder.end_parcel)
        if len(self._ending) > MAX_ENDING:
            oldest = self._recorders[self._ending[0]]
            self._write(oldest, oldest.wait_for_end)

    def _leave_parcel(self, lease: Lease) -> None:
        """Leave a parcel whose end is written. If it is the last one, its job ends after it."""
        recorder = self._recorders[lease]
        if lease not in self._lost and recorder.has_ended is None:
            return
        self._ending.remove(lease)
        if recorder.has_ended:
            self._forget_parcel(lease)
            self._leases.forget_lease(lease)
        elif recorder.is_stopped or (last_steps := self._build_last_steps(lease)) is None:
            self._conclude_job(lease)
        else:
            self._side_jobs.start_job(lease, last_steps)

    def _build_last_steps(self, lease: Lease) -> DocumentMaker | None:
        parts = self._jobs[lease.job_id].parts
        return retry_transient(partial(build_end_maker, self._database, lease, parts))

    def _write(self, recorder: RunRecorder, write: Callable[[], None]) -> None:
        """Let a recorder write; drop its parcel if the lease is lost."""
        try:
            with bind_lease(recorder.lease):
                write()
        except LeaseLost as error:
            self._drop_lost_parcel(recorder, error)

    def _list_ready_to_conclude(self) -> list[Lease]:
        """List jobs whose last steps are done, or are no longer wanted."""
        stopped = [key for key in self._side_jobs.pending_keys if self._recorders[key].is_stopped]
        for lease in stopped:
            self._side_jobs.cancel_job(lease)
        return [*stopped, *self._side_jobs.list_done()]

    def _conclude_job(self, lease: Lease) -> None:
        """End the job of its last parcel, or a parcel that was cancelled or lost."""
        cramer_rao = self._side_jobs.take_result(lease) if lease in self._side_jobs else None
        recorder = self._recorders[lease]
        self._forget_parcel(lease)
        if lease in self._lost:
            self._lost.discard(lease)
            return
        try:  # the lease is renewed until the end is written
            with bind_lease(lease):
                retry_transient(
                    recorder.cancel_parcel
                    if recorder.is_stopped
                    else partial(recorder.finish_job, cramer_rao)
                )
                _log.info("%s has ended", lease.job_id)
        except LeaseLost as error:
            with bind_lease(lease):
                _log.warning("the end of the job was not written: %s", error)
        finally:
            self._leases.forget_lease(lease)

    def _forget_parcel(self, lease: Lease) -> None:
        del self._recorders[lease]
        held = self._jobs[lease.job_id]
        del held.parcels[lease]
        if not held.parcels:
            del self._jobs[lease.job_id]
        service_metrics.held_jobs.set(len(self._jobs))

    def _release_jobs(self, *, lost: bool = False) -> None:
        self._side_jobs.stop()
        for recorder in self._list_held_recorders():
            self._write(recorder, recorder.wait_for_end)
            if recorder.has_ended:
                self._leases.forget_lease(recorder.lease)
            elif recorder.lease not in self._lost:
                self._write(recorder, partial(retry_transient, recorder.write_all))
        self._leases.release_all(lost=lost)
        self._leases.stop_heartbeat()
        self._overlap.close()
        _log.info("stopped")


def run_dispatcher(
    settings: Settings,
    local: LocalRay | None = None,
    prepare: Callable[[], DispatcherStart] | None = None,
) -> int:
    """Run a dispatcher and return the exit code. Expected errors are logged in one line.

    Parameters
    ----------
    local : LocalRay, optional
        A Ray that is already running; it is closed here.
    prepare : callable, optional
        Returns a start that was made while Ray started, or raises its error.
    """
    try:
        start = DispatcherStart(settings) if prepare is None else prepare()
        return serve_jobs(settings, local, start)
    except (Misconfigured, StorageError, WorkersError) as error:
        _log.error("%s", error)
    except SQLAlchemyError as error:
        _log.error("the database cannot be used: %s", str(error).splitlines()[0])
    finally:
        if local is not None:
            local.close()
    return 1


def serve_jobs(settings: Settings, local: LocalRay | None, start: DispatcherStart) -> int:
    """Run a dispatcher until it is stopped.

    Raises
    ------
    Misconfigured, StorageError, WorkersError
        If the data folder, the database, the object store or Ray cannot be used.
    """
    start.announce()
    # In parallel with joining Ray; an error is met again below.
    threading.Thread(target=start.compile_search, name="compile", daemon=True).start()
    where = ClusterSettings(
        settings.ray_address, settings.cpus, settings.worker_memory_bytes, settings.start_seconds
    )
    executor = None
    try:
        store = open_store(settings.store_location)
        executor = RayExecutor(where, local)
        start.finish("ray")
        start.compile_search()
        executor.warm_up_workers()
        start.finish("workers")
        dispatcher = Dispatcher(
            start.database,
            store,
            executor,
            start.leases,
            project_cores=settings.project_cores,
            keeps_signals=settings.keep_signals,
            cluster=None if executor.identity is None else executor,
        )
        _stop_on_signals(dispatcher.stopping, executor)
        _watch_process(dispatcher.stopping, executor, start.leases.loop)
        dispatcher.run_until_stopped()
    except ClusterLost as error:
        _log.error("%s", error)
        assert executor is not None
        _exit_now(executor)
    finally:
        if executor is not None:
            executor.close()
        start.close()
    return 0


@contextmanager
def _spare_from_collection() -> Iterator[None]:
    """Search seldom for garbage, and not among what lives now, until the block ends.

    Modules have some hundred thousand objects. To search them again and again took a tenth of the
    time of a dispatcher.
    """
    _, *later = thresholds = gc.get_threshold()
    gc.set_threshold(NEW_OBJECTS, *later)
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        gc.set_threshold(*thresholds)


def bind_lease(lease: Lease) -> AbstractContextManager[None]:
    """Let log lines name the job and the attempt."""
    return bind_ids(job_id=lease.job_id, attempt=lease.attempt)


def _stop_on_signals(stopping: threading.Event, executor: RayExecutor) -> None:
    """Stop on SIGTERM, on SIGINT, and when a supervisor closes standard input."""

    def handle(_number: int, _frame: FrameType | None) -> None:
        stopping.set()  # the listener's thread sees it and wakes the main loop

    # After ray.init, which sets handlers of its own.
    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)
    if os.environ.get(SUPERVISED_VARIABLE):
        threading.Thread(target=_exit_with_parent, args=(stopping, executor), daemon=True).start()


def _exit_with_parent(stopping: threading.Event, executor: RayExecutor) -> None:
    # Not through the buffer, because its lock would be held when the interpreter exits.
    while os.read(sys.stdin.fileno(), 1024):
        pass
    stopping.set()
    time.sleep(RELEASE_SECONDS)
    _exit_now(executor)


def _watch_process(stopping: threading.Event, executor: RayExecutor, loop: LoopWatch) -> None:
    """End the process if the cluster is lost or the main loop stands: the supervisor restarts it.

    It may hang in a call to Ray.
    """
    service_metrics.loop_standing.set_function(lambda: loop.standing_seconds)

    def look() -> None:
        if not executor.is_alive():
            time.sleep(RELEASE_SECONDS)
            _exit_now(executor)

    end_if_standing(loop, stopping, partial(_exit_now, executor), look)


def _exit_now(executor: RayExecutor) -> None:
    """End the process without Ray's own shutdown, which may wait for lost processes."""
    executor.abandon_cluster()
    logging.shutdown()
    os._exit(RESTART_EXIT_CODE)
