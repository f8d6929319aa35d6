"""Sessions and column types: the same on SQLite and on PostgreSQL."""

import threading
from datetime import UTC, datetime, timedelta, timezone

import pytest
from sqlalchemy import select, text
from sqlalchemy.exc import DBAPIError, IntegrityError

from service.core.settings import Settings
from service.storage.open_storage import open_storage
from service.storage.sessions import Database
from service.storage.storage_errors import UnstorableValue
from service.storage.tables import DEFAULT_PROJECT, ApiKey, Base, Job, Project
from tests.support.storage.databases import copy_sqlite_template
from tests.support.storage.job_rows import job_of, submit


def list_names(database):
    with database.read_session() as session:
        return set(session.scalars(select(Project.id)))


def test_a_writing_session_commits_at_its_end(database):
    with database.write_session() as session:
        session.add(Project(id="proj_a", name="a"))
    assert list_names(database) == {DEFAULT_PROJECT, "proj_a"}


def test_a_writing_session_that_fails_leaves_nothing(database):
    def fail():
        with database.write_session() as session:
            session.add(Project(id="proj_a", name="a"))
            session.flush()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list_names(database) == {DEFAULT_PROJECT}


def test_a_reading_session_cannot_write(database):
    with pytest.raises(DBAPIError, match=r"(?i)read-?only"), database.read_session() as session:
        session.execute(text("DELETE FROM projects"))
    with database.write_session() as session:  # and the same connection can, afterwards
        session.add(Project(id="proj_a", name="a"))
    assert "proj_a" in list_names(database)


def test_readers_do_not_wait_for_a_writer(database):
    with database.write_session() as session:
        session.add(Project(id="proj_a", name="a"))
        session.flush()
        assert list_names(database) == {DEFAULT_PROJECT}


def test_writers_wait_for_each_other_and_none_is_lost(database):
    job_id = submit(database)

    def raise_priority():
        for _ in range(10):
            with database.write_session() as session:
                lock = select(Job).where(Job.id == job_id).with_for_update()
                session.scalars(lock).one().priority += 1

    threads = [threading.Thread(target=raise_priority) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert job_of(database, job_id).priority == 40


def test_foreign_keys_are_kept(database):
    with pytest.raises(IntegrityError), database.write_session() as session:
        session.add(Job(id="job_1", project_id="proj_none", name="", spec={}, n_runs=1))


def test_a_moment_comes_back_in_utc_to_the_microsecond(database):
    moment = datetime(2026, 3, 1, 12, 0, 0, 123456, timezone(timedelta(hours=9)))
    with database.write_session() as session:
        session.add(Project(id="proj_a", name="a", created_at=moment))
    with database.read_session() as session:
        kept = session.get_one(Project, "proj_a").created_at
        later = select(Project.id).where(Project.created_at > moment - timedelta(seconds=1))
        assert "proj_a" in session.scalars(later).all()
    assert kept == moment
    assert kept.tzinfo is UTC


def test_a_moment_without_time_zone_is_refused(database):
    naive = datetime(2026, 3, 1)  # noqa: DTZ001 - what is to be refused
    with pytest.raises(UnstorableValue, match="no time zone"), database.write_session() as session:
        session.add(Project(id="proj_a", name="a", created_at=naive))


def test_nothing_is_null_and_not_a_document(database):
    with database.write_session() as session:
        session.add(ApiKey(id="key_1", project_id=DEFAULT_PROJECT, name="", digest="d", scopes=[]))
    with database.read_session() as session:
        assert session.get_one(ApiKey, "key_1").expires_at is None
        assert session.scalar(text("SELECT count(*) FROM runs WHERE result IS NULL")) == 0


def test_sqlite_runs_as_agreed(sqlite_database):
    with sqlite_database.read_session() as session:
        pragmas = {
            name: session.scalar(text(f"PRAGMA {name}"))
            for name in ("journal_mode", "synchronous", "busy_timeout", "foreign_keys")
        }
    assert pragmas == {
        "journal_mode": "wal",
        "synchronous": 1,
        "busy_timeout": 30_000,
        "foreign_keys": 1,
    }


def test_what_a_request_was_told_survives_a_power_cut(tmp_path):
    settings = Settings(data_dir=tmp_path, database_url=None)
    copy_sqlite_template(tmp_path)
    database, _ = open_storage(settings)  # as the web process does
    with database.write_session() as session:
        assert session.scalar(text("PRAGMA synchronous")) == 2  # FULL: each commit is synced
    database.dispose()


def test_statistics_are_those_of_the_rows_and_wait_for_nobody(database):
    for number in range(3):
        submit(database, name=str(number))
    with database.write_session():
        database.update_statistics()  # another writer holds SQLite's lock
    database.update_statistics()
    if database.is_sqlite:
        query = "SELECT stat FROM sqlite_stat1 WHERE idx = 'ix_jobs_open'"
        with database.read_session() as session:
            assert session.scalar(text(query)).startswith("3 ")


def test_every_table_a_user_owns_names_its_project():
    # The others belong to a run or a job, which does, or to the service itself.
    within = {"projects", "run_history", "migrations_log", "checkpoints", "events", "dispatchers"}
    within |= {"job_summaries", "parcels", "web_sessions"}
    for name, table in Base.metadata.tables.items():
        assert ("project_id" in table.columns) != (name in within), name


def test_plain_addresses_of_postgresql_use_the_installed_driver():
    database = Database("postgresql://someone@localhost/lagid")
    assert database.engine.url.drivername == "postgresql+psycopg"
    assert not database.is_sqlite
