"""Runs as the dispatcher writes them. Every write holds the job's lease; most are in bulk."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from service.queue.clocks import Clock
from service.queue.leases import Lease, Outcome, Queue, smaller
from service.repositories.history import HistoryPoint, MigrantPoint, history_parts, migrant_parts
from service.storage.columns import Document, utc_now
from service.storage.statements import (
    CHUNK,
    IN_PLACE,
    chunks,
    insert_missing,
    new_ids,
    update_by_id,
    upsert,
)
from service.storage.tables import OPEN, Checkpoint, Job, MigrationLog, Run, RunHistory, State

# Every default of the table: with one missing, the rows would take the ORM's slow way.
_FRESH = {"state": State.QUEUED, "attempt": 0, "kills": 0, "evaluations": 0, "generations": 0}


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One run to be made: its place in the sweep and what distinguishes it."""

    number: int
    cell: Document = field(default_factory=dict)
    labels: Document = field(default_factory=dict)
    spec_hash: str | None = None
    method: str | None = None
    seed: int | None = None
    sigma: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOutcome:
    """How a run ended. `result` is the document of the run result; None when it failed."""

    run_id: str
    state: Outcome
    error: str | None = None
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


class RunLedger:
    """Writes to the runs of one leased job, in one writing session.

    The first method that is called locks the job's row, or raises `LeaseLost` when the lease is
    not held; nobody else can change that until the session ends.
    """

    def __init__(self, session: Session, lease: Lease, clock: Clock = utc_now) -> None:
        self._session, self._lease, self._clock = session, lease, clock
        self._queue = Queue(session, clock)
        self._held: Job | None = None

    def create(self, cells: Iterable[Cell]) -> None:
        """Make the job's runs; those that are there already stay, so a second call is harmless."""
        add_runs(self._session, self._hold(), cells)

    def pending(self, limit: int = CHUNK, after: int = -1) -> list[Run]:
        """Unfinished runs with a `number` above `after`, in order."""
        self._hold()
        left = select(Run).where(
            Run.job_id == self._lease.job_id, Run.state.in_(OPEN), Run.number > after
        )
        return list(self._session.scalars(left.order_by(Run.number).limit(limit)))

    def unfinished(self, numbers: Sequence[int]) -> list[Run]:
        """Those of the runs of these numbers that are unfinished, in their order."""
        self._hold()
        found: list[Run] = []
        for chunk in chunks(numbers):
            mine = (Run.job_id == self._lease.job_id) & Run.number.in_(chunk)
            found += self._session.scalars(select(Run).where(mine, Run.state.in_(OPEN)))
        return sorted(found, key=lambda run: run.number)

    def start(self, run_ids: Collection[str]) -> None:
        """Mark queued runs as running."""
        self._hold()
        for chunk in chunks(run_ids):
            begun = update(Run).where(self._is_mine(chunk), Run.state == State.QUEUED).values(
                state=State.RUNNING, attempt=self._lease.attempt,
                started_at=func.coalesce(Run.started_at, self._clock()),
            )  # fmt: skip
            self._session.execute(begun, execution_options=IN_PLACE)

    def blame(self, kills: Mapping[str, int]) -> None:
        """Write how often in a row a worker died over each of these runs."""
        self._hold()
        if kills:
            rows = [{"id": run, "kills": count} for run, count in kills.items()]
            update_by_id(self._session, Run, rows)

    def record(
        self,
        outcomes: Sequence[RunOutcome],
        history: Iterable[HistoryPoint] = (),
        migrants: Iterable[MigrantPoint] = (),
    ) -> tuple[str, ...]:
        """End runs: results, states, history, the job's counts, all in this transaction.

        A run that has ended already keeps its result. Gives the identifiers of those written.
        """
        self._hold()
        open_ids = self._open_ids([one.run_id for one in outcomes])
        fresh = [one for one in outcomes if one.run_id in open_ids]
        self._insert(history, migrants)
        if not fresh:
            return ()
        now, attempt = self._clock(), self._lease.attempt
        update_by_id(self._session, Run, (_ended(one, now, attempt) for one in fresh))
        self._count(fresh)
        for chunk in chunks(open_ids):
            self._session.execute(delete(Checkpoint).where(Checkpoint.run_id.in_(chunk)))
        return tuple(one.run_id for one in fresh)

    def append(
        self, history: Iterable[HistoryPoint], migrants: Iterable[MigrantPoint] = ()
    ) -> None:
        """Add to the history of runs.

        A run that goes on from a checkpoint finds the same points again, bit for bit; they count
        once.
        """
        self._hold()
        self._insert(history, migrants)

    def save(self, states: Iterable[tuple[str, int, bytes]]) -> None:
        """Replace the checkpoints of runs, given as (run, evaluations, state)."""
        self._hold()
        now = self._clock()
        rows = (
            {"run_id": run_id, "job_id": self._lease.job_id, "attempt": self._lease.attempt,
             "evaluations": evaluations, "state": state, "created_at": now}
            for run_id, evaluations, state in states
        )  # fmt: skip
        upsert(self._session, Checkpoint, rows)

    def checkpoints(self) -> dict[str, bytes]:
        """The states from which unfinished runs of the job can go on, by run."""
        self._hold()
        query = select(Checkpoint.run_id, Checkpoint.state).where(
            Checkpoint.job_id == self._lease.job_id
        )
        return dict(self._session.execute(query).all())

    def _hold(self) -> Job:
        if self._held is None:
            self._held = self._queue.hold(self._lease)
        return self._held

    def _is_mine(self, run_ids: Collection[str]) -> Any:
        return (Run.job_id == self._lease.job_id) & Run.id.in_(run_ids)

    def _open_ids(self, run_ids: Iterable[str]) -> set[str]:
        found: set[str] = set()
        for chunk in chunks(run_ids):
            query = select(Run.id).where(self._is_mine(chunk), Run.state.in_(OPEN))
            found.update(self._session.scalars(query))
        return found

    def _insert(self, history: Iterable[HistoryPoint], migrants: Iterable[MigrantPoint]) -> None:
        insert_missing(self._session, RunHistory, history_parts(history))
        insert_missing(self._session, MigrationLog, migrant_parts(migrants))

    def _count(self, ended: Sequence[RunOutcome]) -> None:
        values: dict[str, Any] = {
            "n_done": Job.n_done + len(ended),
            "n_failed": Job.n_failed + sum(one.state is State.FAILED for one in ended),
        }
        found = [one.best_rms for one in ended if one.best_rms is not None]
        if found:
            values["best_rms"] = smaller(min(found))
        changed = update(Job).where(*self._lease.fence()).values(values)
        self._session.execute(changed, execution_options=IN_PLACE)


def add_runs(session: Session, job: Job, cells: Iterable[Cell]) -> None:
    """Make the queued runs of a job, in bulk; those that are there already stay as they are."""
    now = utc_now()
    for chunk in chunks(cells):
        rows = [
            {**_shallow(cell), **_FRESH, "id": run_id, "project_id": job.project_id,
             "job_id": job.id, "created_at": now}
            for cell, run_id in zip(chunk, new_ids("run", len(chunk)), strict=True)
        ]  # fmt: skip
        insert_missing(session, Run, rows)


def _ended(one: RunOutcome, now: Any, attempt: int) -> dict[str, Any]:
    values = {name: getattr(one, name) for name in RunOutcome.__slots__ if name != "run_id"}
    return {
        **values, "id": one.run_id, "estimates": _estimates(one.result), "attempt": attempt,
        "finished_at": now,
    }  # fmt: skip


def _shallow(cell: Cell) -> dict[str, Any]:
    return {name: getattr(cell, name) for name in Cell.__slots__}


def _estimates(result: Document | None) -> Document | None:
    if result is None:
        return None
    return {
        one["name"]: {"value": one["value"], "stderr": one["stderr"]}
        for one in result["parameters"]
    }
