"""Waiting for work: a waker tells of it soon, and never needs to."""

import threading
import time

from sqlalchemy import text

from service.queue.leases import LeaseQueue
from service.queue.notifications import open_notifier
from service.repositories.job_rows import JobRepository
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.job_rows import submit, submit_and_claim

LONG = LIMIT_SECONDS  # far beyond what a wake-up takes; a test that waits that long has failed


def settle(waker):
    while waker.wait_for_change(0.1):
        pass


def later(act):
    thread = threading.Timer(0.1, act)
    thread.start()
    return thread


def measure_wait(waker, seconds):
    start = time.monotonic()
    return waker.wait_for_change(seconds), time.monotonic() - start


def test_a_new_job_wakes_the_waiting(database):
    with open_notifier(database) as waker:
        settle(waker)
        thread = later(lambda: submit(database))
        assert waker.wait_for_change(LONG)
        thread.join()


def test_a_job_that_came_just_before_the_wait_is_not_missed(database):
    with open_notifier(database) as waker:
        settle(waker)
        submit(database)
        assert waker.wait_for_change(LONG)


def test_jobs_that_come_back_wake_too(database):
    got, _ = submit_and_claim(database)
    with open_notifier(database) as waker:
        settle(waker)
        with database.write_session() as session:
            LeaseQueue(session).release_job(got.lease)
        assert waker.wait_for_change(LONG)
        settle(waker)
        with database.write_session() as session:
            JobRepository(session).cancel(got.job.id)
            JobRepository(session).resume(got.job.id)
        assert waker.wait_for_change(LONG)


def test_without_news_the_wait_ends_by_the_clock(database):
    with open_notifier(database) as waker:
        settle(waker)
        woken, seconds = measure_wait(waker, 0.2)
    assert not woken
    assert seconds >= 0.2


def test_a_stop_ends_the_wait(database):
    stop = threading.Event()
    with open_notifier(database, stop) as waker:
        settle(waker)
        thread = later(stop.set)
        assert waker.wait_for_change(LONG)
        thread.join()


def test_a_broken_connection_is_replaced(postgres_database):
    with open_notifier(postgres_database) as waker:
        settle(waker)
        with postgres_database.write_session() as session:
            session.execute(
                text(
                    "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
                    "WHERE query LIKE 'LISTEN%' AND datname = current_database()"
                )
            )
        assert not waker.wait_for_change(0.1)  # it notices
        settle(waker)  # it listens again
        thread = later(lambda: submit(postgres_database))
        assert waker.wait_for_change(LONG)
        thread.join()
