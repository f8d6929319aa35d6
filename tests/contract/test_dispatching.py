"""A dispatcher with several jobs: each is claimed, cancelled and lost by itself."""

import gc
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.core.states import OPEN_STATES, JobState
from service.dispatch import dispatcher
from service.dispatch.job_runs import JobRuns
from service.queue.leases import LeaseQueue
from service.queue.run_writes import RunWriter
from tests.contract.test_leases import Stand, leases_of
from tests.support.storage.job_rows import Clock
from workers.protocol import QueuedRun

SWEEP = {"axes": [{"path": "/seed", "range": [0, dispatcher.SHORT_RUNS + 1]}]}


@pytest.fixture
def stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stand]:
    """A dispatcher that looks at its queue in each round."""
    monkeypatch.setattr(dispatcher, "BUSY_SECONDS", -1.0)
    monkeypatch.setattr(dispatcher, "IDLE_SECONDS", 0.0)
    made = Stand(tmp_path / "data", Clock())
    yield made
    made.place.database.dispose()


def turn(stand: Stand, rounds: int) -> None:
    for _ in range(rounds):
        stand.dispatcher.run_round()


def states(stand: Stand, *jobs: str) -> list[JobState]:
    return [stand.place.job(job).state for job in jobs]


def test_of_two_jobs_the_one_that_is_cancelled_stops(stand: Stand) -> None:
    stays, goes = stand.place.submit(), stand.place.submit()
    turn(stand, 4)
    (kept,), (stopped,) = (
        [handle for handle, runs in enumerate(stand.executor.sent) if run.id in runs]
        for job in (stays, goes)
        for run in stand.place.runs(job)
    )
    stand.place.cancel(goes)
    turn(stand, 2)
    assert (kept, stopped) == (0, 1)
    assert stand.executor.cancelled == [(stopped, False)]
    stand.executor.is_slow = False
    turn(stand, 2)
    assert states(stand, stays, goes) == [JobState.FAILED, JobState.CANCELLED]
    assert stand.place.job(stays).error == "as told"


def test_of_two_jobs_the_one_that_is_lost_stops(stand: Stand) -> None:
    lost = stand.place.submit()
    turn(stand, 2)
    stand.clock.advance(31)
    kept = stand.place.submit()
    turn(stand, 2)
    assert states(stand, lost, kept) == [JobState.RUNNING, JobState.RUNNING]
    rival = leases_of(stand.place.database, stand.clock)
    rival.renew_leases()  # reaps the first one
    assert rival.claim_job().job.id == lost
    stand.leases.renew_leases()
    turn(stand, 2)
    assert stand.executor.cancelled == [(0, False)]
    stand.executor.is_slow = False
    turn(stand, 2)
    assert states(stand, lost, kept) == [JobState.RUNNING, JobState.FAILED]
    assert {run.state for run in stand.place.runs(lost)} <= set(OPEN_STATES)


def test_a_parcel_that_is_lost_while_it_is_taken_stays_with_its_new_holder(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process stands still after its claim, for longer than its lease."""
    lost, rival = stand.place.submit(), leases_of(stand.place.database, stand.clock)
    rival.claim_job()
    rival.release_all()  # the recorder of a later claim looks at what was stored before
    claim = stand.leases.claim_job

    def claim_and_stand_still(*given, **options):
        claimed = claim(*given, **options)
        stand.clock.advance(31)
        rival.renew_leases()
        assert rival.claim_job().job.id == lost
        monkeypatch.setattr(stand.leases, "claim_job", claim)
        return claimed

    monkeypatch.setattr(stand.leases, "claim_job", claim_and_stand_still)
    turn(stand, 1)
    assert (stand.leases.list_held(), stand.executor.sent) == ((), [])
    stand.executor.is_slow = False
    other = stand.place.submit()
    turn(stand, 4)
    assert states(stand, lost, other) == [JobState.RUNNING, JobState.FAILED]
    rival.release_all()
    turn(stand, 4)
    assert states(stand, lost) == [JobState.FAILED]


def test_a_full_dispatcher_takes_what_is_short_or_more_urgent_than_one_of_its_jobs(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatcher, "MAX_JOBS", 2)
    held = [stand.place.submit(priority=priority) for priority in (0, 5)]
    turn(stand, 4)
    sweep, urgent = (stand.place.submit(priority=one, sweep=SWEEP) for one in (0, 3))
    turn(stand, 4)
    short, late = stand.place.submit(), stand.place.submit()
    turn(stand, 6)
    assert states(stand, *held, urgent, short) == [JobState.RUNNING] * 4
    assert states(stand, sweep, late) == [JobState.QUEUED] * 2  # twice as many as `MAX_JOBS`


def test_deaths_counted_by_an_earlier_dispatcher_go_with_their_run(stand: Stand) -> None:
    axes = [{"path": "/seed", "range": [0, 3]}]
    job = stand.place.submit(sweep={"axes": axes})
    first, second, _ = (run.id for run in stand.place.runs(job))
    with stand.place.database.write_session() as session:
        claim = LeaseQueue(session).claim_job("d1")
        RunWriter(session, claim.lease).write_kills({second: 1})
    entries = JobRuns(stand.place.database, claim, stand.place.store).iterate_runs()
    found = {entry.run: entry.kills for entry in entries if isinstance(entry, QueuedRun)}
    assert (found[first], found[second]) == (0, 1)


def test_while_a_dispatcher_works_modules_are_not_searched_for_garbage(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    spared, before = [], gc.get_threshold()

    def note_once(working: dispatcher.Dispatcher) -> None:
        spared.append(gc.get_freeze_count())
        working.stopping.set()

    monkeypatch.setattr(dispatcher.Dispatcher, "run_round", note_once)
    stand.dispatcher.run_until_stopped()
    assert spared[0] > dispatcher.NEW_OBJECTS
    assert (gc.get_freeze_count(), gc.get_threshold()) == (0, before)
