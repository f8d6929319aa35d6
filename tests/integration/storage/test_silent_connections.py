"""Connections to PostgreSQL that fall silent are noticed, and nothing waits without a limit."""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.exc import TimeoutError as NoConnection

from service.core.process import service_metrics
from service.queue import notifications
from service.queue.notifications import open_notifier
from service.repositories.job_rows import QUEUE_CHANNEL
from service.storage import postgresql, sessions
from service.storage.retry import is_transient
from service.storage.sessions import Database
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.databases import empty_postgres, postgres_url
from tests.support.storage.silent_proxy import SilentProxy

pytestmark = pytest.mark.postgres


@pytest.fixture
def proxy() -> Iterator[SilentProxy]:
    made = SilentProxy(postgres_url())
    yield made
    made.close()


@pytest.fixture
def database(proxy: SilentProxy) -> Iterator[Database]:
    """A database behind the door that can fall silent."""
    with empty_postgres() as direct:
        made = Database(proxy.url(direct.engine.url.database), pool_size=2, max_overflow=0)
        yield made
        made.dispose()


def read_one(database: Database, statement: str = "SELECT 1") -> object:
    with database.read_session() as session:
        return session.scalar(text(statement))


def count_silent() -> float:
    return service_metrics.silent_connections._value.get()


def measure(work: Callable[[], object]) -> float:
    begun = time.monotonic()
    work()
    return time.monotonic() - begun


def test_a_pooled_connection_that_fell_silent_is_replaced_before_its_use(
    database: Database, proxy: SilentProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(postgresql, "PING_SECONDS", 0.3)
    read_one(database)
    before = count_silent()
    proxy.silence_all()
    assert measure(lambda: read_one(database)) < LIMIT_SECONDS
    assert count_silent() == before + 1


def test_a_statement_without_an_answer_fails_as_a_fault_that_may_pass(
    database: Database, proxy: SilentProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(postgresql, "SILENCE_SECONDS", 0.5)
    with database.write_session() as session:
        session.execute(text("SELECT 1"))
        proxy.silence_all()
        with pytest.raises(OperationalError, match=r"silent for 0\.5 s") as caught:
            session.execute(text("SELECT 2"))
        session.rollback()
    assert is_transient(caught.value)
    assert read_one(database) == 1


def test_what_arrives_slowly_is_not_silence(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(postgresql, "SILENCE_SECONDS", 0.6)
    slow = "SELECT count(pg_sleep(0.01)) FROM generate_series(1, 20)"
    with database.read_session() as session:
        for _ in range(5):  # together longer than the limit
            assert session.scalar(text(slow)) == 20


@pytest.mark.parametrize(
    ("limit", "statement"),
    [("STATEMENT", "SELECT pg_sleep(600)"), ("LOCK", "LOCK TABLE held IN ACCESS EXCLUSIVE MODE")],
)
def test_the_server_ends_statements_and_waits_for_locks(
    database: Database, monkeypatch: pytest.MonkeyPatch, limit: str, statement: str
) -> None:
    name = {"STATEMENT": "statement_timeout", "LOCK": "lock_timeout"}[limit]
    monkeypatch.setattr(postgresql, "_SERVER_LIMITS", f"SET {name} = 300")
    with database.write_session() as session:
        session.execute(text("CREATE TABLE held (x int)"))
    with database.write_session() as holder:
        holder.execute(text("LOCK TABLE held IN SHARE MODE"))
        with database.write_session() as session:
            with pytest.raises(OperationalError) as caught:
                session.execute(text(statement))
            session.rollback()
    assert is_transient(caught.value)


def test_a_transaction_whose_client_is_silent_ends_and_may_be_tried_again(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = "SET idle_in_transaction_session_timeout = 100"
    monkeypatch.setattr(postgresql, "_SERVER_LIMITS", limits)
    with database.write_session() as session:
        session.execute(text("SELECT 1"))
        time.sleep(0.4)
        with pytest.raises(DBAPIError) as caught:
            session.execute(text("SELECT 2"))
        session.rollback()
    assert is_transient(caught.value)
    assert read_one(database) == 1


def test_each_connection_has_the_limits_of_server_and_kernel(database: Database) -> None:
    shown = [
        read_one(database, f"SHOW {name}")
        for name in ("statement_timeout", "lock_timeout", "idle_in_transaction_session_timeout")
    ]
    assert shown == ["15s", "10s", "30s"]
    with database.engine.connect() as connection:
        info = connection.connection.dbapi_connection.info.get_parameters()
    assert (info["keepalives_idle"], info["tcp_user_timeout"]) == ("10", "15000")


def test_what_takes_long_has_no_limit_at_the_server(database: Database) -> None:
    with database.get_waiting_engine(7.0).begin() as connection:
        assert connection.exec_driver_sql("SHOW statement_timeout").scalar() == "0"
        assert connection.exec_driver_sql("SHOW lock_timeout").scalar() == "7s"
    with database.read_snapshot() as connection:
        assert connection.exec_driver_sql("SHOW statement_timeout").scalar() == "0"
    assert read_one(database, "SHOW statement_timeout") == "15s"  # only within the transaction


def test_the_wait_for_a_pooled_connection_has_a_limit(
    proxy: SilentProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "POOL_SECONDS", 0.2)
    few = Database(proxy.url("postgres"), pool_size=1, max_overflow=0)
    with few.read_session() as session:
        session.execute(text("SELECT 1"))
        with pytest.raises(NoConnection):
            read_one(few)
    few.dispose()


def test_a_listener_whose_connection_fell_silent_listens_again(
    database: Database, proxy: SilentProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(notifications, "QUIET_SECONDS", 0.2)
    monkeypatch.setattr(postgresql.LimitedConnection, "silence_seconds", 0.3)
    stop = threading.Event()
    with open_notifier(database, stop) as notifier, ThreadPoolExecutor(1) as pool:
        notifier.wait_for_change(5.0)  # it connects
        proxy.silence_all()
        limit = time.monotonic() + LIMIT_SECONDS
        heard = pool.submit(lambda: None)
        while not heard.done() or not heard.result():
            assert time.monotonic() < limit, "nothing was heard again"
            heard = pool.submit(notifier.wait_for_change, 0.5)
            heard.result()
            with database.write_session() as session:
                session.execute(text(f"NOTIFY {QUEUE_CHANNEL}"))
        stop.set()
