"""Hosts whose clocks are five minutes apart: web processes, dispatchers, database and store."""

import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from service.core.states import JobState
from service.dispatch.held_leases import HeldLeases
from service.jobs.submit import measure_seconds
from service.queue.dispatchers import DispatcherRepository
from service.queue.leases import LeaseQueue
from service.queue.orphaned_jobs import reap_jobs
from service.repositories.job_rows import JobRepository
from service.repositories.run_rows import RunRepository
from service.storage import columns, objects
from service.storage.clocks import choose_database_clock
from service.storage.columns import utc_now
from service.storage.garbage import delete_orphans
from service.storage.objects import RENEWAL_AGE, open_store
from service.storage.sessions import Database
from tests.support.storage.job_rows import job_of, state_of, submit, submit_and_claim
from tests.support.storage.object_stores import make_bucket

APART = timedelta(minutes=5)
SECONDS = 2.0
Move = Callable[[timedelta], None]


@pytest.fixture
def go_to_host(monkeypatch: pytest.MonkeyPatch) -> Move:
    """Go to a host whose clock is so far ahead."""

    def move(ahead: timedelta) -> None:
        class HostClock(datetime):
            @classmethod
            def now(cls, tz: Any = None) -> Any:
                return datetime.now(tz) + ahead

        monkeypatch.setattr(columns, "datetime", HostClock)
        monkeypatch.setattr(objects, "datetime", HostClock)
        assert abs(utc_now() - datetime.now(UTC) - ahead) < timedelta(seconds=5)

    return move


@pytest.fixture
def database(postgres_database: Database) -> Database:
    """The one database of several hosts."""
    return postgres_database


@pytest.mark.postgres
@pytest.mark.parametrize(("held", "rival"), [(APART, -APART), (-APART, APART)])
def test_a_lease_ends_after_its_length_whatever_the_clocks_of_hosts(
    database: Database, go_to_host: Move, held: timedelta, rival: timedelta
) -> None:
    job = submit(database)
    go_to_host(held)
    leases, others = (HeldLeases(database, SECONDS) for _ in range(2))
    for one in (leases, others):
        one._announce_dispatcher({"lease_seconds": SECONDS})
    lease = leases.claim_job().lease
    go_to_host(rival)
    assert reap_jobs(database).requeued == ()
    with database.read_session() as session:
        alive = DispatcherRepository(session).list_alive()
        assert {one.owner for one in alive} == {leases.owner, others.owner}
    time.sleep(0.7 * SECONDS)
    go_to_host(held)
    leases.renew_leases()
    assert leases.is_held(lease)
    go_to_host(rival)
    time.sleep(0.7 * SECONDS)
    assert reap_jobs(database).requeued == ()  # it was renewed
    time.sleep(0.4 * SECONDS)
    assert reap_jobs(database).requeued == (job,)
    assert others.claim_job().lease.job_id == job


@pytest.mark.postgres
@pytest.mark.parametrize("web", [APART, -APART])
def test_times_of_a_job_follow_from_one_clock(
    database: Database, go_to_host: Move, web: timedelta
) -> None:
    got, (run_id, *_) = submit_and_claim(database, n_runs=2)
    go_to_host(web)
    with database.read_session() as session:
        job, clock = JobRepository(session).get(got.job.id), choose_database_clock(session)
        seconds = measure_seconds(job, clock)
    assert seconds is not None
    assert 0.0 < seconds < 60.0
    with database.write_session() as session:
        JobRepository(session).cancel(got.job.id)
        LeaseQueue(session).cancel_parcel(got.lease)
    queued = submit(database)
    with database.write_session() as session:
        JobRepository(session).cancel(queued)
    now = datetime.now(UTC)
    for job_id in (got.job.id, queued):
        assert state_of(database, job_id) is JobState.CANCELLED
        ended = job_of(database, job_id).finished_at
        assert ended is not None
        assert abs(now - ended) < timedelta(seconds=60)
    with database.read_session() as session:
        ended = RunRepository(session).get(run_id).finished_at
        assert ended is not None
        assert abs(now - ended) < timedelta(seconds=60)


@pytest.mark.postgres
@pytest.mark.parametrize(("uploader", "housekeeper"), [(-APART, APART), (APART, -APART)])
def test_no_object_is_garbage_while_its_row_is_written(
    database: Database, go_to_host: Move, uploader: timedelta, housekeeper: timedelta
) -> None:
    """An object that an uploader just finds young enough is not yet old for a housekeeper."""
    assert 2 * APART < RENEWAL_AGE
    store = open_store(make_bucket())
    stored = store.put_stream([b"twice"]).sha256
    go_to_host(RENEWAL_AGE + uploader - timedelta(minutes=6))  # so long after, on its clock
    store.put_stream([b"twice"])
    go_to_host(RENEWAL_AGE + housekeeper + timedelta(minutes=6))
    assert delete_orphans(database, store) == (0, 0)
    assert store.exists(stored)
