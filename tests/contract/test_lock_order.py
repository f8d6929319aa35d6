"""Transactions of users and dispatchers lock rows in one order, so none is given up for another."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from sqlalchemy import event, text
from sqlalchemy.exc import SQLAlchemyError

from service.core.states import JobState
from service.items.editing import edit_item
from service.items.item_schemas import EditIn
from service.queue.leases import LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.job_rows import JobRepository
from service.storage.sessions import Database
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.job_rows import (
    claim,
    job_of,
    parcels_of,
    runs_of,
    state_of,
    submit,
    submit_and_claim,
)

pytestmark = pytest.mark.postgres  # SQLite has one writer at a time


@pytest.fixture
def database(postgres_database: Database) -> Database:
    return postgres_database


class Beside:
    """Work in a thread; its error is raised by `join`."""

    def __init__(self, work: Callable[[], object]) -> None:
        self._work, self._error = work, None
        self._thread = threading.Thread(target=self._carry_out)
        self._thread.start()

    def _carry_out(self) -> None:
        try:
            self._work()
        except SQLAlchemyError as error:
            self._error = error

    def join(self) -> None:
        self._thread.join(LIMIT_SECONDS)
        assert not self._thread.is_alive()
        if self._error is not None:
            raise self._error


def wait_until_blocked(database: Database) -> None:
    """Wait until a transaction waits for a lock of another."""
    query = text(
        "SELECT count(*) FROM pg_stat_activity "
        "WHERE datname = current_database() AND wait_event_type = 'Lock'"
    )
    deadline = time.monotonic() + LIMIT_SECONDS
    with database.engine.connect() as connection:
        while not connection.scalar(query):
            connection.rollback()
            assert time.monotonic() < deadline, "nothing waits"
            time.sleep(0.01)


@contextmanager
def act_after(database: Database, *acts: tuple[str, Callable[[], object]]) -> Iterator[None]:
    """Act in this thread, one act after another, each after a statement with that text."""
    thread, left, is_acting = threading.get_ident(), list(acts), False

    def look(_connection, _cursor, statement, *_) -> None:
        nonlocal is_acting
        is_own = threading.get_ident() == thread and not is_acting
        if left and is_own and left[0][0] in statement:
            is_acting = True
            left.pop(0)[1]()
            is_acting = False

    event.listen(database.engine, "after_cursor_execute", look)
    try:
        yield
    finally:
        event.remove(database.engine, "after_cursor_execute", look)
    assert not left


def test_a_job_that_is_given_back_and_claimed_while_it_is_cancelled_is_cancelled(database):
    job = submit(database)
    lease, claims, beside = claim(database, "d1").lease, [], []

    def give_back() -> None:
        with database.write_session() as session:
            LeaseQueue(session).release_job(lease)

    def claim_again() -> None:
        beside.append(Beside(lambda: claims.append(claim(database, "d2"))))
        wait_until_blocked(database)

    with (
        act_after(database, ("SELECT jobs.state", give_back), ("FOR NO KEY", claim_again)),
        database.write_session() as session,
    ):
        JobRepository(session).cancel(job)
    beside[0].join()
    (claimed_again,) = claims
    is_held = claimed_again is not None
    assert job_of(database, job).cancel_requested
    assert state_of(database, job) is (JobState.RUNNING if is_held else JobState.CANCELLED)
    assert len(parcels_of(database, job)) == is_held


def test_a_run_is_edited_while_its_dispatcher_writes_it(database):
    got, (run,) = submit_and_claim(database)

    def edit() -> None:
        with database.write_session() as session:
            edit_item(session, "run", run, EditIn(note="odd"))

    with database.write_session() as session:
        writer = RunWriter(session, got.lease)
        writer.start_runs([run])
        beside = Beside(edit)
        wait_until_blocked(database)
        writer.record_outcomes([RunOutcome(run_id=run, state=JobState.SUCCEEDED)])
    beside.join()
    (stored,) = runs_of(database, got.job.id)
    assert (stored.state, stored.note) == (JobState.SUCCEEDED, "odd")
    assert job_of(database, got.job.id).n_done == 1
