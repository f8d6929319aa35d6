"""Summaries of stored results: rates of ended runs, bounds at one σ, nothing out of date."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest

from service.core import computed
from service.core.errors import InvalidRequest
from service.core.states import JobState
from service.dispatch import job_end
from service.dispatch.job_runs import JobRuns
from service.queue.leases import Claim, Lease, LeaseQueue
from service.queue.run_writes import RunOutcome
from service.repositories.job_rows import JobRepository
from service.storage.sessions import Database
from service.storage.storage_errors import LeaseLost
from service.storage.tables import StoredSummary
from service.sweeps import job_summary, summary
from service.sweeps.sweep_schemas import SummaryOut
from tests.support.cluster.dispatch_place import Place
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.databases import record_statements
from tests.support.storage.job_rows import record_outcomes
from tests.support.storage.run_results import claim_job, conclude, write_results

AXES = [{"path": "/noise/sigma", "values": [0.1, 0.2]}, {"path": "/seed", "range": [0, 4]}]
CRAMER_RAO = {
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
def stored_place(tmp_path: Path, database: Database, monkeypatch: pytest.MonkeyPatch) -> Place:
    """A place where the summaries of all jobs are stored, and none is remembered."""
    monkeypatch.setattr(job_summary, "STORED_RUNS", 1)
    monkeypatch.setattr(job_end, "STORED_RUNS", 1)
    forget(monkeypatch)
    return Place(tmp_path / "data", database)


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a new process."""
    monkeypatch.setattr(job_summary, "_summaries", computed.ComputedValues(8))
    monkeypatch.setattr(job_summary, "_tables", computed.ComputedValues(2))


def swept(place: Place) -> tuple[str, Lease, list[str]]:
    """A claimed noise sweep with bounds, and its runs: four for each of two σ."""
    job = place.submit(sweep={"axes": AXES})
    lease = claim_job(place.database, job)
    with place.database.write_session() as session:
        LeaseQueue(session).write_cramer_rao(lease, CRAMER_RAO)
    return job, lease, [run.id for run in place.runs(job)]


def summarise(place: Place, job: str, by: list[str] | None = None) -> SummaryOut:
    with place.database.read_session() as session:
        return summary.summarise_job(session, job, by)


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
        assert (group.sigma, group.rms_cramer_rao_bound) == (sigma, pytest.approx(3.0 * sigma))
        assert parameter.cramer_rao_bound == pytest.approx(2.0 * sigma)
        assert parameter.error == pytest.approx([value - 0.5 for value in parameter.value])
    (whole,) = summarise(place, job, []).groups
    assert (whole.sigma, whole.rms_cramer_rao_bound, whole.parameters[0].cramer_rao_bound) == (
        None,
        None,
        None,
    )
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


def end_noise_sweep(place: Place) -> tuple[str, Lease, list[str]]:
    """A noise sweep whose runs have ended: one failed, the others with different estimates."""
    job, lease, runs = swept(place)
    results = {run: conclude(L=(0.5 + 0.01 * n, 0.1 + 0.1 * n)) for n, run in enumerate(runs[1:])}
    write_results(place.database, lease, results)
    fail(place, lease, runs[0])
    return job, lease, runs


def finish(place: Place, lease: Lease, state: JobState = JobState.SUCCEEDED) -> None:
    with place.database.write_session() as session:
        LeaseQueue(session).finish_job(lease, state)


def summarise_without_runs(place: Place, job: str) -> SummaryOut:
    """The summary of a job, which must not look at its runs."""
    with record_statements(place.database) as statements:
        told = summarise(place, job)
    assert not [one for one, _ in statements if "FROM runs" in one]
    return told


def test_readers_that_hold_all_connections_get_and_store_one_summary(
    stored_place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None of them may wait for the one that computes, and hold what it needs to store."""
    job, lease, _ = end_noise_sweep(stored_place)
    finish(stored_place, lease)
    url = stored_place.database.engine.url.render_as_string(hide_password=False)
    few = Database(url, pool_size=2, max_overflow=0, pool_timeout=LIMIT_SECONDS)
    both = Barrier(2)

    def read() -> int:
        with few.read_session() as session:
            row = JobRepository(session).get(job)
            both.wait(LIMIT_SECONDS)
            return len(job_summary.load_summary(session, row).groups)

    with ThreadPoolExecutor() as threads:
        assert [one.result() for one in [threads.submit(read) for _ in range(2)]] == [2, 2]
    few.dispose()
    with stored_place.database.read_session() as session:
        assert session.get(StoredSummary, job) is not None


def test_a_dispatcher_stores_what_the_first_reader_would_compute(
    stored_place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = stored_place
    job, lease, _ = end_noise_sweep(place)
    claim = Claim(lease, place.job(job), range(place.job(job).n_runs))
    maker = job_end.build_end_maker(
        place.database, claim.lease, JobRuns(place.database, claim, place.store).parts
    )
    assert maker is not None
    *_, cramer_rao = maker()
    assert cramer_rao is not None
    assert cramer_rao["axes"] == []
    finish(place, lease)
    stored = summarise_without_runs(place, job)
    with place.database.write_session() as session:
        session.delete(session.get_one(StoredSummary, job))
    forget(monkeypatch)
    assert summarise(place, job) == stored
    assert [group.failed for group in stored.groups] == [1, 0]


def test_the_first_reader_of_an_ended_job_stores_what_it_has_computed(
    stored_place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, lease, _ = end_noise_sweep(stored_place)
    finish(stored_place, lease, JobState.CANCELLED)
    first = summarise(stored_place, job)
    forget(monkeypatch)
    assert summarise_without_runs(stored_place, job) == first


def test_nothing_is_stored_of_a_job_that_runs_or_was_lost(stored_place: Place) -> None:
    job, lease, _ = end_noise_sweep(stored_place)
    summarise(stored_place, job)
    with pytest.raises(LeaseLost):
        job_summary.store_summary(stored_place.database, Lease(job, lease.attempt + 1, "late"))
    with stored_place.database.read_session() as session:
        assert session.get(StoredSummary, job) is None


def test_what_was_stored_of_a_job_is_forgotten_when_it_is_resumed(
    stored_place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, lease, _ = end_noise_sweep(stored_place)
    finish(stored_place, lease, JobState.FAILED)
    assert summarise(stored_place, job).groups[0].failed == 1
    with stored_place.database.write_session() as session:
        JobRepository(session).resume(job)
        assert session.get(StoredSummary, job) is None
        JobRepository(session).cancel(job)
    forget(monkeypatch)
    group, _ = summarise(stored_place, job).groups
    assert (group.runs, group.failed, group.succeeded) == (4, 0, 3)


def test_too_many_groups_are_refused_before_a_run_is_read(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, _, _ = swept(place)
    monkeypatch.setattr(summary, "MAX_GROUPS", 3)
    with (
        record_statements(place.database) as statements,
        pytest.raises(InvalidRequest, match="more than 3 groups"),
    ):
        summarise(place, job, ["/seed"])
    assert not [one for one, _ in statements if "FROM runs" in one]
    assert len(summarise(place, job, ["/noise/sigma"]).groups) == 2


def test_a_summary_that_takes_long_is_used_again_while_the_job_runs(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, lease, (first, second, *_) = swept(place)
    assert summarise(place, job).groups[0].succeeded == 0
    write_results(place.database, lease, {first: conclude(L=(0.5, 0.1))})
    assert summarise(place, job).groups[0].succeeded == 1  # it took less than that
    monkeypatch.setattr(computed, "FRESH_SECONDS", 0.0)
    monkeypatch.setattr(computed, "REUSE_FACTOR", 1e9)
    write_results(place.database, lease, {second: conclude(L=(0.5, 0.1))})
    assert summarise_without_runs(place, job).groups[0].succeeded == 1
    monkeypatch.setattr(computed, "REUSE_FACTOR", 0.0)
    assert summarise(place, job).groups[0].succeeded == 2


def test_readers_that_come_at_once_compute_a_summary_once(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, lease, _ = end_noise_sweep(place)
    finish(place, lease)
    with record_statements(place.database) as statements, ThreadPoolExecutor(4) as pool:
        told = list(pool.map(lambda _: summarise(place, job), range(8)))
    assert told == [told[0]] * 8
    assert len([one for one, _ in statements if "FROM runs" in one and "estimates" in one]) == 1
