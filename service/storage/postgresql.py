"""Connections to PostgreSQL on which nothing waits without a limit.

A connection can fall silent without an end: its server was moved, a cable was cut, or a proxy
forgot it. Then the kernel tells of it after minutes or hours, and never if a proxy still answers
for the server. Therefore each wait has a limit at both ends. The server ends statements and waits
for locks, and transactions whose client is silent, so that their locks do not stay. This end gives
a connection up if nothing has arrived for longer than the server may take.

The limits of the kernel are those of libpq (keepalives and ``tcp_user_timeout``), those of the
server its own settings; both are described in the manual of PostgreSQL.
"""

import logging
import os
import socket
from collections.abc import Generator, Mapping
from time import monotonic
from typing import Any, TypeVar

import psycopg
from sqlalchemy import Connection, Engine, event, text
from sqlalchemy.engine import Dialect
from sqlalchemy.orm import Session
from sqlalchemy.pool import ConnectionPoolEntry

from service.core.process import service_metrics

_log = logging.getLogger(__name__)

T = TypeVar("T")

CONNECT_SECONDS = 5
PING_SECONDS = 5.0
"""Longest silence of a pooled connection that is asked whether it lives, before its use."""
STATEMENT_SECONDS = 15.0
LOCK_SECONDS = 10.0
IDLE_SECONDS = 30.0
"""After this time the server ends a transaction whose client sends nothing: its locks end too."""
SILENCE_SECONDS = STATEMENT_SECONDS + 3.0
"""Longest silence of a connection at work: then the server itself would have ended the statement.
"""
LONG_SECONDS = 3600.0
"""The same for what is known to take long, such as a migration."""
_SETTINGS: dict[str, Any] = {
    "application_name": f"lagid {os.getpid()} of {socket.gethostname()}"[:63],
    "connect_timeout": CONNECT_SECONDS,
    "keepalives": 1,
    "keepalives_idle": 10,
    "keepalives_interval": 3,
    "keepalives_count": 3,
    "tcp_user_timeout": 15_000,  # in ms
}
_SERVER_LIMITS = (
    f"SET statement_timeout = {int(1000 * STATEMENT_SECONDS)}; "
    f"SET lock_timeout = {int(1000 * LOCK_SECONDS)}; "
    f"SET idle_in_transaction_session_timeout = {int(1000 * IDLE_SECONDS)}"
)


class LimitedConnection(psycopg.Connection[Any]):
    """A connection that ends with an error if its server is silent for `silence_seconds`."""

    silence_seconds = SILENCE_SECONDS

    def wait(self, gen: Generator[Any, Any, T], *arguments: Any, **options: Any) -> T:
        """Carry out what waits for the server, within the limit."""
        return super().wait(self._limit_silence(gen), *arguments, **options)

    def _limit_silence(self, steps: Generator[Any, Any, T]) -> Generator[Any, Any, T]:
        """Pass on what the steps of psycopg wait for; it says now and then that nothing came."""
        heard = monotonic()
        try:
            wanted = next(steps)
            while True:
                ready = yield wanted
                if ready:
                    heard = monotonic()
                elif monotonic() - heard > self.silence_seconds:
                    self._give_up()
                wanted = steps.send(ready)
        except StopIteration as end:
            result: T = end.value
            return result

    def _give_up(self) -> None:
        service_metrics.silent_connections.inc()
        told = f"a connection to the database was silent for {self.silence_seconds:g} s"
        _log.warning("%s, and is replaced", told)
        self.pgconn.finish()
        raise psycopg.OperationalError(told)


def open_connection(engine: Engine) -> LimitedConnection:
    """Open a connection to the database of an engine, beside its pool; it commits by itself."""
    _, settings = engine.dialect.create_connect_args(engine.url)
    return _open_limited(settings)


def limit_waits(engine: Engine) -> None:
    """Let an engine open its connections with all limits."""
    event.listen(engine, "do_connect", _connect)
    event.listen(engine, "checkin", _expect_ping)


def limit_transaction(connection: Connection, busy: float | None, *, is_long: bool) -> None:
    """Set the limits of a transaction that begins.

    Parameters
    ----------
    busy : float or None
        How long it waits for locks, in s; None: `LOCK_SECONDS`.
    is_long : bool
        Whether it may take long.
    """
    driver: Any = connection.connection.dbapi_connection
    driver.silence_seconds = LONG_SECONDS if is_long else SILENCE_SECONDS
    limits = [] if busy is None else [f"SET LOCAL lock_timeout = {int(1000 * busy)}"]
    if is_long:
        limits += [
            f"SET LOCAL {name} = 0"
            for name in ("statement_timeout", "idle_in_transaction_session_timeout")
        ]
    if limits:
        connection.exec_driver_sql("; ".join(limits))


def _connect(
    _dialect: Dialect, _entry: ConnectionPoolEntry, _none: list[Any], settings: dict[str, Any]
) -> Any:
    connection = _open_limited(settings)
    connection.autocommit = False
    return connection


def _open_limited(settings: Mapping[str, Any]) -> LimitedConnection:
    """Open a connection with all limits; the address may name other settings of libpq."""
    connection = LimitedConnection.connect(**{**_SETTINGS, **settings}, autocommit=True)
    connection.execute(_SERVER_LIMITS)
    return connection


def _expect_ping(connection: Any, _entry: ConnectionPoolEntry) -> None:
    """Ask a pooled connection whether it lives, before anything else."""
    if connection is not None:
        connection.silence_seconds = PING_SECONDS


def list_other_processes(session: Session) -> list[str]:
    """List the other processes of lagid that have a connection to the database."""
    others = (
        "SELECT DISTINCT application_name FROM pg_stat_activity "
        "WHERE datname = current_database() AND application_name LIKE 'lagid %' "
        "AND application_name <> current_setting('application_name') ORDER BY 1"
    )
    return list(session.scalars(text(others)))
