"""Keep the crew busy with the runs of several jobs, fairly, and hand on what comes back."""

import logging
import time
from collections.abc import Hashable, Iterable
from typing import Generic, TypeVar

from workers.errors import PackFailed, PackLost
from workers.jobwork import JobWork
from workers.packing import PACK_SECONDS, PACKS_PER_CPU
from workers.ports import Crew, Handle, JobSource, RunObserver
from workers.sharing import Shares

_log = logging.getLogger(__name__)

GRACE_SECONDS = 1.0
"""A cancelled pack that has not ended by then loses its worker."""

PREFETCH = 64
"""Runs read ahead of the workers, for each core; the jobs share them."""

LEAST_AHEAD = 128
"""Runs that each job reads ahead: enough for a pack of short ones."""

READ_SECONDS = 0.05
"""Time that a step gives to reading runs: known ones cost no worker's time, and may be many."""

TELL_SECONDS = 0.02
MOST_TELL_SECONDS = 0.25
"""Time that a step gives to telling of results, at which signals are stored: as long as all else
took since the last time, but within these bounds. So half of a busy driver's time goes to it."""

MOST_UNTOLD_SECONDS = PACK_SECONDS
"""Compute time for each core of the results that a job may leave untold; then it gets no pack."""

Key = TypeVar("Key", bound=Hashable)


class Feeder(Generic[Key]):
    """The driver of a crew. `add` jobs, then call `step` until they have ended.

    A job goes by a key of the caller's, which must not be in use. Whose turn it is stands in
    `workers.sharing`; `project_cores` is the most packs of one project that compute at a time.
    """

    def __init__(
        self,
        crew: Crew,
        *,
        grace_seconds: float = GRACE_SECONDS,
        project_cores: int | None = None,
    ) -> None:
        self._crew = crew
        self._grace, self._project_cores = grace_seconds, project_cores
        self._shares: Shares[Key] = Shares()
        self._told_at = time.monotonic()
        self._jobs: dict[Key, JobWork] = {}
        self._stopped: dict[Key, float] = {}  # when the job was told to stop; inf once forced

    @property
    def is_busy(self) -> bool:
        """Whether every core has a pack."""
        return self._in_flight >= self._crew.slots

    def add(
        self,
        job: Key,
        source: JobSource,
        observer: RunObserver,
        *,
        priority: int = 0,
        project: str = "",
    ) -> None:
        """Take on a job."""
        assert job not in self._jobs
        self._jobs[job] = JobWork(source, observer, self._crew)
        self._shares.enter(job, priority=priority, project=project)

    def step(self, timeout: float) -> tuple[Key, ...]:
        """Feed, wait at most `timeout` seconds, collect; returns the jobs that ended.

        Raises
        ------
        ClusterLost
            If the crew shows no sign of life.
        """
        self._stop_where_asked()
        self._feed()
        has_news = any(work.has_news for work in self._jobs.values())
        for handle in self._crew.finished(0.0 if has_news else timeout):
            self._collect(handle)
        self._feed()
        now = time.monotonic()
        since = now - self._told_at
        self._tell(now + min(MOST_TELL_SECONDS, max(TELL_SECONDS, since)))
        self._crew.check()
        ended = tuple(job for job, work in self._jobs.items() if work.is_done)
        for job in ended:
            del self._jobs[job]
            self._shares.leave(job)
            self._stopped.pop(job, None)
        return ended

    def stop(self, jobs: Iterable[Key] | None = None) -> None:
        """Stop jobs (all if not given): soft now, by force after the grace period."""
        for job in tuple(self._jobs if jobs is None else jobs):
            if job in self._jobs and job not in self._stopped:
                self._stopped[job] = time.monotonic()
                self._jobs[job].stop()
                self._cancel(job, force=False)
        if jobs is None:
            self._tell(float("inf"))

    @property
    def _in_flight(self) -> int:
        return sum(len(work.flying) for work in self._jobs.values())

    def _feed(self) -> None:
        deadline = time.monotonic() + READ_SECONDS
        while self._in_flight < PACKS_PER_CPU * self._crew.slots:
            chosen = self._next(deadline)
            if chosen is None:
                return
            self._shares.serve(chosen)
            self._jobs[chosen].feed(self._idle(chosen))

    def _next(self, deadline: float) -> Key | None:
        """The job that the next place belongs to, if it has work for it.

        A place beside a pack that computes (`is_busy`) is not given away over the head of a job
        that is with the workers and will come back: its next slice would wait behind that pack.
        """
        going = {job: work for job, work in self._jobs.items() if job not in self._stopped}
        wanted = max(LEAST_AHEAD, PREFETCH * self._crew.slots // max(len(going), 1))
        for job in self._shares.order({job: len(work.flying) for job, work in going.items()}):
            if not self._has_core_for(job) or self._is_behind(going[job]):
                continue
            if going[job].read_ahead(wanted, deadline):
                return job
            if going[job].flying and self.is_busy:
                return None
        return None

    def _tell(self, deadline: float) -> None:
        """Tell of results, one of each job in turn, until the time is up.

        Before the next ones the workers are asked and fed: a slice of a single run that comes
        back does not wait until all that a sweep's pack gave is stored.
        """
        while sum(work.tell() for work in self._jobs.values()):
            if time.monotonic() > deadline:
                break
        self._told_at = time.monotonic()

    def _has_core_for(self, job: Key) -> bool:
        if self._project_cores is None:
            return True
        project = self._shares.project_of(job)
        flying = (
            len(work.flying)
            for mate, work in self._jobs.items()
            if self._shares.project_of(mate) == project
        )
        return sum(flying) < self._project_cores

    def _is_behind(self, work: JobWork) -> bool:
        return work.untold_seconds > MOST_UNTOLD_SECONDS * self._crew.slots

    def _idle(self, chosen: Key) -> int:
        """Cores that one run of this job may take besides its own: nobody else's turn suffers."""
        rank = self._shares.rank(chosen)
        taken = 0
        for job, work in self._jobs.items():
            if self._shares.rank(job) <= rank:
                taken += len(work.flying)
                if job != chosen and work.is_hungry:
                    return 0
        return self._crew.slots - taken

    def _collect(self, handle: Handle) -> None:
        owner = next((j for j, work in self._jobs.items() if handle in work.flying), None)
        try:
            done = self._crew.fetch(handle)
        except PackLost as error:
            if owner is not None:
                self._mourn(owner, self._jobs[owner], handle, error)
            return
        if owner is None:  # the crew does not know it any more, that is all
            _log.warning("a pack of no job came back")
            return
        self._shares.charge(owner, sum(one.seconds for one in done))
        if owner in self._stopped:
            del self._jobs[owner].flying[handle]
        else:
            self._jobs[owner].absorb(handle, done)

    def _mourn(self, job: Key, work: JobWork, handle: Handle, error: PackLost) -> None:
        if job in self._stopped:
            del work.flying[handle]
        elif isinstance(error, PackFailed):
            _log.error("a pack of %s failed: %s", job, error)
            work.fail(handle, f"internal error: {str(error).strip().splitlines()[-1]}")
        else:
            _log.warning("a worker of %s died: %s", job, error)
            work.lose(handle, str(error))

    def _stop_where_asked(self) -> None:
        self.stop([job for job, work in self._jobs.items() if work.observer.should_stop()])
        now = time.monotonic()
        for job, since in self._stopped.items():
            if now - since > self._grace:
                self._stopped[job] = float("inf")
                self._cancel(job, force=True)

    def _cancel(self, job: Key, *, force: bool) -> None:
        for handle in self._jobs[job].flying:
            self._crew.cancel(handle, force=force)
