"""Jobs whose dispatcher is gone, or seems to be: on SQLite and on PostgreSQL alike."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
from datetime import timedelta

import pytest

from service.core.process.process_identity import describe_process, is_awake, is_gone
from service.core.states import JobState
from service.dispatch.held_leases import HeldLeases
from service.queue.dispatchers import LEASE_SECONDS_KEY, DispatcherRepository
from service.queue.leases import HUNG_AFTER, SPARED_LOSS_FACTOR, LeaseQueue
from service.queue.orphaned_jobs import Reaper, reap_jobs
from service.queue.run_writes import RunOutcome, RunWriter
from service.storage import columns
from service.storage.clocks import choose_database_clock
from service.storage.columns import utc_now
from sysid.core.machine import read_machine_id
from tests.support.cluster.dispatch_place import until
from tests.support.storage.job_rows import (
    Clock,
    claim,
    job_of,
    new_run,
    parcel_of,
    runs_of,
    state_of,
    submit,
    submit_and_claim,
)

LEASE = timedelta(seconds=10)


@pytest.fixture
def clock() -> Clock:
    return Clock()


def announce(database, owner: str, details) -> None:
    with database.write_session() as session:
        told = {LEASE_SECONDS_KEY: LEASE.total_seconds(), **details}
        DispatcherRepository(session).add_dispatcher(owner, told)


def of_a_process_that_has_ended():
    """What a dispatcher told that is no more."""
    imports = "import json; from service.core.process.process_identity import describe_process"
    code = f"{imports}; print(json.dumps(describe_process()))"
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return json.loads(ran.stdout)


needs_proc = pytest.mark.skipif(read_machine_id() is None, reason="there is no /proc")


@needs_proc
def test_jobs_of_a_dispatcher_whose_process_has_ended_are_given_back_at_once(database) -> None:
    job = submit(database)
    claim(database, "dead")
    announce(database, "dead", of_a_process_that_has_ended())
    assert reap_jobs(database).requeued == (job,)
    assert state_of(database, job) is JobState.QUEUED
    with database.read_session() as session:
        assert DispatcherRepository(session).list_alive() == []


@needs_proc
def test_a_dispatcher_whose_process_has_ended_is_forgotten_also_without_jobs(database) -> None:
    announce(database, "dead", of_a_process_that_has_ended())
    announce(database, "here", describe_process())
    reap_jobs(database)
    with database.read_session() as session:
        assert [row.owner for row in DispatcherRepository(session).list_all()] == ["here"]


def test_jobs_of_a_dispatcher_that_lives_or_that_cannot_be_seen_are_left_alone(database) -> None:
    announce(database, "here", describe_process())
    announce(database, "elsewhere", {**describe_process(), "machine": "another", "pid": 2**22 - 1})
    announce(database, "unknown", {})
    jobs = {submit(database) for _ in range(3)}
    for owner in ("here", "elsewhere", "unknown"):
        claim(database, owner)
    assert reap_jobs(database).requeued == ()
    assert {state_of(database, job) for job in jobs} == {JobState.RUNNING}


@needs_proc
def test_a_process_that_took_over_the_number_of_another_is_not_taken_for_it() -> None:
    assert not is_gone(describe_process())
    assert is_gone({**describe_process(), "started": 1})


def test_a_lease_written_before_the_clock_was_stepped_back_is_not_waited_for(
    database, clock: Clock
) -> None:
    announce(database, "silent", {})
    job = submit(database)
    claim(database, "silent", clock)
    clock.advance(-3600)
    assert reap_jobs(database, clock).requeued == ()  # its owner has one lease to renew it
    clock.advance(11)
    assert reap_jobs(database, clock).requeued == (job,)


def test_a_dispatcher_that_lives_keeps_its_jobs_though_the_clock_is_stepped_back(
    database, clock: Clock
) -> None:
    announce(database, "alive", {})
    submit(database)
    held = claim(database, "alive", clock).lease
    clock.advance(-3600)
    reap_jobs(database, clock)
    for _ in range(5):
        clock.advance(3)
        with database.write_session() as session:
            assert LeaseQueue(session, clock).renew_leases([held], LEASE) == {held}
        assert reap_jobs(database, clock).requeued == ()


def test_leases_lost_while_runs_come_to_their_end_are_not_added_up(database, clock: Clock) -> None:
    job = submit(database, n_runs=3, max_attempts=2)
    for number in range(3):
        got = claim(database, "falls", clock)
        with database.write_session() as session:
            ledger = RunWriter(session, got.lease)
            ledger.create_runs(new_run(number=i) for i in range(3))
            run = ledger.list_pending()[0].id
            ledger.record_outcomes([RunOutcome(run_id=run, state=JobState.SUCCEEDED, best_rms=1.0)])
        clock.advance(11)
        assert reap_jobs(database, clock).requeued == (job,), number
    assert job_of(database, job).lost_leases == 1
    claim(database, "falls", clock)  # and now no run ends, but those of earlier attempts have
    clock.advance(11)
    assert reap_jobs(database, clock).failed == (job,)


def test_a_job_is_not_spared_for_its_own_progress(database, clock: Clock) -> None:
    job = submit(database, max_attempts=1)
    save_one(database, claim(database, "falls", clock))
    clock.advance(11)
    assert reap_jobs(database, clock).failed == (job,)


def test_a_job_is_not_spared_for_the_progress_of_another_dispatcher(database, clock: Clock) -> None:
    mine = submit(database, max_attempts=1)
    claim(database, "falls", clock)
    theirs = submit(database, max_attempts=2)
    save_one(database, claim(database, "works", clock))
    clock.advance(11)
    reaped = reap_jobs(database, clock)
    assert (reaped.failed, reaped.requeued) == ((mine,), (theirs,))


def test_a_job_given_back_because_the_workers_are_gone_counts_as_lost(database) -> None:
    got, _ = submit_and_claim(database, max_attempts=2)
    with database.write_session() as session:
        LeaseQueue(session).release_job(got.lease, lost=True)
    assert job_of(database, got.job.id).lost_leases == 1
    again = claim(database)
    with database.write_session() as session:
        LeaseQueue(session).release_job(again.lease, lost=True)
    job = job_of(database, got.job.id)
    assert job.state is JobState.FAILED
    assert "gave up after 2 attempts without progress" in (job.error or "")


def test_deaths_over_a_run_outlive_the_dispatcher_that_counted_them(database) -> None:
    got, (run,) = submit_and_claim(database)
    with database.write_session() as session:
        RunWriter(session, got.lease).write_kills({run: 1})
    with database.write_session() as session:
        LeaseQueue(session).release_job(got.lease)
    assert [one.kills for one in runs_of(database, got.job.id)] == [1]


@needs_proc
def test_the_web_process_reaps_too(database) -> None:
    job = submit(database)
    claim(database, "dead")
    announce(database, "dead", of_a_process_that_has_ended())
    stopping = threading.Event()
    reaper = Reaper(database, stopping)
    reaper.start()
    try:
        until(lambda: state_of(database, job) is JobState.QUEUED, "it was queued again")
    finally:
        stopping.set()
        reaper.join()


def let_lease_expire(database, owner: str, details, seconds: float = 0.1) -> str:
    """A job whose owner has told these details, and whose lease has ended since then."""
    job = submit(database)
    announce(database, owner, details)
    with database.write_session() as session:
        ago = timedelta(seconds=-seconds)
        assert LeaseQueue(session).claim_job(owner, ago).job.id == job
    return job


@needs_proc
def test_a_dispatcher_that_lives_here_is_not_reaped_while_it_waits_for_the_database(
    database,
) -> None:
    job = let_lease_expire(database, "here", describe_process(), HUNG_AFTER.total_seconds() - 10)
    lost = let_lease_expire(database, "elsewhere", {**describe_process(), "machine": "another"})
    assert reap_jobs(database).requeued == (lost,)
    assert state_of(database, job) is JobState.RUNNING
    assert job_of(database, job).lost_leases == 0


@needs_proc
def test_a_dispatcher_that_lives_but_hangs_is_reaped_at_last_and_not_called_gone(
    database, caplog: pytest.LogCaptureFixture
) -> None:
    job = let_lease_expire(database, "here", describe_process(), HUNG_AFTER.total_seconds() + 1)
    with caplog.at_level(logging.WARNING):
        assert reap_jobs(database).requeued == (job,)
    (told,) = caplog.messages
    assert "here lives, but has not renewed its leases" in told
    assert "gone" not in told
    assert "ended" not in told


@needs_proc
def test_a_dispatcher_that_is_stopped_is_reaped_when_its_lease_ends(database) -> None:
    code = (
        "import json; from service.core.process.process_identity import describe_process\n"
        "print(json.dumps(describe_process()), flush=True); input()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        details = json.loads(process.stdout.readline())
        assert is_awake(details)
        os.kill(process.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        assert not is_awake(details)
        assert not is_gone(details)
        job = let_lease_expire(database, "stopped", details)
        assert reap_jobs(database).requeued == (job,)
    finally:
        process.kill()
        process.communicate()


def test_leases_lost_while_a_run_came_further_are_not_added_up(database, clock: Clock) -> None:
    job = submit(database, max_attempts=2)
    for number in range(4):
        got = claim(database, "falls", clock)
        with database.write_session() as session:
            ledger = RunWriter(session, got.lease)
            ledger.create_runs([new_run(number=0)])
            ledger.save_checkpoints([(ledger.list_pending()[0].id, 100 * (number + 1), b"state")])
        clock.advance(11)
        assert reap_jobs(database, clock).requeued == (job,), number
        assert job_of(database, job).lost_leases == 1
    claim(database, "falls", clock)  # and now it does not come further
    clock.advance(11)
    assert reap_jobs(database, clock).failed == (job,)


def test_how_long_a_lease_is_tells_its_dispatcher_and_not_the_one_who_reaps(
    database, clock: Clock
) -> None:
    job = submit(database)
    announce(database, "slow", {LEASE_SECONDS_KEY: 60.0})
    with database.write_session() as session:
        LeaseQueue(session, clock).claim_job("slow", timedelta(seconds=60))
    assert reap_jobs(database, clock).requeued == ()
    assert parcel_of(database, job).lease_until == clock.now + timedelta(seconds=60)
    clock.advance(-3600)
    reap_jobs(database, clock)
    assert parcel_of(database, job).lease_until == clock.now + timedelta(seconds=60)
    clock.advance(59)
    assert reap_jobs(database, clock).requeued == ()
    clock.advance(2)
    assert reap_jobs(database, clock).requeued == (job,)


def test_a_dispatcher_with_long_leases_counts_as_alive_as_long(database, clock: Clock) -> None:
    with database.write_session() as session:
        repository = DispatcherRepository(session, clock)
        repository.add_dispatcher("slow", {LEASE_SECONDS_KEY: 60.0})
        repository.add_dispatcher("quick", {LEASE_SECONDS_KEY: 10.0})
        clock.advance(30)
        assert [one.owner for one in repository.list_alive()] == ["slow"]


def test_each_dispatcher_has_its_own_heartbeat_and_leaves_alone(database, clock: Clock) -> None:
    with database.write_session() as session:
        repository = DispatcherRepository(session, clock)
        for owner in ("first", "second"):
            repository.add_dispatcher(owner, {LEASE_SECONDS_KEY: 10.0})
        clock.advance(11)
        repository.record_heartbeat("second")
        assert [one.owner for one in repository.list_alive()] == ["second"]
        repository.remove_dispatcher("second")
        assert [one.owner for one in repository.list_all()] == ["first"]


def test_a_dispatcher_is_forgotten_a_day_after_its_last_heartbeat(database, clock: Clock) -> None:
    with database.write_session() as session:
        repository = DispatcherRepository(session, clock)
        for owner in ("old", "silent", "new"):
            repository.add_dispatcher(owner, {LEASE_SECONDS_KEY: 10.0})
            clock.advance(13 * 3600)
        assert [one.owner for one in repository.list_all()] == ["new", "silent"]


@pytest.mark.postgres
def test_leases_follow_the_clock_of_the_server_not_those_of_its_clients(
    postgres_database, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = utc_now() - timedelta(seconds=1000)
    monkeypatch.setattr(columns, "utc_now", lambda: wrong)
    job = submit(postgres_database)
    with postgres_database.write_session() as session:
        assert choose_database_clock(session)() > wrong + timedelta(seconds=500)
        LeaseQueue(session).claim_job("behind")
    monkeypatch.undo()
    assert reap_jobs(postgres_database).requeued == ()
    assert state_of(postgres_database, job) is JobState.RUNNING


def save_one(database, got) -> None:
    """Write a checkpoint of a run of the job."""
    with database.write_session() as session:
        ledger = RunWriter(session, got.lease)
        ledger.create_runs([new_run(number=0)])
        ledger.save_checkpoints([(ledger.list_pending()[0].id, 100, b"state")])


@pytest.mark.parametrize("is_told", [False, True], ids=["reaped", "given back"])
def test_a_job_that_waits_beside_others_that_come_further_is_not_soon_given_up(
    database, clock: Clock, is_told: bool
) -> None:
    busy, waits = submit(database, max_attempts=2), submit(database, max_attempts=2)
    leases = HeldLeases(database, 10, clock=clock, stopwatch=lambda: clock.now.timestamp())
    for loss in range(1, 2 * SPARED_LOSS_FACTOR):
        got = [leases.claim_job(), leases.claim_job()]
        save_one(database, next(one for one in got if one.job.id == busy))
        if is_told:
            leases.release_all(lost=True)
        else:
            clock.advance(11)
            reap_jobs(database, clock)
            for one in got:
                leases.forget_lease(one.lease)
        assert state_of(database, waits) is JobState.QUEUED
        assert job_of(database, waits).lost_leases == loss
        assert job_of(database, busy).lost_leases == 1
    leases.claim_job(), leases.claim_job()
    leases.release_all(lost=True)  # and now nothing came further
    assert state_of(database, waits) is JobState.FAILED
    assert state_of(database, busy) is JobState.FAILED
