"""Runs of a large sweep are made while it runs: none lost, none doubled, and all as submitted."""

from datetime import timedelta

import pytest
from sqlalchemy import func, select, update

from service.core.states import JobState
from service.dispatch import job_runs
from service.dispatch.job_runs import JobRuns
from service.jobs import submit
from service.jobs.job_schemas import JobIn
from service.queue.leases import LeaseOwners, LeaseQueue
from service.queue.run_writes import RunWriter
from service.repositories.job_rows import JobRepository
from service.runs.runs import RunQuery, list_runs
from service.storage.storage_errors import RowConflict
from service.storage.tables import Dataset, Run
from service.sweeps.groups import GroupKey, SweepGroups
from service.sweeps.job_summary import load_groups
from service.sweeps.summary import summarise_job
from tests.support.cluster.dispatch_place import Place, carry_out
from tests.support.cluster.inline_executor import InlineExecutor

pytestmark = pytest.mark.slow

SMALL = {"population": 8, "generations": 3, "islands": 1, "refine": False}
AXES = [
    {"path": "/noise/sigma", "values": [0.0, 0.01, 0.3], "labels": [{"x": 1}, {"x": 2}, {"x": 1}]},
    {"path": "/seed", "range": [3, 5]},
]
SWEEP = {"algorithm": SMALL, "sweep": {"axes": AXES}}
AT_ONCE, N_RUNS = 3, 6


@pytest.fixture
def few_at_once(monkeypatch):
    monkeypatch.setattr(submit, "CELLS_AT_SUBMISSION", AT_ONCE)
    monkeypatch.setattr(job_runs, "CHUNK_ROWS", 2)


@pytest.fixture
def place(tmp_path, database, few_at_once):
    return Place(tmp_path / "data", database)


@pytest.fixture
def sqlite_place(tmp_path, sqlite_database, few_at_once):
    """For what is computed, whichever database keeps it."""
    return Place(tmp_path / "data", sqlite_database)


def claim(place, owner="d1"):
    with place.database.write_session() as session:
        return LeaseQueue(session).claim_job(owner)


def lose(place, claim):
    with place.database.write_session() as session:
        LeaseQueue(session).reap_expired(LeaseOwners(ended=frozenset({claim.lease.owner})))


def make_source(place, claim):
    return JobRuns(place.database, claim, place.store)


def list_cells(place, job):
    return [
        (run.number, run.cell, run.labels, run.seed, run.sigma, run.method)
        for run in place.runs(job)
    ]


def submit_whole(place, monkeypatch, **body):
    """A job whose runs are all made at submission."""
    with monkeypatch.context() as patched:
        patched.setattr(submit, "CELLS_AT_SUBMISSION", 1000)
        return place.submit(**body)


def numbers_found(run):
    return run.state, run.best_rms, run.evaluations, run.estimates, run.spec_hash


def test_a_submission_makes_the_first_runs_and_the_dispatcher_the_others(place, monkeypatch):
    whole = submit_whole(place, monkeypatch, **SWEEP)
    lazily = place.submit(**SWEEP)
    assert len(place.runs(lazily)) == AT_ONCE
    assert place.job(lazily).n_runs == len(place.runs(whole)) == N_RUNS
    carry_out(place, lazily, InlineExecutor())
    assert place.job(lazily).state is JobState.SUCCEEDED
    assert list_cells(place, lazily) == list_cells(place, whole)


def carry_out_both(place, monkeypatch, **body):
    """A job whose runs were all made at submission, and one whose runs were not."""
    jobs = submit_whole(place, monkeypatch, **body), place.submit(**body)
    for job in jobs:
        carry_out(place, job, InlineExecutor())
    return jobs


def test_results_are_those_of_a_job_whose_runs_were_all_made_at_submission(
    sqlite_place, monkeypatch
):
    whole, lazily = carry_out_both(sqlite_place, monkeypatch, **SWEEP)
    found = [[numbers_found(run) for run in sqlite_place.runs(job)] for job in (whole, lazily)]
    assert found[0] == found[1]
    assert all(state is JobState.SUCCEEDED for state, *_ in found[1])


def test_a_chain_of_warm_starts_goes_on_over_runs_that_are_made_later(sqlite_place, monkeypatch):
    chained = {**SWEEP, "warm_start": "previous"}
    whole, lazily = carry_out_both(sqlite_place, monkeypatch, **chained)
    assert [run.estimates for run in sqlite_place.runs(lazily)] == [
        run.estimates for run in sqlite_place.runs(whole)
    ]


def test_what_was_computed_before_is_taken_over_also_by_runs_that_are_made_later(sqlite_place):
    carry_out(sqlite_place, sqlite_place.submit(**SWEEP), InlineExecutor())
    second = sqlite_place.submit(**SWEEP, reuse=True)
    carry_out(sqlite_place, second, InlineExecutor())
    assert sqlite_place.job(second).n_reused == N_RUNS


def test_another_dispatcher_goes_on_making_runs_where_the_first_one_stopped(place, monkeypatch):
    whole, job = submit_whole(place, monkeypatch, **SWEEP), place.submit(**SWEEP)
    assert claim(place).job.id == whole
    first = claim(place, "first")
    coming = make_source(place, first).iterate_runs()
    seen = [next(coming).run for _ in range(AT_ONCE + 1)]
    made = [run.id for run in place.runs(job)]
    assert len(made) == AT_ONCE + 1  # to the end of the chunk
    lose(place, first)
    second = claim(place, "second")
    again = [one.run for one in make_source(place, second).iterate_runs()]
    # The first one learns that it has lost the lease.
    assert list(coming) == []
    assert again[: len(made)] == made
    assert seen == made[: len(seen)]
    assert list_cells(place, job) == list_cells(place, whole)
    assert len(set(again)) == N_RUNS


def test_a_transaction_that_fails_makes_no_runs_and_the_next_one_makes_them(place, monkeypatch):
    job = place.submit(**SWEEP)
    runs = make_source(place, claim(place))
    create = RunWriter.create_runs

    def broken(ledger, made):
        create(ledger, made)
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(RunWriter, "create_runs", broken)
        with pytest.raises(MemoryError):
            list(runs.iterate_runs())
    assert len(place.runs(job)) == AT_ONCE
    assert len(list(runs.iterate_runs())) == N_RUNS
    assert [run.number for run in place.runs(job)] == list(range(N_RUNS))


def test_two_sources_of_one_lease_make_each_run_once(place):
    job = place.submit(**SWEEP)
    got = claim(place)
    both = [make_source(place, got).iterate_runs() for _ in range(2)]
    for _ in range(N_RUNS):
        assert len({next(coming).run for coming in both}) == 1
    assert [run.number for run in place.runs(job)] == list(range(N_RUNS))


def test_a_job_cannot_succeed_before_all_its_runs_are_made(place):
    place.submit(**SWEEP)
    got = claim(place)
    with place.database.write_session() as session:
        of_job = update(Run).where(Run.job_id == got.job.id)
        session.execute(of_job.values(state=JobState.SUCCEEDED))
    left = N_RUNS - AT_ONCE
    said = f"{left} of its runs did not finish"
    with pytest.raises(RowConflict, match=said), place.database.write_session() as session:
        LeaseQueue(session).finish_job(got.lease, JobState.SUCCEEDED)


def test_a_cancelled_job_is_resumed_with_the_runs_that_were_never_made(place, monkeypatch):
    whole, job = submit_whole(place, monkeypatch, **SWEEP), place.submit(**SWEEP)
    place.cancel(whole)
    place.cancel(job)
    assert len(place.runs(job)) == AT_ONCE
    with place.database.read_session() as session:
        cancelled = place.job(job)
        (group,) = load_groups(session, cancelled, SweepGroups(cancelled.spec, [], 10))
    assert group.states[JobState.CANCELLED] == N_RUNS
    with place.database.write_session() as session:
        submit.resume_job(session, job, place.settings)
    carry_out(place, job, InlineExecutor())
    assert place.job(job).state is JobState.SUCCEEDED
    assert list_cells(place, job) == list_cells(place, whole)


def test_a_clone_has_the_same_cells(place):
    job = place.submit(**SWEEP)
    other = submit.clone_job(place.database, job, place.settings).id
    assert place.job(other).n_runs == N_RUNS
    for one in (job, other):
        assert len(list(make_source(place, claim(place)).iterate_runs())) == N_RUNS, one
    assert list_cells(place, other) == list_cells(place, job)


@pytest.mark.parametrize(
    "by", [[], ["/noise/sigma"], ["/seed"], ["x"], ["x", "/seed"], ["/seed", "/noise/sigma"]]
)
def test_groups_count_runs_that_are_not_made_yet_as_queued(place, monkeypatch, by):
    whole, job = submit_whole(place, monkeypatch, **SWEEP), place.submit(**SWEEP)
    keys = [GroupKey("label" if one == "x" else "axis", one) for one in by]
    with place.database.read_session() as session:
        expected, found = (
            load_groups(session, one, SweepGroups(one.spec, keys, 100))
            for one in (place.job(whole), place.job(job))
        )
        told = summarise_job(session, job, by)
    assert [(one.key, one.first_number, one.states) for one in found] == [
        (one.key, one.first_number, one.states) for one in expected
    ]
    assert sum(one.runs for one in told.groups) == told.runs == N_RUNS


def test_a_list_of_runs_has_those_that_are_made_and_progress_counts_all(sqlite_place):
    job = sqlite_place.submit(**SWEEP)
    with sqlite_place.database.read_session() as session:
        listed = list_runs(session, job, None, 100, RunQuery())
        progress = submit.describe_job(session, JobRepository(session).get(job)).progress
        made = session.scalar(select(func.count()).where(Run.job_id == job))
        assert made == len(listed.items) == AT_ONCE
    assert (progress.runs, progress.finished) == (N_RUNS, 0)


def test_what_a_name_means_is_settled_at_submission(sqlite_place):
    axes = [{"path": "/datasets", "values": [["steps"]] * 5}]
    job = sqlite_place.submit(algorithm=SMALL, sweep={"axes": axes})
    with sqlite_place.database.write_session() as session:
        session.get(Dataset, sqlite_place.dataset).name = "another name"
    carry_out(sqlite_place, job, InlineExecutor())
    told = {"/datasets": [sqlite_place.dataset]}
    assert [run.cell for run in sqlite_place.runs(job)] == [told] * 5
    assert sqlite_place.job(job).state is JobState.SUCCEEDED


def test_names_inside_objects_and_lists_are_settled_too(sqlite_place):
    axes = [
        {"path": "/validation", "values": [None, {"fraction": 0.5}]},
        {"path": "/datasets/0", "values": ["steps"]},
        {"path": "/algorithm", "values": [SMALL]},
    ]
    spec = sqlite_place.job(sqlite_place.submit(sweep={"axes": axes})).spec
    stored = [axis["values"] for axis in spec["sweep"]["axes"]]
    assert stored[:2] == [[None, {"datasets": None, "fraction": 0.5}], [sqlite_place.dataset]]
    whole = JobIn(model="m", datasets=["d"], algorithm=SMALL).to_normal_form()
    assert stored[2] == [whole["algorithm"]]


def test_a_lease_that_has_expired_makes_nothing(place):
    job = place.submit(**SWEEP)
    with place.database.write_session() as session:
        got = LeaseQueue(session).claim_job("late", timedelta(seconds=0))
    lose(place, got)
    assert list(make_source(place, got).iterate_runs()) == []
    assert len(place.runs(job)) == AT_ONCE
