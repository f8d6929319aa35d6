"""A database may be away for a while: restarted, unreachable, or its disk full."""

import logging
import sqlite3
import time
from collections.abc import Callable
from typing import TypeVar

from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError

_log = logging.getLogger(__name__)

T = TypeVar("T")
TRANSIENT_ERRORS = (OperationalError, InterfaceError)
"""What SQLAlchemy raises when the database is to blame, and by some drivers for mistakes too."""

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
_POSTGRESQL_STATES = ("08", "40", "53", "55P03", "57", "58")
"""Connection, deadlock, resources such as disk and memory, a lock not got, shutdown, I/O."""

PAUSE_SECONDS = 0.3
GIVE_UP_SECONDS = 60.0


def is_transient(error: DBAPIError) -> bool:
    """Whether an error of the database may pass by itself; a mistake in a statement does not.

    SQLite calls both an operational error, and tells them apart by its result code; PostgreSQL by
    SQLSTATE, which an error of the connection itself does not have.
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
    """Do work that may be done again from its beginning, until the database lets it.

    A transaction that failed has left nothing; one whose commit was not answered may have been
    made, so the work must bear being done twice: states, results, counts and checkpoints do, and
    the end of a job, whose second time raises LeaseLost; a line of the log may be told twice.

    Raises
    ------
    OperationalError, InterfaceError
        After `GIVE_UP_SECONDS`.
    """
    begun = time.monotonic()
    is_told = False
    while True:
        try:
            done = work()
        except TRANSIENT_ERRORS as error:
            if not is_transient(error) or time.monotonic() - begun > GIVE_UP_SECONDS:
                raise
            if not is_told:
                _log.warning("the database does not answer: %s", str(error).splitlines()[0])
            is_told = True
            time.sleep(PAUSE_SECONDS)
        else:
            if is_told:
                _log.info("the database was back after %.1f s", time.monotonic() - begun)
            return done
