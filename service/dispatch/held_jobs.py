"""Jobs of which a dispatcher holds parcels, and how large their next parcels are.

A parcel should be some seconds of work for its dispatcher. Then several dispatchers end a sweep
together, and the rows of parcels cost nothing. The first one is small. Each later one is as much
larger or smaller as the one before it was read too soon or too late.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from math import ceil

from sqlalchemy.orm.attributes import set_committed_value

from service.dispatch.job_parts import JobParts
from service.dispatch.job_runs import JobRuns
from service.dispatch.recorder import JobSpeed
from service.dispatch.run_warm_starts import may_wait
from service.queue.leases import Claim, Lease
from service.storage.tables import Job

FIRST_RUNS = 250
"""Runs of the first parcel at least: a job with no more is one parcel."""
RUNS_PER_CORE = 4
"""Runs of the first parcel for each core of the dispatcher."""
PARCEL_SECONDS = 5.0
"""Time in which the runs of a parcel should be read."""
MAX_RUNS = 50_000
"""Runs of a parcel at most."""
MAX_CHANGE = 4.0
"""Factor between the sizes of two parcels, at most."""
UNREAD_PART = 0.25
"""A new parcel is claimed when this part of the last one is not read yet."""
END_PARTS = 2
"""Parcels that each dispatcher gets of the last runs of a job, at least."""


@dataclass(slots=True)
class HeldJob:
    """A job of which this dispatcher holds parcels.

    Attributes
    ----------
    parts : JobParts
        What its parcels share.
    speed : JobSpeed
        Start of the job in this dispatcher.
    parcels : dict
        Source of the runs of each parcel, by lease, the oldest first.
    """

    parts: JobParts
    speed: JobSpeed
    stopwatch: Callable[[], float] = time.monotonic
    parcels: dict[Lease, JobRuns] = field(default_factory=dict)
    _n_last: int = 0
    _claimed_at: float = 0.0

    @property
    def job(self) -> Job:
        """The row of the job as it was at its first claim."""
        return self.parts.job

    @property
    def wants_parcel(self) -> bool:
        """Whether few runs of the parcels are left to read."""
        unread = sum(source.n_unread for source in self.parcels.values())
        return unread <= UNREAD_PART * self._n_last

    def complete_row(self, job: Job) -> None:
        """Add the specification to the row of a later claim, which has none."""
        set_committed_value(job, "spec", self.job.spec)

    def add_parcel(self, claim: Claim, source: JobRuns) -> None:
        """Add a parcel that was claimed."""
        self.parcels[claim.lease] = source
        self._n_last, self._claimed_at = len(claim.runs), self.stopwatch()

    def choose_size(self, job: Job, n_sharing: int = 1) -> int:
        """Choose how many runs the next parcel has, if `n_sharing` dispatchers work.

        All of them if some start from others.
        """
        if may_wait(self.job):
            return job.n_runs
        read_in = max(self.stopwatch() - self._claimed_at, 1e-3)
        change = PARCEL_SECONDS * (1 - UNREAD_PART) / read_in
        by_time = self._n_last * min(max(change, 1 / MAX_CHANGE), MAX_CHANGE)
        share = ceil((job.n_runs - job.n_done) / (END_PARTS * max(n_sharing, 1)))
        return int(max(FIRST_RUNS, min(by_time, share, MAX_RUNS)))


def choose_first_size(job: Job, n_cores: int) -> int:
    """Choose how many runs the first parcel of a job has in a dispatcher.

    All of them if some start from others.
    """
    return job.n_runs if may_wait(job) else max(FIRST_RUNS, RUNS_PER_CORE * n_cores)
