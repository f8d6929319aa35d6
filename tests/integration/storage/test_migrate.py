"""Migrations: they build the program's tables, undo them, and never race."""

import multiprocessing
import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sqlalchemy import delete, inspect, select, text

import migrations
from service.core.states import JobState
from service.items.deletion import delete_item
from service.queue.leases import LeaseQueue
from service.queue.run_writes import NewRun, RunOutcome, RunWriter
from service.repositories.datasets import DatasetRepository
from service.repositories.lineage import LineageLink, LineageRepository
from service.storage import migrate, sessions
from service.storage.errors import DatabaseIsNewer, DatabaseNotAtHead, UnknownRevision
from service.storage.sessions import Database
from service.storage.tables import Base, Event, Job, Project, Run, SearchTerm, StoredSummary
from tests.database import empty_postgres, record_statements
from tests.limits import LIMIT_SECONDS
from tests.stored import (
    claim,
    claimed,
    new_dataset,
    parcels_of,
    record_outcomes,
    record_success,
    submit,
)

HEAD = migrate.find_head_revision()
VERSIONS = Path(migrations.__file__).parent / "versions"
REVISIONS = sorted((path.name[:4] for path in VERSIONS.glob("0*.py")), reverse=True)
"""The latest first."""


def tables(database):
    return set(inspect(database.engine).get_table_names()) - {"alembic_version"}


def test_the_migrations_build_exactly_the_tables_of_the_program(empty_database):
    migrate.upgrade_database(empty_database)
    assert tables(empty_database) == set(Base.metadata.tables)
    assert migrate.list_differences(empty_database) == []


def test_indexes_are_those_of_the_program_with_their_conditions(empty_database):
    migrate.upgrade_database(empty_database)
    migrated = indexes(empty_database)
    migrate.downgrade_database(empty_database)
    Base.metadata.create_all(empty_database.engine)
    assert migrated == indexes(empty_database)
    assert any("WHERE" in definition for definition in migrated.values())
    Base.metadata.drop_all(empty_database.engine)


def indexes(database):
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


def test_rows_are_kept_by_an_upgrade_from_the_first_revision_and_by_the_way_back(empty_database):
    migrate.upgrade_database(empty_database)
    claim, runs = claimed(empty_database, n_runs=2)
    record_success(empty_database, claim.lease, runs[0], rms=0.5)
    with empty_database.write_session() as session:
        session.add(StoredSummary(job_id=claim.job.id, attempt=1, document={"a": 1}))
    kinds = (Job, Run, Event)
    before = [rows(empty_database, kind) for kind in kinds]
    migrate.downgrade_database(empty_database, "0001")
    with empty_database.engine.connect() as connection:
        query = text("SELECT n_done, best_rms FROM jobs")
        assert [tuple(row) for row in connection.execute(query)] == [(1, 0.5)]
    migrate.upgrade_database(empty_database)
    assert [rows(empty_database, kind) for kind in kinds] == before
    assert rows(empty_database, StoredSummary) == []  # the next reader computes it again


@pytest.mark.postgres
def test_postgresql_compresses_no_result_by_its_slow_method_after_a_way_back():
    # What compresses fast, or is compressed already, is told by storage and method.
    query = text(
        "SELECT attrelid::regclass::text, attstorage, attcompression FROM pg_attribute WHERE "
        "(attrelid, attname) IN (('runs'::regclass, 'result'), ('run_history'::regclass, 'points'))"
    )
    with empty_postgres() as database:
        migrate.upgrade_database(database)
        migrate.downgrade_database(database, "0007")
        migrate.upgrade_database(database)
        with database.engine.connect() as connection:
            found = {table: rest for table, *rest in connection.execute(query)}
    assert set(found) == {"runs", "run_history"}
    assert all(storage == "e" or method == "l" for storage, method in found.values()), found


def end_two_runs(database, *, fits=True, batch=False, trust=True, state=JobState.SUCCEEDED):
    """A job of three runs, or of two if it succeeds, of which two ended with a result."""
    ended, runs = claimed(database, n_runs=2 + (state is not JobState.SUCCEEDED))
    for run, rms in zip(runs, (0.5, 0.4), strict=False):
        verdict = {"trust": "limited" if rms == 0.4 else "trustworthy"}
        outcome = RunOutcome(
            run_id=run,
            state=JobState.SUCCEEDED,
            best_rms=rms,
            fit_estimation=100 - rms if fits else None,
            result={"parameters": [], **({"verdict": verdict} if trust else {})},
        )
        record_outcomes(database, ended.lease, outcome)
    with database.write_session() as session:
        if batch:
            for run in runs:
                session.get_one(Run, run).cell = {"/datasets": ["ds_1"]}
        LeaseQueue(session).finish_job(ended.lease, state)
    return ended.job.id


def test_rms_fit_and_trust_of_ended_jobs_are_taken_from_their_best_runs(empty_database):
    database = empty_database
    migrate.upgrade_database(database)
    jobs = {
        end_two_runs(database): (0.4, 99.6, "limited"),
        end_two_runs(database, batch=True): (0.4, None, None),
        end_two_runs(database, fits=False): (0.4, None, "limited"),
        end_two_runs(database, state=JobState.CANCELLED): (0.4, 99.6, "limited"),
        end_two_runs(database, state=JobState.FAILED): (0.4, 99.6, "limited"),
        end_two_runs(database, trust=False): (0.4, 99.6, None),
    }
    running, (run, _) = claimed(database, n_runs=2)
    record_success(database, running.lease, run, rms=0.3)
    jobs[running.job.id] = (0.3, None, None)
    assert read_sorted_values(database) == jobs
    migrate.downgrade_database(database, "0006")
    with record_statements(database) as statements:
        migrate.upgrade_database(database)
    assert read_sorted_values(database) == jobs
    # SQLite knows these since 3.38.
    assert not [text for text, _ in statements if database.is_sqlite and "->" in text]


def test_an_ended_job_that_the_program_left_without_fit_gets_that_of_its_best_run(empty_database):
    database = empty_database
    migrate.upgrade_database(database)
    job = end_two_runs(database, state=JobState.CANCELLED)
    migrate.downgrade_database(database, "0008")
    with database.engine.begin() as connection:
        connection.execute(text("UPDATE jobs SET fit_estimation = NULL, best_rms = 0.1"))
    migrate.upgrade_database(database)
    assert read_sorted_values(database) == {job: (0.4, 99.6, "limited")}


def read_sorted_values(database):
    query = select(Job.id, Job.best_rms, Job.fit_estimation, Job.trust)
    with database.read_session() as session:
        return {job: tuple(values) for job, *values in session.execute(query)}


def test_a_sweep_in_parcels_goes_down_without_gaps_and_up_again(empty_database):
    """The earlier version creates runs in their order, so nothing may be behind a gap."""
    database = empty_database
    migrate.upgrade_database(database)
    job = submit(database, n_runs=6)
    for owner, numbers in (("d1", [0]), ("d2", [3, 4])):
        with database.write_session() as session:
            lease = LeaseQueue(session).claim_job(owner, choose_size=lambda _: 3).lease
            writer = RunWriter(session, lease)
            created = writer.create_runs(NewRun(number=number) for number in numbers)
            record = RunOutcome(run_id=created[0].id, state=JobState.SUCCEEDED)
            writer.record_outcomes([record])
    whole = submit(database, n_runs=1)
    leased = claim(database, "d3")
    migrate.downgrade_database(database, "0002")
    with database.engine.connect() as connection:
        query = "SELECT id, state, lease_owner, n_done FROM jobs ORDER BY id"
        assert list(map(tuple, connection.execute(text(query)))) == [
            (job, "queued", None, 1),
            (whole, "running", "d3", 0),
        ]
        numbers = text("SELECT number FROM runs ORDER BY number")
        assert list(connection.scalars(numbers)) == [0]
    migrate.upgrade_database(database)
    assert migrate.list_differences(database) == []
    (waiting,), (held,) = parcels_of(database, job), parcels_of(database, whole)
    assert (waiting.first, waiting.stop, waiting.lease_owner) == (0, 6, None)
    assert (held.attempt, held.lease_owner) == (leased.lease.attempt, "d3")
    again = claim(database, "d4")
    assert (again.job.id, again.runs, again.is_new) == (job, range(6), False)


@pytest.mark.parametrize("revision", ["0003", "0002"])
def test_summaries_of_jobs_that_lose_runs_on_the_way_down_go_with_them(empty_database, revision):
    database = empty_database
    migrate.upgrade_database(database)
    kept, _ = claimed(database, n_runs=2)
    with database.write_session() as session:
        LeaseQueue(session).finish_job(kept.lease, JobState.CANCELLED)
    claim_of_more, runs = claimed(database, n_runs=3)
    for run in runs:
        record_success(database, claim_of_more.lease, run, rms=0.5)
    with database.write_session() as session:
        LeaseQueue(session).finish_job(claim_of_more.lease, JobState.FAILED, "as told")
        for job in (kept.job.id, claim_of_more.job.id):
            session.add(StoredSummary(job_id=job, attempt=1, document={}))
        if revision == "0003":
            delete_item(session, "run", runs[1])
            session.add(StoredSummary(job_id=claim_of_more.job.id, attempt=1, document={}))
        else:
            session.execute(delete(Run).where(Run.id == runs[1]))  # a gap: later runs go
    migrate.downgrade_database(database, revision)
    with database.engine.connect() as connection:
        summaries = connection.scalars(text("SELECT job_id FROM job_summaries"))
        assert list(summaries) == [kept.job.id]
        count = text("SELECT n_done FROM jobs WHERE id = :job")
        n_done = connection.scalar(count, {"job": claim_of_more.job.id})
        n_rows = text("SELECT count(*) FROM runs WHERE job_id = :job")
        assert n_done == connection.scalar(n_rows, {"job": claim_of_more.job.id})


def test_stored_jobs_and_datasets_are_found_by_what_they_already_had(empty_database):
    axis = {"path": "/datasets", "values": ["ds_1", "ds_2"], "labels": [{"x": 5.0}, {"x": 10}]}
    spec = {"model": {"name": "pump"}, "datasets": ["ds_1"], "sweep": {"axes": [axis]}}
    migrate.upgrade_database(empty_database)
    first, (run,) = claimed(empty_database, spec={"model": "tube", "datasets": ["ds_3"]})
    later, _ = claimed(empty_database, spec={**spec, "warm_start": run})
    with empty_database.write_session() as session:
        segments = [{"labels": {"length_m": 5}}]
        new = new_dataset(details={"segments": segments})
        data = DatasetRepository(session).add(new).dataset.id
    migrate.downgrade_database(empty_database, "0002")
    migrate.upgrade_database(empty_database)
    found = {(kind, value, item) for _, kind, value, item in rows(empty_database, SearchTerm)}
    job = later.job.id
    assert found == {
        ("job:model", "tube", first.job.id),
        ("job:dataset", "ds_3", first.job.id),
        ("job:model", "pump", job),
        ("job:dataset", "ds_1", job),
        ("job:dataset", "ds_2", job),
        ("job:label", "x=5", job),
        ("job:label", "x=10", job),
        ("dataset:label", "length_m=5", data),
    }
    with empty_database.read_session() as session:
        lineage = LineageRepository(session)
        assert lineage.list_ancestors(job) == sorted(
            [LineageLink(job, run, "warm-start"), LineageLink(run, first.job.id, "computed")]
        )


def rows(database, kind):
    with database.engine.connect() as connection:
        return sorted(map(tuple, connection.execute(kind.__table__.select())), key=repr)


def test_going_down_removes_every_table_and_up_again_brings_them_back(empty_database):
    migrate.upgrade_database(empty_database)
    migrate.downgrade_database(empty_database)
    assert tables(empty_database) == set()
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


def test_a_database_of_a_later_version_is_not_touched(database):
    with database.engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    actions = (migrate.upgrade_database, migrate.downgrade_database, migrate.check_revision)
    try:
        for action in actions:
            with pytest.raises(DatabaseIsNewer, match=rf"9999.*up to {HEAD}"):
                action(database)
        assert migrate.read_current_revision(database) == "9999"
    finally:  # PostgreSQL's is that of all tests
        with database.engine.begin() as connection:
            connection.execute(text(f"UPDATE alembic_version SET version_num = '{HEAD}'"))


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
    assert tables(empty_database) == {"dispatchers"}


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


NEXT = """
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
def revisions(tmp_path, monkeypatch):
    """The revisions of the program in a folder of their own, to which a test adds another."""
    folder = tmp_path / "migrations"
    shutil.copytree(Path(migrations.__file__).parent, folder)
    monkeypatch.setattr(migrations, "__file__", str(folder / "__init__.py"))
    return folder / "versions"


def copies(database):
    with database.engine.connect() as connection:
        return list(connection.scalars(text("SELECT copy FROM projects")))


def columns(database):
    return {one["name"] for one in inspect(database.engine).get_columns("projects")}


def test_a_further_revision_carries_the_rows_over_and_back(database, revisions):
    before = columns(database)
    (revisions / "next.py").write_text(NEXT.format(head=HEAD, last=""))
    with pytest.raises(DatabaseNotAtHead, match="next"):
        migrate.check_revision(database)
    migrate.upgrade_database(database)
    assert copies(database) == ["default"]
    undone = migrate.list_undone_migrations(database, "base")
    assert [name for name, _ in undone] == ["next", *REVISIONS]
    assert [name for name, _ in migrate.list_undone_migrations(database, HEAD)] == ["next"]
    earlier = ", ".join((*REVISIONS, "base"))
    with pytest.raises(UnknownRevision, match=f"Earlier ones, the latest first: {earlier}"):
        migrate.list_undone_migrations(database, "next")
    migrate.downgrade_database(database, HEAD)
    assert columns(database) == before
    with database.read_session() as session:
        assert [one.name for one in session.query(Project)] == ["default"]
    assert migrate.list_differences(database) == []


def test_a_further_revision_that_fails_leaves_the_database_as_it_was(database, revisions):
    before = columns(database)
    (revisions / "next.py").write_text(
        NEXT.format(head=HEAD, last='raise OSError("in the middle")')
    )
    with pytest.raises(OSError, match="in the middle"):
        migrate.upgrade_database(database)
    assert columns(database) == before
    assert migrate.read_current_revision(database) == HEAD


def test_an_upgrade_waits_for_a_writer_that_has_begun_and_carries_over_what_it_wrote(
    database, revisions
):
    (revisions / "next.py").write_text(NEXT.format(head=HEAD, last=""))
    with ThreadPoolExecutor(1) as pool:
        with database.engine.begin() as writer:
            writer.execute(text("UPDATE projects SET name = 'early'"))
            upgraded = pool.submit(migrate.upgrade_database, database)
            wait_for_a_lock(database, upgraded)
            writer.execute(text("UPDATE projects SET name = 'late'"))
        upgraded.result()
    assert copies(database) == ["late"]


def wait_for_a_lock(database, upgraded):
    """Until it waits on PostgreSQL; on SQLite nobody else can have begun."""
    with database.engine.connect() as looking:
        if looking.dialect.name == "sqlite":
            return
        waiting = text("SELECT count(*) FROM pg_locks WHERE NOT granted")
        while not (looking.scalar(waiting) or upgraded.done()):
            time.sleep(0.01)


def test_an_upgrade_waits_longer_for_its_turn_than_other_writers(database, revisions, monkeypatch):
    monkeypatch.setattr(sessions, "BUSY_SECONDS", 0.01)
    (revisions / "next.py").write_text(NEXT.format(head=HEAD, last=""))
    with ThreadPoolExecutor(1) as pool:
        with database.engine.begin() as writer:
            writer.execute(text("UPDATE projects SET name = 'late'"))
            upgraded = pool.submit(migrate.upgrade_database, database)
            time.sleep(0.3)
        upgraded.result()
    assert copies(database) == ["late"]
