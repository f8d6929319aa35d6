"""Summaries of stored results: rates of ended runs, bounds at one σ, nothing out of date."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.core.states import JobState
from service.queue.leases import Lease, LeaseQueue
from service.queue.run_writes import RunOutcome
from service.repositories.jobs import JobRepository
from service.sweeps.schemas import SummaryOut
from service.sweeps.summary import summarise_job
from tests.dispatching import Place
from tests.results import claim_job, conclude, write_results
from tests.stored import record_outcomes

AXES = [{"path": "/noise/sigma", "values": [0.1, 0.2]}, {"path": "/seed", "range": [0, 4]}]
FLOORS = {
    "axes": [],
    "note": "",
    "problems": [
        {
            "cell": {},
            "reference": {"kind": "truth", "run": None, "sigma": None, "values": {"L": 0.5}},
            "stderr": {"L": 2.0},
            "rms": 3.0,
            "note": "",
        }
    ],
}


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    made = Place(tmp_path / "data")
    yield made
    made.database.dispose()


def swept(place: Place) -> tuple[str, Lease, list[str]]:
    """A claimed noise sweep with bounds, and its runs: four for each of two σ."""
    job = place.submit(sweep={"axes": AXES})
    lease = claim_job(place.database, job)
    with place.database.write_session() as session:
        LeaseQueue(session).write_floors(lease, FLOORS)
    return job, lease, [run.id for run in place.runs(job)]


def summarise(place: Place, job: str, by: list[str] | None = None) -> SummaryOut:
    with place.database.read_session() as session:
        return summarise_job(session, job, by)


def fail(place: Place, lease: Lease, run: str) -> None:
    outcome = RunOutcome(run_id=run, state=JobState.FAILED, error="as told")
    record_outcomes(place.database, lease, outcome)


def test_the_rate_of_success_is_that_of_the_runs_that_have_ended(place: Place) -> None:
    job, lease, runs = swept(place)
    write_results(place.database, lease, {run: conclude(L=(0.5, 0.1)) for run in runs[:2]})
    fail(place, lease, runs[2])
    first, second = summarise(place, job).groups
    assert (first.runs, first.succeeded, first.failed) == (4, 2, 1)
    assert first.success_rate == pytest.approx(2 / 3)
    assert (second.runs, second.success_rate) == (4, 0.0)


def test_errors_are_from_the_reference_and_bounds_in_proportion_to_one_deviation(
    place: Place,
) -> None:
    job, lease, runs = swept(place)
    results = {run: conclude(L=(0.5 + 0.01 * n, 0.1 * n + 0.1)) for n, run in enumerate(runs)}
    write_results(place.database, lease, results)
    for group, sigma in zip(summarise(place, job).groups, (0.1, 0.2), strict=True):
        (parameter,) = group.parameters
        assert (group.sigma, group.rms_floor) == (sigma, pytest.approx(3.0 * sigma))
        assert parameter.floor == pytest.approx(2.0 * sigma)
        assert parameter.error == pytest.approx([value - 0.5 for value in parameter.value])
    (whole,) = summarise(place, job, []).groups
    assert (whole.sigma, whole.rms_floor, whole.parameters[0].floor) == (None, None, None)
    assert whole.parameters[0].stderr == pytest.approx(0.45)


def test_a_summary_of_an_ended_job_is_computed_again_after_it_was_resumed(place: Place) -> None:
    job, lease, runs = swept(place)
    write_results(place.database, lease, {run: conclude(L=(0.5, 0.1)) for run in runs[1:]})
    fail(place, lease, runs[0])
    with place.database.write_session() as session:
        LeaseQueue(session).finish_job(lease, JobState.FAILED, "one is missing")
    for _ in range(2):  # the second one comes from the cache
        assert [group.failed for group in summarise(place, job).groups] == [1, 0]
    with place.database.write_session() as session:
        JobRepository(session).resume(job)
    again = claim_job(place.database, job)
    write_results(place.database, again, {runs[0]: conclude(L=(0.5, 0.1))})
    with place.database.write_session() as session:
        LeaseQueue(session).finish_job(again, JobState.SUCCEEDED)
    assert [group.succeeded for group in summarise(place, job).groups] == [4, 4]
