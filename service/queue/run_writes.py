"""Writes of the dispatcher to runs. Every write holds the lease of the job; most are in bulk."""

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

# Every default of the table: if one is missing, the slow path of the ORM is used.
_RUN_DEFAULTS = {
    "state": JobState.QUEUED,
    "attempt": 0,
    "kills": 0,
    "evaluations": 0,
    "generations": 0,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class NewRun:
    """A run to be created: its position in the sweep, and its settings."""

    number: int
    cell: Document = field(default_factory=dict)
    labels: Document = field(default_factory=dict)
    spec_hash: str | None = None
    method: str | None = None
    seed: int | None = None
    sigma: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOutcome:
    """Outcome of a run. `result` is the document of the run result; None if the run failed."""

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

    The first method that is called locks the row of the job, or raises `LeaseLost` if the lease is
    not held. Nobody else can change the row until the session ends.
    """

    def __init__(self, session: Session, lease: Lease, clock: Clock = utc_now) -> None:
        self._session, self._lease, self._clock = session, lease, clock
        self._queue = LeaseQueue(session, clock)
        self._held: Job | None = None

    def create_runs(self, cells: Iterable[NewRun]) -> None:
        """Create the runs of the job; existing runs stay, so a second call is harmless."""
        insert_runs(self._session, self._lock_job(), cells)

    def list_pending(self, limit: int = CHUNK_ROWS, after: int = -1) -> list[Run]:
        """List unfinished runs with a `number` above `after`, in order."""
        self._lock_job()
        pending = select(Run).where(
            Run.job_id == self._lease.job_id, Run.state.in_(OPEN_STATES), Run.number > after
        )
        return list(self._session.scalars(pending.order_by(Run.number).limit(limit)))

    def list_unfinished(self, numbers: Sequence[int]) -> list[Run]:
        """List the unfinished runs of these numbers, in their order."""
        self._lock_job()
        runs: list[Run] = []
        for chunk in split_chunks(numbers):
            of_job = (Run.job_id == self._lease.job_id) & Run.number.in_(chunk)
            runs += self._session.scalars(select(Run).where(of_job, Run.state.in_(OPEN_STATES)))
        return sorted(runs, key=lambda run: run.number)

    def start_runs(self, run_ids: Collection[str]) -> None:
        """Mark queued runs as running."""
        self._lock_job()
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
        """End runs: results, states, history and the counts of the job, in one transaction.

        A run that has ended already keeps its result. Return the identifiers of the written runs.
        """
        self._lock_job()
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
        self._update_counts(fresh)
        for chunk in split_chunks(open_ids):
            self._session.execute(delete(Checkpoint).where(Checkpoint.run_id.in_(chunk)))
        return tuple(outcome.run_id for outcome in fresh)

    def append_history(
        self, history: Iterable[HistoryPoint], migrants: Iterable[MigrantPoint] = ()
    ) -> None:
        """Append to the history of runs.

        A run that continues from a checkpoint computes the same points again, bit for bit. They
        count once.
        """
        self._lock_job()
        self._insert_history(history, migrants)

    def save_checkpoints(self, states: Iterable[tuple[str, int, bytes]]) -> None:
        """Replace the checkpoints of runs, passed as (run, evaluations, state)."""
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
        """Read the checkpoints of the unfinished runs of the job, by run."""
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
        values: dict[str, Any] = {
            "n_done": Job.n_done + len(ended),
            "n_failed": Job.n_failed + sum(outcome.state is JobState.FAILED for outcome in ended),
        }
        rms = [outcome.best_rms for outcome in ended if outcome.best_rms is not None]
        if rms:
            values["best_rms"] = choose_smaller_rms(min(rms))
        changed = update(Job).where(*self._lease.fence()).values(values)
        self._session.execute(changed, execution_options=RETURNING_OPTIONS)


def insert_runs(session: Session, job: Job, cells: Iterable[NewRun]) -> None:
    """Create the queued runs of a job in bulk; existing runs stay unchanged."""
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


def _build_outcome_values(outcome: RunOutcome, now: Any, attempt: int) -> dict[str, Any]:
    values = {name: getattr(outcome, name) for name in RunOutcome.__slots__ if name != "run_id"}
    return {
        **values,
        "id": outcome.run_id,
        "estimates": _extract_estimates(outcome.result),
        "attempt": attempt,
        "finished_at": now,
    }


def _build_run_values(cell: NewRun) -> dict[str, Any]:
    return {name: getattr(cell, name) for name in NewRun.__slots__}


def _extract_estimates(result: Document | None) -> Document | None:
    if result is None:
        return None
    return {
        parameter["name"]: {"value": parameter["value"], "stderr": parameter["stderr"]}
        for parameter in result["parameters"]
    }
