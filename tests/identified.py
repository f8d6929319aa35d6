"""Jobs that are carried out in this process: queue, workers' code and ledger, without Ray."""

from datetime import timedelta
from typing import Any

from service.api.dependencies import Parts
from service.dispatch.cramer_rao import floors_for
from service.dispatch.job_runs import JobRuns
from service.dispatch.recorder import Recorder
from service.jobs import submit as jobs
from service.jobs.schemas import JobIn
from service.queue.leases import Queue
from service.repositories.runs import RunRepository
from workers.feeding import Feeder
from workers.inline import InlineCrew


def identified(parts: Parts, body: dict[str, Any], steps: int = 5000) -> tuple[str, list[str]]:
    """Submit a job and carry it out; gives its id and those of its runs."""
    job = jobs.submit_to(parts.database, JobIn.model_validate(body), parts.settings).id
    return job, carried_out(parts, job, steps)


def carried_out(parts: Parts, job: str, steps: int = 5000) -> list[str]:
    """Carry out a job that waits; gives the ids of its runs."""
    with parts.database.write() as session:
        claim = Queue(session).claim("test", timedelta(hours=1))
        while claim is not None and claim.job.id != job:  # others that wait are left claimed
            claim = Queue(session).claim("test", timedelta(hours=1))
    assert claim is not None
    source = JobRuns(parts.database, claim, parts.store)
    floors = floors_for(parts.database, claim, source)
    recorder = Recorder(parts.database, claim, source.save, source.failed)
    feeder: Feeder[str] = Feeder(InlineCrew())
    feeder.add(job, source, recorder)
    for _ in range(steps):
        if feeder.step(0.05):
            recorder.store()
            recorder.finish(None if floors is None else list(floors())[-1])
            break
    with parts.database.read() as session:
        return [run.id for run in RunRepository(session).page(job, limit=100).items]
