"""Short ways to put rows into a test's database and to look at them."""

from datetime import UTC, datetime, timedelta

from sqlalchemy import select

from service.core.states import JobState
from service.queue.leases import Claim, Lease, LeaseQueue
from service.queue.run_writes import NewRun, RunOutcome, RunWriter
from service.repositories.dataset_rows import NewDataset
from service.repositories.job_rows import JobRepository, NewJob
from service.repositories.run_rows import RunRepository
from service.storage.sessions import Database
from service.storage.tables import Job, Parcel, Run


class Clock:
    """A clock that only tests move."""

    def __init__(self) -> None:
        self.now = datetime(2026, 1, 1, tzinfo=UTC)

    def __call__(self) -> datetime:
        return self.now

    def advance(self, seconds: float) -> None:
        self.now += timedelta(seconds=seconds)


def submit(database: Database, name: str = "tube", **values) -> str:
    with database.write_session() as session:
        new = new_job(name, **{"spec": {"model": "tube"}, **values})
        return JobRepository(session).submit(new).job.id


def new_job(name: str, spec: dict, **values) -> NewJob:
    return NewJob(name, spec, **{"version": "0", "spec_hash": "a" * 64, **values})


def claim(database: Database, owner: str = "d1", clock: Clock | None = None) -> Claim | None:
    with database.write_session() as session:
        return LeaseQueue(session, *([clock] if clock else [])).claim_job(owner)


def submit_and_claim(database: Database, n_runs: int = 1, **values) -> tuple[Claim, list[str]]:
    """A submitted and claimed job, and the identifiers of its runs."""
    submit(database, n_runs=n_runs, **values)
    got = claim(database)
    with database.write_session() as session:
        ledger = RunWriter(session, got.lease)
        ledger.create_runs(new_run(number=i, cell={"/seed": i}, seed=i) for i in range(n_runs))
        return got, [run.id for run in ledger.list_pending(limit=10_000)]


def new_run(number: int, **values) -> NewRun:
    given = {"cell": {}, "labels": {}, "method": "improved", "seed": 1, "sigma": 0.0, **values}
    return NewRun(number, **given)


def record_outcomes(
    database: Database, lease: Lease, *outcomes: RunOutcome, **evidence
) -> tuple[str, ...]:
    """End runs of a leased job; gives the identifiers of those that this ended."""
    with database.write_session() as session:
        return RunWriter(session, lease).record_outcomes(outcomes, **evidence)


def record_success(database: Database, lease: Lease, run_id: str, rms: float | None = None) -> None:
    """End a run of a leased job with success."""
    outcome = RunOutcome(run_id=run_id, state=JobState.SUCCEEDED, best_rms=rms)
    record_outcomes(database, lease, outcome)


def job_of(database: Database, job_id: str) -> Job:
    with database.read_session() as session:
        return JobRepository(session).get(job_id)


def parcels_of(database: Database, job_id: str) -> list[Parcel]:
    """The parcels of an open job, in order."""
    with database.read_session() as session:
        query = select(Parcel).where(Parcel.job_id == job_id).order_by(Parcel.first)
        return list(session.scalars(query))


def parcel_of(database: Database, job_id: str) -> Parcel:
    """The only parcel of an open job."""
    (parcel,) = parcels_of(database, job_id)
    return parcel


def state_of(database: Database, job_id: str) -> JobState:
    return job_of(database, job_id).state


def runs_of(database: Database, job_id: str) -> list[Run]:
    with database.read_session() as session:
        return list(RunRepository(session).list_page(job_id, limit=10_000).items)


def new_dataset(**values) -> NewDataset:
    given = {
        "name": "step",
        "kind": "upload",
        "sha256": "a" * 64,
        "source_key": "s1",
        "size_bytes": 10,
        "n_samples": 5,
        "duration": 1.0,
        "sample_time": 0.25,
        "channels": [{"name": "u", "unit": "V"}],
        "details": {"segments": [], "started_at": None, "warnings": []},
        **values,
    }
    return NewDataset(**given)
