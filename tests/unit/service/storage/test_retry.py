"""Work on a database that is away for a while is done when it is back."""

import sqlite3
from pathlib import Path

import psycopg
import pytest
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError, InterfaceError, OperationalError

from service.core.settings import make_sqlite_url
from service.storage import retry
from service.storage.sessions import Database


def away() -> OperationalError:
    return OperationalError("SELECT 1", {}, Exception("connection refused"))


def test_work_is_tried_until_the_database_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "PAUSE_SECONDS", 0.0)
    troubles = [away(), away()]

    def work() -> str:
        if troubles:
            raise troubles.pop()
        return "done"

    assert retry.retry_transient(work) == "done"


def test_a_database_that_does_not_come_back_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retry, "PAUSE_SECONDS", 0.0)
    monkeypatch.setattr(retry, "GIVE_UP_SECONDS", 0.0)

    def work() -> None:
        raise away()

    with pytest.raises(OperationalError):
        retry.retry_transient(work)


def test_a_fault_of_the_statement_is_not_tried_again() -> None:
    tries = []

    def work() -> None:
        tries.append(1)
        raise IntegrityError("INSERT", {}, Exception("duplicate"))

    with pytest.raises(IntegrityError):
        retry.retry_transient(work)
    assert len(tries) == 1


def catch_error(database: Database, statement: str, **values: object) -> OperationalError:
    """What a statement that cannot be carried out raises."""
    with (
        pytest.raises((OperationalError, InterfaceError)) as caught,
        database.write_session(busy_seconds=0.05) as session,
    ):
        session.execute(text(statement), values)
    return caught.value


@pytest.fixture
def database(tmp_path: Path):
    made = Database(make_sqlite_url(tmp_path / "a.db"))
    yield made
    made.dispose()


def test_a_mistake_in_a_statement_is_not_taken_for_a_database_that_is_away(
    database: Database,
) -> None:
    mistake = catch_error(database, "SELECT nothing FROM nowhere")
    assert isinstance(mistake, OperationalError)
    assert not retry.is_transient(mistake)
    tries = []

    def work() -> None:
        tries.append(1)
        raise mistake

    with pytest.raises(OperationalError):
        retry.retry_transient(work)
    assert len(tries) == 1


def test_a_locked_file_and_one_that_cannot_be_opened_may_pass(
    database: Database, tmp_path: Path
) -> None:
    with database.write_session() as session:
        session.execute(text("SELECT 1"))  # a transaction begins with its first statement
        assert retry.is_transient(catch_error(database, "SELECT 1"))
    other = Database(make_sqlite_url(tmp_path / "absent" / "a.db"))
    assert retry.is_transient(catch_error(other, "SELECT 1"))
    other.dispose()


def test_a_disk_that_is_full_may_pass(database: Database) -> None:
    with database.write_session() as session:
        session.execute(text("CREATE TABLE t (x)"))
    with database.write_session() as session:
        session.execute(text("PRAGMA max_page_count = 3"))
        with pytest.raises(OperationalError) as caught:
            session.execute(text("INSERT INTO t VALUES (zeroblob(100000))"))
        session.rollback()
    assert retry.is_transient(caught.value)


@pytest.mark.parametrize(
    ("cause", "passes"),
    [
        (psycopg.OperationalError("the connection is lost"), True),
        (psycopg.errors.AdminShutdown("terminating"), True),
        (psycopg.errors.CannotConnectNow("starting up"), True),
        (psycopg.errors.DiskFull("no space"), True),
        (psycopg.errors.DeadlockDetected("deadlock"), True),
        (psycopg.errors.LockNotAvailable("lock timeout"), True),
        (psycopg.errors.ObjectInUse("in use"), False),
        (psycopg.errors.ObjectNotInPrerequisiteState("state"), False),
    ],
    ids=lambda value: type(value).__name__,
)
def test_postgresql_tells_by_its_state_whether_an_error_may_pass(
    cause: psycopg.Error, passes: bool
) -> None:
    assert retry.is_transient(OperationalError("SELECT 1", {}, cause)) is passes


def test_a_value_that_sqlite_cannot_take_does_not_pass() -> None:
    cause = sqlite3.InterfaceError("Error binding parameter")
    assert not retry.is_transient(InterfaceError("SELECT ?", {}, cause))
