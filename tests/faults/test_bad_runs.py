"""Runs that kill their workers, want too much memory, diverge; jobs cancelled in every state."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from benchmarks import paper_example
from benchmarks.breaking.audit import is_over
from benchmarks.breaking.stand import Stand, standing_service, until
from service.client.calls import ProblemError
from service.core.states import JobState
from service.storage.tables import Job, Run

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(400)]

DEADLY, GREEDY = 13, 77
LIMIT_SECONDS = 200.0
ENDLESS = {"generations": 10_000_000, "stop": {"settled": None}}


class Service:
    """A standing service with one dataset; while `broken` is there, without a dispatcher."""

    def __init__(self, stand: Stand, dataset: str, broken: Path) -> None:
        self.stand, self.dataset, self.broken = stand, dataset, broken

    def submit(self, **body: Any) -> str:
        common = {"model": "duffing-eq16", "datasets": [self.dataset], "reuse": False}
        return str(self.stand.client.submit({**common, **body})["id"])

    def end(self, job: str) -> Job:
        until(lambda: is_over(self.stand, job), f"{job} ended", LIMIT_SECONDS)
        return self.job(job)

    def job(self, job: str) -> Job:
        with self.stand.database.read_session() as session:
            return session.get_one(Job, job)

    def runs(self, job: str) -> list[Run]:
        with self.stand.database.read_session() as session:
            query = select(Run).where(Run.job_id == job).order_by(Run.number)
            return list(session.scalars(query))


@pytest.fixture(scope="module")
def waiting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The service before its dispatcher can start."""
    folder = tmp_path_factory.mktemp("bad")
    broken = folder / "broken"
    broken.touch()
    environment = {
        "BREAK_SEEDS": str(DEADLY),
        "BREAK_MEMORY": str(GREEDY),
        "LAGID_WORKER_MEMORY_MB": "512",
        "BREAK_RAY": str(broken),
    }
    with standing_service(Stand(folder / "data", environment=environment), wait=False) as stand:
        until(lambda: stand.answers() == 200, "the web answered", LIMIT_SECONDS)
        path = paper_example.write_csv(folder / "record.csv", seed=1)
        yield Service(stand, stand.client.add_dataset(path, name="example 1")["id"], broken)
        stand.stop()
        assert stand.leftovers() == []


@pytest.fixture
def service(waiting: Service) -> Service:
    """The service with its dispatcher, or soon."""
    waiting.broken.unlink(missing_ok=True)
    return waiting


def test_a_queued_job_is_cancelled_at_once_and_stays_so(waiting: Service) -> None:
    job = waiting.submit(algorithm=ENDLESS)
    assert waiting.stand.client.cancel(job)["state"] == "cancelled"
    assert waiting.stand.client.cancel(job)["state"] == "cancelled"
    assert [run.state for run in waiting.runs(job)] == [JobState.CANCELLED]


def test_a_run_that_kills_its_worker_fails_with_that_reason_and_the_others_go_on(
    service: Service,
) -> None:
    seeds = {"path": "/seed", "values": list(range(1, 31))}
    job = service.end(service.submit(sweep={"axes": [seeds]}))
    runs = {run.seed: run for run in service.runs(job.id)}
    killer = runs.pop(DEADLY)
    assert (killer.state, killer.kills) == (JobState.FAILED, 2)
    assert (killer.error or "").startswith("its worker process died 2 times")
    assert {run.state for run in runs.values()} == {JobState.SUCCEEDED}
    assert {run.kills for run in runs.values()} <= {0, 1}
    assert (job.state, job.n_done, job.n_failed) == (JobState.SUCCEEDED, 30, 1)


def test_a_run_that_wants_too_much_memory_fails_and_the_others_go_on(service: Service) -> None:
    seeds = {"path": "/seed", "values": [1, 2, GREEDY, 4, 5]}
    job = service.end(service.submit(sweep={"axes": [seeds]}))
    runs = {run.seed: run for run in service.runs(job.id)}
    greedy = runs.pop(GREEDY)
    assert greedy.state is JobState.FAILED
    assert (greedy.error or "").startswith("it needs more memory than a worker may use")
    assert {run.state for run in runs.values()} == {JobState.SUCCEEDED}
    assert (job.state, job.n_failed) == (JobState.SUCCEEDED, 1)


def test_a_model_that_diverges_in_half_of_its_cells_ends_with_the_other_half(
    service: Service,
) -> None:
    cells = [{"fixed": 5.0}, {"lower": -1e9, "upper": 10.0, "fixed": -1e8}]
    axes = [{"path": "/parameters/b", "values": cells}, {"path": "/seed", "values": [1, 2, 3]}]
    job = service.end(service.submit(sweep={"axes": axes}))
    states = [run.state for run in service.runs(job.id)]
    assert states == [JobState.SUCCEEDED] * 3 + [JobState.FAILED] * 3
    assert "diverged" in (service.runs(job.id)[-1].error or "")
    assert (job.state, job.n_failed) == (JobState.SUCCEEDED, 3)


def test_a_running_job_is_cancelled_with_what_it_has(service: Service) -> None:
    job = service.submit(algorithm=ENDLESS)
    until(lambda: service.job(job).evaluations > 0, "progress", LIMIT_SECONDS)
    service.stand.client.cancel(job)
    assert service.end(job).state is JobState.CANCELLED
    assert [run.state for run in service.runs(job)] == [JobState.CANCELLED]


def test_a_job_cancelled_while_its_dispatcher_is_dead_is_not_taken_up_again(
    service: Service,
) -> None:
    job = service.submit(algorithm=ENDLESS)
    until(lambda: service.job(job).evaluations > 0, "progress", LIMIT_SECONDS)
    for pid in service.stand.family.dispatchers():
        os.kill(pid, signal.SIGKILL)
    service.stand.client.cancel(job)
    ended = service.end(job)
    assert (ended.state, ended.attempt) == (JobState.CANCELLED, 1)


def test_an_ended_job_cannot_be_cancelled(service: Service) -> None:
    job = service.submit()
    assert service.end(job).state is JobState.SUCCEEDED
    with pytest.raises(ProblemError, match="only a queued or running job"):
        service.stand.client.cancel(job)
