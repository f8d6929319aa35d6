"""Jobs as users see them: submit, read, list, cancel, resume, delete."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal, get_args

from sqlalchemy import ColumnElement, case, delete, func, or_, select, text, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.core.states import OPEN_STATES, JobState
from service.repositories.audit_rows import record_action
from service.repositories.event_rows import EventRepository
from service.repositories.outcome_rows import record_best_run
from service.repositories.project_rows import DAY
from service.repositories.search_conditions import NO_FILTER, ListFilter, select_ids, select_matches
from service.storage.clocks import choose_database_clock
from service.storage.columns import Document, utc_now
from service.storage.sessions import find_project
from service.storage.statements import (
    RETURNING_OPTIONS,
    RowPage,
    check_id_cursor,
    make_page,
    new_id,
)
from service.storage.storage_errors import InvalidCursor, KeyReused, RowConflict, RowNotFound
from service.storage.tables import IdempotencyKey, Job, Parcel, Run, StoredSummary

JobOrder = Literal[
    "newest", "oldest", "name", "verdict", "worst-verdict", "fit", "worst-fit", "rms"
]
JOB_ORDERS: tuple[JobOrder, ...] = get_args(JobOrder)
"""Orders of a list of jobs; `fit` and `verdict` have the best first."""
# The RMS of a batch, or before the end, compares with no other. It has no fit then.
_FINAL_RMS = case((Job.fit_estimation.is_not(None), Job.best_rms))
_TRUST_RANK = case({"trustworthy": 0, "limited": 1, "not trustworthy": 2}, value=Job.trust)
_ORDERS: Mapping[JobOrder, tuple[ColumnElement[Any], bool]] = {
    "oldest": (Job.id.expression, True),
    "name": (func.lower(Job.name), True),
    "verdict": (_TRUST_RANK, True),
    "worst-verdict": (_TRUST_RANK, False),
    "fit": (Job.fit_estimation.expression, False),
    "worst-fit": (Job.fit_estimation.expression, True),
    "rms": (_FINAL_RMS, True),
}
"""Value by which each order sorts, and whether the smallest comes first."""

QUEUE_CHANNEL = "lagid_queue"
"""PostgreSQL's notification channel that wakes the dispatchers."""


@dataclass(frozen=True, slots=True)
class NewJob:
    """A job to submit: `spec` is the validated body, `n_runs` counts the cells of its sweep.

    `version` is that of the program that takes it, `spec_hash` the digest of the request.
    """

    name: str
    spec: Document
    version: str
    spec_hash: str
    n_runs: int = 1
    priority: int = 0
    max_attempts: int = 3


@dataclass(frozen=True, slots=True)
class Submission:
    """A job, and whether it is new or was submitted earlier with the same key."""

    job: Job
    is_new: bool


class JobRepository:
    """The jobs of one project in one session. The opener of the session commits."""

    def __init__(self, session: Session, project_id: str | None = None) -> None:
        self._session, self._project_id = session, project_id or find_project(session)
        self._clock = choose_database_clock(session)

    def submit(self, new: NewJob, *, key: str | None = None, request_hash: str = "") -> Submission:
        """Queue a job; with a `key` that was used before, return the earlier job.

        Raises
        ------
        KeyReused
            If the key was used before with another request.
        """
        if key is None:
            return Submission(self._insert_job(new), True)
        existing = self._find_by_key(key, request_hash)
        if existing is not None:
            return Submission(existing, False)
        try:
            # Of two requests with one key at once, the later one fails here.
            with self._session.begin_nested():
                job = self._insert_job(new)
                self._session.add(
                    IdempotencyKey(
                        project_id=self._project_id,
                        key=key,
                        request_hash=request_hash,
                        job_id=job.id,
                    )
                )
        except IntegrityError:
            existing = self._find_by_key(key, request_hash)
            if existing is None:
                raise
            return Submission(existing, False)
        return Submission(job, True)

    def is_key_used(self, key: str) -> bool:
        """Return whether a job was submitted under this key."""
        query = select(IdempotencyKey.key).where(
            IdempotencyKey.project_id == self._project_id, IdempotencyKey.key == key
        )
        return self._session.scalar(query) is not None

    def get(self, job_id: str) -> Job:
        """Return an undeleted job of this project; else raise `RowNotFound`."""
        job = self._session.get(Job, job_id, populate_existing=True)
        if job is None or job.project_id != self._project_id or job.deleted_at is not None:
            raise RowNotFound("job", job_id)
        return job

    def list_some(self, job_ids: Collection[str]) -> Sequence[Job]:
        """List those of these jobs that are not deleted, latest first."""
        query = select(Job).where(Job.id.in_(job_ids), *self._filter_project())
        return self._session.scalars(query.order_by(Job.id.desc())).all()

    def get_state(self, job_id: str) -> JobState:
        """Return only the state of an undeleted job; else raise `RowNotFound`."""
        query = select(Job.state).where(Job.id == job_id, *self._filter_project())
        state = self._session.scalar(query)
        if state is None:
            raise RowNotFound("job", job_id)
        return state

    def list_page(
        self,
        *,
        cursor: str | None = None,
        limit: int = 50,
        states: Sequence[JobState] = (),
        chosen: ListFilter = NO_FILTER,
        order: JobOrder = "newest",
    ) -> RowPage[Job]:
        """List the jobs that meet a filter, latest first, or in another order.

        The pages do not shift while new jobs arrive.
        """
        if order != "newest":
            return self._sort_page(order, chosen, states, cursor, limit)
        if chosen:
            return self._search_page(chosen, states, cursor, limit)
        query = select(Job).where(*self._filter_project()).order_by(Job.id.desc()).limit(limit + 1)
        if cursor is not None:
            query = query.where(Job.id < check_id_cursor(cursor, "job"))
        rows: Sequence[Job]
        if states:  # each by itself, so that an index has them in order
            found = [
                job
                for state in set(states)
                for job in self._session.scalars(query.where(Job.state == state))
            ]
            rows = sorted(found, key=lambda job: job.id, reverse=True)[: limit + 1]
        else:
            rows = self._session.scalars(query).all()
        return make_page(rows, limit, (job.id for job in rows))

    def _search_page(
        self, chosen: ListFilter, states: Sequence[JobState], cursor: str | None, limit: int
    ) -> RowPage[Job]:
        ids = select_ids(Job, self._project_id, chosen, cursor=cursor, limit=limit)
        if states:
            ids = ids.where(Job.state.in_(states))
        query = select(Job).where(Job.id.in_(list(self._session.scalars(ids))))
        rows = sorted(self._session.scalars(query), key=lambda job: job.id, reverse=True)
        return make_page(rows, limit, (job.id for job in rows))

    def _sort_page(
        self,
        order: JobOrder,
        chosen: ListFilter,
        states: Sequence[JobState],
        cursor: str | None,
        limit: int,
    ) -> RowPage[Job]:
        """List jobs by a value. Those without one come last, and of equal ones the latest first.

        The cursor is a job. Its value is read again, so that a page begins where it stands now.
        """
        value, is_rising = _ORDERS[order]
        ids = select_matches(Job, self._project_id, chosen)
        if states:
            ids = ids.where(Job.state.in_(states))
        if cursor is not None:
            after = self._session.execute(
                select(value).where(Job.id == cursor, Job.project_id == self._project_id)
            ).first()
            if after is None:
                raise InvalidCursor(cursor)
            ids = ids.where(_comes_after(value, after[0], cursor, is_rising=is_rising))
        first = value.asc() if is_rising else value.desc()
        ids = ids.order_by(value.is_(None), first, Job.id.desc()).limit(limit + 1)
        places = {job: place for place, job in enumerate(self._session.scalars(ids))}
        rows = self._session.scalars(select(Job).where(Job.id.in_(places)))
        ordered = sorted(rows, key=lambda job: places[job.id])
        return make_page(ordered, limit, (job.id for job in ordered))

    def cancel(self, job_id: str, reason: str | None = None) -> Job:
        """Cancel a queued job at once, or ask the dispatcher of a running one to stop.

        Parameters
        ----------
        reason : str, optional
            Why the service cancels it, for its users; the job keeps it as its error.

        Raises
        ------
        RowConflict
            If the job has already succeeded or failed. A cancelled job stays unchanged.
        """
        job = self._lock_to_cancel(job_id)
        if job.state is JobState.CANCELLED:
            return job
        if job.state not in OPEN_STATES:
            raise RowConflict(
                f"{job_id} is {job.state}; only a queued or running job can be cancelled"
            )
        if not job.cancel_requested:  # else the first who asked has told why
            job.cancel_requested, job.error = True, reason
        if job.state is JobState.QUEUED:
            end_job(self._session, job, JobState.CANCELLED, None, self._clock())
        record_action(self._session, "job.cancel", job_id, self._project_id)
        self._session.flush()
        return job

    def resume(self, job_id: str, *, only_failed: bool = False) -> Job:
        """Queue a failed or cancelled job again; successful runs keep their results.

        Only this request of a user leaves a terminal state. With `only_failed` it takes the failed
        runs alone, also of a job that is incomplete.

        Raises
        ------
        RowConflict
            If there is nothing to resume.
        """
        job = self._lock_job(job_id)
        again = [state for state in JobState if state is not JobState.SUCCEEDED]
        allowed = [JobState.FAILED, JobState.CANCELLED]
        if only_failed:
            again, allowed = [JobState.FAILED], [JobState.FAILED, JobState.INCOMPLETE]
        if job.state not in allowed or (only_failed and not job.n_failed):
            raise RowConflict(_explain_no_resume(job, only_failed=only_failed))
        chosen = update(Run).where(
            Run.job_id == job_id, Run.state.in_(again), Run.deleted_at.is_(None)
        )
        self._session.execute(
            chosen.values(state=JobState.QUEUED, error=None, finished_at=None, kills=0),
            execution_options=RETURNING_OPTIONS,
        )
        if job.finished_at is not None and job.finished_at <= self._clock() - DAY:
            job.evaluations_before = job.evaluations
        job.state, job.cancel_requested = JobState.QUEUED, False
        job.error = job.finished_at = job.fit_estimation = job.trust = None
        job.n_done -= job.n_failed
        job.lost_leases = job.n_failed = 0
        self._add_parcel(job)
        self._session.execute(delete(StoredSummary).where(StoredSummary.job_id == job_id))
        record_action(self._session, "job.resume", job_id, self._project_id)
        EventRepository(self._session).append_state(job)
        notify_queue(self._session)
        return job

    def delete(self, job_id: str) -> None:
        """Hide a finished job; objects of this job alone become garbage.

        Its runs are deleted later (`service.upkeep.retention`), because there may be many.

        Raises
        ------
        RowConflict
            If it is queued or running.
        """
        job = self.lock(job_id)
        if job.state in OPEN_STATES:
            raise RowConflict(f"{job_id} is {job.state}; cancel it before deleting it")
        job.deleted_at = utc_now()
        self._session.execute(delete(IdempotencyKey).where(IdempotencyKey.job_id == job_id))
        record_action(self._session, "job.delete", job_id, self._project_id)
        self._session.flush()

    def share_lock(self, job_id: str) -> None:
        """Keep a job from being deleted until the session ends, for all who only use it."""
        lock = select(Job.id).where(Job.id == job_id).with_for_update(read=True, key_share=True)
        self._session.execute(lock)

    def lock(self, job_id: str) -> Job:
        """Return a job that nobody can change or use until the session ends; else `RowNotFound`."""
        return self._lock_job(job_id, is_exclusive=True)

    def _filter_project(self) -> tuple[Any, ...]:
        return Job.project_id == self._project_id, Job.deleted_at.is_(None)

    def _read_state(self, job_id: str) -> JobState | None:
        query = select(Job.state).where(Job.id == job_id, *self._filter_project())
        return self._session.scalar(query)

    def _lock_to_cancel(self, job_id: str) -> Job:
        """Lock a job, and the parcels of a queued one before its row: a dispatcher may claim one.

        A job that is queued again meanwhile is let go once, so that the order holds.
        """
        is_queued = self._read_state(job_id) is JobState.QUEUED
        while True:
            if is_queued:
                lock_parcels(self._session, job_id)
            attempt = self._session.begin_nested()
            job = self._lock_job(job_id)
            if is_queued or job.state is not JobState.QUEUED:
                attempt.commit()
                return job
            attempt.rollback()
            is_queued = True

    def _add_parcel(self, job: Job) -> None:
        """Add one parcel of all runs. Dispatchers divide it as they claim."""
        parcel = Parcel(
            job_id=job.id,
            first=0,
            stop=job.n_runs,
            attempt=job.attempt,
            evaluations=job.evaluations,
        )
        self._session.add(parcel)

    def _lock_job(self, job_id: str, *, is_exclusive: bool = False) -> Job:
        lock = (
            select(Job)
            .where(Job.id == job_id, *self._filter_project())
            .with_for_update(key_share=not is_exclusive)
        )
        job = self._session.scalar(lock, execution_options={"populate_existing": True})
        if job is None:
            raise RowNotFound("job", job_id)
        return job

    def _insert_job(self, new: NewJob) -> Job:
        job = Job(
            id=new_id("job"),
            project_id=self._project_id,
            name=new.name,
            spec=new.spec,
            n_runs=new.n_runs,
            priority=new.priority,
            max_attempts=new.max_attempts,
            version=new.version,
            spec_hash=new.spec_hash,
            state=JobState.QUEUED,
            attempt=0,
            evaluations=0,
        )
        self._session.add(job)
        self._session.flush()
        record_action(self._session, "job.submit", job.id, self._project_id)
        self._add_parcel(job)
        EventRepository(self._session).append_state(job)
        notify_queue(self._session)
        return job

    def _find_by_key(self, key: str, request_hash: str) -> Job | None:
        used = self._session.get(
            IdempotencyKey, {"project_id": self._project_id, "key": key}, populate_existing=True
        )
        if used is None:
            return None
        if used.request_hash != request_hash:
            raise KeyReused(key)
        return self._session.get_one(Job, used.job_id)


def _comes_after(
    value: ColumnElement[Any], last: object, job: str, *, is_rising: bool
) -> ColumnElement[bool]:
    """Test whether a row follows that of a job with this value in the order of a list."""
    if last is None:
        return value.is_(None) & (Job.id < job)
    following = value > last if is_rising else value < last
    return or_(following, (value == last) & (Job.id < job), value.is_(None))


def lock_parcels(session: Session, job_id: str) -> None:
    """Lock all parcels of a job, in their order, before the row of the job is locked."""
    query = select(Parcel.first).where(Parcel.job_id == job_id).order_by(Parcel.first)
    session.execute(query.with_for_update(key_share=True)).all()


def end_job(
    session: Session, job: Job, state: JobState, error: str | None, moment: datetime
) -> None:
    """End a job, with its parcels and its unfinished runs, and record its best run.

    Its parcels and its row are locked. Every end of a job is here, so that lists of jobs sort all
    that have ended by their results.
    """
    job.state, job.finished_at, job.seconds_left = state, moment, None
    if state is not JobState.CANCELLED or error is not None:
        job.error = error  # else it has the reason, if the service cancelled it
    session.flush()
    parcels = delete(Parcel).where(Parcel.job_id == job.id)
    session.execute(parcels, execution_options={"synchronize_session": False})
    if state in (JobState.FAILED, JobState.CANCELLED):
        end_open_runs(session, job.id, state, error)
    record_best_run(session, job)
    EventRepository(session).append_state(job)


def end_open_runs(
    session: Session,
    job_id: str,
    state: JobState,
    error: str | None,
    numbers: range | None = None,
) -> None:
    """Move the unfinished runs of a job, or those of these numbers, to a terminal state."""
    unfinished = update(Run).where(Run.job_id == job_id, Run.state.in_(OPEN_STATES))
    if numbers is not None:
        unfinished = unfinished.where(Run.number >= numbers.start, Run.number < numbers.stop)
    session.execute(
        unfinished.values(state=state, error=error, finished_at=choose_database_clock(session)()),
        execution_options=RETURNING_OPTIONS,
    )


def notify_queue(session: Session) -> None:
    """Wake the dispatchers when this transaction commits. With SQLite they poll."""
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_notify(:channel, '')"), {"channel": QUEUE_CHANNEL})


def _explain_no_resume(job: Job, *, only_failed: bool) -> str:
    if only_failed and job.state.is_terminal and not job.n_failed:
        return f"no run of {job.id} has failed"
    if only_failed:
        return f"{job.id} is {job.state}; failed runs are resumed once a job has ended by itself"
    advice = "; add failed=true for its failed runs" if job.n_failed else ""
    return f"{job.id} is {job.state}; only a failed or cancelled job can be resumed{advice}"
