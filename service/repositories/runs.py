"""Runs as users see them: read, list, count, and the columns of summaries."""

import json
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from sqlalchemy import (
    ColumnElement,
    Select,
    cast,
    exists,
    func,
    literal,
    or_,
    select,
    true,
    type_coerce,
)
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.orm import InstrumentedAttribute, Session

from service.core.states import JobState
from service.core.text_checks import MANY
from service.repositories.history import HistoryPoint, MigrantPoint, unpack_history, unpack_migrants
from service.storage.columns import Document, to_json
from service.storage.errors import InvalidCursor, RowNotFound
from service.storage.statements import RowPage, make_page
from service.storage.tables import DEFAULT_PROJECT, MigrationLog, Run, RunHistory

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


class RunRow(NamedTuple):
    """The columns of a run for summaries and plots; `estimates` as in the table."""

    id: str
    number: int
    cell: Document
    labels: Document
    state: JobState
    valid: bool | None
    best_rms: float | None
    fit_estimation: float | None
    fit_validation: float | None
    sigma: float | None
    method: str | None
    seed: int | None
    evaluations: int
    generations: int
    seconds: float | None
    estimates: Document | None


class RunRepository:
    """The runs of one project in one session."""

    def __init__(self, session: Session, project_id: str = DEFAULT_PROJECT) -> None:
        self._session, self._project_id = session, project_id

    def get(self, run_id: str) -> Run:
        """Return a run of this project; else raise `RowNotFound`."""
        run = self._session.get(Run, run_id, populate_existing=True)
        if run is None or run.project_id != self._project_id:
            raise RowNotFound("run", run_id)
        return run

    def list_page(
        self,
        job_id: str,
        *,
        cursor: str | None = None,
        limit: int = 50,
        states: Sequence[JobState] = (),
        cell: Mapping[str, Any] | None = None,
        labels: Mapping[str, Any] | None = None,
        order: RunOrder = "number",
        descending: bool = False,
    ) -> RowPage[Run]:
        """List the runs of a job, sorted by a column; runs without a value in it come last.

        `cell` selects the runs whose axes have these values, such as ``{"/noise/sigma": 0.1}``. The
        pages do not shift while runs finish, unless their values in the column change.
        """
        query = select(Run).where(*self._filter_job(job_id)).limit(limit + 1)
        if states:
            query = query.where(Run.state.in_(states))
        for column, entries in ((Run.cell, cell), (Run.labels, labels)):
            for key, value in (entries or {}).items():
                query = query.where(entry_equals(self._session, column, key, value))
        rows = self._session.scalars(
            _apply_order(query, _ORDER_COLUMNS[order], descending, cursor)
        ).all()
        cursors = (json.dumps([getattr(run, order), run.number]) for run in rows)
        return make_page(rows, limit, cursors)

    def count_created(self, job_id: str) -> int:
        """Count the created runs of a job; they are always its first ones."""
        last = self._session.scalar(select(func.max(Run.number)).where(*self._filter_job(job_id)))
        return 0 if last is None else int(last) + 1

    def count_states(self, job_id: str) -> dict[JobState, int]:
        """Count the runs of a job in each state."""
        query = select(Run.state, func.count()).where(*self._filter_job(job_id)).group_by(Run.state)
        counts = dict(self._session.execute(query).all())
        return {state: counts.get(state, 0) for state in JobState}

    def read_table(self, job_id: str) -> list[RunRow]:
        """Read the summary columns of all runs of a job, in the order of the sweep."""
        columns = [getattr(Run, name) for name in RunRow._fields]
        query = select(*columns).where(*self._filter_job(job_id)).order_by(Run.number)
        return [RunRow(*row) for row in self._session.execute(query)]

    def list_parameters(self, job_id: str) -> list[tuple[str, str]]:
        """List names and units of all parameters in the results of a job, the earliest first."""
        if self._session.get_bind().dialect.name == "postgresql":
            elements = func.jsonb_array_elements(Run.result["parameters"]).table_valued("value")
            each, entry = elements.render_derived(), func.jsonb_extract_path_text
            name, unit = (entry(each.c.value, key) for key in ("name", "unit"))
        else:
            each = func.json_each(Run.result, "$.parameters").table_valued("value")
            name, unit = (func.json_extract(each.c.value, f"$.{key}") for key in ("name", "unit"))
        query_columns = select(name, unit, func.min(Run.number)).select_from(Run).join(each, true())
        query = query_columns.where(*self._filter_job(job_id), Run.result.is_not(None)).group_by(
            name, unit
        )
        rows = sorted(self._session.execute(query), key=lambda row: row[2])
        return [(row[0], row[1]) for row in rows]

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

    def _filter_job(self, job_id: str) -> tuple[ColumnElement[bool], ...]:
        return Run.job_id == job_id, Run.project_id == self._project_id


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


def _apply_order(
    query: Select[Run],
    column: InstrumentedAttribute[Any],
    descending: bool,
    cursor: str | None,
) -> Select[Run]:
    by = column.desc() if descending else column.asc()
    if column is Run.number:  # never NULL and unique: a plain order can use its index
        query = query.order_by(by)
    else:
        query = query.order_by(column.is_(None), by, Run.number)
    if cursor is None:
        return query
    value, number = _parse_cursor(cursor)
    if value is None:
        return query.where(column.is_(None), Run.number > number)
    beyond = column < value if descending else column > value
    if column is Run.number:
        return query.where(beyond)
    tied = (column == value) & (Run.number > number)
    return query.where(or_(beyond, tied, column.is_(None)))


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
