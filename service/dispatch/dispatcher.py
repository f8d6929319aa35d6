"""The dispatcher: claims jobs by lease, drives the workers, writes what they find.

A process of its own (`service.dispatch.process`); any number of them share one queue.
"""

import logging
import os
import signal
import sys
import threading
import time
from functools import partial
from types import FrameType

from sqlalchemy.exc import SQLAlchemyError

from service.core.errors import Misconfigured
from service.core.settings import LOG_FORMAT, Settings
from service.dispatch.background import Aside, Make
from service.dispatch.cramer_rao import floors_for
from service.dispatch.job_runs import JobRuns
from service.dispatch.leases import Leases
from service.dispatch.recorder import Recorder
from service.dispatch.supervisor import AGAIN, SUPERVISED
from service.queue.admission import Admission
from service.queue.leases import Claim, Lease
from service.queue.notifications import new_waker
from service.storage import migrate
from service.storage.errors import LeaseLost, StorageError
from service.storage.objects import ObjectStore, open_store
from service.storage.retry import patiently
from service.storage.sessions import Database
from workers.cluster import ClusterSettings, RayCrew
from workers.errors import ClusterLost, WorkersError
from workers.feeding import Feeder
from workers.local_ray import LocalRay
from workers.ports import Crew
from workers.warming import warm

_log = logging.getLogger("lagid.dispatcher")

IDLE_SECONDS = 1.0
"""Longest wait for work; a submission wakes the dispatcher at once."""
BUSY_SECONDS = 0.2
"""How often a busy dispatcher looks for cancelled and waiting jobs."""
STEP_SECONDS = 0.1
LEAVE_SECONDS = 5.0
"""What giving the jobs back may take once the parent or the workers are gone."""
MAX_JOBS = 64
"""Jobs in hand at a time: they share the workers, and each is read as it is needed. As many again
may come if they are short or urgent: a single identification does not wait for 64 sweeps."""
SHORT_RUNS = 8
"""A job of so many runs is short."""


class Dispatcher:
    """Joins the queue, the workers and the records of several jobs at a time."""

    def __init__(
        self,
        database: Database,
        store: ObjectStore,
        crew: Crew,
        leases: Leases,
        *,
        project_cores: int | None = None,
    ) -> None:
        self.stopping = threading.Event()
        self._database, self._store, self._crew = database, store, crew
        self._woken = threading.Event()
        self._woken.set()  # what was queued before is not heard of
        self._leases = leases
        # By lease: a job may come back under a new attempt while packs of the old one fly.
        self._feeder: Feeder[Lease] = Feeder(crew, project_cores=project_cores)
        self._recorders: dict[Lease, Recorder] = {}
        self._priorities: dict[Lease, int] = {}
        self._is_filling = False
        self._floors: dict[Lease, Make] = {}  # of jobs with noise, to be made when their runs end
        self._aside: Aside[Lease] = Aside()
        self._lost: set[Lease] = set()
        self._looked = 0.0
        self._waking = threading.Thread(target=self._listen, name="waker", daemon=True)

    def run(self) -> None:
        """Work until `stopping` is set; then give every job back with its checkpoints.

        Raises
        ------
        ClusterLost
            If the workers are gone; the jobs were given back, as lost.
        """
        self._leases.start({"cpus": self._crew.slots, "pid": os.getpid()})
        _log.info("ready: %s with %d cores", self._leases.owner, self._crew.slots)
        self._waking.start()
        try:
            while not self.stopping.is_set():
                self.turn()
        except ClusterLost:
            self._give_back(lost=True)
            raise
        self._feeder.stop()
        self._give_back()

    def turn(self) -> None:
        """One round: look at the queue, feed and collect, write."""
        if not self._recorders:
            self._woken.wait(IDLE_SECONDS)
        pause = time.monotonic() - self._looked
        if self._woken.is_set() or pause > (BUSY_SECONDS if self._recorders else 0.0):
            self._woken.clear()
            self._looked = time.monotonic()
            self._attend()
        has_time = self._recorders and not self._is_filling
        for lease in self._feeder.step(STEP_SECONDS if has_time else 0.0):
            self._end(lease)
        for lease in self._over():
            self._conclude(lease)
        for recorder in self._kept():
            if not self._leases.is_sure(recorder.lease):
                continue  # the heartbeat that waits, or the next one, tells whose it is
            try:
                patiently(recorder.flush)
            except LeaseLost as error:
                self._lose(recorder, error)

    def _attend(self) -> None:
        admission = self._admission()
        signals = patiently(partial(self._leases.look, admission))
        for recorder in self._kept():
            lease = recorder.lease
            if self._leases.is_lost(lease):
                self._lose(recorder, LeaseLost(lease.job_id, lease.attempt))
            elif lease.job_id in signals.to_cancel:
                recorder.is_stopped = True
        self._is_filling = False
        if signals.is_waiting and len(self._recorders) < 2 * MAX_JOBS:
            claim = patiently(partial(self._leases.claim, admission))
            if claim is not None:
                self._take(claim)
                self._is_filling = True  # the next one in the next turn: rivals get some
                self._woken.set()

    def _admission(self) -> Admission | None:
        """What may still come; None is everything."""
        if len(self._recorders) < MAX_JOBS:
            return None
        return Admission(SHORT_RUNS, min(self._priorities.values()))

    def _kept(self) -> list[Recorder]:
        return [one for lease, one in self._recorders.items() if lease not in self._lost]

    def _listen(self) -> None:
        with new_waker(self._database, self.stopping) as waker:
            while not self.stopping.is_set():
                if waker.wait():
                    self._woken.set()
        self._woken.set()

    def _take(self, claim: Claim) -> None:
        source = JobRuns(self._database, claim, self._store)
        floors = patiently(partial(floors_for, self._database, claim, source))
        recorder = patiently(partial(Recorder, self._database, claim, source.save, source.failed))
        if floors is not None:
            self._floors[claim.lease] = floors
        self._recorders[claim.lease] = recorder
        job = claim.job
        self._priorities[claim.lease] = job.priority
        self._feeder.add(
            claim.lease, source, recorder, priority=job.priority, project=job.project_id
        )
        _log.info("%s: %d runs, attempt %d", claim.job.id, claim.job.n_runs, claim.lease.attempt)

    def _lose(self, recorder: Recorder, error: LeaseLost) -> None:
        _log.warning("stop at once: %s", error)
        self._lost.add(recorder.lease)
        self._leases.forget(recorder.lease)
        recorder.is_stopped = True

    def _end(self, lease: Lease) -> None:
        """The runs of a job are over: its floors are made before it ends, if it has any."""
        recorder, floors = self._recorders[lease], self._floors.pop(lease, None)
        if floors is None or recorder.is_stopped:
            self._conclude(lease)
            return
        try:
            patiently(recorder.store)
        except LeaseLost as error:
            self._lose(recorder, error)
            self._conclude(lease)
        else:
            self._aside.begin(lease, floors)

    def _over(self) -> list[Lease]:
        """Jobs whose floors were made, or are no longer wanted."""
        stopped = [one for one in self._aside.keys if self._recorders[one].is_stopped]
        for lease in stopped:
            self._aside.drop(lease)
        return [*stopped, *self._aside.ended()]

    def _conclude(self, lease: Lease) -> None:
        floors = self._aside.take(lease) if lease in self._aside else None
        recorder = self._recorders.pop(lease)
        del self._priorities[lease]
        if lease in self._lost:
            self._lost.discard(lease)
            return
        try:
            patiently(recorder.cancel if recorder.is_stopped else partial(recorder.finish, floors))
        except LeaseLost as error:
            _log.warning("its end was not written: %s", error)
        self._leases.forget(lease)

    def _give_back(self, *, lost: bool = False) -> None:
        self._aside.stop()
        for recorder in self._kept():
            try:
                patiently(recorder.keep)
            except LeaseLost as error:
                self._lose(recorder, error)
        self._leases.release_all(lost=lost)
        self._leases.stop()
        _log.info("stopped")


def run_to_the_end(settings: Settings, local: LocalRay | None = None) -> int:
    """Run a dispatcher; what cannot be used is told in one line. Gives the exit code.

    Parameters
    ----------
    local : LocalRay, optional
        A Ray that was started before; it ends here.
    """
    try:
        return serve(settings, local)
    except (Misconfigured, StorageError, WorkersError) as error:
        _log.error("%s", error)
    except SQLAlchemyError as error:
        _log.error("the database cannot be used: %s", str(error).splitlines()[0])
    finally:
        if local is not None:
            local.close()
    return 1


def serve(settings: Settings, local: LocalRay | None = None) -> int:
    """Run a dispatcher until it is told to stop.

    Raises
    ------
    Misconfigured, StorageError, WorkersError
        If the data folder, the database, the object store or Ray cannot be used.
    """
    logging.basicConfig(level=logging.INFO, format=LOG_FORMAT)
    settings.prepare_folder()
    database = Database(settings.database)
    patiently(partial(migrate.upgrade, database))  # it may be starting as well
    store = open_store(settings.store)
    compiling = threading.Thread(target=warm, name="warm", daemon=True)
    compiling.start()  # the compiler and Ray's start wait on different things
    where = ClusterSettings(settings.ray_address, settings.cpus, settings.worker_memory)
    crew = RayCrew(where, local)
    try:
        compiling.join()
        crew.warm()
        leases = Leases(database, settings.lease_seconds)
        dispatcher = Dispatcher(database, store, crew, leases, project_cores=settings.project_cores)
        _stop_on_signals(dispatcher.stopping, crew)
        dispatcher.run()
    except ClusterLost as error:
        _log.error("%s", error)
        _end_at_once(crew)
    finally:
        crew.close()
        database.dispose()
    return 0


def _stop_on_signals(stopping: threading.Event, crew: RayCrew) -> None:
    """SIGTERM, SIGINT, and the end of standard input where a supervisor holds it."""

    def handle(_number: int, _frame: FrameType | None) -> None:
        stopping.set()  # the waker's thread sees it and wakes the main loop

    # After ray.init, which sets handlers of its own.
    signal.signal(signal.SIGTERM, handle)
    signal.signal(signal.SIGINT, handle)
    if os.environ.get(SUPERVISED):
        threading.Thread(target=_outlive_no_parent, args=(stopping, crew), daemon=True).start()
    threading.Thread(target=_outlive_no_cluster, args=(stopping, crew), daemon=True).start()


def _outlive_no_parent(stopping: threading.Event, crew: RayCrew) -> None:
    # Not through the buffer: its lock would be held at the interpreter's end.
    while os.read(sys.stdin.fileno(), 1024):
        pass
    stopping.set()
    time.sleep(LEAVE_SECONDS)
    _end_at_once(crew)


def _outlive_no_cluster(stopping: threading.Event, crew: RayCrew) -> None:
    """The main thread sees it as well, unless it is in a call of Ray's that does not return."""
    while not stopping.wait(IDLE_SECONDS):
        if not crew.is_alive():
            time.sleep(LEAVE_SECONDS)
            _end_at_once(crew)


def _end_at_once(crew: RayCrew) -> None:
    """End the process without Ray's own end, which waits for what may be gone."""
    crew.abandon()
    logging.shutdown()
    os._exit(AGAIN)
