"""Projects: their limits, and what they use of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import timedelta

from sqlalchemy import ColumnElement, case, delete, func, select, update
from sqlalchemy.orm import Session

from service.core.errors import BudgetExceeded
from service.core.states import OPEN_STATES
from service.repositories.audit_rows import record_action
from service.storage.columns import utc_now
from service.storage.garbage import MINIMUM_AGE
from service.storage.sessions import find_project
from service.storage.statements import insert_missing, new_id
from service.storage.storage_errors import RowConflict, RowNotFound
from service.storage.tables import Dataset, Job, Project, RequestedWork

DAY = timedelta(days=1)
FULL_RETRY_SECONDS = 3600.0
"""When to try again if only a deletion makes room."""
RESULT_BYTES = 8400
"""Bytes of the result of a run with its history: 71 MB of SQLite for 8,498 runs, measured."""
REMOVAL_TIME = MINIMUM_AGE + timedelta(hours=1)
"""The bytes of a deleted recording are there for that time; the store is cleared every hour."""


@dataclass(frozen=True, slots=True)
class ProjectLimits:
    """Limits of a project; None is the limit of the settings, or none where they have none.

    Attributes
    ----------
    max_open_jobs, max_open_runs : int or None
        Unfinished jobs, and their unfinished runs.
    max_stored_bytes : int or None
        Bytes of the stored recordings and results. With those that are deleted but still there,
        at most twice as many.
    max_daily_evaluations : int or None
        Evaluations of the last 24 hours: of jobs that ran, and of requests.
    """

    max_open_jobs: int | None = None
    max_open_runs: int | None = None
    max_stored_bytes: int | None = None
    max_daily_evaluations: int | None = None


LIMIT_NAMES = tuple(field.name for field in fields(ProjectLimits))


@dataclass(frozen=True, slots=True)
class ProjectUse:
    """What a project uses: stored bytes, and evaluations in the last 24 hours."""

    stored_bytes: int
    daily_evaluations: int


class ProjectRepository:
    """All projects, in one session. The opener of the session commits."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def add(self, name: str) -> Project:
        """Create a project without limits of its own.

        Raises
        ------
        RowConflict
            If there is one of that name.
        """
        if self._session.scalar(select(Project.id).where(Project.name == name)) is not None:
            raise RowConflict(f"there is a project {name!r} already; choose another name")
        project = Project(id=new_id("proj"), name=name)
        self._session.add(project)
        self._session.flush()
        record_action(self._session, "project.create", project.id, project.id)
        return project

    def get(self, reference: str) -> Project:
        """Return a project by its name or identifier; else raise `RowNotFound`."""
        matching = select(Project).where((Project.name == reference) | (Project.id == reference))
        projects = self._session.scalars(matching).all()
        for project in projects:
            if project.id == reference or len(projects) == 1:
                return project
        raise RowNotFound("project", repr(reference))

    def list_all(self) -> Sequence[Project]:
        """List all projects, the first one first."""
        return self._session.scalars(select(Project).order_by(Project.created_at)).all()

    def change_limits(self, reference: str, limits: Mapping[str, int | None]) -> Project:
        """Change limits of a project, by their names."""
        project = self.get(reference)
        for name, limit in limits.items():
            setattr(project, name, limit)
        self._session.flush()
        record_action(self._session, "project.limit", project.id, project.id)
        return project

    def change_retention(self, reference: str, days: float | None) -> Project:
        """Change how many days ended jobs of a project are kept: 0 for ever, None by default."""
        project = self.get(reference)
        project.keep_days = days
        self._session.flush()
        record_action(self._session, "project.keep", project.id, project.id)
        return project

    def lock_limits(self, project_id: str) -> ProjectLimits:
        """Read the limits of a project, and let no other transaction pass until this one ends.

        So what others add at the same time is counted by the later one. SQLite has one writer.
        """
        lock = select(Project).where(Project.id == project_id).with_for_update(key_share=True)
        project = self._session.scalar(lock, execution_options={"populate_existing": True})
        return read_limits(project) if project is not None else ProjectLimits()

    def measure_use(self, project_id: str) -> ProjectUse:
        """Measure what a project uses."""
        return ProjectUse(
            count_stored_bytes(self._session, project_id),
            _count_daily_evaluations(self._session, project_id),
        )


def read_limits(project: Project) -> ProjectLimits:
    """Return the limits of a project's row."""
    return ProjectLimits(*(getattr(project, name) for name in LIMIT_NAMES))


def check_stored_bytes(session: Session, project_id: str) -> None:
    """Refuse what was just added if its project now exceeds its limit of stored bytes.

    Raises
    ------
    BudgetExceeded
        With the numbers; the caller's transaction ends with it.
    """
    limit = ProjectRepository(session).lock_limits(project_id).max_stored_bytes
    check_bytes(session, project_id, limit)


def check_room(session: Session, size: int) -> None:
    """Refuse a recording of `size` bytes before it is written, if its project has no room for it.

    Raises
    ------
    BudgetExceeded
        With the numbers.
    """
    project = session.get(Project, find_project(session))
    if project is not None:
        check_bytes(session, project.id, project.max_stored_bytes, size)


def check_bytes(session: Session, project_id: str, limit: int | None, new: int = 0) -> None:
    """Refuse `new` bytes, and what was just added, beyond the limit that was read.

    Raises
    ------
    BudgetExceeded
        With the numbers.
    """
    if limit is None:
        return
    stored = count_stored_bytes(session, project_id) + new
    if stored > limit:
        raise BudgetExceeded(
            f"with this the project would store {stored} bytes; at most {limit} are allowed. "
            "Delete recordings or jobs, or ask the operator for more (`lagid project limit`)",
            FULL_RETRY_SECONDS,
        )
    there = count_stored_bytes(session, project_id, with_deleted=True) + new
    if there > 2 * limit:
        raise BudgetExceeded(
            f"with this and what was deleted, the project would fill {there} bytes; at most "
            f"{2 * limit} are allowed. Deleted bytes are removed after about {REMOVAL_TIME}",
            FULL_RETRY_SECONDS,
        )


def check_daily_evaluations(session: Session, project_id: str, limit: int | None) -> None:
    """Refuse further work if the jobs of the last 24 hours have used up the evaluations.

    Raises
    ------
    BudgetExceeded
        With the numbers, and the time until the first of these jobs no longer counts.
    """
    if limit is None:
        return
    made = _count_daily_evaluations(session, project_id)
    if made < limit:
        return
    raise BudgetExceeded(
        f"{_describe_overrun(made, limit)} Try again later, or ask the operator for more "
        "(`lagid project limit`)",
        _find_seconds_until_free(session, project_id),
    )


@dataclass(frozen=True, slots=True)
class Overrun:
    """A project that has used up its evaluations of a day, and its jobs that still go on."""

    project_id: str
    reason: str
    job_ids: tuple[str, ...]


def list_overruns(session: Session) -> list[Overrun]:
    """List the projects whose open jobs must stop, because no evaluations of the day are left."""
    found = []
    projects = session.execute(select(Project.id, Project.max_daily_evaluations)).all()
    for project_id, limit in projects:
        if limit is None or (made := _count_daily_evaluations(session, project_id)) < limit:
            continue
        going_on = select(Job.id).where(
            Job.project_id == project_id, Job.state.in_(OPEN_STATES), ~Job.cancel_requested
        )
        if jobs := session.scalars(going_on.order_by(Job.id)).all():
            reason = (
                f"stopped: {_describe_overrun(made, limit)} Resume the job when they are a day "
                "old, or ask the operator for more (`lagid project limit`)."
            )
            found.append(Overrun(project_id, reason, tuple(jobs)))
    return found


def _describe_overrun(made: int, limit: int) -> str:
    return f"the last 24 hours made {made} evaluations; {limit} are allowed."


def count_stored_bytes(session: Session, project_id: str, *, with_deleted: bool = False) -> int:
    """Count the bytes of the recordings of a project, and of the results of its runs.

    Open runs count as if they had their results.

    Parameters
    ----------
    with_deleted : bool
        Whether what is deleted counts until it is removed.
    """
    shown: ColumnElement[bool] = Dataset.deleted_at.is_(None)
    kept: ColumnElement[bool] = Job.deleted_at.is_(None)
    if with_deleted:
        shown = shown | (Dataset.deleted_at > utc_now() - REMOVAL_TIME)
        kept = Job.purged_at.is_(None)
    files = select(Dataset.sha256, Dataset.size_bytes).where(
        Dataset.project_id == project_id, shown
    )
    recordings = select(func.sum(files.distinct().subquery().c.size_bytes))
    n_results = case((Job.state.in_(OPEN_STATES), Job.n_runs), else_=Job.n_done)
    results = select(func.sum(n_results)).where(Job.project_id == project_id, kept)
    return int(session.scalar(recordings) or 0) + RESULT_BYTES * int(session.scalar(results) or 0)


def _count_daily_evaluations(session: Session, project_id: str) -> int:
    """Count the evaluations of requests, of jobs that ended in the last 24 hours, and of open ones.

    Runs that were taken over from other jobs cost nothing: their part of a job does not count.
    """
    new = Job.evaluations - Job.evaluations_before
    counted = case((new > 0, new), else_=0)  # a run that failed is counted anew
    own = func.sum(counted * (Job.n_runs - Job.n_reused) / Job.n_runs)
    of_project = Job.project_id == project_id
    ended = select(own).where(of_project, Job.finished_at >= utc_now() - DAY)
    running = select(own).where(of_project, Job.state.in_(OPEN_STATES))
    requested = select(func.sum(RequestedWork.evaluations)).where(
        RequestedWork.project_id == project_id, RequestedWork.hour > utc_now() - DAY
    )
    return sum(int(session.scalar(query) or 0) for query in (ended, running, requested))


def add_requested_work(session: Session, evaluations: int) -> None:
    """Add evaluations that a request of the session's project has made to those of the hour."""
    now = utc_now()
    of_project = RequestedWork.project_id == find_project(session)
    key = {
        "project_id": find_project(session),
        "hour": now.replace(minute=0, second=0, microsecond=0),
    }
    insert_missing(session, RequestedWork, [{**key, "evaluations": 0}])
    session.execute(
        update(RequestedWork)
        .where(of_project, RequestedWork.hour == key["hour"])
        .values(evaluations=RequestedWork.evaluations + evaluations)
    )
    session.execute(delete(RequestedWork).where(of_project, RequestedWork.hour <= now - DAY))


def _find_seconds_until_free(session: Session, project_id: str) -> float:
    now = utc_now()
    jobs = select(func.min(Job.finished_at)).where(
        Job.project_id == project_id, Job.finished_at >= now - DAY
    )
    requests = select(func.min(RequestedWork.hour)).where(
        RequestedWork.project_id == project_id, RequestedWork.hour > now - DAY
    )
    first = min(filter(None, (session.scalar(jobs), session.scalar(requests))), default=None)
    return FULL_RETRY_SECONDS if first is None else (first + DAY - now).total_seconds()
