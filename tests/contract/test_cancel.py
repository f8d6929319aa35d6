"""Cancelling and resuming jobs, also while a dispatcher is at work, on both databases."""

import threading

import pytest

from service.core.states import JobState
from service.queue.leases import LeaseOwners, LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.event_rows import EventRepository
from service.repositories.job_rows import JobRepository
from service.storage.storage_errors import RowConflict, RowNotFound
from tests.support.storage.job_rows import (
    claim,
    job_of,
    record_outcomes,
    record_success,
    runs_of,
    state_of,
    submit,
    submit_and_claim,
)


def finish(database, lease, state):
    with database.write_session() as session:
        LeaseQueue(session).finish_job(lease, state)


def test_a_queued_job_is_cancelled_at_once(database):
    job_id = submit(database)
    with database.write_session() as session:
        assert JobRepository(session).cancel(job_id).state is JobState.CANCELLED
    assert claim(database) is None


def test_a_running_job_goes_on_until_its_dispatcher_cancels_it(database):
    got, _ = submit_and_claim(database)
    with database.write_session() as session:
        job = JobRepository(session).cancel(got.job.id)
        assert (job.state, job.cancel_requested) == (JobState.RUNNING, True)
    finish(database, got.lease, JobState.CANCELLED)
    assert state_of(database, got.job.id) is JobState.CANCELLED


def cancel_job(database, lease):
    with database.write_session() as session:
        JobRepository(session).cancel(lease.job_id)


def release(database, lease, **how):
    with database.write_session() as session:
        LeaseQueue(session).release_job(lease, **how)


def reap(database, lease):
    with database.write_session() as session:
        LeaseQueue(session).reap_expired(LeaseOwners(ended=frozenset({lease.owner})))


def cancel_parcel(database, lease):
    with database.write_session() as session:
        LeaseQueue(session).cancel_parcel(lease)


def lose_workers(database, lease):
    release(database, lease, lost=True)


def cancel_resumed(database, lease):
    finish(database, lease, JobState.FAILED)
    with database.write_session() as session:
        JobRepository(session).resume(lease.job_id)
    assert (job_of(database, lease.job_id).fit_estimation, state_of(database, lease.job_id)) == (
        None,
        JobState.QUEUED,
    )
    cancel_job(database, lease)


@pytest.mark.parametrize(
    ("ways", "state"),
    [
        ([cancel_job, cancel_parcel], JobState.CANCELLED),
        ([cancel_job, release], JobState.CANCELLED),
        ([cancel_job, reap], JobState.CANCELLED),
        ([cancel_job, lose_workers], JobState.CANCELLED),
        ([release, cancel_job], JobState.CANCELLED),
        ([cancel_resumed], JobState.CANCELLED),
        ([reap], JobState.FAILED),
        ([lose_workers], JobState.FAILED),
    ],
)
def test_a_job_that_ends_early_has_the_results_of_its_best_run(database, ways, state):
    got, runs = submit_and_claim(database, n_runs=3, max_attempts=1)
    for run, rms, trust in zip(runs, (0.5, 0.4), ("trustworthy", "limited"), strict=False):
        outcome = RunOutcome(
            run_id=run,
            state=JobState.SUCCEEDED,
            best_rms=rms,
            fit_estimation=100 - rms,
            result={"parameters": [], "verdict": {"trust": trust}},
        )
        record_outcomes(database, got.lease, outcome)
    for way in ways:
        way(database, got.lease)
    job = job_of(database, got.job.id)
    assert (job.state, job.best_rms, job.fit_estimation, job.trust) == (state, 0.4, 99.6, "limited")


def test_of_two_wishes_to_cancel_the_first_gives_the_reason(database):
    got, _ = submit_and_claim(database)
    for reason in ("as told", None):
        with database.write_session() as session:
            JobRepository(session).cancel(got.job.id, reason)
    finish(database, got.lease, JobState.CANCELLED)
    assert job_of(database, got.job.id).error == "as told"


def test_cancelling_twice_is_as_cancelling_once(database):
    job_id = submit(database)
    for _ in range(2):
        with database.write_session() as session:
            assert JobRepository(session).cancel(job_id).state is JobState.CANCELLED


@pytest.mark.parametrize("end", [JobState.SUCCEEDED, JobState.FAILED])
def test_a_finished_job_cannot_be_cancelled(database, end):
    got, (run_id,) = submit_and_claim(database)
    with database.write_session() as session:
        RunWriter(session, got.lease).record_outcomes([RunOutcome(run_id=run_id, state=end)])
        LeaseQueue(session).finish_job(got.lease, end)
    with pytest.raises(RowConflict, match=end.value), database.write_session() as session:
        JobRepository(session).cancel(got.job.id)


def test_cancel_and_claim_at_once_never_lose_the_wish(database):
    for _ in range(8):
        job_id, start = submit(database), threading.Barrier(2)

        def cancel(job_id=job_id, start=start):
            start.wait()
            with database.write_session() as session:
                JobRepository(session).cancel(job_id)

        thread = threading.Thread(target=cancel)
        thread.start()
        start.wait()
        got = claim(database)
        thread.join()
        job = job_of(database, job_id)
        assert job.cancel_requested
        assert job.state is (JobState.RUNNING if got else JobState.CANCELLED)


def test_cancel_and_finish_at_once_end_in_one_state_and_one_end_event(database):
    for _ in range(8):
        got, (run_id,) = submit_and_claim(database)
        start = threading.Barrier(2)

        def cancel(job_id=got.job.id, start=start):
            start.wait()
            try:
                with database.write_session() as session:
                    JobRepository(session).cancel(job_id)
            except RowConflict:
                pass

        thread = threading.Thread(target=cancel)
        thread.start()
        start.wait()
        with database.write_session() as session:
            RunWriter(session, got.lease).record_outcomes(
                [RunOutcome(run_id=run_id, state=JobState.SUCCEEDED)]
            )
            LeaseQueue(session).finish_job(got.lease, JobState.SUCCEEDED)
        thread.join()
        assert state_of(database, got.job.id) is JobState.SUCCEEDED
        with database.read_session() as session:
            kinds = [event.kind for event in EventRepository(session).list_after(got.job.id)]
        assert kinds.count("end") == 1
        assert kinds[-1] == "end"


def test_a_resumed_job_runs_again_only_what_did_not_succeed(database):
    got, (done, bad, _) = submit_and_claim(database, n_runs=3)
    record_outcomes(
        database,
        got.lease,
        RunOutcome(run_id=done, state=JobState.SUCCEEDED, best_rms=0.1),
        RunOutcome(run_id=bad, state=JobState.FAILED, error="diverged"),
    )
    with database.write_session() as session:
        LeaseQueue(session).finish_job(got.lease, JobState.FAILED, "1 run failed")
    with database.write_session() as session:
        JobRepository(session).get(got.job.id).fit_estimation = 90.0
    with database.write_session() as session:
        job = JobRepository(session).resume(got.job.id)
        assert (job.state, job.n_done, job.n_failed, job.error) == (JobState.QUEUED, 1, 0, None)
        assert job.fit_estimation is None  # lists sort by that of ended jobs
    states = [run.state for run in runs_of(database, got.job.id)]
    assert states == [JobState.SUCCEEDED, JobState.QUEUED, JobState.QUEUED]
    assert claim(database).lease.attempt == 2


def test_a_resumed_job_begins_with_a_clean_slate_and_leaves_other_jobs_alone(database):
    other, (foreign,) = submit_and_claim(database)
    record_success(database, other.lease, foreign, 0.1)
    running, (runs_on,) = submit_and_claim(database)
    with database.write_session() as session:
        RunWriter(session, running.lease).start_runs([runs_on])
    got, (run_id,) = submit_and_claim(database, max_attempts=2)
    with database.write_session() as session:
        RunWriter(session, got.lease).write_kills({run_id: 1})
    for _ in range(2):  # the dispatcher loses its workers twice, and gives up
        with database.write_session() as session:
            LeaseQueue(session).release_job(got.lease, lost=True)
        got = claim(database) or got
    assert state_of(database, got.job.id) is JobState.FAILED
    with database.write_session() as session:
        job = JobRepository(session).resume(got.job.id)
        assert (job.n_done, job.lost_leases, job.cancel_requested) == (0, 0, False)
    assert [run.kills for run in runs_of(database, got.job.id)] == [0]
    again = claim(database)
    assert again.job.id == got.job.id
    with database.write_session() as session:
        LeaseQueue(session).release_job(again.lease, lost=True)
    assert state_of(database, got.job.id) is JobState.QUEUED  # one loss of two
    states = [runs_of(database, one.job.id)[0].state for one in (other, running)]
    assert states == [JobState.SUCCEEDED, JobState.RUNNING]


def test_only_a_failed_or_cancelled_job_can_be_resumed(database):
    job_id = submit(database)
    with pytest.raises(RowConflict, match="queued"), database.write_session() as session:
        JobRepository(session).resume(job_id)
    with pytest.raises(RowNotFound), database.write_session() as session:
        JobRepository(session).resume("job_none")


def test_the_failed_runs_of_a_job_that_ended_are_resumed_alone(database):
    got, (done, bad, late) = submit_and_claim(database, n_runs=3)
    record_outcomes(
        database,
        got.lease,
        RunOutcome(run_id=done, state=JobState.SUCCEEDED, best_rms=0.1),
        RunOutcome(run_id=bad, state=JobState.FAILED, error="the store was away"),
        RunOutcome(run_id=late, state=JobState.SUCCEEDED, best_rms=0.2),
    )
    with pytest.raises(RowConflict, match="by itself"), database.write_session() as session:
        JobRepository(session).resume(got.job.id, only_failed=True)
    with database.write_session() as session:
        LeaseQueue(session).finish_job(got.lease, JobState.INCOMPLETE, "1 of 3 runs failed")
    with pytest.raises(RowConflict, match="failed=true"), database.write_session() as session:
        JobRepository(session).resume(got.job.id)
    with database.write_session() as session:
        job = JobRepository(session).resume(got.job.id, only_failed=True)
        assert (job.state, job.n_done, job.n_failed, job.error) == (JobState.QUEUED, 2, 0, None)
    runs = {run.id: run.state for run in runs_of(database, got.job.id)}
    assert runs == {
        done: JobState.SUCCEEDED,
        bad: JobState.QUEUED,
        late: JobState.SUCCEEDED,
    }
    again = claim(database)
    with database.write_session() as session:
        success = RunOutcome(run_id=bad, state=JobState.SUCCEEDED, best_rms=0.3)
        RunWriter(session, again.lease).record_outcomes([success])
        LeaseQueue(session).finish_job(again.lease, JobState.SUCCEEDED, None)
    with pytest.raises(RowConflict, match="no run of"), database.write_session() as session:
        JobRepository(session).resume(got.job.id, only_failed=True)
