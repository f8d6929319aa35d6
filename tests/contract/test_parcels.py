"""One job in several parcels: dispatchers share it, and it holds what holds for a job in one."""

import threading
from datetime import timedelta

import pytest
from sqlalchemy import select

from service.core.states import JobState
from service.dispatch import dispatcher, held_jobs
from service.dispatch.dispatcher import Dispatcher
from service.dispatch.held_leases import HeldLeases
from service.queue.leases import Claim, JobProgress, LeaseOwners, LeaseQueue
from service.queue.notifications import read_queue_status
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.event_rows import EventRepository
from service.repositories.job_rows import JobRepository
from service.storage.storage_errors import LeaseLost, RowConflict
from service.storage.tables import Checkpoint
from tests.support.cluster.dispatch_place import Place, carry_out
from tests.support.cluster.inline_executor import InlineExecutor
from tests.support.storage.job_rows import (
    job_of,
    new_run,
    parcels_of,
    record_outcomes,
    runs_of,
    state_of,
    submit,
)
from tests.support.storage.run_results import conclude, write_results

N_RUNS, SIZE = 10, 4
SMALL = {"population": 8, "generations": 3, "islands": 1, "refine": False}
SWEEP = {"algorithm": SMALL, "sweep": {"axes": [{"path": "/seed", "range": [0, N_RUNS]}]}}
CHAIN = {**SWEEP, "warm_start": "previous"}


def claim(database, owner, size=SIZE) -> Claim | None:
    with database.write_session() as session:
        return LeaseQueue(session).claim_job(owner, choose_size=lambda job: size)


@pytest.fixture
def shared_job(database):
    """A job of which two dispatchers hold four runs each, and two runs wait."""
    submit(database, n_runs=N_RUNS)
    first, second = claim(database, "d1"), claim(database, "d2")
    for one in (first, second):
        with database.write_session() as session:
            RunWriter(session, one.lease).create_runs(new_run(number=n) for n in one.runs)
    return first, second


def pending(database, got: Claim):
    with database.write_session() as session:
        return RunWriter(session, got.lease).list_pending()


def end_runs(database, got: Claim, state=JobState.SUCCEEDED) -> None:
    ended = [RunOutcome(run_id=run.id, state=state) for run in pending(database, got)]
    record_outcomes(database, got.lease, *ended)


def end_parcel(database, got: Claim) -> bool:
    with database.write_session() as session:
        return LeaseQueue(session).end_parcel(got.lease)


def reap(database, *owners: str):
    with database.write_session() as session:
        return LeaseQueue(session).reap_expired(LeaseOwners(ended=frozenset(owners)))


def list_states(database, job: str) -> list[str]:
    with database.read_session() as session:
        events = EventRepository(session).list_after(job, 0)
        return [event.data["state"] for event in events if event.kind == "state"]


def test_claims_divide_a_job_and_each_has_a_token_of_its_own(database):
    job = submit(database, n_runs=N_RUNS)
    got = [claim(database, owner) for owner in ("d1", "d2", "d1")]
    assert [one.runs for one in got] == [range(4), range(4, 8), range(8, 10)]
    assert [one.lease.attempt for one in got] == [1, 2, 3]
    assert all(one.is_new for one in got)
    assert claim(database, "d2") is None
    assert list_states(database, job) == ["queued", "running"]


def test_a_lost_parcel_is_given_back_alone_and_its_holder_writes_nothing_more(database, shared_job):
    first, second = shared_job
    assert reap(database, "d1").requeued == (first.job.id,)
    assert state_of(database, first.job.id) is JobState.RUNNING
    with pytest.raises(LeaseLost):
        end_runs(database, first)
    end_runs(database, second)
    again = claim(database, "d3")
    assert (again.runs, again.is_new, again.lease.attempt) == (first.runs, False, 3)
    assert [run.number for run in pending(database, again)] == list(first.runs)


def test_the_progress_of_a_job_is_the_sum_over_its_parcels(database, shared_job):
    first, second = shared_job

    def report(got, evaluations, generation):
        with database.write_session() as session:
            LeaseQueue(session).write_progress(got.lease, JobProgress(evaluations, generation))
        job = job_of(database, got.job.id)
        return job.evaluations, job.generation

    assert report(first, 100, 7) == (100, 7)
    assert report(second, 50, 3) == (150, 7)
    assert report(first, 120, 8) == (170, 8)
    reap(database, "d1")
    assert report(claim(database, "d3"), 30, 2) == (80, 8)  # from the checkpoints on
    end_runs(database, second)
    assert job_of(database, second.job.id).n_done == len(second.runs)


def test_the_last_parcel_ends_the_job_and_only_it(database, shared_job):
    first, second = shared_job
    third = claim(database, "d1")
    with database.write_session() as session:
        RunWriter(session, third.lease).create_runs(new_run(number=n) for n in third.runs)
    for got in (second, third, first):
        end_runs(database, got)
        assert state_of(database, got.job.id) is JobState.RUNNING
        assert end_parcel(database, got) is (got is not first)
    with database.write_session() as session:
        LeaseQueue(session).finish_job(first.lease, JobState.SUCCEEDED)
    assert list_states(database, first.job.id) == ["queued", "running", "succeeded"]
    assert parcels_of(database, first.job.id) == []
    with pytest.raises(LeaseLost):
        end_parcel(database, second)


def test_of_parcels_that_end_at_once_exactly_one_is_the_last(database):
    for _ in range(5):
        submit(database, n_runs=2)
        both = [claim(database, owner, 1) for owner in ("d1", "d2")]
        for got in both:
            with database.write_session() as session:
                RunWriter(session, got.lease).create_runs([new_run(number=got.runs.start)])
            end_runs(database, got)
        start, was_ended = threading.Barrier(2), []

        def end(got, start=start, was_ended=was_ended):
            start.wait()
            was_ended.append(end_parcel(database, got))

        threads = [threading.Thread(target=end, args=(got,)) for got in both]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(was_ended) == [False, True]


def test_a_parcel_ends_only_with_all_its_runs(database, shared_job):
    first, _ = shared_job
    run = pending(database, first)[0]
    record_outcomes(database, first.lease, RunOutcome(run_id=run.id, state=JobState.SUCCEEDED))
    with pytest.raises(RowConflict, match="3 of its runs did not finish"):
        end_parcel(database, first)


def test_a_cancel_reaches_all_holders_and_the_last_one_ends_the_job(database, shared_job):
    first, second = shared_job
    job = first.job.id
    with database.write_session() as session:
        JobRepository(session).cancel(job)
    with database.read_session() as session:
        for owner in ("d1", "d2"):
            assert read_queue_status(session, owner).jobs_to_cancel == {job}
    assert claim(database, "d3") is None
    for got, state in ((second, JobState.RUNNING), (first, JobState.CANCELLED)):
        with database.write_session() as session:
            LeaseQueue(session).cancel_parcel(got.lease)
        assert state_of(database, job) is state
    assert {run.state for run in runs_of(database, job)} == {JobState.CANCELLED}
    assert parcels_of(database, job) == []


def test_a_cancelled_job_ends_with_its_last_holder_also_if_that_one_dies(database, shared_job):
    first, second = shared_job
    with database.write_session() as session:
        JobRepository(session).cancel(first.job.id)
    with database.write_session() as session:
        LeaseQueue(session).release_job(first.lease)
    assert state_of(database, first.job.id) is JobState.RUNNING
    assert reap(database, "d2").cancelled == (second.job.id,)
    assert state_of(database, first.job.id) is JobState.CANCELLED


def test_a_cancelled_job_ends_although_the_runs_of_its_last_holder_ended_first(
    database, shared_job
):
    first, second = shared_job
    with database.write_session() as session:
        JobRepository(session).cancel(first.job.id)
    with database.write_session() as session:
        LeaseQueue(session).cancel_parcel(second.lease)
    end_runs(database, first)
    assert end_parcel(database, first)
    assert state_of(database, first.job.id) is JobState.CANCELLED
    assert parcels_of(database, first.job.id) == []


def test_checkpoints_of_cancelled_runs_outlive_what_other_holders_write(database, shared_job):
    first, second = shared_job
    runs = [run.id for run in pending(database, second)]
    with database.write_session() as session:
        RunWriter(session, second.lease).save_checkpoints([(run, 7, b"state") for run in runs])
        JobRepository(session).cancel(first.job.id)
    with database.write_session() as session:
        LeaseQueue(session).cancel_parcel(second.lease)
    write_results(database, first.lease, {pending(database, first)[0].id: conclude()})
    with database.read_session() as session:
        assert set(session.scalars(select(Checkpoint.run_id))) == set(runs)


def test_a_split_leaves_losses_and_evaluations_with_their_runs(database, shared_job):
    first, second = shared_job
    for got, evaluations in ((first, 400), (second, 1000)):
        for run in pending(database, got):
            outcome = RunOutcome(
                run_id=run.id, state=JobState.SUCCEEDED, evaluations=evaluations // SIZE
            )
            record_outcomes(database, got.lease, outcome)
        with database.write_session() as session:
            LeaseQueue(session).write_progress(got.lease, JobProgress(evaluations))
    with database.write_session() as session:
        LeaseQueue(session).finish_job(first.lease, JobState.FAILED, "as told")
    with database.write_session() as session:
        JobRepository(session).resume(first.job.id)
    again = claim(database, "d3")
    assert [one.evaluations for one in parcels_of(database, first.job.id)] == [400, 1000]
    with database.write_session() as session:
        LeaseQueue(session).write_progress(again.lease, JobProgress(400))
    assert job_of(database, first.job.id).evaluations == 1400
    assert reap(database, "d3").requeued == (first.job.id,)
    claim(database, "d4", 1)
    assert [one.lost_leases for one in parcels_of(database, first.job.id)] == [1, 1, 0]


@pytest.mark.parametrize("way", ["failed", "cancelled", "cancelled while it waits"])
def test_a_job_counts_the_evaluations_of_its_runs_though_its_holder_told_no_progress(database, way):
    submit(database, n_runs=3 * SIZE, max_attempts=1 if way == "failed" else 3)
    first, second = claim(database, "d1"), claim(database, "d2")
    for got in (first, second):
        with database.write_session() as session:
            RunWriter(session, got.lease).create_runs(new_run(number=n) for n in got.runs)
        ended, begun, *_ = (run.id for run in pending(database, got))
        outcome = RunOutcome(run_id=ended, state=JobState.SUCCEEDED, evaluations=70)
        record_outcomes(database, got.lease, outcome)
        with database.write_session() as session:
            RunWriter(session, got.lease).save_checkpoints([(begun, 7, b"state")])
    with database.write_session() as session:
        LeaseQueue(session).write_progress(second.lease, JobProgress(77))
    cancel_at = {"cancelled": 0, "cancelled while it waits": 1}.get(way)
    for step, owners in enumerate([("d1", "d2"), ()]):
        if step == cancel_at:
            with database.write_session() as session:
                JobRepository(session).cancel(first.job.id)
        reap(database, *owners)
    job = job_of(database, first.job.id)
    assert (job.state.value, job.evaluations) == (way.split()[0], 2 * 77)


def test_losses_are_counted_for_each_parcel_and_the_first_that_has_too_many_fails_the_job(
    database,
):
    job = submit(database, n_runs=2, max_attempts=3)
    healthy = claim(database, "healthy", 1)
    for _ in range(2):
        claim(database, "bad", 1)
        reap(database, "bad")
    with database.write_session() as session:
        LeaseQueue(session).release_job(healthy.lease, lost=True)
    assert [one.lost_leases for one in parcels_of(database, job)] == [1, 2]
    healthy, _ = claim(database, "healthy", 1), claim(database, "bad", 1)
    assert reap(database, "bad").failed == (job,)
    failed = job_of(database, job)
    assert (failed.state, failed.lost_leases) == (JobState.FAILED, 3)
    with pytest.raises(LeaseLost):
        pending(database, healthy)


def test_a_resumed_job_is_one_parcel_of_what_is_left(database, shared_job):
    first, second = shared_job
    end_runs(database, second)
    with database.write_session() as session:
        LeaseQueue(session).finish_job(first.lease, JobState.FAILED, "as told")
    with database.write_session() as session:
        JobRepository(session).resume(first.job.id)
    again = claim(database, "d3", N_RUNS)
    assert (again.runs, again.is_new) == (range(N_RUNS), False)
    assert [run.number for run in pending(database, again)] == list(first.runs)


def test_a_released_parcel_waits_and_the_job_too_if_nobody_else_holds_one(database, shared_job):
    first, second = shared_job
    for got, state in ((first, JobState.RUNNING), (second, JobState.QUEUED)):
        with database.write_session() as session:
            LeaseQueue(session).release_job(got.lease)
        assert state_of(database, got.job.id) is state
    assert claim(database, "d3", 1).runs == range(1)
    assert [one.stop for one in parcels_of(database, first.job.id)] == [1, 4, 8, 10]


def test_a_holder_sees_that_its_job_has_more_and_others_see_the_job(database, shared_job):
    first, _ = shared_job
    job = first.job.id
    with database.read_session() as session:
        own, others = (read_queue_status(session, "d1", held=held) for held in ([job], []))
    assert (own.has_waiting_job, own.jobs_to_extend) == (False, {job})
    assert (others.has_waiting_job, others.jobs_to_extend) == (True, frozenset())
    with database.write_session() as session:
        queue = LeaseQueue(session)
        assert queue.claim_job("d1", held=[job]) is None
        assert queue.claim_job("d1", only=job).runs == range(8, 10)


@pytest.fixture
def place(tmp_path, database, monkeypatch):
    monkeypatch.setattr(held_jobs, "FIRST_RUNS", 2)
    monkeypatch.setattr(held_jobs, "RUNS_PER_CORE", 1)
    monkeypatch.setattr(held_jobs, "MAX_CHANGE", 1.0)
    monkeypatch.setattr(dispatcher, "BUSY_SECONDS", -1.0)
    monkeypatch.setattr(dispatcher, "IDLE_SECONDS", 0.0)
    return Place(tmp_path / "data", database)


def begin(place) -> Dispatcher:
    leases = HeldLeases(place.database, 60.0)
    return Dispatcher(place.database, place.store, InlineExecutor(), leases)


def turn(place, job: str, *dispatchers: Dispatcher) -> None:
    """Let dispatchers take their turns until the job has ended."""
    for _ in range(500):
        for one in dispatchers:
            one.run_round()
        if state_of(place.database, job).is_terminal:
            return
    raise AssertionError(f"{job} did not end")


def list_results(place, job: str):
    return [(run.number, run.state, run.estimates, run.spec_hash) for run in place.runs(job)]


@pytest.mark.slow
def test_two_dispatchers_share_one_sweep_with_the_results_of_one(place):
    alone = place.submit(**SWEEP)
    carry_out(place, alone, InlineExecutor())
    job = place.submit(**SWEEP)
    both = [begin(place), begin(place)]
    turn(place, job, *both)
    assert list_results(place, job) == list_results(place, alone)
    tokens = [run.attempt for run in place.runs(job)]
    assert tokens[0] != tokens[2] != tokens[4]  # the parcels of two runs each
    assert list_states(place.database, job) == ["queued", "running", "succeeded"]
    ended = place.job(job)
    assert (ended.n_done, ended.n_failed) == (N_RUNS, 0)
    assert ended.evaluations == sum(run.evaluations for run in place.runs(job))


@pytest.mark.slow
def test_what_a_dead_dispatcher_held_is_computed_by_the_other_one(place):
    job = place.submit(**SWEEP)
    dies, lives = begin(place), begin(place)
    for _ in range(2):
        dies.run_round()
        lives.run_round()
    (owner,) = {
        parcel.lease_owner for parcel in parcels_of(place.database, job) if parcel.lease_owner
    } - {lives._leases.owner}
    reap(place.database, owner)
    turn(place, job, lives)
    assert place.job(job).state is JobState.SUCCEEDED
    assert [run.number for run in place.runs(job)] == list(range(N_RUNS))
    assert {run.state for run in place.runs(job)} == {JobState.SUCCEEDED}


@pytest.mark.slow
def test_a_chain_is_one_parcel(place):
    job = place.submit(**CHAIN)
    begin(place).run_round()
    with place.database.write_session() as session:
        assert LeaseQueue(session).claim_job("other", timedelta(seconds=9)) is None
    assert [len(range(one.first, one.stop)) for one in parcels_of(place.database, job)] == [N_RUNS]
