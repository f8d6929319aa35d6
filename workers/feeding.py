"""Keep the crew busy with the runs of several jobs, fairly, and hand on what comes back."""

import logging
import time
from collections.abc import Hashable, Iterable
from typing import Generic, TypeVar

from workers.errors import PackFailed, PackLost
from workers.jobwork import JobWork
from workers.packing import PACKS_PER_CPU, fairest
from workers.ports import Crew, Handle, JobSource, RunObserver

_log = logging.getLogger(__name__)

GRACE_SECONDS = 1.0
"""A cancelled pack that has not ended by then loses its worker."""


Key = TypeVar("Key", bound=Hashable)


class Feeder(Generic[Key]):
    """The driver of a crew. `add` jobs, then call `step` until they have ended.

    A job goes by a key of the caller's, which must not be in use.
    """

    def __init__(self, crew: Crew, *, grace_seconds: float = GRACE_SECONDS) -> None:
        self._crew = crew
        self._grace = grace_seconds
        self._jobs: dict[Key, JobWork] = {}
        self._stopped: dict[Key, float] = {}  # when the job was told to stop; inf once forced

    def __len__(self) -> int:
        return len(self._jobs)

    def add(self, job: Key, source: JobSource, observer: RunObserver) -> None:
        """Take on a job."""
        assert job not in self._jobs
        self._jobs[job] = JobWork(source, observer, self._crew)

    def step(self, timeout: float) -> tuple[Key, ...]:
        """Feed, wait at most `timeout` seconds, collect; returns the jobs that ended.

        Raises
        ------
        ClusterLost
            If the crew shows no sign of life.
        """
        self._stop_where_asked()
        self._feed()
        for handle in self._crew.finished(timeout):
            self._collect(handle)
        self._feed()
        self._crew.check()
        ended = tuple(job for job, work in self._jobs.items() if work.is_done)
        for job in ended:
            del self._jobs[job]
            self._stopped.pop(job, None)
        return ended

    def stop(self, jobs: Iterable[Key] | None = None) -> None:
        """Stop jobs (all if not given): soft now, by force after the grace period."""
        for job in tuple(self._jobs if jobs is None else jobs):
            if job in self._jobs and job not in self._stopped:
                self._stopped[job] = time.monotonic()
                self._jobs[job].stop()
                self._cancel(job, force=False)

    @property
    def _room(self) -> int:
        in_flight = sum(len(work.flying) for work in self._jobs.values())
        return PACKS_PER_CPU * self._crew.slots - in_flight

    def _feed(self) -> None:
        while self._room > 0:
            hungry = {
                job: len(work.flying)
                for job, work in self._jobs.items()
                if job not in self._stopped and work.read_ahead()
            }
            chosen = fairest(hungry)
            if chosen is None:
                return
            idle = self._crew.slots - sum(len(work.flying) for work in self._jobs.values())
            self._jobs[chosen].feed(idle if len(hungry) == 1 else 0)

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
        elif owner in self._stopped:
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
