"""Engines and sessions: one transaction per session, opened for reading or for writing."""

import copy
import os
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, make_url
from sqlalchemy.engine.interfaces import DBAPIConnection, ExceptionContext
from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.orm import Session, sessionmaker
from sqlalchemy.pool import ConnectionPoolEntry, QueuePool

from service.core.extras import check_extra
from service.core.process import service_metrics
from service.storage.columns import to_json
from service.storage.retry import is_transient
from service.storage.tables import DEFAULT_PROJECT

BUSY_SECONDS = 30.0
POOL_SECONDS = 10.0
"""Longest wait for a connection of the pool, while others of this process have them all."""
CACHE_KIB = 32_768
"""Pages that a connection of SQLite keeps if it writes thousands of rows at a time, in KiB."""
ANALYSED_ROWS = 1000
"""Rows of each index that SQLite's ANALYZE reads."""
_LONG_OPTION, _BUSY_OPTION = "lagid_is_long", "lagid_busy_seconds"
"""Options of a transaction: whether it may take long, and how long it waits for locks (s)."""
_READ_OPTIONS = {"lagid_reads": True, "postgresql_readonly": True}
_DATABASE_KEY, _OWNER_KEY = "lagid_database", "lagid_owner"


@dataclass(frozen=True, slots=True)
class SessionOwner:
    """For whom a session works: it sees this project, and its changes are this actor's.

    Attributes
    ----------
    project_id : str
    actor : str
        Identifier of an API key, or ``user:NAME`` from a proxy. Without keys ``loopback``, or
        ``anybody`` on an open host. Else a part of lagid.
    request_id : str or None
        Identifier of the request that the session serves.
    """

    project_id: str = DEFAULT_PROJECT
    actor: str = "lagid"
    request_id: str | None = None


_DEFAULT_OWNER = SessionOwner()


class Database:
    """Access to the SQL database.

    ``with database.write_session() as session`` commits at the end, or rolls back on an error. On
    SQLite a writing session begins with ``BEGIN IMMEDIATE``. So it waits for the lock at its start
    and never meets a deadlock later. A reading session sees one consistent state and cannot write.

    Parameters
    ----------
    url : str
        Address of the database.
    is_durable : bool
        Whether a commit survives a power cut. On SQLite, without it, the last commits may be lost:
        right for a dispatcher, whose work is computed again. On PostgreSQL each commit survives.
    **options
        Options of SQLAlchemy's engine.
    """

    def __init__(self, url: str, *, is_durable: bool = False, **options: Any) -> None:
        self.engine = _create_engine(url, is_durable=is_durable, **options)
        event.listen(self.engine, "handle_error", _count_error)
        self._info: dict[str, Any] = {_DATABASE_KEY: self}
        self._write = sessionmaker(self.engine, expire_on_commit=False)
        self._read = sessionmaker(
            self.engine.execution_options(**_READ_OPTIONS),
            expire_on_commit=False,
            autoflush=False,
        )

    @property
    def is_sqlite(self) -> bool:
        """Whether the database is SQLite (else PostgreSQL)."""
        return self.engine.dialect.name == "sqlite"

    def open_for(self, owner: SessionOwner) -> "Database":
        """Return the same database for sessions of an owner; both share their connections."""
        owned = copy.copy(self)
        owned._info = {_DATABASE_KEY: owned, _OWNER_KEY: owner}
        return owned

    @property
    def owner(self) -> SessionOwner:
        """For whom the sessions of this database work."""
        owner: SessionOwner = self._info.get(_OWNER_KEY, _DEFAULT_OWNER)
        return owner

    @contextmanager
    def write_session(self, busy_seconds: float | None = None) -> Iterator[Session]:
        """Open a session that commits when its block ends without an error.

        Parameters
        ----------
        busy_seconds : float, optional
            How long to wait for locks of others, `BUSY_SECONDS` at most. By default that time on
            SQLite, and on PostgreSQL what its connections have as their limit.
        """
        factory = self._write
        if busy_seconds is not None:
            impatient = self.engine.execution_options(
                **{_BUSY_OPTION: min(busy_seconds, BUSY_SECONDS)}
            )
            factory = sessionmaker(impatient, expire_on_commit=False)
        with factory(info=self._info) as session, session.begin():
            yield session

    @contextmanager
    def read_session(self) -> Iterator[Session]:
        """Open a session that only reads."""
        with self._read(info=self._info) as session:
            yield session

    @contextmanager
    def read_snapshot(self) -> Iterator[Connection]:
        """Open a connection that sees one state of the database until the block ends."""
        options: dict[str, Any] = {**_READ_OPTIONS, _LONG_OPTION: True}
        if not self.is_sqlite:  # where a reading transaction sees one state in any case
            options["isolation_level"] = "REPEATABLE READ"
        with self.engine.execution_options(**options).begin() as connection:
            yield connection

    def get_waiting_engine(self, seconds: float) -> Engine:
        """Return an engine whose transactions wait `seconds` for locks, and may take long."""
        return self.engine.execution_options(**{_BUSY_OPTION: seconds, _LONG_OPTION: True})

    def update_statistics(self) -> None:
        """Count rows for SQLite's planner, by samples of each index; PostgreSQL does it by itself.

        It is done when the database is opened and after many rows were written. If others hold the
        lock, it is left to the next time.
        """
        if self.is_sqlite:
            with suppress(OperationalError), self.get_waiting_engine(0.1).begin() as connection:
                connection.exec_driver_sql(f"PRAGMA analysis_limit = {ANALYSED_ROWS}")
                connection.exec_driver_sql("ANALYZE")

    def dispose(self) -> None:
        """Close every pooled connection."""
        self.engine.dispose()


def release_connection(session: Session) -> None:
    """Return the connection of a reading session to the pool, before a wait.

    Rows that were loaded stay. The next statement takes a connection again, and sees newer rows.
    """
    session.commit()


def find_database(session: Session) -> Database:
    """Return the database of a reading session, to store what reading it has shown."""
    database: Database = session.info[_DATABASE_KEY]
    return database


def find_owner(session: Session) -> SessionOwner:
    """Return for whom a session works."""
    owner: SessionOwner = session.info.get(_OWNER_KEY, _DEFAULT_OWNER)
    return owner


def find_project(session: Session) -> str:
    """Return the project that a session sees."""
    return find_owner(session).project_id


def _create_engine(url: str, *, is_durable: bool, **options: Any) -> Engine:
    address = make_url(url)
    if options.get("poolclass", QueuePool) is QueuePool:
        options.setdefault("pool_timeout", POOL_SECONDS)
    if address.get_backend_name() == "sqlite":
        settings = {"timeout": BUSY_SECONDS, "check_same_thread": False}
        engine = create_engine(address, json_serializer=to_json, connect_args=settings, **options)
        event.listen(engine, "do_connect", _create_private_file)
        event.listen(engine, "connect", partial(_prepare_sqlite, is_durable=is_durable))
        event.listen(engine, "begin", _begin_sqlite)
        return engine
    if address.drivername == "postgresql":
        address = address.set(drivername="postgresql+psycopg")
    if address.drivername == "postgresql+psycopg":
        check_extra("postgres", "a database on PostgreSQL")
    # A pooled connection may have died with a restarted server: ask before use.
    engine = create_engine(address, json_serializer=to_json, pool_pre_ping=True, **options)
    from service.storage.postgresql import limit_transaction, limit_waits

    limit_waits(engine)
    event.listen(engine, "begin", partial(_begin_postgresql, limit_transaction))
    return engine


def _count_error(context: ExceptionContext) -> None:
    """Count an error that is the database's own, not one of a statement."""
    error = context.sqlalchemy_exception
    if isinstance(error, DBAPIError) and is_transient(error):
        service_metrics.store_errors.labels("database").inc()


def _create_private_file(
    _dialect: Any, _entry: ConnectionPoolEntry, arguments: list[Any], _settings: dict[str, Any]
) -> None:
    """Create the file of a database for this user only; SQLite's other files take its mode.

    A file that is there is not opened: to close it would drop the locks of all its connections.
    """
    path = str(arguments[0])
    if path != ":memory:" and not path.startswith("file:"):
        with suppress(OSError):  # SQLite tells why it cannot be opened
            os.close(os.open(path, os.O_RDONLY | os.O_CREAT | os.O_EXCL, 0o600))


def _prepare_sqlite(
    connection: DBAPIConnection, _entry: ConnectionPoolEntry, *, is_durable: bool
) -> None:
    assert isinstance(connection, sqlite3.Connection)
    connection.isolation_level = None  # sqlite3 must not begin transactions by itself
    connection.execute(f"PRAGMA busy_timeout = {int(1000 * BUSY_SECONDS)}")
    _enable_wal(connection)
    # NORMAL syncs the write-ahead log only now and then, FULL at each commit.
    connection.execute(f"PRAGMA synchronous = {'FULL' if is_durable else 'NORMAL'}")
    if not is_durable:  # of a dispatcher: a transaction that does not fit is written twice
        connection.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
    connection.execute("PRAGMA foreign_keys = ON")


def _enable_wal(connection: sqlite3.Connection) -> None:
    """Switch the file to a write-ahead log, unless it has one already.

    The switch ignores the busy timeout when two processes open a new file at once.
    """
    deadline = time.monotonic() + BUSY_SECONDS
    while connection.execute("PRAGMA journal_mode").fetchone()[0] not in ("wal", "memory"):
        try:
            connection.execute("PRAGMA journal_mode = WAL")
        except sqlite3.OperationalError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.01)


def _begin_sqlite(connection: Connection) -> None:
    options = connection.get_execution_options()
    reads = options.get("lagid_reads", False)
    busy = int(1000 * options.get(_BUSY_OPTION, BUSY_SECONDS))
    connection.exec_driver_sql(f"PRAGMA busy_timeout = {busy}")
    connection.exec_driver_sql(f"PRAGMA query_only = {'ON' if reads else 'OFF'}")
    connection.exec_driver_sql("BEGIN" if reads else "BEGIN IMMEDIATE")


def _begin_postgresql(limit: Callable[..., None], connection: Connection) -> None:
    options = connection.get_execution_options()
    limit(connection, options.get(_BUSY_OPTION), is_long=options.get(_LONG_OPTION, False))
