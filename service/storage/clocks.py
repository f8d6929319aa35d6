"""The clock of leases, and of starts and ends: one for all processes that share a database."""

from collections.abc import Callable
from datetime import datetime
from functools import partial

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.storage import columns
from service.storage.columns import UtcDateTime

Clock = Callable[[], datetime]


def choose_database_clock(session: Session) -> Clock:
    """Return the clock of PostgreSQL, or for SQLite that of this host.

    The clocks of several hosts may differ. SQLite is used on one host only.
    """
    if session.get_bind().dialect.name == "postgresql":
        return partial(_read_server_time, session)
    return columns.utc_now


def _read_server_time(session: Session) -> datetime:
    # Not now(), the start of the transaction: it may have waited since.
    return session.scalars(select(func.clock_timestamp(type_=UtcDateTime))).one()
