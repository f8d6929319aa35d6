"""Old jobs are deleted by rule, and deleted ones leave only their tombstones; on both databases."""

import threading
from datetime import datetime, timedelta

import pytest
from sqlalchemy import func, select, update

from service.core.states import JobState
from service.items.deletion import delete_item
from service.repositories.audit_rows import list_actions, record_action
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.history_rows import HistoryPoint, pack_history
from service.repositories.job_rows import JobRepository
from service.repositories.reference_rows import ReferenceRepository
from service.storage.columns import utc_now
from service.storage.garbage import delete_orphans
from service.storage.objects import open_store
from service.storage.sessions import Database
from service.storage.statements import insert_missing
from service.storage.tables import (
    DEFAULT_PROJECT,
    Base,
    Dataset,
    Event,
    Job,
    Project,
    Run,
    RunHistory,
    StoredSummary,
)
from service.upkeep import housekeeper, retention
from service.upkeep.housekeeper import Housekeeper, KeptDays
from service.upkeep.retention import (
    delete_expired_actions,
    delete_expired_jobs,
    purge_deleted_jobs,
)
from service.upkeep.scrubber import Scrubber
from tests.contract.test_items import add_dataset, add_job, end_job
from tests.support.storage.job_rows import runs_of

AT_ONCE = timedelta(seconds=-5)
DONE = (JobState.SUCCEEDED,)


def age(database: Database, table: type[Job | Dataset], item: str, days: float) -> None:
    """Move the times of an item into the past."""
    then = utc_now() - timedelta(days=days)
    with database.write_session() as session:
        values = {"finished_at": then} if table is Job else {"created_at": then}
        session.execute(update(table).where(table.id == item).values(values))


def keep(database: Database, days: float | None) -> None:
    with database.write_session() as session:
        session.get_one(Project, DEFAULT_PROJECT).keep_days = days


def count(database: Database, *tables: type) -> list[int]:
    with database.read_session() as session:
        return [session.scalar(select(func.count()).select_from(table)) or 0 for table in tables]


@pytest.fixture
def old_job(database: Database) -> tuple[str, str, str]:
    """A job that ended 40 days ago, its dataset of the same age, and its run."""
    data = add_dataset(database)
    job, (run,) = end_job(database, DONE, dataset=data)
    age(database, Job, job, 40)
    age(database, Dataset, data, 41)
    return job, data, run


def test_without_a_rule_everything_is_kept(
    database: Database, old_job: tuple[str, str, str]
) -> None:
    assert delete_expired_jobs(database, None) == []


def test_an_old_job_goes_with_the_dataset_that_only_it_used(
    database: Database, old_job: tuple[str, str, str]
) -> None:
    young, _ = end_job(database, DONE, dataset="ds_young")
    waiting = add_job(database)
    assert delete_expired_jobs(database, 45) == []
    assert delete_expired_jobs(database, 30) == [*old_job[:2]]
    assert delete_expired_jobs(database, 30) == []
    with database.read_session() as session:
        left = {job.id for job in JobRepository(session).list_page().items}
        assert left == {young, waiting}
        assert DatasetRepository(session).list_page().items == ()


def test_a_dataset_that_is_younger_or_used_by_another_job_stays(
    database: Database, old_job: tuple[str, str, str]
) -> None:
    job, data, _ = old_job
    other, _ = end_job(database, DONE, dataset=data)
    assert delete_expired_jobs(database, 30) == [job]
    age(database, Job, other, 40)
    age(database, Dataset, data, 20)
    assert delete_expired_jobs(database, 30) == [other]
    with database.read_session() as session:
        assert DatasetRepository(session).get(data).deleted_at is None


def test_a_job_with_an_accepted_run_stays(
    database: Database, old_job: tuple[str, str, str]
) -> None:
    with database.write_session() as session:
        ReferenceRepository(session).accept_run("tube", old_job[2])
    assert delete_expired_jobs(database, 30) == []


def test_the_rule_of_a_project_replaces_the_one_of_the_service(
    database: Database, old_job: tuple[str, str, str]
) -> None:
    keep(database, 100)
    assert delete_expired_jobs(database, 30) == []
    keep(database, 30)
    assert delete_expired_jobs(database, None)[:1] == [old_job[0]]


def test_many_old_jobs_are_deleted_although_some_must_stay(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "MAX_JOBS", 2)
    jobs = [end_job(database, DONE, dataset=f"ds_{number}") for number in range(7)]
    for number, (job, (run,)) in enumerate(jobs):
        age(database, Job, job, 50 - number)
        if number in (0, 1, 4):
            with database.write_session() as session:
                ReferenceRepository(session).accept_run(f"r{number}", run)
    assert delete_expired_jobs(database, 30) == [jobs[number][0] for number in (2, 3, 5, 6)]


def list_named_rows(database: Database, named: dict[str, set[str]]) -> list[str]:
    """The tables with rows that refer to one of these rows by a foreign key."""
    with database.read_session() as session:
        return [
            table.name
            for table in Base.metadata.sorted_tables
            for key in table.foreign_keys
            if session.scalars(
                select(key.parent).where(key.parent.in_(named.get(key.column.table.name, set())))
            ).first()
        ]


def test_a_purge_removes_all_of_a_deleted_job_but_its_tombstone(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "ROWS_AT_ONCE", 2)
    kept, _ = end_job(database, DONE)
    before = count(database, Run, Event, RunHistory)
    job, runs = end_job(database, DONE * 5)
    point = HistoryPoint(runs[0], 0, 0, 1, 10, 1.0, "genetic", (1.0,))
    with database.write_session() as session:
        insert_missing(session, RunHistory, pack_history([point]))
        session.add(StoredSummary(job_id=job, attempt=1, document={}))
        delete_item(session, "job", job)
    assert purge_deleted_jobs(database) == 0  # not before its time
    assert purge_deleted_jobs(database, AT_ONCE) == 5
    assert purge_deleted_jobs(database, AT_ONCE) == 0
    assert count(database, Run, Event, RunHistory, StoredSummary) == [*before, 0]
    assert [run.job_id for run in runs_of(database, kept)] == [kept]
    with database.read_session() as session:
        row = session.get_one(Job, job)
        assert (row.name, row.spec) == ("tube", {})
        assert row.purged_at is not None
    assert list_named_rows(database, {"jobs": {job}, "runs": set(runs)}) == []


def test_the_housekeeper_frees_objects_of_what_was_deleted(
    database: Database, tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = open_store(f"file://{tmp_path}/objects")
    raw = store.put_stream([b"raw"]).sha256
    data = add_dataset(database, sha256=raw)
    job, _ = end_job(database, DONE, dataset=data)
    age(database, Job, job, 40)
    age(database, Dataset, data, 40)
    keeper = Housekeeper(database, store, KeptDays(jobs=30), threading.Event(), Scrubber(store, 0))
    keeper.run_pass()
    assert store.exists(raw)  # a backup may be reading it
    monkeypatch.setattr(housekeeper, "COLLECT_SECONDS", -1.0)
    monkeypatch.setattr(
        housekeeper, "purge_deleted_jobs", lambda base: purge_deleted_jobs(base, AT_ONCE)
    )
    monkeypatch.setattr(
        housekeeper, "delete_orphans", lambda base, objects: delete_orphans(base, objects, AT_ONCE)
    )
    keeper.run_pass()
    assert not store.exists(raw)
    assert count(database, Run) == [0]


def test_audit_entries_are_deleted_once_their_days_have_passed(
    database: Database, tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    def list_numbers() -> list[str | None]:
        with database.read_session() as session:
            return [row.object_id for row in list_actions(session).items]

    with database.write_session() as session:
        for number in range(6):
            record_action(session, "key.refuse", f"key_{number}")
            session.flush()
        for entry in list_actions(session).items[2:]:
            entry.at = utc_now() - timedelta(days=31)
    store = open_store(f"file://{tmp_path}/objects")
    Housekeeper(database, store, KeptDays(), threading.Event(), Scrubber(store, 0)).run_pass()
    assert len(list_numbers()) == 6
    monkeypatch.setattr(retention, "ROWS_AT_ONCE", 2)
    Housekeeper(
        database, store, KeptDays(audit=30), threading.Event(), Scrubber(store, 0)
    ).run_pass()
    assert list_numbers() == ["key_5", "key_4"]
    assert delete_expired_actions(database, 30) == 0


def test_a_job_is_deleted_once_its_days_have_passed(database: Database) -> None:
    job, _ = end_job(database, DONE)
    now: datetime = utc_now()
    assert delete_expired_jobs(database, 1, now) == []
    assert delete_expired_jobs(database, 1, now + timedelta(days=2)) == [job]
