"""Damage of the database itself, as far as it can tell."""

from sqlalchemy import Connection, text
from sqlalchemy.exc import DBAPIError

from service.storage.retry import is_transient
from service.storage.sessions import BUSY_SECONDS, Database

MAX_FAULTS = 10
"""Faults that are named."""
_INDEXES = text(
    "SELECT c.oid::regclass::text, bt_index_check(c.oid) FROM pg_index i "
    "JOIN pg_class c ON c.oid = i.indexrelid JOIN pg_am a ON a.oid = c.relam "
    "JOIN pg_namespace n ON n.oid = c.relnamespace "
    "WHERE a.amname = 'btree' AND n.nspname = current_schema() AND i.indisvalid"
)


def find_faults(database: Database) -> list[str]:
    """Look for damage: in all pages of SQLite; in the indexes of PostgreSQL with ``amcheck``.

    PostgreSQL needs ``CREATE EXTENSION amcheck``; without it nothing is looked at. Its tables have
    checksums if its operator chose so.
    """
    try:
        with database.get_waiting_engine(BUSY_SECONDS).connect() as connection:
            if database.is_sqlite:
                return _check_sqlite(connection)
            if connection.scalar(text("SELECT 1 FROM pg_extension WHERE extname = 'amcheck'")):
                connection.execute(_INDEXES).all()
            return []
    except DBAPIError as error:
        if is_transient(error):
            raise
        return [str(error.orig).splitlines()[0]]


def _check_sqlite(connection: Connection) -> list[str]:
    told = connection.exec_driver_sql(f"PRAGMA integrity_check({MAX_FAULTS})").scalars()
    return [fault for fault in told if fault != "ok"]
