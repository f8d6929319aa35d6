"""The job queue: leases on parcels of jobs, with the attempt as fencing token.

A parcel is a range of a job's runs. A dispatcher claims one for some time, and renews all its
leases with one statement. When its heartbeat stops, the reaper gives its parcels back. Each claim
increments the `attempt` of the job, and every later write carries it. So a dispatcher that comes
back late changes no row and learns that it must stop.

A transaction locks parcels first, in their order, and then the row of the job. A job is open as
long as it has a parcel, and running as long as one is held. The holder of the last one ends it.

All times come from one clock: that of PostgreSQL, or with SQLite that of the host. A wrong clock
makes the reaper late or early. But the attempt alone decides which dispatcher may write.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import groupby
from typing import Any, Literal, NamedTuple

from sqlalchemy import (
    ColumnElement,
    Select,
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
from sqlalchemy.orm import Session, defer

from service.core.states import OPEN_STATES, JobState
from service.queue.admission import Admission, count_running_jobs, is_open
from service.repositories.event_rows import EventKind, EventRepository
from service.repositories.job_rows import end_job, end_open_runs, lock_parcels, notify_queue
from service.storage.clocks import Clock, choose_database_clock
from service.storage.columns import Document, UtcDateTime
from service.storage.statements import RETURNING_OPTIONS
from service.storage.storage_errors import LeaseLost, RowConflict
from service.storage.tables import Checkpoint, Job, Parcel, Run

DEFAULT_LEASE = timedelta(seconds=10)
MAX_LEASE_LENGTHS = 2
"""A lease ends within this many of its lengths, unless a clock was stepped back."""
HUNG_AFTER = timedelta(seconds=60)
"""How long a dispatcher with a living process keeps its jobs after the end of its lease.

It probably waits for the database and has lost nothing. After this time it counts as hung.
"""
SPARED_LOSS_FACTOR = 4
"""Factor on the allowed losses of a parcel while others of the same dispatcher progress.

Then this one is hardly the reason why the dispatchers die.
"""
_DEFER_SPEC = defer(Job.spec)
"""A specification of many cells has megabytes; it is loaded only where it is needed."""
_FRESH = {"populate_existing": True}
FinalState = Literal[JobState.SUCCEEDED, JobState.INCOMPLETE, JobState.FAILED, JobState.CANCELLED]
SizeRule = Callable[[Job], int]
"""Tells how many runs of a job a new parcel has at most."""


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to write for a parcel; `attempt` is its fencing token.

    The claims of all parcels of a job are counted together, so no two leases have one token.
    """

    job_id: str
    attempt: int
    owner: str

    def fence(self) -> tuple[ColumnElement[bool], ...]:
        """Return the condition that a row of `parcels` still belongs to this lease."""
        return (
            Parcel.job_id == self.job_id,
            Parcel.attempt == self.attempt,
            Parcel.lease_owner == self.owner,
        )


@dataclass(frozen=True, slots=True)
class Claim:
    """A newly claimed parcel and its lease.

    Attributes
    ----------
    job : Job
        Its job. The specification is not loaded if the claim was for a certain job.
    runs : range
        Numbers of its runs.
    is_new : bool
        Whether nobody has held these runs before.
    """

    lease: Lease
    job: Job
    runs: range
    is_new: bool = False


class ProgramOfJob(NamedTuple):
    """Version and fingerprint of a program that computes runs."""

    version: str
    fingerprint: str


class LockedParcel(NamedTuple):
    """A parcel that is locked until the transaction ends, and its job, which is not."""

    parcel: Parcel
    job: Job


@dataclass(frozen=True, slots=True)
class JobProgress:
    """Progress over the runs of a parcel; `seconds_left` is that of the whole job."""

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
    """Jobs of the parcels whose leases had expired, by their fate, and the owners of the leases."""

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
        self,
        owner: str,
        lease: timedelta = DEFAULT_LEASE,
        admission: Admission | None = None,
        *,
        held: Collection[str] = (),
        only: str | None = None,
        choose_size: SizeRule | None = None,
        program: ProgramOfJob | None = None,
    ) -> Claim | None:
        """Claim a parcel of the first job that `admission` accepts; None if none waits.

        The order is: highest priority, then fewest running jobs of the project, then jobs that
        nobody works on, then the oldest.

        Parameters
        ----------
        held : collection of str
            Jobs that are left out.
        only : str, optional
            The only job that counts.
        choose_size : callable, optional
            Runs of the parcel at most. The others wait as another one. By default all of them.
        program : ProgramOfJob, optional
            What will compute the runs. The job names it.
        """
        wanted = Job.id.not_in(held) if only is None else Job.id == only
        admitted = true() if admission is None else admission.admits(Job)
        parcel = self._session.scalar(_select_waiting(wanted & admitted), execution_options=_FRESH)
        if parcel is None:
            return None
        job = self._lock_job(parcel.job_id, with_spec=only is None)
        if job.cancel_requested:
            return None
        is_new = parcel.attempt == 0
        if choose_size is not None:
            self._split_parcel(parcel, choose_size(job))
        now = self._read_clock()
        was_queued = job.state is JobState.QUEUED
        job.state, job.attempt = JobState.RUNNING, job.attempt + 1
        job.started_at = job.started_at or now
        if program is not None:
            job.version, job.fingerprint = program
        parcel.attempt, parcel.n_ended = job.attempt, 0
        parcel.lease_owner, parcel.lease_until = owner, now + lease
        self._session.flush()
        if was_queued:
            self._events.append_state(job)
        return _describe_claim(parcel, job, is_new=is_new)

    def _split_parcel(self, parcel: Parcel, size: int) -> None:
        """Leave only the first runs in a parcel; the others wait as a new one."""
        stop = parcel.first + max(size, 1)
        if stop < parcel.stop:
            after = range(stop, parcel.stop)
            measured = self._count_evaluations(parcel.job_id, after) if parcel.evaluations else 0
            rest = Parcel(
                job_id=parcel.job_id,
                first=stop,
                stop=parcel.stop,
                attempt=parcel.attempt,
                evaluations=min(measured, parcel.evaluations),
                lost_leases=parcel.lost_leases,
            )
            self._session.add(rest)
            parcel.stop, parcel.evaluations = stop, parcel.evaluations - rest.evaluations

    def _count_evaluations(self, job_id: str, runs: range) -> int:
        """Count the evaluations of the runs of these numbers, as far as they are stored."""
        these = Run.job_id == job_id, Run.number >= runs.start, Run.number < runs.stop
        ended = select(func.sum(Run.evaluations)).where(*these, ~Run.state.in_(OPEN_STATES))
        begun = (
            select(func.sum(Checkpoint.evaluations))
            .join(Run, Run.id == Checkpoint.run_id)
            .where(*these, Run.state.in_(OPEN_STATES))
        )
        return sum(int(self._session.scalar(query) or 0) for query in (ended, begun))

    def recover_claim(self, owner: str, held: Collection[Lease]) -> Claim | None:
        """Return a parcel that this owner claimed without receiving the answer, if there is one.

        Parameters
        ----------
        held : collection of Lease
            Those that the owner knows as its own.
        """
        known = {(lease.job_id, lease.attempt) for lease in held}
        owned = select(Parcel).where(Parcel.lease_owner == owner).with_for_update(key_share=True)
        for parcel in self._session.scalars(owned, execution_options=_FRESH):
            if (parcel.job_id, parcel.attempt) not in known:
                return _describe_claim(parcel, self._session.get_one(Job, parcel.job_id))
        return None

    def renew_leases(
        self, held: Collection[Lease], lease: timedelta = DEFAULT_LEASE
    ) -> frozenset[Lease]:
        """Renew leases; those that are not returned are lost.

        A dispatcher passes no lease that it has dropped, so that the reaper finds it.
        """
        renewed = (
            update(Parcel)
            .where(or_(false(), *(and_(*item.fence()) for item in held)))
            .values(lease_until=self._read_clock() + lease)
            .returning(Parcel.job_id, Parcel.attempt, Parcel.lease_owner)
        )
        rows = self._session.execute(renewed, execution_options=RETURNING_OPTIONS)
        return frozenset(Lease(job, attempt, str(owner)) for job, attempt, owner in rows)

    def lock_lease(self, lease: Lease) -> LockedParcel:
        """Lock the parcel of a lease against every other writer, until the transaction ends.

        Raises
        ------
        LeaseLost
            If the parcel has another attempt, or no longer exists.
        """
        held = (
            select(Parcel, Job)
            .join(Job, Job.id == Parcel.job_id)
            .where(*lease.fence())
            .with_for_update(key_share=True, of=Parcel)
            .options(_DEFER_SPEC)
        )
        row = self._session.execute(held, execution_options=_FRESH).one_or_none()
        if row is None:
            raise LeaseLost(lease.job_id, lease.attempt)
        return LockedParcel(*row)

    def read_n_done(self, lease: Lease) -> int:
        """Return how many runs of the job have ended, in all its parcels."""
        return self._session.scalars(select(Job.n_done).where(Job.id == lease.job_id)).one()

    def write_progress(self, lease: Lease, progress: JobProgress) -> None:
        """Write the progress of the parcel into that of its job, and append it as an event."""
        parcel, job = self.lock_lease(lease)
        is_whole = parcel.stop - parcel.first == job.n_runs
        most: ColumnElement[Any] = case(
            (Job.generation > progress.generation, Job.generation), else_=progress.generation
        )
        values: dict[str, Any] = {
            "evaluations": Job.evaluations + (progress.evaluations - parcel.evaluations),
            "generation": progress.generation if is_whole else most,
            "seconds_left": progress.seconds_left,
        }
        if progress.best_rms is not None:
            values["best_rms"] = choose_smaller_rms(progress.best_rms)
        parcel.evaluations = progress.evaluations
        job = self._update_job(job.id, values)
        names = (*values, "best_rms", "n_runs", "n_done", "n_failed")
        data = {name: getattr(job, name) for name in names}
        self._events.append_event(job.id, "progress", data)

    def append_event(self, lease: Lease, kind: EventKind, data: Document) -> None:
        """Append an event to the job, such as a line of its log."""
        self.lock_lease(lease)
        self._events.append_event(lease.job_id, kind, data)

    def write_cramer_rao(self, lease: Lease, cramer_rao: Document) -> None:
        """Write the Cramér–Rao bounds to which the runs of the job are compared."""
        self.lock_lease(lease)
        self._update_job(lease.job_id, {"cramer_rao": cramer_rao})

    def end_parcel(self, lease: Lease) -> bool:
        """End a parcel whose runs have ended; return False if it is the last one of its job.

        The last one stays: its holder then ends the job (`finish_job`).

        Raises
        ------
        LeaseLost
            If the lease is no longer held; nothing is written.
        RowConflict
            If a run of the parcel has not ended.
        """
        parcel, job = self.lock_lease(lease)
        self._check_runs_finished(job.id, range(parcel.first, parcel.stop))
        job = self._lock_job(lease.job_id)
        others = select(Parcel.first).where(Parcel.job_id == job.id, Parcel.first != parcel.first)
        if self._session.scalar(others.limit(1)) is None:
            return False
        if job.cancel_requested:  # parcels that were cancelled stay until the job ends
            self._cancel_parcel(parcel, job)
            return True
        self._session.delete(parcel)
        self._session.flush()
        self._note_left(job)
        return True

    def cancel_parcel(self, lease: Lease) -> None:
        """End a parcel as cancelled, with its unfinished runs; the last held one ends the job."""
        parcel, _ = self.lock_lease(lease)
        self._cancel_parcel(parcel, self._lock_job(lease.job_id))

    def finish_job(self, lease: Lease, state: FinalState, error: str | None = None) -> Job:
        """End a job, and with it all its parcels and unfinished runs.

        A job that succeeds or is incomplete must have none.

        Raises
        ------
        LeaseLost
            If the lease is no longer held; nothing is written.
        RowConflict
            If the job is to succeed but has unfinished runs.
        """
        self.lock_lease(lease)
        lock_parcels(self._session, lease.job_id)
        job = self._lock_job(lease.job_id)
        if state in (JobState.SUCCEEDED, JobState.INCOMPLETE):
            self._check_runs_finished(job.id, range(job.n_runs))
        self._end_job(job, state, error)
        return job

    def has_progressed(self, owner: str) -> bool:
        """Return whether a parcel that this owner holds has progressed under its lease."""
        held = select(Parcel.first).where(Parcel.lease_owner == owner)
        return bool(self._session.scalar(select(held.where(_has_progressed()).exists())))

    def release_job(
        self, lease: Lease, *, lost: bool = False, others_progressed: bool = False
    ) -> None:
        """Give a parcel back when the dispatcher shuts down, or has `lost` its workers.

        Parameters
        ----------
        others_progressed : bool
            Whether another parcel of the same owner progressed meanwhile.
        """
        parcel, job = self.lock_lease(lease)
        if lost:
            self._settle_lost([parcel], job, {lease.owner} if others_progressed else set())
            return
        job = self._lock_job(lease.job_id)
        if job.cancel_requested:
            self._cancel_parcel(parcel, job)
        else:
            self._requeue_parcel(parcel, job)

    def has_expired(self, owners: LeaseOwners) -> bool:
        """Return whether a lease is to be reaped, or ends later than any valid lease."""
        now = self._read_clock()
        is_wrong = or_(_is_expired(now, owners), _ends_too_late(now, owners))
        return bool(self._session.scalar(select(exists().where(_is_held(), is_wrong))))

    def reap_expired(self, owners: LeaseOwners | None = None) -> ReapResult:
        """Give back the parcels whose leases have expired, or end their jobs.

        A parcel of a job with a cancel request is cancelled. If a parcel was lost `max_attempts`
        times without any progress of its runs, its job fails. The limit is `SPARED_LOSS_FACTOR`
        times higher if other parcels of its owner progressed. Any other parcel waits, and its runs
        continue from their checkpoints.

        Leases of ended owners are reaped at once, those of living owners `HUNG_AFTER` later. A
        lease that ends more than `MAX_LEASE_LENGTHS` lengths from now was written before a clock
        was stepped back. It is shortened to one length from now.
        """
        now, current_owners = self._read_clock(), owners or LeaseOwners()
        ahead = update(Parcel).where(_is_held(), _ends_too_late(now, current_owners))
        ends = _choose_by_owner(
            {owner: now + length for owner, length in current_owners.lease_lengths.items()}, now
        )
        self._session.execute(ahead.values(lease_until=ends), execution_options=RETURNING_OPTIONS)
        expired = (
            select(Parcel)
            .where(_is_held(), _is_expired(now, current_owners))
            .order_by(Parcel.job_id, Parcel.first)
            .with_for_update(skip_locked=True, key_share=True)
        )
        lost = self._session.scalars(expired, execution_options=_FRESH).all()
        lost_owners = frozenset(str(parcel.lease_owner) for parcel in lost)
        busy = {owner for owner in lost_owners if self.has_progressed(owner)}
        fates: dict[str, JobState] = {}
        for job_id, parcels in groupby(lost, key=lambda parcel: parcel.job_id):
            job = self._session.get_one(Job, job_id, options=[_DEFER_SPEC], populate_existing=True)
            fates[job_id] = self._settle_lost(list(parcels), job, busy)
        queued, failed, cancelled = (
            tuple(job for job, fate in fates.items() if fate is state)
            for state in (JobState.QUEUED, JobState.FAILED, JobState.CANCELLED)
        )
        return ReapResult(queued, failed, cancelled, lost_owners)

    def _read_clock(self) -> datetime:
        self._session.connection()  # SQLite may wait here for the lock, and time passes
        return self._clock()

    def _lock_job(self, job_id: str, *, with_spec: bool = False) -> Job:
        """Lock the row of a job; the transaction has locked a parcel of it before."""
        query = select(Job).where(Job.id == job_id).with_for_update(key_share=True)
        if not with_spec:
            query = query.options(_DEFER_SPEC)
        return self._session.scalars(query, execution_options=_FRESH).one()

    def _update_job(self, job_id: str, values: dict[str, Any]) -> Job:
        self._session.flush()
        changed = update(Job).where(Job.id == job_id).values(values)
        self._session.execute(changed, execution_options=RETURNING_OPTIONS)
        query = select(Job).where(Job.id == job_id).options(_DEFER_SPEC)
        return self._session.scalars(query, execution_options=_FRESH).one()

    def _check_runs_finished(self, job_id: str, runs: range) -> None:
        """Check that all these runs have finished, including those that are not created yet."""
        of_range = Run.job_id == job_id, Run.number >= runs.start, Run.number < runs.stop
        unfinished = select(func.count()).where(*of_range, Run.state.in_(OPEN_STATES))
        last = self._session.scalar(select(func.max(Run.number)).where(*of_range))
        n_created = 0 if last is None else last + 1 - runs.start
        n_left = len(runs) - n_created + (self._session.scalar(unfinished) or 0)
        if n_left:
            raise RowConflict(f"{job_id} cannot succeed: {n_left} of its runs did not finish")

    def _settle_lost(self, parcels: Sequence[Parcel], job: Job, busy: Collection[str]) -> JobState:
        """Decide on lost parcels of a job, which are locked; return the fate of the job.

        All parcels are locked before the job, as everywhere: else a writer of another parcel would
        wait for the job, and be waited for.
        """
        failed = [parcel for parcel in parcels if self._count_loss(parcel, job, busy)]
        self._session.flush()
        if failed:
            lock_parcels(self._session, job.id)
        job = self._lock_job(job.id)
        for parcel in parcels:
            self._correct_evaluations(parcel, job)
        job.lost_leases = max(parcel.lost_leases for parcel in parcels)
        if failed and not job.cancel_requested:
            self._end_job(
                job,
                JobState.FAILED,
                f"gave up after {failed[0].lost_leases} attempts without progress: the dispatcher "
                f"or its workers stopped. The last dispatcher was {failed[0].lease_owner}. See "
                "its log, then resume the job.",
            )
            return JobState.FAILED
        for parcel in parcels:
            if not job.cancel_requested:
                self._requeue_parcel(parcel, job)
            elif not job.state.is_terminal:
                self._cancel_parcel(parcel, job)
        return JobState.CANCELLED if job.cancel_requested else JobState.QUEUED

    def _correct_evaluations(self, parcel: Parcel, job: Job) -> None:
        """Take the evaluations of a lost parcel from its runs; its last progress may be older."""
        stored = self._count_evaluations(job.id, range(parcel.first, parcel.stop))
        job.evaluations += stored - parcel.evaluations
        parcel.evaluations = stored

    def _count_loss(self, parcel: Parcel, job: Job, busy: Collection[str]) -> bool:
        """Count the loss of a parcel; return whether it was lost too often without progress.

        `busy` are owners of which another parcel progressed.
        """
        this = Parcel.job_id == parcel.job_id, Parcel.first == parcel.first
        progressed = self._session.scalar(select(Parcel.first).where(*this, _has_progressed()))
        parcel.lost_leases = parcel.lost_leases + 1 if progressed is None else 1
        is_spared = parcel.lease_owner in busy and progressed is None
        return parcel.lost_leases >= job.max_attempts * (SPARED_LOSS_FACTOR if is_spared else 1)

    def _end_job(self, job: Job, state: JobState, error: str | None) -> None:
        end_job(self._session, job, state, error, self._read_clock())

    def _cancel_parcel(self, parcel: Parcel, job: Job) -> None:
        parcel.lease_owner = None  # it waits for the end of the job, and nobody claims it
        self._session.flush()
        if self._is_held(job):
            runs = range(parcel.first, parcel.stop)
            end_open_runs(self._session, job.id, JobState.CANCELLED, None, runs)
        else:
            self._end_job(job, JobState.CANCELLED, None)

    def _requeue_parcel(self, parcel: Parcel, job: Job) -> None:
        parcel.lease_owner = parcel.lease_until = None
        running = update(Run).where(
            Run.job_id == job.id,
            Run.state == JobState.RUNNING,
            Run.number >= parcel.first,
            Run.number < parcel.stop,
        )
        self._session.execute(
            running.values(state=JobState.QUEUED), execution_options=RETURNING_OPTIONS
        )
        self._note_left(job)
        notify_queue(self._session)

    def _note_left(self, job: Job) -> None:
        """Queue a job again if nobody holds a parcel of it. Its row is locked."""
        self._session.flush()
        if not self._is_held(job):
            job.state = JobState.QUEUED
            self._events.append_state(job)

    def _is_held(self, job: Job) -> bool:
        held = select(Parcel.first).where(Parcel.job_id == job.id, _is_held()).limit(1)
        return self._session.scalar(held) is not None


def _select_waiting(condition: ColumnElement[bool]) -> Select[Parcel]:
    """Select the next waiting parcel of the jobs that meet a condition, and lock it."""
    running_jobs = count_running_jobs()
    order = (
        Job.priority.desc(),
        func.coalesce(running_jobs.c.n, 0),
        Job.state == JobState.RUNNING,
        Job.id,
        Parcel.first,
    )
    return (
        select(Parcel)
        .join(Job, Job.id == Parcel.job_id)
        .outerjoin(running_jobs, running_jobs.c.project_id == Job.project_id)
        .where(Parcel.lease_owner.is_(None), is_open(), ~Job.cancel_requested, condition)
        .order_by(*order)
        .limit(1)
        # Rivals take the next parcel; SQLite has no rivals.
        .with_for_update(skip_locked=True, of=Parcel)
    )


def _describe_claim(parcel: Parcel, job: Job, *, is_new: bool = False) -> Claim:
    lease = Lease(parcel.job_id, parcel.attempt, str(parcel.lease_owner))
    return Claim(lease, job, range(parcel.first, parcel.stop), is_new)


def _is_held() -> ColumnElement[bool]:
    """Return the condition that a dispatcher holds a parcel, as in the index of these."""
    return Parcel.lease_owner.is_not(None)


def _has_progressed() -> ColumnElement[bool]:
    """Return the condition that a run of a parcel ended or was checkpointed in this attempt."""
    same = Checkpoint.job_id == Parcel.job_id, Checkpoint.attempt == Parcel.attempt
    return or_(Parcel.n_ended > 0, exists().where(*same))


def _is_expired(now: datetime, owners: LeaseOwners) -> ColumnElement[bool]:
    """Return the condition that the lease of a parcel has expired."""
    overdue = Parcel.lease_until < _choose_by_owner(
        dict.fromkeys(owners.awake, now - HUNG_AFTER), now
    )
    return or_(overdue, Parcel.lease_owner.in_(owners.ended))


def _ends_too_late(now: datetime, owners: LeaseOwners) -> ColumnElement[bool]:
    """Return the condition that a lease ends later than any that its owner could get now.

    An owner without a row among the dispatchers has no known length, so its leases are left.
    """
    latest = {
        owner: now + MAX_LEASE_LENGTHS * length for owner, length in owners.lease_lengths.items()
    }
    return and_(Parcel.lease_owner.in_(latest), Parcel.lease_until > _choose_by_owner(latest, now))


def _choose_by_owner(times: Mapping[str, datetime], other: datetime) -> ColumnElement[datetime]:
    """Return the time of each owner of a lease, and one time for all others."""
    by_owner = {owner: literal(time, UtcDateTime()) for owner, time in times.items()}
    otherwise = literal(other, UtcDateTime())
    return case(by_owner, value=Parcel.lease_owner, else_=otherwise) if by_owner else otherwise


def count_held_parcels(session: Session) -> dict[str, int]:
    """Count the parcels that each dispatcher holds, by its name."""
    held = Parcel.lease_owner.is_not(None)
    query = select(Parcel.lease_owner, func.count()).where(held).group_by(Parcel.lease_owner)
    return {str(owner): n for owner, n in session.execute(query)}


def choose_smaller_rms(rms: float) -> ColumnElement[Any]:
    """Return the smaller of the job's `best_rms` and this one, for an UPDATE."""
    return case((Job.best_rms <= rms, Job.best_rms), else_=rms)
