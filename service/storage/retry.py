"""Retry while the database is unavailable: restarted, unreachable, or its disk full."""

import logging
import sqlite3
import time
from collections.abc import Callable
from typing import TypeVar

from sqlalchemy.exc import DBAPIError, InterfaceError, InternalError, OperationalError

from service.core.process.loop_watch import report_turn
from sysid.core.awake_clock import read_awake_seconds

_log = logging.getLogger(__name__)

T = TypeVar("T")
TRANSIENT_ERRORS = (OperationalError, InterfaceError, InternalError)
"""Errors of SQLAlchemy for a failing database; some drivers raise them for mistakes too."""

_SQLITE_CODES = frozenset(
    (
        sqlite3.SQLITE_BUSY,
        sqlite3.SQLITE_LOCKED,
        sqlite3.SQLITE_NOMEM,
        sqlite3.SQLITE_INTERRUPT,
        sqlite3.SQLITE_IOERR,
        sqlite3.SQLITE_FULL,
        sqlite3.SQLITE_CANTOPEN,
        sqlite3.SQLITE_PROTOCOL,
    )
)
_POSTGRESQL_STATES = ("08", "25P03", "40", "53", "55P03", "57", "58")
"""Connection, idle transaction, deadlock, resources such as disk and memory, lock timeout,
shutdown, I/O."""

PAUSE_SECONDS = 0.3
GIVE_UP_SECONDS = 60.0


def is_transient(error: DBAPIError) -> bool:
    """Return whether an error of the database may pass by itself, unlike a mistake in a statement.

    SQLite calls both an operational error and distinguishes them by the result code. PostgreSQL
    distinguishes them by SQLSTATE, which an error of the connection itself does not have.
    """
    if not isinstance(error, TRANSIENT_ERRORS):
        return False
    cause = error.orig
    if isinstance(cause, sqlite3.Error):
        code = getattr(cause, "sqlite_errorcode", None)  # its low byte is the primary code
        return code is not None and code & 0xFF in _SQLITE_CODES
    state = getattr(cause, "sqlstate", None)
    return state is None or str(state).startswith(_POSTGRESQL_STATES)


def retry_transient(work: Callable[[], T]) -> T:
    """Repeat work until the database carries it out; the work must be repeatable.

    A failed transaction leaves nothing. A transaction whose commit was not answered may have been
    committed, so the work may be done twice. States, results, counts and checkpoints allow that.
    The end of a job raises LeaseLost the second time. A line of the log may appear twice.

    Raises
    ------
    OperationalError, InterfaceError, InternalError
        After `GIVE_UP_SECONDS`.
    """
    start = read_awake_seconds()
    is_logged = False
    while True:
        try:
            result = work()
        except TRANSIENT_ERRORS as error:
            if not is_transient(error) or read_awake_seconds() - start > GIVE_UP_SECONDS:
                raise
            if not is_logged:
                _log.warning("the database does not answer: %s", str(error).splitlines()[0])
            is_logged = True
            report_turn()
            time.sleep(PAUSE_SECONDS)
        else:
            if is_logged:
                _log.info("the database answers again after %.1f s", read_awake_seconds() - start)
            return result
