"""The dispatcher as a process: late, killed, told to cancel, told to stop."""

import os
import signal
import sqlite3
from contextlib import closing
from datetime import timedelta
from pathlib import Path

import pytest

from service.core.states import JobState
from service.queue.orphaned_jobs import reap_jobs
from service.storage.columns import utc_now
from service.storage.tables import Checkpoint
from tests.dispatching import Place, until

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(600)]

LONG = {"generations": 30_000, "stop": {"settled": None}}  # seconds after its first checkpoint
ENDLESS = {"generations": 10_000_000, "stop": {"settled": None}}


def has_checkpoint(place: Place) -> bool:
    with place.database.read_session() as session:
        return session.query(Checkpoint).count() > 0


def test_a_job_survives_that_its_dispatcher_is_down_and_then_killed(tmp_path: Path) -> None:
    place = Place(tmp_path / "data")
    job = place.submit(algorithm=LONG, seed=7)
    assert place.job(job).state is JobState.QUEUED  # nobody is there to take it
    with place.dispatcher() as first:
        until(lambda: has_checkpoint(place), "a checkpoint")
        os.kill(first.pid, signal.SIGKILL)
        first.wait()
    assert place.job(job).state is JobState.RUNNING
    with place.dispatcher():
        ended = place.until(job, JobState.SUCCEEDED, JobState.FAILED)
        undisturbed = place.submit(algorithm=LONG, seed=7)
        place.until(undisturbed, JobState.SUCCEEDED, JobState.FAILED)
    assert (ended.state, ended.attempt, ended.lost_leases) == (JobState.SUCCEEDED, 2, 1)
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
        place.until(cancelled, JobState.CANCELLED)
        stopped = place.submit(algorithm=ENDLESS)
        until(lambda: place.job(stopped).evaluations > 0, "progress")
    assert dispatcher.returncode == 0
    assert [run.state for run in place.runs(cancelled)] == [JobState.CANCELLED]
    assert (place.job(stopped).state, place.job(stopped).lost_leases) == (JobState.QUEUED, 0)
    assert has_checkpoint(place)


def test_a_database_that_is_busy_for_longer_than_a_lease_costs_nobody_a_job(
    tmp_path: Path,
) -> None:
    place = Place(tmp_path / "data")
    place.settings = place.settings.model_copy(update={"lease_seconds": 1.0})
    lease = timedelta(seconds=1)

    def is_overdue() -> bool:
        until_when = place.job(job).lease_until
        return until_when is not None and until_when < utc_now() - lease

    with place.dispatcher(), closing(sqlite3.connect(place.settings.data_dir / "lagid.db")) as busy:
        busy.isolation_level = None
        busy.execute("PRAGMA busy_timeout = 30000")
        job = place.submit(algorithm=ENDLESS)
        until(lambda: place.job(job).evaluations > 0, "progress")
        for _ in range(3):
            busy.execute("BEGIN IMMEDIATE")
            until(is_overdue, "the lease was overdue")
            busy.execute("ROLLBACK")
            assert reap_jobs(place.database).owners == frozenset()
            before = place.job(job).evaluations
            until(lambda before=before: place.job(job).evaluations > before, "more progress")
        row = place.job(job)
        assert (row.state, row.attempt, row.lost_leases) == (JobState.RUNNING, 1, 0)
        place.cancel(job)
        place.until(job, JobState.CANCELLED)
    log = (place.settings.data_dir / "dispatcher.log").read_text()
    assert "no longer holds the lease" not in log
