"""A dispatcher's leases and what it does when one is late or lost; the clock is the test's."""

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sqlalchemy import update
from sqlalchemy.exc import OperationalError

from service.core.states import JobState
from service.dispatch.dispatcher import Dispatcher
from service.dispatch.held_leases import HeldLeases
from service.queue.dispatchers import DispatcherRepository
from service.storage.tables import Parcel
from tests.support.cluster.dispatch_place import Place, until
from tests.support.storage.job_rows import Clock, claim, job_of, state_of, submit
from tests.unit.workers.test_scheduler import ScriptedExecutor, fails

SECONDS = 30.0


@pytest.fixture
def clock() -> Clock:
    return Clock()


def leases_of(database, clock: Clock) -> HeldLeases:
    return HeldLeases(database, SECONDS, clock=clock, stopwatch=lambda: clock.now.timestamp())


def test_a_lease_renewed_in_time_is_kept(database, clock: Clock) -> None:
    job, leases = submit(database), leases_of(database, clock)
    lease = leases.claim_job().lease
    for _ in range(5):
        clock.advance(20)
        leases.renew_leases()
        assert not leases.is_lost(lease)
    assert state_of(database, job) is JobState.RUNNING


def test_a_lease_that_is_late_is_unknown_until_a_heartbeat_tells_that_it_is_still_ours(
    database, clock: Clock
) -> None:
    submit(database)
    leases = leases_of(database, clock)
    lease = leases.claim_job().lease
    clock.advance(31)
    assert (leases.is_held(lease), leases.is_lost(lease)) == (False, False)
    leases.renew_leases()
    assert (leases.is_held(lease), leases.is_lost(lease)) == (True, False)
    assert job_of(database, lease.job_id).lost_leases == 0


def test_a_late_heartbeat_of_other_leases_does_not_make_a_new_one_late(
    database, clock: Clock
) -> None:
    submit(database), submit(database)
    leases = leases_of(database, clock)
    old = leases.claim_job().lease
    clock.advance(31)
    young = leases.claim_job().lease
    assert (leases.is_held(old), leases.is_held(young)) == (False, True)


def test_a_forgotten_lease_expires_while_the_others_of_its_owner_live(
    database, clock: Clock
) -> None:
    submit(database), submit(database)
    leases = leases_of(database, clock)
    dropped, kept = leases.claim_job().lease, leases.claim_job().lease
    leases.forget_lease(dropped)
    for _ in range(2):
        clock.advance(20)
        leases.renew_leases()
    assert state_of(database, dropped.job_id) is JobState.QUEUED
    assert state_of(database, kept.job_id) is JobState.RUNNING


def test_a_lease_that_a_rival_took_is_lost_and_the_rivals_is_not_renewed(
    database, clock: Clock
) -> None:
    submit(database)
    leases, rival = leases_of(database, clock), leases_of(database, clock)
    lease = leases.claim_job().lease
    clock.advance(31)
    rival.renew_leases()
    assert claim(database, "d2", clock).lease.attempt == 2
    leases.renew_leases()
    assert (leases.is_lost(lease), leases.is_held(lease)) == (True, False)
    clock.advance(31)
    leases.renew_leases()
    assert (state_of(database, lease.job_id), job_of(database, lease.job_id).lost_leases) == (
        JobState.QUEUED,
        2,
    )


class Stand:
    """A dispatcher in this process, with a executor and a clock that the test moves."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self.place, self.clock = Place(folder), clock
        self.executor = ScriptedExecutor(fails)
        self.executor.is_slow = True
        self.leases = leases_of(self.place.database, clock)
        self.dispatcher = Dispatcher(
            self.place.database, self.place.store, self.executor, self.leases
        )

    def turn_until(self, job: str, state: JobState, attempt: int) -> None:
        for _ in range(200_000):
            row = self.place.job(job)
            if (row.state, row.attempt) == (state, attempt):
                return
            self.dispatcher.run_round()
        raise AssertionError(f"{job} is {row.state} in attempt {row.attempt}")

    def turn_until_sent(self, n_packs: int) -> None:
        for _ in range(200_000):
            if len(self.executor.sent) == n_packs:
                return
            self.dispatcher.run_round()
        raise AssertionError(f"{len(self.executor.sent)} packs were sent")

    def lose_job(self) -> str:
        """Begin a job whose heartbeat is late, so that another dispatcher reaps it."""
        job = self.place.submit()
        self.turn_until_sent(1)
        self.clock.advance(31)
        leases_of(self.place.database, self.clock).renew_leases()
        return job


@pytest.fixture
def stand(tmp_path: Path, clock: Clock) -> Iterator[Stand]:
    made = Stand(tmp_path / "data", clock)
    yield made
    made.place.database.dispose()


def test_a_job_whose_heartbeat_was_late_goes_on_and_meanwhile_nothing_is_written(
    stand: Stand,
) -> None:
    job = stand.place.submit()
    stand.turn_until_sent(1)
    stand.clock.advance(31)  # the heartbeat waits for the database
    (recorder,) = stand.dispatcher._recorders.values()
    flushes = []
    recorder.write_due = lambda: flushes.append(stand.clock.now)  # type: ignore[method-assign]
    for _ in range(20):
        stand.dispatcher.run_round()
    assert (stand.executor.cancelled, flushes) == ([], [])
    stand.leases.renew_leases()
    stand.dispatcher.run_round()
    assert (stand.executor.cancelled, len(flushes)) == ([], 1)
    row = stand.place.job(job)
    assert (row.state, row.attempt, row.lost_leases) == (JobState.RUNNING, 1, 0)


def test_a_job_that_was_lost_while_its_heartbeat_was_late_is_taken_up_again(
    stand: Stand,
) -> None:
    job = stand.lose_job()
    stand.leases.renew_leases()
    for _ in range(200_000):
        stand.dispatcher.run_round()
        if stand.executor.cancelled:
            break
    assert stand.executor.cancelled
    assert stand.place.job(job).lost_leases == 1
    stand.turn_until(job, JobState.RUNNING, attempt=2)


class SlowDatabase:
    """A database whose commits take 8 s by the clock of the test; it notes how long it waits."""

    def __init__(self, database, clock: Clock) -> None:
        self._database, self._clock = database, clock
        self.read_session, self.waits = database.read_session, []

    @contextmanager
    def write_session(self, busy_seconds: float | None = None):
        self.waits.append(busy_seconds)
        with self._database.write_session(min(busy_seconds or 5.0, 5.0)) as session:
            yield session
        self._clock.advance(8)


def test_a_lease_is_held_from_the_moment_it_was_asked_for(database, clock: Clock) -> None:
    submit(database)
    leases = leases_of(SlowDatabase(database, clock), clock)
    lease = leases.claim_job().lease
    clock.advance(22)
    assert leases.is_held(lease)
    clock.advance(1)  # the answer came 23 s ago, the lease began 31 s ago
    assert not leases.is_held(lease)
    leases.renew_leases()
    clock.advance(22)
    assert leases.is_held(lease)
    clock.advance(1)
    assert not leases.is_held(lease)


class Unanswered:
    """A database whose answer to one commit is lost."""

    def __init__(self, database, *, is_deaf: bool = True) -> None:
        self._database, self.is_deaf = database, is_deaf
        self.read_session = database.read_session

    @contextmanager
    def write_session(self, *given: float):
        with self._database.write_session(*given) as session:
            yield session
        if self.is_deaf:
            self.is_deaf = False
            raise OperationalError("COMMIT", {}, Exception("server closed the connection"))


def test_a_claim_that_was_made_but_not_answered_is_found_by_the_next(
    database, clock: Clock
) -> None:
    job, other = submit(database), submit(database)
    leases = leases_of(Unanswered(database), clock)
    with pytest.raises(OperationalError):
        leases.claim_job()
    found = leases.claim_job()
    assert (found.job.id, found.lease.attempt) == (job, 1)
    assert state_of(database, other) is JobState.QUEUED
    leases.renew_leases()
    assert leases.is_held(found.lease)
    assert leases.claim_job().job.id == other


def test_a_claim_without_an_answer_gives_neither_a_held_job_nor_one_of_a_rival(
    database, clock: Clock
) -> None:
    rival = claim_of(database, leases_of(database, clock))
    deaf = Unanswered(database, is_deaf=False)
    leases = leases_of(deaf, clock)
    held, lost = claim_of(database, leases), submit(database)
    deaf.is_deaf = True
    with pytest.raises(OperationalError):
        leases.claim_job()
    assert leases.claim_job().job.id == lost
    assert leases.claim_job() is None
    assert [job_of(database, job).attempt for job in (rival, held, lost)] == [1, 1, 1]


def claim_of(database, leases: HeldLeases) -> str:
    """Submit a job and claim it; its identifier."""
    job = submit(database)
    assert leases.claim_job().job.id == job
    return job


def test_a_heartbeat_waits_for_the_database_no_longer_than_a_third_of_the_lease(
    database, clock: Clock
) -> None:
    slow = SlowDatabase(database, clock)
    job = submit(database)
    leases = HeldLeases(slow, 3.0)  # by the true clock
    lease = leases.claim_job().lease
    slow.waits.clear()
    with database.write_session() as other:
        other.execute(update(Parcel).where(Parcel.job_id == job).values(lost_leases=0))
        with pytest.raises(OperationalError):
            leases.renew_leases()
    assert slow.waits == [1.0]
    leases.renew_leases()
    assert leases.is_held(lease)


def test_no_heartbeat_is_sent_while_the_main_loop_stands(
    database, caplog: pytest.LogCaptureFixture
) -> None:
    claimed = HeldLeases(database, 0.6)

    def has_news() -> bool:
        with database.read_session() as session:
            (row,) = DispatcherRepository(session).list_all()
        is_new, seen["at"] = row.seen_at != seen.get("at"), row.seen_at
        return is_new

    seen: dict[str, object] = {}
    claimed.loop.turn()
    claimed.start_heartbeat({})
    until(lambda: "stands" in caplog.text, "the log")
    has_news()
    time.sleep(0.6)
    assert not has_news()
    with database.read_session() as session:
        told = DispatcherRepository(session).describe_wait()
    assert re.match(f"no dispatcher is alive: the last heartbeat of {claimed.owner} is", told or "")
    claimed.loop.turn()
    claimed.loop.end()  # it needs none any more
    until(has_news, "a heartbeat")
    assert "the main loop turns again" in caplog.text
    claimed.stop_heartbeat()


def test_of_two_dispatchers_the_one_that_stops_is_removed(database, clock: Clock) -> None:
    first, second = (leases_of(database, clock) for _ in range(2))
    for leases in (first, second):
        leases.start_heartbeat({})
    first.stop_heartbeat()
    with database.read_session() as session:
        assert [row.owner for row in DispatcherRepository(session).list_all()] == [second.owner]
    second.stop_heartbeat()


@pytest.mark.slow
def test_a_job_claimed_back_while_its_old_packs_fly_ends_once_under_its_new_attempt(
    stand: Stand,
) -> None:
    job = stand.lose_job()
    stand.turn_until_sent(2)
    assert len(stand.executor.packs) == 2
    stand.executor.is_slow = False
    stand.turn_until(job, JobState.FAILED, attempt=2)
    (run,) = stand.place.runs(job)
    assert (run.state, run.attempt, run.error) == (JobState.FAILED, 2, "as told")
    for _ in range(3):
        stand.dispatcher.run_round()
    assert stand.executor.packs == {}
