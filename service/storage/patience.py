"""A database may be away for a while: restarted, unreachable, or its disk full."""

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from sqlalchemy.exc import InterfaceError, OperationalError

_log = logging.getLogger(__name__)

T = TypeVar("T")
PASSING = (OperationalError, InterfaceError)
"""What SQLAlchemy raises when the database, and not the statement, is to blame."""

PAUSE_SECONDS = 0.3
LONGEST_SECONDS = 60.0


def patiently(work: Callable[[], T]) -> T:
    """Do work that may be done again from its beginning, until the database lets it.

    A transaction that failed has left nothing; one whose commit was not answered may have been
    made, so the work must bear being done twice.

    Raises
    ------
    OperationalError, InterfaceError
        After `LONGEST_SECONDS`.
    """
    begun = time.monotonic()
    is_told = False
    while True:
        try:
            done = work()
        except PASSING as error:
            if time.monotonic() - begun > LONGEST_SECONDS:
                raise
            if not is_told:
                _log.warning("the database does not answer: %s", str(error).splitlines()[0])
            is_told = True
            time.sleep(PAUSE_SECONDS)
        else:
            if is_told:
                _log.info("the database was back after %.1f s", time.monotonic() - begun)
            return done
