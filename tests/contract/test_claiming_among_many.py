"""What a claim reads does not grow with the jobs there ever were; on both databases."""

import re
from datetime import timedelta
from threading import Event as Flag

import pytest
from sqlalchemy import Connection, Engine, event, insert, text

from service.api.event_feed import EventFeed
from service.core.states import OPEN_STATES, JobState
from service.jobs.job_schemas import JobIn
from service.queue.admission import Admission
from service.queue.leases import JobProgress, LeaseOwners, LeaseQueue
from service.queue.notifications import read_queue_status
from service.repositories.job_rows import JobRepository
from service.storage.columns import utc_now
from service.storage.tables import Job, Parcel, Project
from tests.support.storage.job_rows import submit_and_claim

PROJECTS = [f"p{number}" for number in range(4)]
N_ENDED, N_QUEUED, N_RUNNING = 4000, 400, 128


@pytest.fixture(scope="module")
def crowded_database(module_database):
    """A database with thousands of ended jobs, hundreds of queued ones, and many that run."""
    return add_crowd(module_database)


@pytest.fixture
def crowded_sqlite(sqlite_database):
    """The same on SQLite: its virtual machine counts the work of a statement."""
    return add_crowd(sqlite_database)


def add_crowd(database):
    """Add the jobs of many projects."""
    states = (
        [JobState.SUCCEEDED] * N_ENDED
        + [JobState.QUEUED] * N_QUEUED
        + [JobState.RUNNING] * N_RUNNING
    )
    until = utc_now() + timedelta(hours=1)
    spec = JobIn.model_validate({"model": "tube", "datasets": ["ds_1"]}).to_normal_form()
    rows = [
        {
            "id": f"job_{number:05d}",
            "project_id": PROJECTS[number % 3],
            "name": "j",
            "spec": spec,
            "n_runs": 1,
            "state": state,
            "priority": 0,
            "version": "0",
            "spec_hash": "a" * 64,
        }
        for number, state in enumerate(states)
    ]
    parcels = [
        {
            "job_id": row["id"],
            "first": 0,
            "stop": 1,
            "lease_owner": "d1" if row["state"] is JobState.RUNNING else None,
            "lease_until": until if row["state"] is JobState.RUNNING else None,
        }
        for row in rows
        if row["state"] in OPEN_STATES
    ]
    with database.write_session() as session:
        session.execute(insert(Project), [{"id": one, "name": one} for one in PROJECTS])
        session.execute(insert(Job), rows)
        session.execute(insert(Parcel), parcels)
    with database.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.exec_driver_sql(
            "ANALYZE" if database.is_sqlite else "VACUUM ANALYZE"
        )  # as the database itself does from time to time
    return database


def plans_of(database, work) -> list[str]:
    """How the database carries out each statement on `jobs` that `work` makes."""
    plans: list[str] = []
    explain = "EXPLAIN QUERY PLAN " if database.is_sqlite else "EXPLAIN "
    engine: Engine = database.engine

    def note(connection: Connection, cursor, statement, parameters, *_) -> None:
        if "jobs" in statement and not statement.startswith(explain):
            cursor.execute(explain + statement, parameters)
            plans.append("\n".join(str(row[-1]) for row in cursor.fetchall()))

    event.listen(engine, "before_cursor_execute", note)
    try:
        work()
    finally:
        event.remove(engine, "before_cursor_execute", note)
    return plans


def claim(database, admission=None):
    with database.write_session() as session:
        return LeaseQueue(session).claim_job("d2", admission=admission)


@pytest.mark.parametrize("admission", [None, Admission(8, 0)], ids=["all", "short"])
def test_a_claim_scans_no_table_and_counts_running_jobs_once(crowded_database, admission) -> None:
    plans = plans_of(crowded_database, lambda: claim(crowded_database, admission))
    assert plans
    whole = "SCAN jobs" if crowded_database.is_sqlite else "Seq Scan on jobs"
    assert not [plan for plan in plans if whole in plan], plans
    assert not [plan for plan in plans if "CORRELATED" in plan or "SubPlan" in plan], plans
    if crowded_database.is_sqlite:
        assert "COVERING INDEX ix_jobs_open" in plans[0]


def test_a_look_at_the_queue_scans_no_table(crowded_database) -> None:
    def work() -> None:
        with crowded_database.read_session() as session:
            read_queue_status(session, "d1")

    plans = plans_of(crowded_database, work)
    assert len(plans) == 2
    for plan in plans:
        wanted = "COVERING INDEX" if crowded_database.is_sqlite else "Index"
        assert wanted in plan, plans
        assert "Seq Scan" not in plan, plans


def test_a_claim_reads_each_running_job_once_and_not_for_every_waiting_one(crowded_sqlite) -> None:
    steps = 0

    def count() -> int:
        nonlocal steps
        steps += 1
        return 0

    with crowded_sqlite.write_session() as session:
        session.connection().connection.driver_connection.set_progress_handler(count, 100)
        assert LeaseQueue(session).claim_job("d2") is not None
        session.connection().connection.driver_connection.set_progress_handler(None, 0)
    assert 100 * steps < 100 * (N_QUEUED + N_RUNNING)


def test_a_project_that_has_nothing_running_comes_first_among_many(crowded_database) -> None:
    with crowded_database.write_session() as session:
        session.execute(text("UPDATE jobs SET project_id = 'p3' WHERE id = 'job_04399'"))
    first = claim(crowded_database)
    assert job_of_project(crowded_database, first) == "p3"


def statements_of(database, work) -> list[str]:
    """The statements on `jobs` that `work` makes."""
    found: list[str] = []

    def note(connection: Connection, cursor, statement, *_) -> None:
        if "jobs" in statement:
            found.append(statement)

    event.listen(database.engine, "before_cursor_execute", note)
    try:
        work()
    finally:
        event.remove(database.engine, "before_cursor_execute", note)
    return found


def test_a_job_that_is_held_told_of_reaped_or_watched_does_not_bring_its_specification(
    database,
) -> None:
    got, _ = submit_and_claim(database)

    def work() -> None:
        with database.write_session() as session:
            queue = LeaseQueue(session)
            queue.lock_lease(got.lease)
            queue.write_progress(got.lease, JobProgress(1))
            queue.append_event(got.lease, "log", {"message": "told"})
            queue.reap_expired(LeaseOwners(ended=frozenset({got.lease.owner})))
        with database.read_session() as session:
            assert JobRepository(session).get_state(got.job.id) is JobState.QUEUED
        feed = EventFeed(database, Flag(), 1.0, 1)
        feed._read_batch(got.job.id, 0)
        assert feed._read_heads([got.job.id])[got.job.id].last > 0

    found = statements_of(database, work)
    assert len(found) > 5
    assert not [one for one in found if re.search(r"\bspec\b", one)]


def job_of_project(database, got) -> str:
    with database.read_session() as session:
        return str(session.get_one(Job, got.job.id).project_id)
