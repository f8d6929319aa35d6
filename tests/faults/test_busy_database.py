"""A database that another process holds for longer than a lease."""

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import timedelta
from pathlib import Path

import pytest

from service.core.states import JobState
from service.dispatch.dispatcher import Dispatcher
from service.dispatch.held_leases import HeldLeases
from service.queue.orphaned_jobs import reap_jobs
from service.storage.columns import utc_now
from tests.support.cluster.dispatch_place import Place, until
from tests.support.cluster.inline_executor import InlineExecutor
from tests.support.storage.job_rows import parcels_of

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

LEASE_SECONDS = 0.5
ENDLESS = {"generations": 10_000_000, "stop": {"settled": None}}


@contextmanager
def dispatching(place: Place) -> Iterator[None]:
    """A dispatcher at work in a thread for the length of the block."""
    leases = HeldLeases(place.database, LEASE_SECONDS)
    dispatcher = Dispatcher(place.database, place.store, InlineExecutor(), leases)
    thread = threading.Thread(target=dispatcher.run_until_stopped)
    thread.start()
    try:
        yield
    finally:
        dispatcher.stopping.set()
        thread.join()


def test_a_database_that_is_busy_for_longer_than_a_lease_costs_nobody_a_job(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place = Place(tmp_path / "data")
    job = place.submit(algorithm=ENDLESS)

    def is_overdue() -> bool:
        parcels = parcels_of(place.database, job)
        end = parcels[0].lease_until if parcels else None
        return end is not None and end < utc_now() - timedelta(seconds=LEASE_SECONDS)

    file = place.settings.data_dir / "lagid.db"
    with dispatching(place), closing(sqlite3.connect(file)) as busy:
        busy.isolation_level = None
        busy.execute("PRAGMA busy_timeout = 30000")
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
    assert "no longer holds the lease" not in caplog.text
