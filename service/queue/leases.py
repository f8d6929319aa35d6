"""The queue: leases on jobs, fenced by the attempt.

A dispatcher claims a job for a time and renews all its leases with one statement. When it falls
silent, the reaper gives its jobs back. Each claim raises the job's `attempt`, and every later
write carries it: a dispatcher that comes back late hits no row and learns that it must stop.

Times are those of the one clock that all have: PostgreSQL's, or with SQLite that of the host.
A wrong clock delays or hastens the reaper, but which dispatcher may write is decided by the
attempt alone.
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
from service.queue.admission import Admission, count_running_jobs
from service.queue.clocks import Clock, choose_database_clock
from service.repositories.events import EventKind, EventRepository
from service.repositories.jobs import end_open_runs, notify_queue
from service.storage.columns import Document, UtcDateTime
from service.storage.errors import LeaseLost, RowConflict
from service.storage.statements import RETURNING_OPTIONS
from service.storage.tables import Checkpoint, Job, Run

DEFAULT_LEASE = timedelta(seconds=10)
MAX_LEASE_LENGTHS = 2
"""No lease ends later than after so many of its lengths, unless a clock was stepped back."""
HUNG_AFTER = timedelta(seconds=60)
"""A dispatcher whose process lives keeps its jobs so long after its lease has ended: it waits for
the database, and lost nothing. Then it counts as hung."""
SPARED_LOSS_FACTOR = 4
"""So many times as many losses without progress a job may have while others of the same dispatcher
come further: then it is hardly this one over which the dispatchers die."""
_DEFER_SPEC = defer(Job.spec)
"""A specification of many cells has megabytes; it is read where it is wanted."""
FinalState = Literal[JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED]


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to write for a job; `attempt` is its fencing token."""

    job_id: str
    attempt: int
    owner: str

    def fence(self) -> tuple[ColumnElement[bool], ...]:
        """Condition under which a row of `jobs` is still this lease's."""
        return Job.id == self.job_id, Job.attempt == self.attempt, Job.state == JobState.RUNNING


@dataclass(frozen=True, slots=True)
class Claim:
    """A job that was just claimed, and the lease on it."""

    lease: Lease
    job: Job


@dataclass(frozen=True, slots=True)
class RenewedLease:
    """A lease that a heartbeat renewed, and whether its job is to be cancelled."""

    lease: Lease
    cancel_requested: bool


@dataclass(frozen=True, slots=True)
class JobProgress:
    """How far a job has come, over all its runs."""

    evaluations: int
    generation: int = 0
    best_rms: float | None = None
    seconds_left: float | None = None


@dataclass(frozen=True, slots=True)
class LeaseOwners:
    """What is known of those who hold leases.

    Attributes
    ----------
    gone, living : frozenset of str
        Known to have ended, and known to be there and awake; of others only their leases tell.
    lengths : mapping
        How long the leases of each are.
    """

    ended: frozenset[str] = frozenset()
    awake: frozenset[str] = frozenset()
    lease_lengths: Mapping[str, timedelta] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ReapResult:
    """What became of the jobs whose leases had expired, and whose they were."""

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
        """Take the first queued job that `admission` lets in; None if none waits.

        First comes the highest priority, then the project that has fewest jobs running, then the
        oldest.
        """
        waiting, mates = aliased(Job), count_running_jobs()
        first = (
            select(waiting.id)
            .outerjoin(mates, mates.c.project_id == waiting.project_id)
            .where(waiting.state == JobState.QUEUED)
            .where(true() if admission is None else admission.admits(waiting))
            .order_by(waiting.priority.desc(), func.coalesce(mates.c.n, 0), waiting.id)
            .limit(1)
            # Rivals take the next one; SQLite has no rivals.
            .with_for_update(skip_locked=True, of=waiting)
        )
        now = self._read_clock()
        taken = (
            update(Job)
            .where(Job.id == first.scalar_subquery())
            .values(
                state=JobState.RUNNING,
                attempt=Job.attempt + 1,
                lease_owner=owner,
                lease_until=now + lease,
                started_at=func.coalesce(Job.started_at, now),
            )
            .returning(Job)
        )
        job = self._session.scalar(taken, execution_options=RETURNING_OPTIONS)
        if job is None:
            return None
        self._events.append_state(job)
        return Claim(Lease(job.id, job.attempt, owner), job)

    def recover_claim(self, owner: str, held: Collection[str]) -> Claim | None:
        """A job that this owner has claimed without learning of it; None if there is none.

        Parameters
        ----------
        held : collection of str
            The jobs that it knows to be its own.
        """
        mine = (Job.lease_owner == owner, Job.state == JobState.RUNNING, Job.id.not_in(held))
        job = self._session.scalar(select(Job).where(*mine).limit(1).with_for_update())
        return None if job is None else Claim(Lease(job.id, job.attempt, owner), job)

    def renew_leases(
        self, held: Collection[Lease], lease: timedelta = DEFAULT_LEASE
    ) -> tuple[RenewedLease, ...]:
        """Renew these leases; those that do not come back are lost.

        A lease that its dispatcher has dropped is not among them, so that the reaper finds it.
        """
        owners = {one.job_id: one.owner for one in held}
        renewed = (
            update(Job)
            .where(or_(false(), *(and_(*one.fence()) for one in held)))
            .values(lease_until=self._read_clock() + lease)
            .returning(Job.id, Job.attempt, Job.cancel_requested)
        )
        rows = self._session.execute(renewed, execution_options=RETURNING_OPTIONS)
        return tuple(
            RenewedLease(Lease(job, attempt, owners[job]), stop) for job, attempt, stop in rows
        )

    def lock_job(self, lease: Lease) -> Job:
        """The job, locked against every other writer until the transaction ends.

        Raises
        ------
        LeaseLost
            When the job has another attempt or is no longer running.
        """
        held = select(Job).where(*lease.fence()).with_for_update(key_share=True)
        job = self._session.scalar(
            held.options(_DEFER_SPEC), execution_options={"populate_existing": True}
        )
        if job is None:
            raise LeaseLost(lease.job_id, lease.attempt)
        return job

    def write_progress(self, lease: Lease, progress: JobProgress) -> None:
        """Write how far the job has come, and tell it as an event."""
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
        """Add an event to the job, such as a line of its log."""
        self.lock_job(lease)
        self._events.append_event(lease.job_id, kind, data)

    def write_floors(self, lease: Lease, floors: Document) -> None:
        """Write what the runs of the job are measured by."""
        self._update_job(lease, {"floors": floors})

    def finish_job(self, lease: Lease, state: FinalState, error: str | None = None) -> Job:
        """End a job. Its unfinished runs end with it, unless it succeeded: then none may be left.

        Raises
        ------
        LeaseLost
            When the job is no longer this lease's; nothing is written.
        Conflict
            When the job is to succeed and has runs that did not finish.
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
        """Whether a job that this owner holds has come further under its lease."""
        found = select(Job.id).where(Job.lease_owner == owner, Job.state == JobState.RUNNING)
        return bool(self._session.scalar(select(found.where(_has_progressed()).exists())))

    def release_job(self, lease: Lease, *, lost: bool = False, beside_others: bool = False) -> None:
        """Give a job back, because the dispatcher is shutting down, or has `lost` its workers.

        Parameters
        ----------
        beside_others : bool
            Whether a job of the same owner came further meanwhile.
        """
        job = self.lock_job(lease)
        if lost:
            self._fail_or_retry(job, beside_others=beside_others)
        elif job.cancel_requested:
            self._end_job(job, JobState.CANCELLED, None)
        else:
            self._requeue_job(job)

    def has_expired(self, owners: LeaseOwners) -> bool:
        """Whether a lease is to be reaped, or seems to end later than any that is given."""
        now = self._read_clock()
        wrong = or_(_is_expired(now, owners), _ends_too_late(now, owners))
        found = select(exists().where(Job.state == JobState.RUNNING, wrong))
        return bool(self._session.scalar(found))

    def reap_expired(self, owners: LeaseOwners | None = None) -> ReapResult:
        """Give back the jobs whose leases have expired, or end them.

        A job that was to be cancelled is cancelled; one that was lost `max_attempts` times while
        no run of it went on or ended fails with that reason, or `SPARED_LOSS_FACTOR` times as often
        where others of its owner did; any other is queued and goes on from its checkpoints. The
        leases of owners that are gone are not waited for, those of
        living ones `HUNG_AFTER` longer. A lease that ends more than `MAX_LEASE_LENGTHS` lengths
        from now was written by a clock that was stepped back since: it is shortened to one, from
        now.
        """
        now, known = self._read_clock(), owners or LeaseOwners()
        ahead = update(Job).where(Job.state == JobState.RUNNING, _ends_too_late(now, known))
        ends = _choose_by_owner(
            {one: now + length for one, length in known.lease_lengths.items()}, now
        )
        self._session.execute(ahead.values(lease_until=ends), execution_options=RETURNING_OPTIONS)
        expired = (
            select(Job)
            .where(Job.state == JobState.RUNNING, _is_expired(now, known))
            .with_for_update(skip_locked=True, key_share=True)
            .options(_DEFER_SPEC)
        )
        lost = self._session.scalars(expired, execution_options={"populate_existing": True}).all()
        whose = frozenset(str(job.lease_owner) for job in lost)
        busy = {owner for owner in whose if self.has_progressed(owner)}
        fates: dict[JobState, list[str]] = {state: [] for state in JobState}
        for job in lost:
            fates[self._fail_or_retry(job, beside_others=job.lease_owner in busy)].append(job.id)
        queued, failed, cancelled = (
            tuple(fates[one]) for one in (JobState.QUEUED, JobState.FAILED, JobState.CANCELLED)
        )
        return ReapResult(queued, failed, cancelled, whose)

    def _read_clock(self) -> datetime:
        self._session.connection()  # SQLite may wait here for its turn, and the time goes on
        return self._clock()

    def _update_job(self, lease: Lease, values: dict[str, Any]) -> Job:
        changed = update(Job).where(*lease.fence()).values(values).returning(Job.id)
        if self._session.scalar(changed, execution_options=RETURNING_OPTIONS) is None:
            raise LeaseLost(lease.job_id, lease.attempt)
        mine = select(Job).where(Job.id == lease.job_id).options(_DEFER_SPEC)
        return self._session.scalars(mine, execution_options={"populate_existing": True}).one()

    def _correct_best_rms(self, job: Job) -> None:
        """Take the best RMS from the results: while a run goes on it tells its fitness only."""
        best = self._session.scalar(select(func.min(Run.best_rms)).where(Run.job_id == job.id))
        if best is not None:
            job.best_rms = best

    def _check_runs_finished(self, job: Job) -> None:
        """Also those that have not been made yet."""
        ended = select(func.count()).where(Run.job_id == job.id, Run.state.not_in(OPEN_STATES))
        n_left = job.n_runs - (self._session.scalar(ended) or 0)
        if n_left:
            raise RowConflict(f"{job.id} cannot succeed: {n_left} of its runs did not finish")

    def _fail_or_retry(self, job: Job, *, beside_others: bool) -> JobState:
        went_on = self._session.scalar(select(Job.id).where(Job.id == job.id, _has_progressed()))
        job.lost_leases = job.lost_leases + 1 if went_on is None else 1
        is_spared = beside_others and went_on is None
        most = job.max_attempts * (SPARED_LOSS_FACTOR if is_spared else 1)
        if job.cancel_requested:
            self._end_job(job, JobState.CANCELLED, None)
        elif job.lost_leases >= most:
            self._end_job(
                job,
                JobState.FAILED,
                f"the dispatcher ended or fell silent {job.lost_leases} times, or lost its "
                f"workers, and the job did not go on between; the last was {job.lease_owner}; "
                "see its log, and resume the job when the cause is gone",
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
    """Condition that a run of a job ended in its attempt, or came further: it has a checkpoint."""
    ended = exists().where(
        Run.job_id == Job.id, Run.attempt == Job.attempt, Run.state.not_in(OPEN_STATES)
    )
    kept = exists().where(Checkpoint.job_id == Job.id, Checkpoint.attempt == Job.attempt)
    return or_(ended, kept)


def _is_expired(now: datetime, owners: LeaseOwners) -> ColumnElement[bool]:
    """Condition that a job's lease is not waited for any longer."""
    overdue = Job.lease_until < _choose_by_owner(dict.fromkeys(owners.awake, now - HUNG_AFTER), now)
    return or_(overdue, Job.lease_owner.in_(owners.ended))


def _ends_too_late(now: datetime, owners: LeaseOwners) -> ColumnElement[bool]:
    """Condition that a job's lease ends later than any that its owner could be given now."""
    latest = {one: now + MAX_LEASE_LENGTHS * length for one, length in owners.lease_lengths.items()}
    return and_(Job.lease_owner.in_(latest), Job.lease_until > _choose_by_owner(latest, now))


def _choose_by_owner(times: Mapping[str, datetime], other: datetime) -> ColumnElement[datetime]:
    """A time for each owner of a lease, and one for all others."""
    known = {owner: literal(time, UtcDateTime()) for owner, time in times.items()}
    otherwise = literal(other, UtcDateTime())
    return case(known, value=Job.lease_owner, else_=otherwise) if known else otherwise


def choose_smaller_rms(rms: float) -> ColumnElement[Any]:
    """The smaller of the job's `best_rms` and this one, for an UPDATE."""
    return case((Job.best_rms <= rms, Job.best_rms), else_=rms)
