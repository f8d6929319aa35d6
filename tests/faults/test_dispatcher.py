"""The dispatcher as a process: late, killed, told to cancel, told to stop."""

import os
import signal
from pathlib import Path

import pytest

from service.storage.tables import Checkpoint, State
from tests.dispatching import Place, until

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(240)]

LONG = {"generations": 6000, "stop": {"settled": None}}
ENDLESS = {"generations": 10_000_000, "stop": {"settled": None}}


def has_checkpoint(place: Place) -> bool:
    with place.database.read() as session:
        return session.query(Checkpoint).count() > 0


def test_a_job_survives_that_its_dispatcher_is_down_and_then_killed(tmp_path: Path) -> None:
    place = Place(tmp_path / "data")
    job = place.submit(algorithm=LONG, seed=7)
    assert place.job(job).state is State.QUEUED  # nobody is there to take it
    with place.dispatcher() as first:
        until(lambda: has_checkpoint(place), "a checkpoint")
        os.kill(first.pid, signal.SIGKILL)
        first.wait()
    assert place.job(job).state is State.RUNNING
    with place.dispatcher():
        ended = place.until(job, State.SUCCEEDED, State.FAILED)
        undisturbed = place.submit(algorithm=LONG, seed=7)
        place.until(undisturbed, State.SUCCEEDED, State.FAILED)
    assert (ended.state, ended.attempt, ended.lost_leases) == (State.SUCCEEDED, 2, 1)
    (run,), (other,) = place.runs(job), place.runs(undisturbed)
    assert run.result is not None
    assert other.result is not None
    assert {**run.result, "seconds": 0} == {**other.result, "seconds": 0}
    assert place.history(run.id) == place.history(other.id)
    assert not has_checkpoint(place)
    assert place.store.exists(run.signals_sha256 or "")


def test_cancelling_ends_a_job_and_stopping_gives_it_back_with_its_checkpoint(
    tmp_path: Path,
) -> None:
    place = Place(tmp_path / "data")
    with place.dispatcher() as dispatcher:
        cancelled = place.submit(algorithm=ENDLESS)
        until(lambda: place.job(cancelled).evaluations > 0, "progress")
        place.cancel(cancelled)
        place.until(cancelled, State.CANCELLED)
        stopped = place.submit(algorithm=ENDLESS)
        until(lambda: place.job(stopped).evaluations > 0, "progress")
    assert dispatcher.returncode == 0
    assert [run.state for run in place.runs(cancelled)] == [State.CANCELLED]
    assert (place.job(stopped).state, place.job(stopped).lost_leases) == (State.QUEUED, 0)
    assert has_checkpoint(place)
