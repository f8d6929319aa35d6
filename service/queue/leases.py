"""The job queue: leases on jobs, with the attempt as fencing token.

A dispatcher claims a job for some time and renews all its leases with one statement. When its
heartbeat stops, the reaper gives its jobs back. Each claim increments the `attempt` of the job, and
every later write carries it. So a dispatcher that comes back late changes no row and learns that it
must stop.

All times come from one clock: that of PostgreSQL, or with SQLite that of the host. A wrong clock
makes the reaper late or early. But the attempt alone decides which dispatcher may write.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, Literal

from sqlalchemy import (
    ColumnElement,
    and_,
    case,
    exists,
    false,
    func,
    literal,
    or_,
    select,
    true,
    update,
)
from sqlalchemy.orm import Session, aliased, defer

from service.core.states import OPEN_STATES, JobState
from service.queue.admission import Admission, count_running_jobs, is_in_state
from service.queue.clocks import Clock, choose_database_clock
from service.repositories.events import EventKind, EventRepository
from service.repositories.jobs import end_open_runs, notify_queue
from service.storage.columns import Document, UtcDateTime
from service.storage.errors import LeaseLost, RowConflict
from service.storage.statements import RETURNING_OPTIONS
from service.storage.tables import Checkpoint, Job, Run

DEFAULT_LEASE = timedelta(seconds=10)
MAX_LEASE_LENGTHS = 2
"""A lease ends within this many of its lengths, unless a clock was stepped back."""
HUNG_AFTER = timedelta(seconds=60)
"""How long a dispatcher with a living process keeps its jobs after the end of its lease.

It probably waits for the database and has lost nothing. After this time it counts as hung.
"""
SPARED_LOSS_FACTOR = 4
"""Factor on the allowed losses of a job while other jobs of the same dispatcher progress.

Then this job is hardly the reason why the dispatchers die.
"""
_DEFER_SPEC = defer(Job.spec)
"""A specification of many cells has megabytes; it is loaded only where it is needed."""
FinalState = Literal[JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED]


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to write for a job; `attempt` is its fencing token."""

    job_id: str
    attempt: int
    owner: str

    def fence(self) -> tuple[ColumnElement[bool], ...]:
        """Return the condition that a row of `jobs` still belongs to this lease."""
        return Job.id == self.job_id, Job.attempt == self.attempt, Job.state == JobState.RUNNING


@dataclass(frozen=True, slots=True)
class Claim:
    """A newly claimed job and its lease."""

    lease: Lease
    job: Job


@dataclass(frozen=True, slots=True)
class RenewedLease:
    """A lease that a heartbeat renewed, and whether its job is to be cancelled."""

    lease: Lease
    cancel_requested: bool


@dataclass(frozen=True, slots=True)
class JobProgress:
    """Progress of a job over all its runs."""

    evaluations: int
    generation: int = 0
    best_rms: float | None = None
    seconds_left: float | None = None


@dataclass(frozen=True, slots=True)
class LeaseOwners:
    """Information about the owners of leases.

    Attributes
    ----------
    ended, awake : frozenset of str
        Owners that have ended, and those that run and are awake. Leases decide on all others.
    lease_lengths : mapping
        Length of the leases of each owner.
    """

    ended: frozenset[str] = frozenset()
    awake: frozenset[str] = frozenset()
    lease_lengths: Mapping[str, timedelta] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ReapResult:
    """Fate of the jobs whose leases had expired, and the owners of these leases."""

    requeued: tuple[str, ...] = ()
    failed: tuple[str, ...] = ()
    cancelled: tuple[str, ...] = ()
    owners: frozenset[str] = frozenset()


class LeaseQueue:
    """The jobs of all projects as dispatchers see them, in one writing session."""

    def __init__(self, session: Session, clock: Clock | None = None) -> None:
        self._session, self._clock = session, clock or choose_database_clock(session)
        self._events = EventRepository(session)

    def claim_job(
        self, owner: str, lease: timedelta = DEFAULT_LEASE, admission: Admission | None = None
    ) -> Claim | None:
        """Claim the first queued job that `admission` accepts; None if none waits.

        The order is: highest priority, then fewest running jobs of the project, then oldest.
        """
        waiting, running_jobs = aliased(Job), count_running_jobs()
        first = (
            select(waiting.id)
            .outerjoin(running_jobs, running_jobs.c.project_id == waiting.project_id)
            .where(is_in_state(JobState.QUEUED, waiting))
            .where(true() if admission is None else admission.admits(waiting))
            .order_by(waiting.priority.desc(), func.coalesce(running_jobs.c.n, 0), waiting.id)
            .limit(1)
            # Rivals take the next job; SQLite has no rivals.
            .with_for_update(skip_locked=True, of=waiting)
        )
        now = self._read_clock()
        claim = (
            update(Job)
            .where(Job.id == first.scalar_subquery())
            .values(
                state=JobState.RUNNING,
                attempt=Job.attempt + 1,
                n_done_at_claim=Job.n_done,
                lease_owner=owner,
                lease_until=now + lease,
                started_at=func.coalesce(Job.started_at, now),
            )
            .returning(Job)
        )
        job = self._session.scalar(claim, execution_options=RETURNING_OPTIONS)
        if job is None:
            return None
        self._events.append_state(job)
        return Claim(Lease(job.id, job.attempt, owner), job)

    def recover_claim(self, owner: str, held: Collection[str]) -> Claim | None:
        """Return a job that this owner claimed without receiving the answer; None if there is none.

        Parameters
        ----------
        held : collection of str
            Jobs that the owner knows as its own.
        """
        conditions = (Job.lease_owner == owner, Job.state == JobState.RUNNING, Job.id.not_in(held))
        job = self._session.scalar(select(Job).where(*conditions).limit(1).with_for_update())
        return None if job is None else Claim(Lease(job.id, job.attempt, owner), job)

    def renew_leases(
        self, held: Collection[Lease], lease: timedelta = DEFAULT_LEASE
    ) -> tuple[RenewedLease, ...]:
        """Renew leases; those that are not returned are lost.

        A dispatcher passes no lease that it has dropped, so that the reaper finds it.
        """
        owners = {item.job_id: item.owner for item in held}
        renewed = (
            update(Job)
            .where(or_(false(), *(and_(*item.fence()) for item in held)))
            .values(lease_until=self._read_clock() + lease)
            .returning(Job.id, Job.attempt, Job.cancel_requested)
        )
        rows = self._session.execute(renewed, execution_options=RETURNING_OPTIONS)
        return tuple(
            RenewedLease(Lease(job, attempt, owners[job]), stop) for job, attempt, stop in rows
        )

    def lock_job(self, lease: Lease) -> Job:
        """Lock the job against every other writer until the transaction ends, and return it.

        Raises
        ------
        LeaseLost
            If the job has another attempt or is no longer running.
        """
        held = select(Job).where(*lease.fence()).with_for_update(key_share=True)
        job = self._session.scalar(
            held.options(_DEFER_SPEC), execution_options={"populate_existing": True}
        )
        if job is None:
            raise LeaseLost(lease.job_id, lease.attempt)
        return job

    def write_progress(self, lease: Lease, progress: JobProgress) -> None:
        """Write the progress of the job, and append it as an event."""
        values: dict[str, Any] = {
            "evaluations": progress.evaluations,
            "generation": progress.generation,
            "seconds_left": progress.seconds_left,
        }
        if progress.best_rms is not None:
            values["best_rms"] = choose_smaller_rms(progress.best_rms)
        job = self._update_job(lease, values)
        data = {"n_runs": job.n_runs, "n_done": job.n_done, "n_failed": job.n_failed}
        self._events.append_event(job.id, "progress", {**values, "best_rms": job.best_rms, **data})

    def append_event(self, lease: Lease, kind: EventKind, data: Document) -> None:
        """Append an event to the job, such as a line of its log."""
        self.lock_job(lease)
        self._events.append_event(lease.job_id, kind, data)

    def write_floors(self, lease: Lease, floors: Document) -> None:
        """Write the noise bounds to which the runs of the job are compared."""
        self._update_job(lease, {"floors": floors})

    def finish_job(self, lease: Lease, state: FinalState, error: str | None = None) -> Job:
        """End a job, and with it its unfinished runs.

        A job that succeeds must have none.

        Raises
        ------
        LeaseLost
            If the lease is no longer held; nothing is written.
        RowConflict
            If the job is to succeed but has unfinished runs.
        """
        job = self._update_job(
            lease,
            {
                "state": state,
                "error": error,
                "finished_at": self._read_clock(),
                "lease_until": None,
                "lease_owner": None,
                "seconds_left": None,
            },
        )
        self._correct_best_rms(job)
        if state is JobState.SUCCEEDED:
            self._check_runs_finished(job)
        else:
            end_open_runs(self._session, job.id, state, error)
        self._events.append_state(job)
        return job

    def has_progressed(self, owner: str) -> bool:
        """Return whether a job that this owner holds has progressed under its lease."""
        held = select(Job.id).where(Job.lease_owner == owner, Job.state == JobState.RUNNING)
        return bool(self._session.scalar(select(held.where(_has_progressed()).exists())))

    def release_job(
        self, lease: Lease, *, lost: bool = False, others_progressed: bool = False
    ) -> None:
        """Give a job back when the dispatcher shuts down, or has `lost` its workers.

        Parameters
        ----------
        others_progressed : bool
            Whether another job of the same owner progressed meanwhile.
        """
        job = self.lock_job(lease)
        if lost:
            self._fail_or_retry(job, others_progressed=others_progressed)
        elif job.cancel_requested:
            self._end_job(job, JobState.CANCELLED, None)
        else:
            self._requeue_job(job)

    def has_expired(self, owners: LeaseOwners) -> bool:
        """Return whether a lease is to be reaped, or ends later than any valid lease."""
        now = self._read_clock()
        is_wrong = or_(_is_expired(now, owners), _ends_too_late(now, owners))
        query = select(exists().where(is_in_state(JobState.RUNNING), is_wrong))
        return bool(self._session.scalar(query))

    def reap_expired(self, owners: LeaseOwners | None = None) -> ReapResult:
        """Give back the jobs whose leases have expired, or end them.

        A job with a cancel request is cancelled. A job that was lost `max_attempts` times without
        any progress of its runs fails. The limit is `SPARED_LOSS_FACTOR` times higher if other jobs
        of its owner progressed. Any other job is queued and continues from its checkpoints.

        Leases of ended owners are reaped at once, those of living owners `HUNG_AFTER` later. A
        lease that ends more than `MAX_LEASE_LENGTHS` lengths from now was written before a clock
        was stepped back. It is shortened to one length from now.
        """
        now, current_owners = self._read_clock(), owners or LeaseOwners()
        ahead = update(Job).where(
            is_in_state(JobState.RUNNING), _ends_too_late(now, current_owners)
        )
        ends = _choose_by_owner(
            {owner: now + length for owner, length in current_owners.lease_lengths.items()}, now
        )
        self._session.execute(ahead.values(lease_until=ends), execution_options=RETURNING_OPTIONS)
        expired = (
            select(Job)
            .where(is_in_state(JobState.RUNNING), _is_expired(now, current_owners))
            .with_for_update(skip_locked=True, key_share=True)
            .options(_DEFER_SPEC)
        )
        lost = self._session.scalars(expired, execution_options={"populate_existing": True}).all()
        lost_owners = frozenset(str(job.lease_owner) for job in lost)
        busy = {owner for owner in lost_owners if self.has_progressed(owner)}
        fates: dict[JobState, list[str]] = {state: [] for state in JobState}
        for job in lost:
            fates[self._fail_or_retry(job, others_progressed=job.lease_owner in busy)].append(
                job.id
            )
        queued, failed, cancelled = (
            tuple(fates[state]) for state in (JobState.QUEUED, JobState.FAILED, JobState.CANCELLED)
        )
        return ReapResult(queued, failed, cancelled, lost_owners)

    def _read_clock(self) -> datetime:
        self._session.connection()  # SQLite may wait here for the lock, and time passes
        return self._clock()

    def _update_job(self, lease: Lease, values: dict[str, Any]) -> Job:
        changed = update(Job).where(*lease.fence()).values(values).returning(Job.id)
        if self._session.scalar(changed, execution_options=RETURNING_OPTIONS) is None:
            raise LeaseLost(lease.job_id, lease.attempt)
        query = select(Job).where(Job.id == lease.job_id).options(_DEFER_SPEC)
        return self._session.scalars(query, execution_options={"populate_existing": True}).one()

    def _correct_best_rms(self, job: Job) -> None:
        """Take the best RMS from the results; a running run reports its fitness only."""
        of_job = Run.job_id == job.id, Run.best_rms.is_not(None)  # as in its index
        best = self._session.scalar(select(func.min(Run.best_rms)).where(*of_job))
        if best is not None:
            job.best_rms = best

    def _check_runs_finished(self, job: Job) -> None:
        """Check that all runs have finished, including those that are not created yet."""
        unfinished = select(func.count()).where(Run.job_id == job.id, Run.state.in_(OPEN_STATES))
        last = self._session.scalar(select(func.max(Run.number)).where(Run.job_id == job.id))
        n_created = 0 if last is None else last + 1
        n_left = job.n_runs - n_created + (self._session.scalar(unfinished) or 0)
        if n_left:
            raise RowConflict(f"{job.id} cannot succeed: {n_left} of its runs did not finish")

    def _fail_or_retry(self, job: Job, *, others_progressed: bool) -> JobState:
        progressed = self._session.scalar(select(Job.id).where(Job.id == job.id, _has_progressed()))
        job.lost_leases = job.lost_leases + 1 if progressed is None else 1
        is_spared = others_progressed and progressed is None
        max_losses = job.max_attempts * (SPARED_LOSS_FACTOR if is_spared else 1)
        if job.cancel_requested:
            self._end_job(job, JobState.CANCELLED, None)
        elif job.lost_leases >= max_losses:
            self._end_job(
                job,
                JobState.FAILED,
                f"gave up after {job.lost_leases} attempts without progress: the dispatcher or its "
                f"workers stopped. The last dispatcher was {job.lease_owner}. See its log, then "
                "resume the job.",
            )
        else:
            self._requeue_job(job)
        return job.state

    def _end_job(self, job: Job, state: JobState, error: str | None) -> None:
        job.state, job.error, job.finished_at = state, error, self._read_clock()
        job.lease_owner = job.lease_until = job.seconds_left = None
        end_open_runs(self._session, job.id, state, error)
        self._events.append_state(job)

    def _requeue_job(self, job: Job) -> None:
        job.state, job.lease_owner, job.lease_until = JobState.QUEUED, None, None
        running = update(Run).where(Run.job_id == job.id, Run.state == JobState.RUNNING)
        self._session.execute(
            running.values(state=JobState.QUEUED), execution_options=RETURNING_OPTIONS
        )
        self._events.append_state(job)
        notify_queue(self._session)


def _has_progressed() -> ColumnElement[bool]:
    """Return the condition that a run of a job ended or was checkpointed in this attempt."""
    checkpointed = exists().where(Checkpoint.job_id == Job.id, Checkpoint.attempt == Job.attempt)
    return or_(Job.n_done > Job.n_done_at_claim, checkpointed)


def _is_expired(now: datetime, owners: LeaseOwners) -> ColumnElement[bool]:
    """Return the condition that the lease of a job has expired."""
    overdue = Job.lease_until < _choose_by_owner(dict.fromkeys(owners.awake, now - HUNG_AFTER), now)
    return or_(overdue, Job.lease_owner.in_(owners.ended))


def _ends_too_late(now: datetime, owners: LeaseOwners) -> ColumnElement[bool]:
    """Return the condition that a lease ends later than any that its owner could get now.

    An owner without a row among the dispatchers has no known length, so its leases are left.
    """
    latest = {
        owner: now + MAX_LEASE_LENGTHS * length for owner, length in owners.lease_lengths.items()
    }
    return and_(Job.lease_owner.in_(latest), Job.lease_until > _choose_by_owner(latest, now))


def _choose_by_owner(times: Mapping[str, datetime], other: datetime) -> ColumnElement[datetime]:
    """Return the time of each owner of a lease, and one time for all others."""
    by_owner = {owner: literal(time, UtcDateTime()) for owner, time in times.items()}
    otherwise = literal(other, UtcDateTime())
    return case(by_owner, value=Job.lease_owner, else_=otherwise) if by_owner else otherwise


def choose_smaller_rms(rms: float) -> ColumnElement[Any]:
    """Return the smaller of the job's `best_rms` and this one, for an UPDATE."""
    return case((Job.best_rms <= rms, Job.best_rms), else_=rms)
