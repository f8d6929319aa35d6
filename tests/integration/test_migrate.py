"""Migrations: they build the program's tables, undo them, and never race."""

import multiprocessing
import threading

import pytest
from sqlalchemy import inspect, text

from service.storage import migrate
from service.storage.errors import DatabaseNotAtHead
from service.storage.sessions import Database
from service.storage.tables import Base, Project


def tables(database):
    return set(inspect(database.engine).get_table_names()) - {"alembic_version"}


def test_the_migrations_build_exactly_the_tables_of_the_program(empty_database):
    migrate.upgrade(empty_database)
    assert tables(empty_database) == set(Base.metadata.tables)
    assert migrate.differences(empty_database) == []


def test_going_down_removes_every_table_and_up_again_brings_them_back(empty_database):
    migrate.upgrade(empty_database)
    migrate.downgrade(empty_database)
    assert tables(empty_database) == set()
    assert migrate.current(empty_database) is None
    migrate.upgrade(empty_database)
    assert migrate.differences(empty_database) == []


def test_a_new_database_has_the_default_project(database):
    with database.read() as session:
        assert [one.id for one in session.query(Project)] == ["proj_default"]


def test_a_database_that_is_not_at_the_head_is_told(empty_database):
    with pytest.raises(DatabaseNotAtHead, match=r"none.*lagid db upgrade"):
        migrate.check(empty_database)
    migrate.upgrade(empty_database)
    migrate.check(empty_database)
    assert migrate.current(empty_database) == migrate.head()


def test_upgrading_again_changes_nothing(database):
    before = migrate.current(database)
    migrate.upgrade(database)
    assert migrate.current(database) == before


def test_a_missing_table_is_a_difference(database):
    with database.engine.begin() as connection:
        connection.execute(text("DROP TABLE dispatchers"))
    assert any("dispatchers" in one for one in migrate.differences(database))


def test_a_migration_that_fails_leaves_the_database_as_it_was(empty_database):
    with empty_database.engine.begin() as connection:
        connection.execute(text("CREATE TABLE dispatchers (x INTEGER)"))  # the last one made
    with pytest.raises(Exception, match="already exists"):
        migrate.upgrade(empty_database)
    assert tables(empty_database) == {"dispatchers"}


def test_threads_that_upgrade_at_once_do_not_race(empty_database):
    errors = []
    start = threading.Barrier(3)

    def work():
        start.wait()
        try:
            migrate.upgrade(empty_database)
        except Exception as error:  # noqa: BLE001 - shown by the assertion
            errors.append(error)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    migrate.check(empty_database)


def _start_service(url, start, results):
    start.wait(180)
    database = Database(url)
    migrate.upgrade(database)
    migrate.check(database)
    database.dispose()
    results.put("up")


@pytest.mark.slow
def test_processes_that_start_at_once_on_a_new_database_do_not_race(empty_database):
    context = multiprocessing.get_context("spawn")
    start, results = context.Barrier(3), context.Queue()
    url = empty_database.engine.url.render_as_string(hide_password=False)
    processes = [
        context.Process(target=_start_service, args=(url, start, results)) for _ in range(3)
    ]
    for process in processes:
        process.start()
    assert [results.get(timeout=180) for _ in processes] == ["up"] * 3
    for process in processes:
        process.join()
    assert migrate.differences(empty_database) == []
