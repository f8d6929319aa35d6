"""Writes of the dispatcher to runs. Every write holds the lease of a parcel; most are in bulk."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import chain
from typing import Any, NamedTuple

from sqlalchemy import Connection, Select, delete, event, func, select, update
from sqlalchemy.orm import Session

from service.core.states import OPEN_STATES, JobState
from service.queue.leases import FinalState, Lease, LeaseQueue, LockedParcel, choose_smaller_rms
from service.queue.packed_results import (
    COPY_END,
    COPY_HEAD,
    LAYOUTS,
    RESULT_ROWS,
    SIGNALS_COLUMNS,
    ColumnKind,
    PackedResults,
    RowLayout,
    extract_estimates,
)
from service.repositories.history_rows import (
    HistoryPoint,
    MigrantPoint,
    pack_history,
    pack_migrants,
)
from service.storage.clocks import Clock
from service.storage.columns import Document, UtcDateTime, to_json, utc_now
from service.storage.statements import (
    CHUNK_ROWS,
    RETURNING_OPTIONS,
    insert_missing,
    new_ids,
    split_chunks,
    update_by_id,
    upsert,
)
from service.storage.tables import Checkpoint, Job, MigrationLog, Run, RunHistory

_RUN_DEFAULTS = {
    "state": JobState.QUEUED.value,
    "attempt": 0,
    "kills": 0,
    "evaluations": 0,
    "generations": 0,
}


TEMPORARY_MIB = 32
"""Memory for the temporary tables of a connection, in MiB: what does not fit is written to disk."""


class NewRun(NamedTuple):
    """A run to be created: its position in the sweep, and its settings.

    Its fields are the columns of `_CELL_COLUMNS`. No document is changed, so runs may share one.
    """

    number: int
    cell: Document
    labels: Document
    method: str
    seed: int
    sigma: float


class WaitingRun(NamedTuple):
    """An unfinished run: what is needed to compute it."""

    id: str
    number: int
    cell: Document
    kills: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOutcome:
    """Outcome of a run. `result` is the document of the run result; None if the run failed."""

    run_id: str
    state: FinalState
    error: str | None = None
    spec_hash: str | None = None
    result: Document | None = None
    valid: bool | None = None
    best_rms: float | None = None
    rms_noise_free: float | None = None
    fit_estimation: float | None = None
    fit_validation: float | None = None
    evaluations: int = 0
    generations: int = 0
    seconds: float | None = None
    signals_sha256: str | None = None
    signals_start: int | None = None
    signals_size: int | None = None


class RunWriter:
    """Writes to the runs of one leased parcel, in one writing session.

    The first method that is called locks the row of the parcel, or raises `LeaseLost` if the lease
    is not held. Nobody else can change the row until the session ends. The row of the job is
    changed last, because the dispatchers of its other parcels change it too.
    """

    def __init__(self, session: Session, lease: Lease, clock: Clock = utc_now) -> None:
        self._session, self._lease, self._clock = session, lease, clock
        self._queue = LeaseQueue(session, clock)
        self._held: LockedParcel | None = None

    def create_runs(self, cells: Iterable[NewRun]) -> list[WaitingRun]:
        """Create runs of the parcel; existing runs stay, so a second call is harmless.

        Return them as they wait; if some exist already, only `list_pending` tells what waits.
        """
        return insert_runs(self._session, self._lock_parcel().job, cells)

    def count_runs(self, numbers: range) -> int:
        """Count the runs of these numbers that exist, in any state."""
        self._lock_parcel()
        of_job = Run.job_id == self._lease.job_id
        query = select(func.count()).where(
            of_job, Run.number >= numbers.start, Run.number < numbers.stop
        )
        return self._session.scalar(query) or 0

    def list_pending(
        self, limit: int = CHUNK_ROWS, after: int = -1, before: int | None = None
    ) -> list[WaitingRun]:
        """List unfinished runs of the parcel with a `number` above `after`, in order."""
        parcel = self._lock_parcel().parcel
        stop = parcel.stop if before is None else min(before, parcel.stop)
        pending = self._select_open().where(
            Run.number > max(after, parcel.first - 1), Run.number < stop
        )
        rows = self._session.execute(pending.order_by(Run.number).limit(limit))
        return list(map(WaitingRun._make, rows))

    def list_unfinished(self, numbers: Sequence[int]) -> list[WaitingRun]:
        """List the unfinished runs of these numbers, in their order."""
        self._lock_parcel()
        runs: list[WaitingRun] = []
        for chunk in split_chunks(numbers):
            rows = self._session.execute(self._select_open().where(Run.number.in_(chunk)))
            runs += map(WaitingRun._make, rows)
        return sorted(runs, key=lambda run: run.number)

    def _select_open(self) -> Select[str, int, Document, int]:
        columns = select(Run.id, Run.number, Run.cell, Run.kills)
        return columns.where(Run.job_id == self._lease.job_id, Run.state.in_(OPEN_STATES))

    def start_runs(self, run_ids: Collection[str]) -> None:
        """Mark queued runs as running."""
        self._lock_parcel()
        for chunk in split_chunks(run_ids):
            statement = (
                update(Run)
                .where(self._filter_runs(chunk), Run.state == JobState.QUEUED)
                .values(
                    state=JobState.RUNNING,
                    attempt=self._lease.attempt,
                    started_at=func.coalesce(Run.started_at, self._clock()),
                )
            )
            self._session.execute(statement, execution_options=RETURNING_OPTIONS)

    def write_kills(self, kills: Mapping[str, int]) -> None:
        """Write how often in a row a worker died in each of these runs."""
        self._lock_parcel()
        if kills:
            rows = [{"id": run, "kills": count} for run, count in kills.items()]
            update_by_id(self._session, Run, rows)

    def record_outcomes(
        self,
        outcomes: Sequence[RunOutcome],
        history: Iterable[HistoryPoint] = (),
        migrants: Iterable[MigrantPoint] = (),
    ) -> tuple[str, ...]:
        """End runs: results, states, history and the counts of the job, in one transaction.

        A run that has ended already keeps its result. Return the identifiers of the written runs.
        """
        self._lock_parcel()
        open_ids = self._find_open_ids([outcome.run_id for outcome in outcomes])
        fresh = [outcome for outcome in outcomes if outcome.run_id in open_ids]
        self._insert_history(history, migrants)
        if not fresh:
            return ()
        now, attempt = self._clock(), self._lease.attempt
        update_by_id(
            self._session,
            Run,
            (_build_outcome_values(outcome, now, attempt) for outcome in fresh),
        )
        for chunk in split_chunks(open_ids):
            self._session.execute(delete(Checkpoint).where(Checkpoint.run_id.in_(chunk)))
        self._update_counts(fresh)
        return tuple(outcome.run_id for outcome in fresh)

    def record_results(
        self, packs: Sequence[PackedResults], lost_signals: Collection[str] = ()
    ) -> None:
        """End the successful runs of packs, as `record_outcomes` does, in bulk.

        Parameters
        ----------
        lost_signals : collection of str
            Objects that could not be stored. Their runs have no signals.
        """
        self._lock_parcel()
        if not packs:
            return
        if self._session.get_bind().dialect.name == "sqlite":
            n_ended = self._record_in_sqlite(packs)
        else:
            n_ended = self._record_in_postgres(packs)
        if lost_signals:
            signals = dict.fromkeys(SIGNALS_COLUMNS)
            lost = (Run.job_id == self._lease.job_id) & Run.signals_sha256.in_(lost_signals)
            self._session.execute(
                update(Run).where(lost).values(signals), execution_options=RETURNING_OPTIONS
            )
        # A cancelled run keeps its own: a resumed job goes on from it.
        has_ended = Run.state.in_((JobState.SUCCEEDED, JobState.FAILED))
        ended = select(Run.id).where(Run.id == Checkpoint.run_id, has_ended)
        self._session.execute(
            delete(Checkpoint).where(Checkpoint.job_id == self._lease.job_id, ended.exists()),
            execution_options={"synchronize_session": False},
        )
        rms = [pack.best_rms for pack in packs if pack.best_rms is not None]
        self._add_to_counts(n_ended, 0, min(rms, default=None))

    def _record_in_sqlite(self, packs: Sequence[PackedResults]) -> int:
        """Hand the rows to SQLite, and return how many runs were open."""
        self._session.flush()
        connection = self._session.connection()
        now = _to_sqlite_time(connection, self._clock())
        constants = (self._lease.job_id, self._lease.attempt, now)
        cursor: Any = connection.connection.cursor()
        n_ended = 0
        for layout, *blocks in zip(LAYOUTS, *(pack.rows for pack in packs), strict=True):
            rows = chain.from_iterable(blocks)
            if layout is RESULT_ROWS:
                cursor.executemany(_UPDATE_IN_SQLITE, map(constants.__add__, rows))
                n_ended = max(cursor.rowcount, 0)
            else:
                cursor.executemany(_build_sqlite_insert(layout), rows)
        cursor.close()
        return n_ended

    def _record_in_postgres(self, packs: Sequence[PackedResults]) -> int:
        """Copy the rows into temporary tables, and from there to their places."""
        self._session.flush()
        connection = self._session.connection()
        driver: Any = connection.connection.driver_connection
        n_ended = 0
        with driver.cursor() as cursor:
            if not connection.info.get(_HAS_TABLES):
                cursor.execute(f"SET temp_buffers = '{TEMPORARY_MIB}MB'")
                for layout in LAYOUTS:
                    cursor.execute(_build_temporary_table(layout))
                _remember_tables(self._session, connection)
            # Each row is looked up by its key, whatever the planner knows of these tables.
            for method in ("hashjoin", "mergejoin", "seqscan"):
                cursor.execute(f"SET LOCAL enable_{method} = off")
            for layout, *blocks in zip(LAYOUTS, *(pack.rows for pack in packs), strict=True):
                with cursor.copy(f"COPY packed_{layout.table} FROM STDIN (FORMAT BINARY)") as copy:
                    copy.write(b"".join((COPY_HEAD, *blocks, COPY_END)))
                if layout is RESULT_ROWS:
                    constants = (self._lease.attempt, *2 * (self._clock(),), self._lease.job_id)
                    cursor.execute(_UPDATE_IN_POSTGRES, constants)
                    n_ended = cursor.rowcount
                else:
                    cursor.execute(_build_postgres_insert(layout))
        return n_ended

    def append_history(
        self, history: Iterable[HistoryPoint], migrants: Iterable[MigrantPoint] = ()
    ) -> None:
        """Append to the history of runs.

        A run that continues from a checkpoint computes the same points again, bit for bit. They
        count once.
        """
        self._lock_parcel()
        self._insert_history(history, migrants)

    def save_checkpoints(self, states: Iterable[tuple[str, int, bytes]]) -> None:
        """Replace the checkpoints of runs, passed as (run, evaluations, state)."""
        self._lock_parcel()
        now = self._clock()
        rows = (
            {
                "run_id": run_id,
                "job_id": self._lease.job_id,
                "attempt": self._lease.attempt,
                "evaluations": evaluations,
                "state": state,
                "created_at": now,
            }
            for run_id, evaluations, state in states
        )
        upsert(self._session, Checkpoint, rows)

    def read_checkpoints(self) -> dict[str, bytes]:
        """Read the checkpoints of the unfinished runs of the parcel, by run."""
        parcel = self._lock_parcel().parcel
        query = (
            select(Checkpoint.run_id, Checkpoint.state)
            .join(Run, Run.id == Checkpoint.run_id)
            .where(
                Checkpoint.job_id == self._lease.job_id,
                Run.number >= parcel.first,
                Run.number < parcel.stop,
            )
        )
        return dict(self._session.execute(query).all())

    def _lock_parcel(self) -> LockedParcel:
        if self._held is None:
            self._held = self._queue.lock_lease(self._lease)
        return self._held

    def _filter_runs(self, run_ids: Collection[str]) -> Any:
        return (Run.job_id == self._lease.job_id) & Run.id.in_(run_ids)

    def _find_open_ids(self, run_ids: Iterable[str]) -> set[str]:
        open_ids: set[str] = set()
        for chunk in split_chunks(run_ids):
            query = select(Run.id).where(self._filter_runs(chunk), Run.state.in_(OPEN_STATES))
            open_ids.update(self._session.scalars(query))
        return open_ids

    def _insert_history(
        self, history: Iterable[HistoryPoint], migrants: Iterable[MigrantPoint]
    ) -> None:
        insert_missing(self._session, RunHistory, pack_history(history))
        insert_missing(self._session, MigrationLog, pack_migrants(migrants))

    def _update_counts(self, ended: Sequence[RunOutcome]) -> None:
        n_failed = sum(outcome.state is JobState.FAILED for outcome in ended)
        rms = [outcome.best_rms for outcome in ended if outcome.best_rms is not None]
        self._add_to_counts(len(ended), n_failed, min(rms, default=None))

    def _add_to_counts(self, n_ended: int, n_failed: int, best_rms: float | None) -> None:
        values: dict[str, Any] = {
            "n_done": Job.n_done + n_ended,
            "n_failed": Job.n_failed + n_failed,
        }
        if best_rms is not None:
            values["best_rms"] = choose_smaller_rms(best_rms)
        self._lock_parcel().parcel.n_ended += n_ended
        self._session.flush()
        changed = update(Job).where(Job.id == self._lease.job_id).values(values)
        self._session.execute(changed, execution_options=RETURNING_OPTIONS)


_CELL_COLUMNS: Mapping[str, ColumnKind] = {
    "number": "integer",
    "cell": "jsonb",
    "labels": "jsonb",
    "method": "text",
    "seed": "bigint",
    "sigma": "double precision",
}
_INSERT = (
    f"INSERT INTO runs ({', '.join(_RUN_DEFAULTS)}, project_id, job_id, created_at, "
    f"id, {', '.join(_CELL_COLUMNS)}) "
)
_DEFAULT_LIST = ", ".join(map(repr, _RUN_DEFAULTS.values()))
_INSERT_IN_SQLITE = (
    f"{_INSERT} VALUES ({_DEFAULT_LIST}, "
    f"{', '.join(f'?{number}' for number in range(1, 5 + len(_CELL_COLUMNS)))}) "
    "ON CONFLICT DO NOTHING"
)
_INSERT_IN_POSTGRES = (
    f"{_INSERT} SELECT {_DEFAULT_LIST}, %s, %s, %s, cells.* FROM json_to_recordset(%s::json) "
    f"AS cells (id text, {', '.join(f'{name} {kind}' for name, kind in _CELL_COLUMNS.items())}) "
    "ON CONFLICT DO NOTHING"
)
_OPEN_LIST = ", ".join(repr(state.value) for state in OPEN_STATES)
_RESULT_NAMES = [name for name in RESULT_ROWS.columns if name != "id"]
_UPDATE_IN_SQLITE = (
    f"UPDATE runs SET state = {JobState.SUCCEEDED.value!r}, attempt = ?2, finished_at = ?3, "
    "started_at = coalesce(started_at, ?3), "
    + ", ".join(f"{name} = ?{number}" for number, name in enumerate(_RESULT_NAMES, 5))
    + f" WHERE id = ?4 AND job_id = ?1 AND state IN ({_OPEN_LIST})"
)
_UPDATE_IN_POSTGRES = (
    f"UPDATE runs SET state = {JobState.SUCCEEDED.value!r}, attempt = %s, finished_at = %s, "
    "started_at = coalesce(started_at, %s), "
    + ", ".join(f"{name} = packed.{name}" for name in _RESULT_NAMES)
    # The subquery is not merged into the join. It finds each row by its key, and not by its job:
    # an index of the job would be read as a whole for each run.
    + " FROM packed_runs AS packed CROSS JOIN LATERAL (SELECT id, job_id, state FROM runs AS own "
    "WHERE own.id = packed.id OFFSET 0) AS found "
    f"WHERE found.job_id = %s AND found.state IN ({_OPEN_LIST}) AND runs.id = found.id"
)


def _build_sqlite_insert(layout: RowLayout) -> str:
    marks = ", ".join("?" * len(layout.columns))
    names = ", ".join(layout.columns)
    return f"INSERT INTO {layout.table} ({names}) VALUES ({marks}) ON CONFLICT DO NOTHING"


def _build_postgres_insert(layout: RowLayout) -> str:
    names = ", ".join(layout.columns)
    return (
        f"INSERT INTO {layout.table} ({names}) SELECT {names} FROM packed_{layout.table} "
        "ON CONFLICT DO NOTHING"
    )


def _build_temporary_table(layout: RowLayout) -> str:
    """Return the statements that create a table for this session, as it is not yet there.

    Its values are copied at once. So they are not compressed, and up to 8 kB they stay in the row.
    """
    table = f"packed_{layout.table}"
    columns = ", ".join(f"{name} {kind}" for name, kind in layout.columns.items())
    large = [name for name, kind in layout.columns.items() if kind in ("json", "jsonb", "bytea")]
    storage = ", ".join(f"ALTER COLUMN {name} SET STORAGE EXTERNAL" for name in large)
    return (
        f"CREATE TEMPORARY TABLE IF NOT EXISTS {table} ({columns}) "
        "WITH (toast_tuple_target = 8160) ON COMMIT DELETE ROWS; "
        f"ALTER TABLE {table} {storage}"
    )


_HAS_TABLES = "lagid_has_packed_tables"


def _remember_tables(session: Session, connection: Connection) -> None:
    """Note that this connection has its temporary tables, once they are committed."""
    info = connection.info
    event.listen(session, "after_commit", lambda _: info.update({_HAS_TABLES: True}), once=True)


def insert_runs(session: Session, job: Job, cells: Iterable[NewRun]) -> list[WaitingRun]:
    """Create the queued runs of a job in bulk; existing runs stay unchanged."""
    session.flush()
    connection, waiting = session.connection(), list[WaitingRun]()
    is_sqlite = connection.dialect.name == "sqlite"
    insert = _insert_in_sqlite if is_sqlite else _insert_in_postgres
    for chunk in split_chunks(cells):
        ids = new_ids("run", len(chunk))
        insert(connection, job, ids, chunk)
        waiting += [
            WaitingRun(run, cell.number, cell.cell, 0) for run, cell in zip(ids, chunk, strict=True)
        ]
    return waiting


def _insert_in_sqlite(
    connection: Connection, job: Job, ids: Sequence[str], cells: Sequence[NewRun]
) -> None:
    constants = (job.project_id, job.id, _to_sqlite_time(connection, utc_now()))
    columns = [
        _list_json(values) if kind == "jsonb" else values
        for kind, values in zip(_CELL_COLUMNS.values(), zip(*cells, strict=True), strict=True)
    ]
    cursor: Any = connection.connection.cursor()
    cursor.executemany(_INSERT_IN_SQLITE, map(constants.__add__, zip(ids, *columns, strict=True)))
    cursor.close()


def _insert_in_postgres(
    connection: Connection, job: Job, ids: Sequence[str], cells: Sequence[NewRun]
) -> None:
    """Insert by one statement, which takes the rows as one document."""
    rows = [{"id": run, **cell._asdict()} for run, cell in zip(ids, cells, strict=True)]
    driver: Any = connection.connection.driver_connection
    with driver.cursor() as cursor:
        cursor.execute(_INSERT_IN_POSTGRES, [job.project_id, job.id, utc_now(), to_json(rows)])


def _to_sqlite_time(connection: Connection, moment: datetime) -> Any:
    convert = UtcDateTime().bind_processor(connection.dialect)
    assert convert is not None
    return convert(moment)


def _list_json(documents: Sequence[Document]) -> list[str]:
    """Return documents as text; equal objects are written once."""
    texts: dict[int, str] = {}
    for document in documents:
        if id(document) not in texts:
            texts[id(document)] = to_json(document)
    return [texts[id(document)] for document in documents]


def _build_outcome_values(outcome: RunOutcome, now: Any, attempt: int) -> dict[str, Any]:
    values = {name: getattr(outcome, name) for name in RunOutcome.__slots__ if name != "run_id"}
    return {
        **values,
        "id": outcome.run_id,
        "estimates": None if outcome.result is None else extract_estimates(outcome.result),
        "attempt": attempt,
        "finished_at": now,
    }
