"""Runs that kill their workers, want too much memory, diverge; jobs that are cancelled."""

import pytest

from benchmarks.breaking.work import DEADLY, GREEDY
from service.client.calls import ProblemError
from service.core.states import JobState
from tests.support.service.whole_service import Service

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(400)]


def test_runs_that_kill_workers_or_take_all_memory_fail_with_that_reason_and_the_others_go_on(
    service: Service,
) -> None:
    deadly, greedy = DEADLY[0], GREEDY[0]
    seeds = {"path": "/seed", "values": [1, 2, 3, deadly, 5, 6, greedy, 8, 9, 10]}
    job = service.wait_for_end(service.submit(sweep={"axes": [seeds]}))
    runs = {run.seed: run for run in service.list_runs(job.id)}
    killer, eater = runs.pop(deadly), runs.pop(greedy)
    assert (killer.state, killer.kills) == (JobState.FAILED, 2)
    assert (killer.error or "").startswith("its worker process died 2 times")
    assert eater.state is JobState.FAILED
    assert (eater.error or "").startswith("it needs more memory than a worker may use")
    assert {run.state for run in runs.values()} == {JobState.SUCCEEDED}
    assert {run.kills for run in runs.values()} <= {0, 1}
    assert (job.state, job.n_done, job.n_failed) == (JobState.INCOMPLETE, 10, 2)


def test_a_model_that_diverges_in_half_of_its_cells_ends_with_the_other_half(
    service: Service,
) -> None:
    cells = [{"fixed": 5.0}, {"lower": -1e9, "upper": 10.0, "fixed": -1e8}]
    axes = [{"path": "/parameters/b", "values": cells}, {"path": "/seed", "values": [1, 2, 3]}]
    job = service.wait_for_end(service.submit(sweep={"axes": axes}))
    states = [run.state for run in service.list_runs(job.id)]
    assert states == [JobState.SUCCEEDED] * 3 + [JobState.FAILED] * 3
    assert "diverged" in (service.list_runs(job.id)[-1].error or "")
    assert (job.state, job.n_failed) == (JobState.INCOMPLETE, 3)


def test_a_running_job_is_cancelled_with_what_it_has(service: Service) -> None:
    job = service.submit_endless()
    service.stand.client.cancel(job)
    assert service.wait_for_end(job).state is JobState.CANCELLED
    assert [run.state for run in service.list_runs(job)] == [JobState.CANCELLED]


def test_an_ended_job_cannot_be_cancelled(service: Service) -> None:
    job = service.submit()
    assert service.wait_for_end(job).state is JobState.SUCCEEDED
    with pytest.raises(ProblemError, match="only a queued or running job"):
        service.stand.client.cancel(job)
