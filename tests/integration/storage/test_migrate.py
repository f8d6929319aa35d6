"""Migrations: they build the program's tables, undo them, and never race."""

import multiprocessing
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import inspect, text

from service.storage import migrate, sessions
from service.storage.sessions import Database
from service.storage.storage_errors import DatabaseNotAtHead, DatabaseUnknown, UnknownRevision
from service.storage.tables import Base, Project
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.databases import empty_postgres

HEAD = migrate.find_head_revision()


@pytest.fixture
def migrated_database(empty_database):
    """A database of the test's own with the tables of today, of both kinds."""
    migrate.upgrade_database(empty_database)
    return empty_database


def list_tables(database):
    return set(inspect(database.engine).get_table_names()) - {"alembic_version"}


def test_the_migrations_build_exactly_the_tables_of_the_program(empty_database):
    migrate.upgrade_database(empty_database)
    assert list_tables(empty_database) == set(Base.metadata.tables)
    assert migrate.list_differences(empty_database) == []


def test_indexes_are_those_of_the_program_with_their_conditions(empty_database):
    migrate.upgrade_database(empty_database)
    migrated = list_indexes(empty_database)
    migrate.downgrade_database(empty_database)
    Base.metadata.create_all(empty_database.engine)
    assert migrated == list_indexes(empty_database)
    assert any("WHERE" in definition for definition in migrated.values())
    Base.metadata.drop_all(empty_database.engine)


def list_indexes(database):
    """The definition of each index that has a name of ours."""
    query = "SELECT name, sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL"
    if not database.is_sqlite:
        query = "SELECT indexname, indexdef FROM pg_indexes WHERE schemaname = 'public'"
    with database.engine.connect() as connection:
        return {
            name: definition.replace('"', "")
            for name, definition in connection.execute(text(query))
            if name != "alembic_version_pkc"
        }


@pytest.mark.postgres
def test_postgresql_compresses_no_result_by_its_slow_method():
    # What compresses fast, or is compressed already, is told by storage and method.
    query = text(
        "SELECT attrelid::regclass || '.' || attname, attstorage, attcompression FROM pg_attribute "
        "WHERE (attrelid, attname) IN (('runs'::regclass, 'result'), "
        "('run_history'::regclass, 'points'), ('migrations_log'::regclass, 'migrants'))"
    )
    with empty_postgres() as database:
        migrate.upgrade_database(database)
        with database.engine.connect() as connection:
            found = {column: rest for column, *rest in connection.execute(query)}
    assert set(found) == {"runs.result", "run_history.points", "migrations_log.migrants"}
    assert all(storage == "e" or method == "l" for storage, method in found.values()), found


def test_a_column_is_empty_or_has_a_default_only_if_the_program_says_so(empty_database):
    migrate.upgrade_database(empty_database)
    for table in Base.metadata.sorted_tables:
        found = inspect(empty_database.engine).get_columns(table.name)
        told = [(one["name"], one["nullable"], bool(one["default"])) for one in found]
        is_numbered = table.autoincrement_column is not None and not empty_database.is_sqlite
        assert told == [
            (one.name, one.nullable, is_numbered and one.primary_key) for one in table.columns
        ]


def test_going_down_removes_every_table_and_up_again_brings_them_back(empty_database):
    migrate.upgrade_database(empty_database)
    migrate.downgrade_database(empty_database)
    assert list_tables(empty_database) == set()
    assert migrate.read_current_revision(empty_database) is None
    migrate.upgrade_database(empty_database)
    assert migrate.list_differences(empty_database) == []


def test_a_new_database_has_the_default_project(database):
    with database.read_session() as session:
        assert [one.id for one in session.query(Project)] == ["proj_default"]


def test_a_database_that_is_not_at_the_head_is_told(empty_database):
    with pytest.raises(DatabaseNotAtHead, match=r"none.*lagid db upgrade"):
        migrate.check_revision(empty_database)
    migrate.upgrade_database(empty_database)
    migrate.check_revision(empty_database)
    assert migrate.read_current_revision(empty_database) == migrate.find_head_revision()


@pytest.mark.parametrize("revision", ["v9999", "0001", "0009"])  # no release has the last two
def test_a_database_of_an_unknown_revision_is_not_touched(migrated_database, revision):
    with migrated_database.engine.begin() as connection:
        connection.execute(text(f"UPDATE alembic_version SET version_num = '{revision}'"))
    actions = (
        migrate.upgrade_database,
        migrate.downgrade_database,
        migrate.check_revision,
        lambda database: migrate.list_undone_migrations(database, "base"),
    )
    told = rf"{revision}.*up to {HEAD}.*`lagid db downgrade {HEAD}`.*before 0\.1\.0.*new folder"
    for action in actions:
        with pytest.raises(DatabaseUnknown, match=told):
            action(migrated_database)
    assert migrate.read_current_revision(migrated_database) == revision


def test_upgrading_again_changes_nothing(database):
    before = migrate.read_current_revision(database)
    migrate.upgrade_database(database)
    assert migrate.read_current_revision(database) == before


def test_a_missing_table_is_a_difference(empty_database):
    migrate.upgrade_database(empty_database)
    with empty_database.engine.begin() as connection:
        connection.execute(text("DROP TABLE dispatchers"))
    assert any("dispatchers" in one for one in migrate.list_differences(empty_database))


def test_a_migration_that_fails_leaves_the_database_as_it_was(empty_database):
    with empty_database.engine.begin() as connection:
        connection.execute(text("CREATE TABLE dispatchers (x INTEGER)"))  # the last one made
    with pytest.raises(Exception, match="already exists"):
        migrate.upgrade_database(empty_database)
    assert list_tables(empty_database) == {"dispatchers"}


def test_threads_that_upgrade_at_once_do_not_race(empty_database):
    errors = []
    start = threading.Barrier(3)

    def work():
        start.wait()
        try:
            migrate.upgrade_database(empty_database)
        except Exception as error:  # noqa: BLE001 - shown by the assertion
            errors.append(error)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    migrate.check_revision(empty_database)


def _start_service(url, start, results):
    start.wait(LIMIT_SECONDS)
    database = Database(url)
    migrate.upgrade_database(database)
    migrate.check_revision(database)
    database.dispose()
    results.put("up")


@pytest.mark.slow
def test_processes_that_start_at_once_on_a_new_database_do_not_race(empty_database):
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])  # imported once for all
    start, results = context.Barrier(3), context.Queue()
    url = empty_database.engine.url.render_as_string(hide_password=False)
    processes = [
        context.Process(target=_start_service, args=(url, start, results)) for _ in range(3)
    ]
    for process in processes:
        process.start()
    assert [results.get(timeout=LIMIT_SECONDS) for _ in processes] == ["up"] * 3
    for process in processes:
        process.join()
    assert migrate.list_differences(empty_database) == []


def copies(database):
    with database.engine.connect() as connection:
        return list(connection.scalars(text("SELECT copy FROM projects")))


def list_columns(database):
    return {one["name"] for one in inspect(database.engine).get_columns("projects")}


def test_a_further_revision_carries_the_rows_over_and_back(migrated_database, add_revision):
    before, known = list_columns(migrated_database), migrate.list_revisions()
    add_revision()
    with pytest.raises(DatabaseNotAtHead, match="next"):
        migrate.check_revision(migrated_database)
    migrate.upgrade_database(migrated_database)
    assert copies(migrated_database) == ["default"]
    undone = migrate.list_undone_migrations(migrated_database, "base")
    assert [name for name, _ in undone] == ["next", *known]
    assert [name for name, _ in migrate.list_undone_migrations(migrated_database, HEAD)] == ["next"]
    earlier = ", ".join((*known, "base"))
    with pytest.raises(UnknownRevision, match=f"Earlier ones, the latest first: {earlier}"):
        migrate.list_undone_migrations(migrated_database, "next")
    migrate.downgrade_database(migrated_database, HEAD)
    assert list_columns(migrated_database) == before
    with migrated_database.read_session() as session:
        assert [one.name for one in session.query(Project)] == ["default"]
    assert migrate.list_differences(migrated_database) == []


def test_a_further_revision_that_fails_leaves_the_database_as_it_was(
    migrated_database, add_revision
):
    before = list_columns(migrated_database)
    add_revision(last='raise OSError("in the middle")')
    with pytest.raises(OSError, match="in the middle"):
        migrate.upgrade_database(migrated_database)
    assert list_columns(migrated_database) == before
    assert migrate.read_current_revision(migrated_database) == HEAD


def test_an_upgrade_waits_for_a_writer_that_has_begun_and_carries_over_what_it_wrote(
    migrated_database, add_revision
):
    add_revision()
    with ThreadPoolExecutor(1) as pool:
        with migrated_database.engine.begin() as writer:
            writer.execute(text("UPDATE projects SET name = 'early'"))
            upgraded = pool.submit(migrate.upgrade_database, migrated_database)
            wait_for_a_lock(migrated_database, upgraded)
            writer.execute(text("UPDATE projects SET name = 'late'"))
        upgraded.result()
    assert copies(migrated_database) == ["late"]


def wait_for_a_lock(database, upgraded):
    """Until it waits on PostgreSQL; on SQLite nobody else can have begun."""
    with database.engine.connect() as looking:
        if looking.dialect.name == "sqlite":
            return
        waiting = text("SELECT count(*) FROM pg_locks WHERE NOT granted")
        while not (looking.scalar(waiting) or upgraded.done()):
            time.sleep(0.01)


def test_an_upgrade_waits_longer_for_its_turn_than_other_writers(
    migrated_database, add_revision, monkeypatch
):
    monkeypatch.setattr(sessions, "BUSY_SECONDS", 0.01)
    add_revision()
    with ThreadPoolExecutor(1) as pool:
        with migrated_database.engine.begin() as writer:
            writer.execute(text("UPDATE projects SET name = 'late'"))
            upgraded = pool.submit(migrate.upgrade_database, migrated_database)
            time.sleep(0.3)
        upgraded.result()
    assert copies(migrated_database) == ["late"]
