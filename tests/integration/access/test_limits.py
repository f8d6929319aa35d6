"""Limits of a project: stored bytes, evaluations in a day, open jobs and runs."""

from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest
from sqlalchemy import func, select, update

from service.core.errors import BudgetExceeded, QuotaExceeded
from service.core.settings import Settings
from service.core.states import JobState
from service.datasets.datasets import add_recording
from service.dispatch.held_leases import HeldLeases
from service.jobs.submit import check_limits, resume_job
from service.queue.daily_limit import check_budget, count_evaluations, stop_overruns
from service.queue.leases import JobProgress, Lease, LeaseQueue
from service.repositories import project_rows
from service.repositories.audit_rows import list_actions
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.job_rows import JobRepository
from service.repositories.project_rows import (
    DAY,
    REMOVAL_TIME,
    RESULT_BYTES,
    ProjectRepository,
    count_stored_bytes,
)
from service.storage.columns import utc_now
from service.storage.objects import open_store
from service.storage.sessions import Database, SessionOwner, find_project
from service.storage.storage_errors import RowConflict, RowNotFound
from service.storage.tables import Dataset, Job, RequestedWork
from sysid.data.records import Channel, Recording
from tests.support.storage.databases import record_statements
from tests.support.storage.job_rows import claim, job_of, new_dataset, new_job, state_of, submit

SETTINGS = Settings()


@pytest.fixture
def limited_database(database: Database) -> Database:
    """The database for a project that may store 250 kB and make 100 evaluations a day."""
    limits = {"max_stored_bytes": 250_000, "max_daily_evaluations": 100, "max_open_jobs": 3}
    with database.write_session() as session:
        project = ProjectRepository(session).add("limited")
        ProjectRepository(session).change_limits("limited", limits)
    return database.open_for(SessionOwner(project.id))


def add_dataset(database: Database, source: str) -> str:
    with database.write_session() as session:
        new = new_dataset(source_key=source, size_bytes=100_000, sha256=source)
        return str(DatasetRepository(session).add(new).dataset.id)


def add_job(database: Database, **values: object) -> Job:
    """A job of the project with these columns, checked as a submission is."""
    with database.write_session() as session:
        new = new_job(name="tube", spec={"model": "tube"})
        job = JobRepository(session).submit(new).job
        check_limits(session, job, SETTINGS)
        for name, value in values.items():
            setattr(job, name, value)
        return job


def end_job(database: Database, evaluations: int, hours_ago: float, **values: object) -> None:
    finished_at = utc_now() - timedelta(hours=hours_ago)
    ended = {"state": JobState.SUCCEEDED, "finished_at": finished_at, "evaluations": evaluations}
    add_job(database, **ended, **values)


def test_stored_bytes_are_limited_and_a_deletion_makes_room(limited_database: Database) -> None:
    first = add_dataset(limited_database, "a")
    add_dataset(limited_database, "b")
    with pytest.raises(BudgetExceeded, match="would store 300000 bytes; at most 250000") as error:
        add_dataset(limited_database, "c")
    assert error.value.headers == {"Retry-After": "3600"}
    assert add_dataset(limited_database, "a") == first  # what is there already needs no room
    with limited_database.write_session() as session:
        DatasetRepository(session).delete(first)
    add_dataset(limited_database, "c")


def test_deleted_bytes_count_until_they_are_removed(limited_database: Database) -> None:
    for number in range(5):
        added = add_dataset(limited_database, f"s{number}")
        with limited_database.write_session() as session:
            DatasetRepository(session).delete(added)
    add_dataset(limited_database, "s0")  # the bytes of the first one, which are there
    with pytest.raises(BudgetExceeded, match="would fill 600000 bytes; at most 500000"):
        add_dataset(limited_database, "s5")
    with limited_database.write_session() as session:
        earlier = utc_now() - REMOVAL_TIME - timedelta(seconds=1)
        was_deleted = Dataset.deleted_at.is_not(None)
        session.execute(update(Dataset).where(was_deleted).values(deleted_at=earlier))
    add_dataset(limited_database, "s5")


def test_results_count_as_soon_as_a_job_is_queued_and_until_its_rows_are_removed(
    limited_database: Database,
) -> None:
    def count() -> tuple[int, int]:
        with limited_database.read_session() as session:
            shown = count_stored_bytes(session, find_project(session))
            there = count_stored_bytes(session, find_project(session), with_deleted=True)
        return shown // RESULT_BYTES, there // RESULT_BYTES

    end_job(limited_database, 0, hours_ago=1, n_runs=20, n_done=12)
    assert count() == (12, 12)
    add_job(limited_database, n_runs=10, n_done=4)
    assert count() == (22, 22)
    with limited_database.write_session() as session:
        session.execute(update(Job).values(deleted_at=utc_now()).where(Job.n_runs == 20))
    assert count() == (10, 22)
    add_job(limited_database, n_runs=30)
    with pytest.raises(BudgetExceeded, match="at most 250000"):
        add_job(limited_database)
    with limited_database.write_session() as session:
        session.execute(update(Job).values(purged_at=utc_now()).where(Job.n_runs == 20))
    assert count() == (40, 40)


def test_what_a_project_has_no_room_for_is_not_written(
    limited_database: Database, tmp_path: Path
) -> None:
    with limited_database.write_session() as session:
        ProjectRepository(session).change_limits("limited", {"max_stored_bytes": 100})
    store = open_store(tmp_path.as_uri())
    recording = Recording((Channel("u", np.arange(9.0), np.zeros(9)),))
    with pytest.raises(BudgetExceeded):
        add_recording(
            limited_database,
            store,
            recording,
            name="x",
            kind="upload",
            key="k",
            details={"warnings": []},
        )
    assert list(store.list_objects()) == []


def test_bytes_that_are_stored_at_once_do_not_pass_the_limit_together(
    limited_database: Database,
) -> None:
    start = Barrier(6)

    def store(number: int) -> bool:
        start.wait()
        try:
            add_dataset(limited_database, f"s{number}")
        except BudgetExceeded:
            return False
        return True

    with ThreadPoolExecutor(6) as pool:
        assert sum(pool.map(store, range(6))) == 2


def test_evaluations_of_a_day_are_limited_until_the_first_job_is_a_day_old(
    limited_database: Database,
) -> None:
    end_job(limited_database, 1000, hours_ago=25)
    end_job(limited_database, 60, hours_ago=23)
    end_job(limited_database, 30, hours_ago=1)
    end_job(limited_database, 1000, hours_ago=1, n_runs=4, n_reused=4)  # computed by other jobs
    add_job(limited_database, evaluations=20)
    with pytest.raises(BudgetExceeded, match="made 110 evaluations; 100 are allowed") as error:
        add_job(limited_database)
    assert 3500 < int(error.value.headers["Retry-After"]) <= 3600
    with limited_database.write_session() as session:
        ProjectRepository(session).change_limits("limited", {"max_daily_evaluations": 111})
    add_job(limited_database)


def start_job(database: Database, evaluations: int) -> Lease:
    """A job that a dispatcher holds, after so many evaluations."""
    submit(database)
    held = claim(database)
    assert held is not None
    with database.write_session() as session:
        LeaseQueue(session).write_progress(held.lease, JobProgress(evaluations))
    return held.lease


def test_jobs_that_use_up_the_day_are_stopped_and_go_on_a_day_later(
    limited_database: Database, caplog: pytest.LogCaptureFixture
) -> None:
    held = start_job(limited_database, 99)
    queued = submit(limited_database)
    assert stop_overruns(limited_database) == []
    with limited_database.write_session() as session:
        LeaseQueue(session).write_progress(held, JobProgress(101))
    others = submit(limited_database.open_for(SessionOwner()))
    assert stop_overruns(limited_database) == [held.job_id, queued]
    assert stop_overruns(limited_database) == []  # the dispatcher is asked once
    assert "made 101 evaluations; 100 are allowed" in caplog.text
    with limited_database.write_session() as session:
        LeaseQueue(session).cancel_parcel(held)
    for job_id in (held.job_id, queued):
        job = job_of(limited_database, job_id)
        assert job.state is JobState.CANCELLED
        assert "101 evaluations; 100 are allowed. Resume the job" in str(job.error)
    assert state_of(limited_database.open_for(SessionOwner()), others) is JobState.QUEUED
    with limited_database.read_session() as session:
        (entry,) = list_actions(session, find_project(session), limit=1).items
        assert (entry.action, entry.actor, entry.object_id) == ("job.cancel", "daily limit", queued)
    with pytest.raises(BudgetExceeded), limited_database.write_session() as session:
        resume_job(session, held.job_id, SETTINGS)
    with limited_database.write_session() as session:
        for job_id in (held.job_id, queued):
            session.get_one(Job, job_id).finished_at = utc_now() - timedelta(hours=25)
    with limited_database.write_session() as session:
        job = resume_job(session, held.job_id, SETTINGS)
        assert (job.error, job.evaluations) == (None, 101)
    assert stop_overruns(limited_database) == []  # what it made a day before counts no more
    again = claim(limited_database)
    assert again is not None
    with limited_database.write_session() as session:
        LeaseQueue(session).write_progress(again.lease, JobProgress(201))
    assert stop_overruns(limited_database) == [held.job_id]


def test_a_job_that_ends_before_it_is_stopped_ends_as_it_would(limited_database: Database) -> None:
    held = start_job(limited_database, 100)
    assert stop_overruns(limited_database) == [held.job_id]
    with limited_database.write_session() as session:
        LeaseQueue(session).finish_job(held, JobState.FAILED, "no result")
    assert job_of(limited_database, held.job_id).error == "no result"


def test_a_heartbeat_of_a_dispatcher_stops_what_goes_too_far(limited_database: Database) -> None:
    held = start_job(limited_database, 100)
    HeldLeases(limited_database, 10.0).renew_leases()
    assert job_of(limited_database, held.job_id).cancel_requested


def test_a_project_has_its_own_limit_of_open_jobs(limited_database: Database) -> None:
    for _ in range(3):
        add_job(limited_database)
    with pytest.raises(QuotaExceeded, match="3 jobs of the project are queued or running"):
        add_job(limited_database)
    with limited_database.write_session() as session:
        ProjectRepository(session).change_limits("limited", {"max_open_jobs": None})
    add_job(limited_database)


def test_what_a_project_uses_is_measured(limited_database: Database) -> None:
    add_dataset(limited_database, "a")
    end_job(limited_database, 60, hours_ago=1)
    add_job(limited_database, evaluations=20)
    with limited_database.read_session() as session:
        repository = ProjectRepository(session)
        used = repository.measure_use(repository.get("limited").id)
        others = repository.measure_use("proj_default")
    assert (used.stored_bytes, used.daily_evaluations) == (100_000 + RESULT_BYTES, 80)
    assert (others.stored_bytes, others.daily_evaluations) == (0, 0)


def test_what_a_web_process_computes_counts_for_a_day(
    limited_database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    def use() -> int:
        with limited_database.read_session() as session:
            return ProjectRepository(session).measure_use(find_project(session)).daily_evaluations

    for evaluations in (1, 60, 39):
        check_budget(limited_database)
        count_evaluations(limited_database, evaluations)
    assert use() == 100
    with pytest.raises(BudgetExceeded, match="made 100 evaluations; 100 are allowed") as error:
        check_budget(limited_database)
    assert DAY.total_seconds() - 3600 <= int(error.value.headers["Retry-After"]) <= 86400
    with pytest.raises(BudgetExceeded):
        add_job(limited_database)
    later = utc_now() + DAY
    monkeypatch.setattr(project_rows, "utc_now", lambda: later)
    assert use() == 0
    count_evaluations(limited_database, 5)
    with limited_database.read_session() as session:
        assert session.scalar(select(func.count()).select_from(RequestedWork)) == 1
    assert use() == 5


def test_without_a_limit_nothing_is_counted(database: Database) -> None:
    with record_statements(database) as statements:
        add_dataset(database, "a")
        add_job(database)
    assert not [text for text, _ in statements if "sum(datasets" in text or "evaluations *" in text]


def test_a_project_is_found_by_name_or_identifier_and_names_are_unique(
    limited_database: Database,
) -> None:
    with limited_database.write_session() as session:
        repository = ProjectRepository(session)
        project = repository.get("limited")
        assert repository.get(project.id) is project
        with pytest.raises(RowNotFound, match="'absent'"):
            repository.get("absent")
        with pytest.raises(RowConflict, match="'limited' already"):
            repository.add("limited")
