"""Runs as the dispatcher writes them. Every write holds the job's lease; most are in bulk."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from service.core.states import OPEN_STATES, JobState
from service.queue.clocks import Clock
from service.queue.leases import FinalState, Lease, LeaseQueue, choose_smaller_rms
from service.repositories.history import HistoryPoint, MigrantPoint, pack_history, pack_migrants
from service.storage.columns import Document, utc_now
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

# Every default of the table: with one missing, the rows would take the ORM's slow way.
_RUN_DEFAULTS = {
    "state": JobState.QUEUED,
    "attempt": 0,
    "kills": 0,
    "evaluations": 0,
    "generations": 0,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class NewRun:
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
    state: FinalState
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


class RunWriter:
    """Writes to the runs of one leased job, in one writing session.

    The first method that is called locks the job's row, or raises `LeaseLost` when the lease is
    not held; nobody else can change that until the session ends.
    """

    def __init__(self, session: Session, lease: Lease, clock: Clock = utc_now) -> None:
        self._session, self._lease, self._clock = session, lease, clock
        self._queue = LeaseQueue(session, clock)
        self._held: Job | None = None

    def create_runs(self, cells: Iterable[NewRun]) -> None:
        """Make the job's runs; those that are there already stay, so a second call is harmless."""
        insert_runs(self._session, self._lock_job(), cells)

    def list_pending(self, limit: int = CHUNK_ROWS, after: int = -1) -> list[Run]:
        """Unfinished runs with a `number` above `after`, in order."""
        self._lock_job()
        left = select(Run).where(
            Run.job_id == self._lease.job_id, Run.state.in_(OPEN_STATES), Run.number > after
        )
        return list(self._session.scalars(left.order_by(Run.number).limit(limit)))

    def list_unfinished(self, numbers: Sequence[int]) -> list[Run]:
        """Those of the runs of these numbers that are unfinished, in their order."""
        self._lock_job()
        found: list[Run] = []
        for chunk in split_chunks(numbers):
            mine = (Run.job_id == self._lease.job_id) & Run.number.in_(chunk)
            found += self._session.scalars(select(Run).where(mine, Run.state.in_(OPEN_STATES)))
        return sorted(found, key=lambda run: run.number)

    def start_runs(self, run_ids: Collection[str]) -> None:
        """Mark queued runs as running."""
        self._lock_job()
        for chunk in split_chunks(run_ids):
            begun = (
                update(Run)
                .where(self._filter_runs(chunk), Run.state == JobState.QUEUED)
                .values(
                    state=JobState.RUNNING,
                    attempt=self._lease.attempt,
                    started_at=func.coalesce(Run.started_at, self._clock()),
                )
            )
            self._session.execute(begun, execution_options=RETURNING_OPTIONS)

    def write_kills(self, kills: Mapping[str, int]) -> None:
        """Write how often in a row a worker died over each of these runs."""
        self._lock_job()
        if kills:
            rows = [{"id": run, "kills": count} for run, count in kills.items()]
            update_by_id(self._session, Run, rows)

    def record_outcomes(
        self,
        outcomes: Sequence[RunOutcome],
        history: Iterable[HistoryPoint] = (),
        migrants: Iterable[MigrantPoint] = (),
    ) -> tuple[str, ...]:
        """End runs: results, states, history, the job's counts, all in this transaction.

        A run that has ended already keeps its result. Gives the identifiers of those written.
        """
        self._lock_job()
        open_ids = self._find_open_ids([one.run_id for one in outcomes])
        fresh = [one for one in outcomes if one.run_id in open_ids]
        self._insert_history(history, migrants)
        if not fresh:
            return ()
        now, attempt = self._clock(), self._lease.attempt
        update_by_id(
            self._session, Run, (_build_outcome_values(one, now, attempt) for one in fresh)
        )
        self._update_counts(fresh)
        for chunk in split_chunks(open_ids):
            self._session.execute(delete(Checkpoint).where(Checkpoint.run_id.in_(chunk)))
        return tuple(one.run_id for one in fresh)

    def append_history(
        self, history: Iterable[HistoryPoint], migrants: Iterable[MigrantPoint] = ()
    ) -> None:
        """Add to the history of runs.

        A run that goes on from a checkpoint finds the same points again, bit for bit; they count
        once.
        """
        self._lock_job()
        self._insert_history(history, migrants)

    def save_checkpoints(self, states: Iterable[tuple[str, int, bytes]]) -> None:
        """Replace the checkpoints of runs, given as (run, evaluations, state)."""
        self._lock_job()
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
        """The states from which unfinished runs of the job can go on, by run."""
        self._lock_job()
        query = select(Checkpoint.run_id, Checkpoint.state).where(
            Checkpoint.job_id == self._lease.job_id
        )
        return dict(self._session.execute(query).all())

    def _lock_job(self) -> Job:
        if self._held is None:
            self._held = self._queue.lock_job(self._lease)
        return self._held

    def _filter_runs(self, run_ids: Collection[str]) -> Any:
        return (Run.job_id == self._lease.job_id) & Run.id.in_(run_ids)

    def _find_open_ids(self, run_ids: Iterable[str]) -> set[str]:
        found: set[str] = set()
        for chunk in split_chunks(run_ids):
            query = select(Run.id).where(self._filter_runs(chunk), Run.state.in_(OPEN_STATES))
            found.update(self._session.scalars(query))
        return found

    def _insert_history(
        self, history: Iterable[HistoryPoint], migrants: Iterable[MigrantPoint]
    ) -> None:
        insert_missing(self._session, RunHistory, pack_history(history))
        insert_missing(self._session, MigrationLog, pack_migrants(migrants))

    def _update_counts(self, ended: Sequence[RunOutcome]) -> None:
        values: dict[str, Any] = {
            "n_done": Job.n_done + len(ended),
            "n_failed": Job.n_failed + sum(one.state is JobState.FAILED for one in ended),
        }
        found = [one.best_rms for one in ended if one.best_rms is not None]
        if found:
            values["best_rms"] = choose_smaller_rms(min(found))
        changed = update(Job).where(*self._lease.fence()).values(values)
        self._session.execute(changed, execution_options=RETURNING_OPTIONS)


def insert_runs(session: Session, job: Job, cells: Iterable[NewRun]) -> None:
    """Make the queued runs of a job, in bulk; those that are there already stay as they are."""
    now = utc_now()
    for chunk in split_chunks(cells):
        rows = [
            {
                **_build_run_values(cell),
                **_RUN_DEFAULTS,
                "id": run_id,
                "project_id": job.project_id,
                "job_id": job.id,
                "created_at": now,
            }
            for cell, run_id in zip(chunk, new_ids("run", len(chunk)), strict=True)
        ]
        insert_missing(session, Run, rows)


def _build_outcome_values(one: RunOutcome, now: Any, attempt: int) -> dict[str, Any]:
    values = {name: getattr(one, name) for name in RunOutcome.__slots__ if name != "run_id"}
    return {
        **values,
        "id": one.run_id,
        "estimates": _extract_estimates(one.result),
        "attempt": attempt,
        "finished_at": now,
    }


def _build_run_values(cell: NewRun) -> dict[str, Any]:
    return {name: getattr(cell, name) for name in NewRun.__slots__}


def _extract_estimates(result: Document | None) -> Document | None:
    if result is None:
        return None
    return {
        one["name"]: {"value": one["value"], "stderr": one["stderr"]}
        for one in result["parameters"]
    }
