"""Bring a database to the tables of this version of the program, and tell whether it is there.

Processes that start at once take turns: PostgreSQL by an advisory lock, SQLite by the write lock
that the transaction takes at its beginning. The later ones find nothing left to do. A migration
that fails leaves the database as it was.
"""

from pathlib import Path

from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, func, select

import migrations
from service.storage.errors import DatabaseNotAtHead
from service.storage.sessions import Database
from service.storage.tables import Base

_LOCK = 0x6C61_6769_64  # "lagid": the key of the advisory lock
LOCK_WAIT_SECONDS = 900.0
"""How long a process waits for another one that carries the rows of a large database over."""


def upgrade_database(database: Database, revision: str = "head") -> None:
    """Create or bring up to date every table."""
    with database.get_waiting_engine(LOCK_WAIT_SECONDS).begin() as connection:
        _lock_migrations(connection)
        command.upgrade(_make_config(connection), revision)


def downgrade_database(database: Database, revision: str = "base") -> None:
    """Go back to an earlier revision. What only later ones can hold is lost."""
    with database.get_waiting_engine(LOCK_WAIT_SECONDS).begin() as connection:
        _lock_migrations(connection)
        command.downgrade(_make_config(connection), revision)


def find_head_revision() -> str | None:
    """The revision this program needs."""
    return ScriptDirectory.from_config(_make_config()).get_current_head()


def read_current_revision(database: Database) -> str | None:
    """The revision the database is at; None before the first."""
    with database.engine.connect() as connection:
        return MigrationContext.configure(connection).get_current_revision()


def check_revision(database: Database) -> None:
    """Nothing, when the database is at the head; else `DatabaseNotAtHead`."""
    found, needed = read_current_revision(database), find_head_revision()
    if found != needed:
        raise DatabaseNotAtHead(found, needed)


def list_differences(database: Database) -> list[str]:
    """Where the database's tables differ from those of the program; empty when they agree."""
    with database.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        return [str(one) for one in compare_metadata(context, Base.metadata)]


def _lock_migrations(connection: Connection) -> None:
    if connection.dialect.name == "postgresql":
        connection.execute(select(func.pg_advisory_xact_lock(_LOCK)))


def _make_config(connection: Connection | None = None) -> Config:
    config = Config()
    folder = Path(migrations.__file__).parent
    config.set_main_option("script_location", str(folder).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    return config
