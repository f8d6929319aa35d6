"""The lease queue: what must hold on SQLite and on PostgreSQL alike."""

import threading
from datetime import timedelta

import pytest
from sqlalchemy import text

from service.core.states import JobState
from service.queue.leases import JobProgress, Lease, LeaseQueue
from service.queue.notifications import read_queue_status
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.event_rows import EventRepository
from service.repositories.job_rows import JobRepository
from service.storage.storage_errors import LeaseLost, RowConflict
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.job_rows import (
    Clock,
    claim,
    job_of,
    new_run,
    parcel_of,
    record_success,
    runs_of,
    state_of,
    submit,
    submit_and_claim,
)

LEASE = timedelta(seconds=10)
IMPATIENT_SECONDS = 0.5
"""How long a transaction of a test waits for a lock that must not be in its way."""
ENDS = [JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED]


@pytest.fixture
def clock():
    return Clock()


def reap(database, clock):
    with database.write_session() as session:
        return LeaseQueue(session, clock).reap_expired()


def finish(database, lease, state=JobState.SUCCEEDED, error=None):
    with database.write_session() as session:
        LeaseQueue(session).finish_job(lease, state, error)


def lose(database, clock):
    """Claim whatever waits, fall silent, and be reaped."""
    got = claim(database, "silent", clock)
    clock.advance(11)
    return got, reap(database, clock)


def test_an_empty_queue_gives_nothing(database):
    assert claim(database) is None


def test_jobs_come_by_priority_then_by_age(database):
    old, young = submit(database), submit(database)
    urgent = submit(database, priority=5)
    assert [claim(database).job.id for _ in range(3)] == [urgent, old, young]
    assert claim(database) is None


def test_a_claimed_job_runs_under_its_first_attempt(database, clock):
    job_id = submit(database)
    got = claim(database, "d1", clock)
    assert got.lease == Lease(job_id, 1, "d1")
    job = job_of(database, job_id)
    parcel = parcel_of(database, job_id)
    assert (job.state, job.attempt, parcel.lease_owner) == (JobState.RUNNING, 1, "d1")
    assert job.started_at == clock.now
    assert parcel.lease_until == clock.now + LEASE


def test_no_two_claimers_ever_get_the_same_job(database):
    jobs = {submit(database) for _ in range(24)}
    taken, start = [], threading.Barrier(4)

    def work(owner):
        start.wait()
        while (got := claim(database, owner)) is not None:
            taken.append(got.job.id)

    threads = [threading.Thread(target=work, args=(f"d{i}",)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(taken) == len(jobs)
    assert set(taken) == jobs


@pytest.mark.postgres
def test_a_claimer_does_not_wait_for_a_rival_that_has_not_committed(postgres_database):
    first, second = submit(postgres_database), submit(postgres_database)
    found = []
    with postgres_database.write_session() as slow:
        assert LeaseQueue(slow).claim_job("slow").job.id == first
        for _ in range(2):
            with postgres_database.write_session(IMPATIENT_SECONDS) as quick:
                got = LeaseQueue(quick).claim_job("quick")
                found.append(None if got is None else got.job.id)
    assert found == [second, None]


@pytest.mark.postgres
def test_a_reaper_leaves_a_job_alone_while_its_owner_writes(postgres_database, clock):
    job = submit(postgres_database)
    lease = claim(postgres_database, "d1", clock).lease
    clock.advance(11)
    with postgres_database.write_session() as writer:
        LeaseQueue(writer).lock_lease(lease)
        with postgres_database.write_session(IMPATIENT_SECONDS) as session:
            assert LeaseQueue(session, clock).reap_expired().requeued == ()
        LeaseQueue(writer).append_event(lease, "log", {"line": "in time"})
    assert reap(postgres_database, clock).requeued == (job,)


@pytest.mark.postgres
def test_a_reaper_does_not_wait_for_another_that_reaps_the_same_job(postgres_database, clock):
    job = submit(postgres_database)
    claim(postgres_database, "d1", clock)
    clock.advance(11)
    with postgres_database.write_session() as slow:
        assert LeaseQueue(slow, clock).reap_expired().requeued == (job,)
        with postgres_database.write_session(IMPATIENT_SECONDS) as quick:
            assert LeaseQueue(quick, clock).reap_expired().requeued == ()
    assert job_of(postgres_database, job).lost_leases == 1


def test_a_claim_without_an_answer_is_found_among_those_of_its_owner_only(database):
    rival, known, lost = (submit(database) for _ in range(3))
    leases = {}
    for owner, job in (("rival", rival), ("d1", known), ("d1", lost)):
        got = claim(database, owner)
        assert got.job.id == job
        leases[job] = got.lease
    with database.write_session() as session:
        queue = LeaseQueue(session)
        assert queue.recover_claim("d1", [leases[known]]).lease == Lease(lost, 1, "d1")
        assert queue.recover_claim("d1", [leases[known], leases[lost]]) is None
        assert queue.recover_claim("d2", []) is None


def test_a_dispatcher_is_asked_to_cancel_its_own_jobs_only(database):
    mine, theirs = submit(database), submit(database)
    claim(database, "d1"), claim(database, "d2")
    with database.write_session() as session:
        for job in (mine, theirs):
            JobRepository(session).cancel(job)
    with database.read_session() as session:
        asked = [read_queue_status(session, owner).jobs_to_cancel for owner in ("d1", "d2")]
    assert asked == [{mine}, {theirs}]


def test_a_claim_that_is_rolled_back_leaves_the_job_queued(database):
    job_id = submit(database)

    def claim_and_crash():
        with database.write_session() as session:
            LeaseQueue(session).claim_job("d1")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        claim_and_crash()
    assert claim(database).lease == Lease(job_id, 1, "d1")


def test_one_heartbeat_renews_the_leases_given_and_no_others(database, clock):
    for _ in range(2):
        submit(database)
    mine = {claim(database, "d1", clock).lease for _ in range(2)}
    others = {submit(database), submit(database)}
    claim(database, "d1", clock)  # of the same owner, who has dropped it
    claim(database, "d2", clock)
    clock.advance(7)
    with database.write_session() as session:
        held = LeaseQueue(session, clock).renew_leases(mine)
    assert held == mine
    clock.advance(4)
    assert set(reap(database, clock).requeued) == others


def test_a_lease_begins_when_the_database_was_got_not_when_it_was_asked_for(
    sqlite_database,
):
    """Only SQLite lets one writer in at a time."""
    database = sqlite_database
    submit(database)
    is_held, may_end = threading.Event(), threading.Event()
    asked: list[bool] = []  # for the time, and whether the other writer had come to its end

    def hold():
        with database.write_session() as session:
            session.execute(text("UPDATE jobs SET name = 'held'"))
            is_held.set()
            threading.Event().wait(0.2)  # so that the claim waits for it
            may_end.set()

    def clock():
        asked.append(may_end.is_set())
        return Clock().now

    holder = threading.Thread(target=hold)
    holder.start()
    is_held.wait(LIMIT_SECONDS)
    got = claim(database, "d1", clock)
    holder.join()
    assert parcel_of(database, got.job.id).lease_until == Clock().now + LEASE
    assert set(asked) == {True}


def test_a_heartbeat_does_not_get_back_a_lease_that_was_lost(database, clock):
    submit(database)
    lost, _ = lose(database, clock)
    claim(database, "silent", clock)  # under a new attempt
    with database.write_session() as session:
        assert LeaseQueue(session, clock).renew_leases([lost.lease]) == frozenset()


def test_a_heartbeat_does_not_renew_the_lease_of_a_job_that_waits_again(database, clock):
    job = submit(database)
    lost, _ = lose(database, clock)
    with database.write_session() as session:
        assert LeaseQueue(session, clock).renew_leases([lost.lease]) == frozenset()
    assert parcel_of(database, job).lease_until is None


def test_a_heartbeat_of_no_lease_renews_nothing(database, clock):
    job_id = submit(database)
    claim(database, "d1", clock)
    clock.advance(7)
    with database.write_session() as session:
        assert LeaseQueue(session, clock).renew_leases([]) == frozenset()
    clock.advance(4)
    assert reap(database, clock).requeued == (job_id,)


def test_the_reaper_leaves_a_living_lease_alone(database, clock):
    job_id = submit(database)
    claim(database, "d1", clock)
    clock.advance(9)
    assert reap(database, clock).requeued == ()
    assert state_of(database, job_id) is JobState.RUNNING


def test_an_expired_job_is_queued_again_with_its_unfinished_runs(database, clock):
    submit(database, n_runs=2)
    got = claim(database, "d1", clock)
    with database.write_session() as session:
        ledger = RunWriter(session, got.lease)
        ledger.create_runs(new_run(number=i) for i in range(2))
        first, second = (run.id for run in ledger.list_pending())
        ledger.start_runs([first, second])
        ledger.record_outcomes([RunOutcome(run_id=first, state=JobState.SUCCEEDED, best_rms=0.5)])
    clock.advance(11)
    assert reap(database, clock).requeued == (got.job.id,)
    assert [run.state for run in runs_of(database, got.job.id)] == [
        JobState.SUCCEEDED,
        JobState.QUEUED,
    ]
    again = claim(database, "d2", clock)
    assert again.lease.attempt == 2
    with database.write_session() as session:
        assert [run.id for run in RunWriter(session, again.lease).list_pending()] == [second]


def test_a_reaped_job_takes_no_run_of_another_job_with_it(database, clock):
    lost, rival = submit_and_claim(database), submit_and_claim(database)
    for got, runs in (lost, rival):
        with database.write_session() as session:
            RunWriter(session, got.lease).start_runs(runs)
    with database.write_session() as session:
        LeaseQueue(session).release_job(lost[0].lease)
    states = [runs_of(database, got.job.id)[0].state for got, _ in (lost, rival)]
    assert states == [JobState.QUEUED, JobState.RUNNING]


def test_a_job_began_with_its_first_claim_and_not_with_a_later_one(database, clock):
    job_id, began = submit(database), clock.now
    lose(database, clock)
    claim(database, "d2", clock)
    assert job_of(database, job_id).started_at == began


def test_a_job_that_loses_its_lease_too_often_fails_and_says_why(database, clock):
    job_id = submit(database, max_attempts=2)
    assert lose(database, clock)[1].requeued == (job_id,)
    again = claim(database, "silent", clock)
    with database.write_session() as session:
        RunWriter(session, again.lease).create_runs([new_run(number=0)])
    clock.advance(11)
    assert reap(database, clock).failed == (job_id,)
    assert [run.state for run in runs_of(database, job_id)] == [JobState.FAILED]
    job = job_of(database, job_id)
    assert job.state is JobState.FAILED
    assert "gave up after 2 attempts without progress" in job.error
    assert "the dispatcher or its workers stopped" in job.error
    assert job.finished_at == clock.now
    assert claim(database) is None


def test_a_job_that_was_to_be_cancelled_is_never_retried(database, clock):
    job_id = submit(database)
    claim(database, "d1", clock)
    with database.write_session() as session:
        JobRepository(session).cancel(job_id)
    clock.advance(11)
    assert reap(database, clock).cancelled == (job_id,)
    assert state_of(database, job_id) is JobState.CANCELLED


def test_two_reapers_bury_a_job_once(database, clock):
    submit(database)
    claim(database, "d1", clock)
    clock.advance(11)
    reap(database, clock)
    assert reap(database, clock).requeued == ()


def test_a_released_job_is_queued_and_nothing_is_counted_against_it(database):
    got, _ = submit_and_claim(database)
    with database.write_session() as session:
        LeaseQueue(session).release_job(got.lease)
    job = job_of(database, got.job.id)
    parcel = parcel_of(database, got.job.id)
    assert (job.state, job.lost_leases, parcel.lease_owner) == (JobState.QUEUED, 0, None)
    assert claim(database).lease.attempt == 2


def test_a_job_released_after_a_wish_to_cancel_is_cancelled(database):
    got, _ = submit_and_claim(database)
    with database.write_session() as session:
        JobRepository(session).cancel(got.job.id)
        LeaseQueue(session).release_job(got.lease)
    assert state_of(database, got.job.id) is JobState.CANCELLED


LATE_WRITES = {
    "hold": lambda session, lease, _: LeaseQueue(session).lock_lease(lease),
    "report": lambda session, lease, _: LeaseQueue(session).write_progress(lease, JobProgress(5)),
    "tell": lambda session, lease, _: LeaseQueue(session).append_event(
        lease, "log", {"line": "late"}
    ),
    "finish": lambda session, lease, _: LeaseQueue(session).finish_job(
        lease, JobState.FAILED, "late"
    ),
    "release": lambda session, lease, _: LeaseQueue(session).release_job(lease),
    "start": lambda session, lease, run: RunWriter(session, lease).start_runs([run]),
    "pending": lambda session, lease, _: RunWriter(session, lease).list_pending(),
    "create": lambda session, lease, _: RunWriter(session, lease).create_runs([]),
    "append": lambda session, lease, _: RunWriter(session, lease).append_history([]),
    "save": lambda session, lease, run: RunWriter(session, lease).save_checkpoints(
        [(run, 1, b"late")]
    ),
    "checkpoints": lambda session, lease, _: RunWriter(session, lease).read_checkpoints(),
    "record": lambda session, lease, run: RunWriter(session, lease).record_outcomes(
        [RunOutcome(run_id=run, state=JobState.SUCCEEDED, best_rms=9.0)]
    ),
}


@pytest.mark.parametrize("write", LATE_WRITES.values(), ids=LATE_WRITES)
def test_a_late_writer_is_refused_and_changes_nothing(database, clock, write):
    got, (run_id,) = submit_and_claim(database)
    with database.write_session() as session:
        LeaseQueue(session, clock).renew_leases(
            [got.lease]
        )  # in the past of the true clock: it expires
    clock.advance(11)
    assert reap(database, clock).requeued == (got.job.id,)
    with database.read_session() as session:
        before = EventRepository(session).list_after(got.job.id)[-1].id
    for rival in (None, "d2"):  # while it is queued again, and while another has it
        if rival:
            claim(database, rival, clock)
            before += 1
        with pytest.raises(LeaseLost, match="attempt 1"), database.write_session() as session:
            write(session, got.lease, run_id)
        (run,) = runs_of(database, got.job.id)
        assert (run.state, run.best_rms, run.attempt) == (JobState.QUEUED, None, 0)
        with database.read_session() as session:
            assert EventRepository(session).list_after(got.job.id)[-1].id == before


@pytest.mark.parametrize("end", ENDS)
def test_a_terminal_state_is_never_overwritten(database, clock, end):
    got, (run_id,) = submit_and_claim(database)
    with database.write_session() as session:
        RunWriter(session, got.lease).record_outcomes([RunOutcome(run_id=run_id, state=end)])
        LeaseQueue(session).finish_job(got.lease, end, "as told")
    for other in ENDS:
        with pytest.raises(LeaseLost):
            finish(database, got.lease, other)
    clock.advance(10**9)
    reap(database, clock)
    assert claim(database) is None
    job = job_of(database, got.job.id)
    assert (job.state, job.error) == (end, "as told")
    assert runs_of(database, got.job.id)[0].state is end


def test_a_job_cannot_succeed_while_a_run_is_unfinished(database):
    got, _ = submit_and_claim(database, n_runs=2)
    with pytest.raises(RowConflict, match="2 of its runs"):
        finish(database, got.lease)
    assert state_of(database, got.job.id) is JobState.RUNNING


def test_results_of_another_job_neither_end_this_one_nor_are_its_best(database):
    other, (done,) = submit_and_claim(database)
    record_success(database, other.lease, done, 0.1)
    got, (run_id,) = submit_and_claim(database)
    with pytest.raises(RowConflict, match="1 of its runs"):
        finish(database, got.lease)
    record_success(database, got.lease, run_id, 0.7)
    finish(database, got.lease)
    assert job_of(database, got.job.id).best_rms == 0.7
    finish(database, other.lease)
    assert job_of(database, other.job.id).best_rms == 0.1


@pytest.mark.parametrize("end", [JobState.FAILED, JobState.CANCELLED])
def test_unfinished_runs_end_with_their_job(database, end):
    got, _ = submit_and_claim(database, n_runs=3)
    finish(database, got.lease, end, "no memory")
    assert {(run.state, run.error) for run in runs_of(database, got.job.id)} == {(end, "no memory")}


def test_progress_is_kept_and_told_and_the_best_never_rises(database):
    got, _ = submit_and_claim(database)
    for rms in (0.5, None, 0.2, 0.9):
        with database.write_session() as session:
            LeaseQueue(session).write_progress(got.lease, JobProgress(100, 7, rms, 3.5))
    job = job_of(database, got.job.id)
    assert (job.evaluations, job.generation, job.best_rms, job.seconds_left) == (100, 7, 0.2, 3.5)
    with database.read_session() as session:
        events = EventRepository(session).list_after(got.job.id)
    told = [event.data["best_rms"] for event in events if event.kind == "progress"]
    assert told == [0.5, 0.5, 0.2, 0.2]


def test_the_best_of_an_ended_job_is_that_of_its_results(database):
    got, runs = submit_and_claim(database)
    with database.write_session() as session:
        LeaseQueue(session).write_progress(
            got.lease, JobProgress(100, 7, 0.2, 3.5)
        )  # fitness, as of soft-l1
        RunWriter(session, got.lease).record_outcomes(
            [RunOutcome(run_id=runs[0], state=JobState.SUCCEEDED, best_rms=0.9)]
        )
    finish(database, got.lease)
    assert job_of(database, got.job.id).best_rms == 0.9
