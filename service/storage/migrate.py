"""Migrate a database to the tables of this version of the program, and check its revision.

Processes that start at once take turns. PostgreSQL uses an advisory lock, SQLite the write lock
that a transaction takes at its start. The later processes find nothing left to do. A failed
migration leaves the database unchanged.
"""

from pathlib import Path

from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, func, select

import migrations
from service.storage.sessions import Database
from service.storage.storage_errors import DatabaseNotAtHead, DatabaseUnknown, UnknownRevision
from service.storage.tables import Base

_LOCK = 0x6C61_6769_64  # "lagid": the key of the advisory lock
LOCK_WAIT_SECONDS = 900.0
"""How long a process waits for another one that migrates a large database."""


def upgrade_database(database: Database, revision: str = "head") -> None:
    """Create all tables, or migrate them to a revision.

    Raises
    ------
    DatabaseUnknown
        If the database is at a revision that this program does not know.
    """
    with database.get_waiting_engine(LOCK_WAIT_SECONDS).begin() as connection:
        _lock_migrations(connection)
        _refuse_unknown_database(read_revision(connection))
        command.upgrade(_make_config(connection), revision)


def downgrade_database(database: Database, revision: str = "base") -> None:
    """Go back to an earlier revision; data that only later revisions can store is lost.

    Raises
    ------
    DatabaseUnknown
        If the database is at a revision that this program does not know, so cannot undo.
    """
    with database.get_waiting_engine(LOCK_WAIT_SECONDS).begin() as connection:
        _lock_migrations(connection)
        _refuse_unknown_database(read_revision(connection))
        command.downgrade(_make_config(connection), revision)


def list_undone_migrations(database: Database, revision: str) -> list[tuple[str, str]]:
    """List revision and description of the migrations that `downgrade_database` would undo.

    Raises
    ------
    DatabaseUnknown
        If the database is at a revision that this program does not know.
    UnknownRevision
        If the revision is not an earlier one of this database. The earliest is ``base``.
    """
    current = read_current_revision(database)
    _refuse_unknown_database(current)
    if current is None:
        raise UnknownRevision(revision, ())
    done = list(ScriptDirectory.from_config(_make_config()).iterate_revisions(current, "base"))
    names = [*(script.revision for script in done[1:]), "base"]
    if revision not in names:
        raise UnknownRevision(revision, names)
    return [(script.revision, script.doc) for script in done[: names.index(revision) + 1]]


def find_head_revision() -> str | None:
    """Return the revision that this program needs."""
    return ScriptDirectory.from_config(_make_config()).get_current_head()


def list_revisions() -> list[str]:
    """List all revisions that this program knows, the latest first."""
    return [
        script.revision for script in ScriptDirectory.from_config(_make_config()).walk_revisions()
    ]


def read_current_revision(database: Database) -> str | None:
    """Return the revision of the database; None before the first migration."""
    with database.engine.connect() as connection:
        return read_revision(connection)


def check_revision(database: Database) -> None:
    """Raise `DatabaseNotAtHead` unless the database has the revision of this program."""
    current, needed = read_current_revision(database), find_head_revision()
    _refuse_unknown_database(current)
    if current != needed:
        raise DatabaseNotAtHead(current, needed)


def list_differences(database: Database) -> list[str]:
    """List the differences between the tables of the database and those of the program."""
    with database.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        return [str(difference) for difference in compare_metadata(context, Base.metadata)]


def read_revision(connection: Connection) -> str | None:
    """Return the revision that a connection sees; None before the first migration."""
    return MigrationContext.configure(connection).get_current_revision()


def _refuse_unknown_database(current: str | None) -> None:
    if current is not None and current not in list_revisions():
        raise DatabaseUnknown(current, find_head_revision())


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
