"""Jobs that are carried out in this process: queue, workers' code and ledger, without Ray."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple

from starlette.testclient import TestClient

from service.api.app import create_app
from service.api.requests.dependencies import Parts
from service.dispatch.encoding import describe_program
from service.dispatch.job_runs import JobRuns
from service.dispatch.recorder import RunRecorder
from service.dispatch.run_cramer_rao import build_bounds_maker
from service.jobs import submit
from service.jobs.job_schemas import JobIn
from service.queue.leases import LeaseQueue, ProgramOfJob
from service.repositories.run_rows import RunRepository
from tests.support.cluster.inline_executor import InlineExecutor
from tests.support.service.web_app import parts_of, recording, settings_of, store_csv
from workers.scheduler import Scheduler


class ServedRun(NamedTuple):
    """A server with one job, and its only run."""

    server: TestClient
    body: dict[str, Any]
    job: str
    run: str


@contextmanager
def serve_run(folder: Path, **changes: Any) -> Iterator[ServedRun]:
    """Serve one run of `fopdt` on a held input with noise; `changes` are fields of its job."""
    with TestClient(create_app(settings_of(folder))) as server:
        body = {
            "model": "fopdt",
            "datasets": [store_csv(server, recording())],
            "algorithm": {"population": 20, "generations": 60, "islands": 1},
            "noise": {"sigma": 0.05},
            "hold": {"u": "zero"},
            **changes,
        }
        job, (run,) = identify_job(parts_of(server), body)
        yield ServedRun(server, body, job, run)


def identify_job(parts: Parts, body: dict[str, Any], steps: int = 5000) -> tuple[str, list[str]]:
    """Submit a job and carry it out; gives its id and those of its runs."""
    job = submit.submit_job(parts.database, JobIn.model_validate(body), parts.settings).id
    return job, carry_out_job(parts, job, steps)


def carry_out_job(parts: Parts, job: str, steps: int = 5000) -> list[str]:
    """Carry out a job that waits; gives the ids of its runs."""
    with parts.database.write_session() as session:
        program, hour = ProgramOfJob(**describe_program()), timedelta(hours=1)
        claim = LeaseQueue(session).claim_job("test", hour, program=program)
        while claim is not None and claim.job.id != job:  # others that wait are left claimed
            claim = LeaseQueue(session).claim_job("test", hour, program=program)
    assert claim is not None
    source = JobRuns(parts.database, claim, parts.store)
    cramer_rao = build_bounds_maker(parts.database, source.parts)
    recorder = RunRecorder(
        parts.database, claim, parts.store, source.parts.encoder, source.parts.warm.record_end
    )
    feeder: Scheduler[str] = Scheduler(InlineExecutor())
    feeder.add_job(job, source, recorder)
    for _ in range(steps):
        if feeder.run_step(0.05):
            recorder.write_all()
            recorder.finish_job(None if cramer_rao is None else list(cramer_rao())[-1])
            break
    with parts.database.read_session() as session:
        return [run.id for run in RunRepository(session).list_page(job, limit=100).items]
