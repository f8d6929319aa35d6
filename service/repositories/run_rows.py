"""Runs as users see them: read, list, count."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

from sqlalchemy import (
    ColumnElement,
    ScalarSelect,
    Select,
    cast,
    exists,
    func,
    literal,
    or_,
    select,
    type_coerce,
)
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import InstrumentedAttribute, Session

from service.core.bodies.text_checks import MANY
from service.core.states import OPEN_STATES, RUN_STATES, JobState
from service.repositories.history_rows import (
    HistoryPoint,
    MigrantPoint,
    unpack_history,
    unpack_migrants,
)
from service.repositories.search_conditions import select_items_with
from service.storage.columns import Document, to_json
from service.storage.sessions import find_project
from service.storage.statements import RowPage, make_page
from service.storage.storage_errors import InvalidCursor, RowNotFound
from service.storage.tables import Job, MigrationLog, Run, RunHistory

RunOrder = Literal[
    "number", "best_rms", "fit_estimation", "fit_validation", "sigma", "seconds", "evaluations"
]
_ORDER_COLUMNS: dict[RunOrder, InstrumentedAttribute[Any]] = {
    "number": Run.number,
    "best_rms": Run.best_rms,
    "fit_estimation": Run.fit_estimation,
    "fit_validation": Run.fit_validation,
    "sigma": Run.sigma,
    "seconds": Run.seconds,
    "evaluations": Run.evaluations,
}


class RunRepository:
    """The runs of one project in one session."""

    def __init__(self, session: Session, project_id: str | None = None) -> None:
        self._session, self._project_id = session, project_id or find_project(session)

    def get(self, run_id: str) -> Run:
        """Return a run of this project; else raise `RowNotFound`."""
        query = select(Run).join(Job, Job.id == Run.job_id)
        query = query.where(
            Run.id == run_id,
            Run.project_id == self._project_id,
            Run.deleted_at.is_(None),
            Job.deleted_at.is_(None),
        )
        run = self._session.scalar(query, execution_options={"populate_existing": True})
        if run is None:
            raise RowNotFound("run", run_id)
        return run

    def lock(self, run_id: str) -> None:
        """Lock the row of a run against every other writer, until the transaction ends."""
        row = select(Run.id).where(Run.id == run_id).with_for_update(key_share=True)
        self._session.execute(row)

    def list_page(
        self,
        job_id: str,
        *,
        cursor: str | None = None,
        limit: int = 50,
        states: Sequence[JobState] = (),
        cell: Mapping[str, Any] | None = None,
        labels: Mapping[str, Any] | None = None,
        tags: Sequence[str] = (),
        order: RunOrder = "number",
        descending: bool = False,
    ) -> RowPage[Run]:
        """List the runs of a job, sorted by a column; runs without a value in it come last.

        `cell` selects the runs whose axes have these values, such as ``{"/noise/sigma": 0.1}``.
        `tags` selects those that have all of them. The pages do not shift while runs finish, unless
        their values in the column change.
        """
        conditions = list(filter_job(job_id, self._project_id))
        conditions += [
            Run.id.in_(select_items_with("run", self._project_id, ("tag", tag))) for tag in tags
        ]
        if states:
            conditions.append(Run.state.in_(states))
        for column, entries in ((Run.cell, cell), (Run.labels, labels)):
            for key, value in (entries or {}).items():
                conditions.append(entry_equals(self._session, column, key, value))
        chosen: list[str] = []  # only identifiers are sorted: a row has kilobytes
        for part in _split_by_order(_ORDER_COLUMNS[order], descending, cursor):
            left = limit + 1 - len(chosen)
            if left:
                query = part.where(*conditions).limit(left)
                chosen += self._session.scalars(query)
        by_id = {
            run.id: run for run in self._session.scalars(select(Run).where(Run.id.in_(chosen)))
        }
        rows = [by_id[run_id] for run_id in chosen]
        cursors = (json.dumps([getattr(run, order), run.number]) for run in rows)
        return make_page(rows, limit, cursors)

    def count_states(self, job_id: str) -> dict[JobState, int]:
        """Count the runs of a job in each state."""
        of_job = filter_job(job_id, self._project_id)
        query = select(Run.state, func.count()).where(*of_job).group_by(Run.state)
        counts = dict(self._session.execute(query).all())
        return {state: counts.get(state, 0) for state in RUN_STATES}

    def count_ended(self, job_id: str) -> int:
        """Count the runs of a job that have ended, deleted ones too."""
        of_job = Run.job_id == select_job_id(job_id, self._project_id)
        query = select(func.count()).where(of_job, Run.state.not_in(OPEN_STATES))
        return self._session.scalars(query).one()

    def read_history(self, run_id: str) -> list[HistoryPoint]:
        """Read the improved champions of a run by island, in their order."""
        parts = select(RunHistory.points, RunHistory.n_parameters).where(
            RunHistory.run_id == self.get(run_id).id
        )
        return unpack_history(run_id, ((row[0], row[1]) for row in self._session.execute(parts)))

    def read_migrations(self, run_id: str) -> list[MigrantPoint]:
        """Read the migrants of a run, in order."""
        parts = select(MigrationLog.migrants).where(MigrationLog.run_id == self.get(run_id).id)
        return unpack_migrants(run_id, self._session.scalars(parts))


def filter_job(job_id: str, project_id: str) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions that a run belongs to a job and was not deleted."""
    return Run.job_id == select_job_id(job_id, project_id), Run.deleted_at.is_(None)


def select_job_id(job_id: str, project_id: str) -> ScalarSelect[str]:
    """Return the identifier of an undeleted job as a subquery, NULL in another project.

    The runs of a job need no condition on the project then. With one, SQLite may search all runs
    of the project.
    """
    query = select(Job.id).where(Job.id == job_id, Job.project_id == project_id)
    return query.where(Job.deleted_at.is_(None)).scalar_subquery()


def entry_equals(
    session: Session, column: InstrumentedAttribute[Document], key: str, value: object
) -> ColumnElement[bool]:
    """Return the condition that a document has this value under a key.

    Raises
    ------
    UnstorableValue
        If no document can have it.
    """
    to_json([key, value])
    if session.get_bind().dialect.name == "postgresql":
        return type_coerce(column, JSONB)[key] == cast(literal(to_json(value)), JSONB)
    return _sqlite_entry_equals(column, key, value)


def _sqlite_entry_equals(
    column: InstrumentedAttribute[Document], key: str, value: object
) -> ColumnElement[bool]:
    each = func.json_each(column).table_valued("key", "value", "type")
    # SQLite stores true and false as 1 and 0: only the type distinguishes them.
    if value is None or isinstance(value, bool):
        return exists(select(1).where(each.c.key == key, each.c.type == to_json(value)))
    types = ("integer", "real") if isinstance(value, int | float) else ("text",)
    stored: object = value
    if isinstance(value, list | dict):
        types, stored = ("array", "object"), to_json(value)
    return exists(
        select(1).where(each.c.key == key, each.c.value == stored, each.c.type.in_(types))
    )


def _split_by_order(
    column: InstrumentedAttribute[Any], descending: bool, cursor: str | None
) -> Iterator[Select[str]]:
    """Yield the queries of the runs after the cursor: those with a value, then the others.

    Each one by itself has the order of an index, if there is one of the column.
    """
    value, number = (None, -1) if cursor is None else _parse_cursor(cursor)
    query, by = select(Run.id), column.desc() if descending else column.asc()
    if column is Run.number:
        if value is not None:
            query = query.where(column < value if descending else column > value)
        yield query.order_by(by)
        return
    if cursor is None:
        yield query.where(column.is_not(None)).order_by(by, Run.number)
    elif value is not None:
        beyond, near = (
            (column < value, column <= value) if descending else (column > value, column >= value)
        )
        after = query.where(column.is_not(None), near, or_(beyond, Run.number > number))
        yield after.order_by(by, Run.number)
        number = -1
    yield query.where(column.is_(None), Run.number > number).order_by(Run.number)


def _parse_cursor(cursor: str) -> tuple[float | None, int]:
    try:
        value, number = json.loads(cursor)
    except (ValueError, TypeError):
        raise InvalidCursor(cursor) from None
    if not (isinstance(value, float | None) or _is_count(value)) or not _is_count(number):
        raise InvalidCursor(cursor)
    return value, number


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= MANY
