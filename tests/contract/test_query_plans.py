"""Every hot query finds its rows by an index, on a filled database: no whole table is read.

The databases plan the statements of the use cases themselves, with their parameters. SQLite plans
without statistics of the tables, with those of the filled ones, and with those of empty ones.
"""

import json
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from itertools import islice
from typing import Any

import pytest
from sqlalchemy import text
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.items.deletion import delete_item, find_dependents
from service.items.editing import edit_item
from service.items.item_schemas import EditIn
from service.items.items import lock_item
from service.queue import run_writes
from service.queue.admission import Admission, count_unfinished
from service.queue.leases import (
    Claim,
    JobProgress,
    LeaseOwners,
    LeaseQueue,
    count_held_parcels,
)
from service.queue.notifications import read_queue_status
from service.queue.packed_results import LAYOUTS
from service.queue.previous_attempts import (
    delete_progress,
    list_failure_reasons,
    summarize_attempts,
)
from service.queue.queue_state import read_queue_state
from service.queue.reuse import find_computed_runs, take_over_runs
from service.queue.run_writes import RunOutcome, RunWriter, insert_runs
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.event_rows import EventRepository
from service.repositories.job_rows import JobRepository
from service.repositories.lineage_rows import LineageRepository
from service.repositories.outcome_rows import read_estimates
from service.repositories.reference_rows import ReferenceRepository
from service.repositories.result_rows import list_results
from service.repositories.run_rows import RunRepository
from service.repositories.search_conditions import ListFilter, add_terms
from service.repositories.summary_rows import (
    find_quietest_run,
    read_run_table,
    read_summary,
    write_summary,
)
from service.repositories.trend_rows import read_trend_rows
from service.storage.garbage import _find_named_hashes, select_hashes
from service.storage.sessions import Database
from service.storage.tables import (
    DEFAULT_PROJECT,
    Checkpoint,
    IdempotencyKey,
    Job,
    MigrationLog,
    RunHistory,
    StoredSummary,
)
from service.upkeep.retention import list_deleted_jobs, list_ended_jobs
from tests.support.storage.databases import record_statements
from tests.support.storage.job_rows import new_dataset, new_job, new_run, submit_and_claim
from tests.support.storage.run_results import conclude, encode_results, write_result

N_JOBS, N_RUNS, N_EVENTS, N_OTHERS = 3000, 2000, 3000, 2000
GROWING = {"jobs", "runs", "events", "datasets", "checkpoints", "run_history", "migrations_log"}
GROWING |= {"idempotency_keys", "lineage_edges", "job_summaries", "models", "search_terms"}
BOUNDED_INDEXES = ("ix_jobs_open", "ix_parcels_owned")
"""Indexes of open jobs: to read them whole is to read what is open."""
NUMBERS = {
    True: "WITH RECURSIVE s(n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM s WHERE n < {last})",
    False: "WITH s AS (SELECT generate_series(0, {last}) AS n)",
}


def copy_row(database: Database, table: str, count: int, **changes: str) -> None:
    """Copy the first row of a table many times, with other values by SQL of the number `s.n`."""
    with database.engine.begin() as connection:
        row = connection.execute(text(f"SELECT * FROM {table} LIMIT 1")).mappings().one()
        names = ", ".join(row)
        values = ", ".join(changes.get(name, f"t.{name}") for name in row)
        numbers = NUMBERS[database.is_sqlite].format(last=count - 1)
        connection.execute(
            text(
                f"INSERT INTO {table} ({names}) {numbers} SELECT {values} FROM s "
                f"CROSS JOIN (SELECT * FROM {table} LIMIT 1) t"
            )
        )


def pad(prefix: str, database: Database) -> str:
    """SQL of an identifier with a number at its end."""
    number = "CAST(s.n AS TEXT)"
    if database.is_sqlite:
        return f"'{prefix}' || substr('0000000000' || {number}, -10)"
    return f"'{prefix}' || lpad({number}, 10, '0')"


LARGE = "job_00000000003"
Filled = tuple[Database, Claim, list[str]]
STATISTICS = [("sqlite", "none"), ("sqlite", "old"), ("sqlite", "fresh")]
ON_POSTGRES = pytest.param(("postgres", "fresh"), marks=pytest.mark.postgres)


@pytest.fixture(params=[*STATISTICS, ON_POSTGRES], ids="-".join)
def database_with_jobs(request: pytest.FixtureRequest) -> Filled:
    """A database with many ended jobs, one of them large, and a claimed job with two runs."""
    kind, statistics = request.param
    database: Database = request.getfixturevalue(f"{kind}_database")
    if statistics == "old":
        database.update_statistics()
    ended, runs_of_ended = submit_and_claim(database, n_runs=2)
    with database.write_session() as session:
        LeaseQueue(session).finish_job(ended.lease, JobState.CANCELLED)
    copy_row(
        database,
        "jobs",
        N_JOBS,
        id=pad("job_0", database),
        state="CASE WHEN s.n % 100 = 0 THEN 'failed' ELSE 'succeeded' END",
        spec=f"""'{{"model": "{"m" * 1000}"}}'""",
    )
    open_one, ids = submit_and_claim(database, n_runs=2)
    owners = [f"job_0000000000{number}" for number in range(5)]
    for number, job in enumerate([*owners, open_one.job.id]):
        copy_row(
            database,
            "runs",
            N_RUNS,
            id=pad(f"run_{number}", database),
            job_id=f"'{job}'",
            number="s.n + 2",
            state="'succeeded'",
            best_rms="1.0 + s.n",
            result=f"'{json.dumps(write_result())}'",
            spec_hash=pad(f"h{number}", database),
            signals_sha256=pad(f"a{number}", database),
        )
    copy_row(
        database,
        "events",
        N_EVENTS,
        id="s.n + 100000",
        job_id=f"'{LARGE}'",
        kind="CASE WHEN s.n % 500 = 0 THEN 'log' ELSE 'progress' END",
    )
    with database.write_session() as session:  # one row of each other table that grows
        session.add(
            IdempotencyKey(key="k", project_id=DEFAULT_PROJECT, request_hash="", job_id=LARGE)
        )
        session.add(StoredSummary(job_id=ended.job.id, attempt=1, document={}))
        add_terms(session, "job", ended.job.id, [("tag", "t"), ("model", "m")])
        LineageRepository(session).add_links("job_1", ["ds_1"], "estimation")
        DatasetRepository(session).add(new_dataset())
        history = {"digest": 1, "n_parameters": 1, "generation": 1, "evaluations": 1, "rms": 1.0}
        session.add(RunHistory(run_id=runs_of_ended[0], points=b"", **history))
        session.add(MigrationLog(run_id=runs_of_ended[0], digest=1, migrants=b""))
        number = {"attempt": 1, "evaluations": 1, "state": b""}
        session.add(Checkpoint(run_id=runs_of_ended[0], job_id=LARGE, **number))
    run = pad("run_0", database)
    copy_row(database, "idempotency_keys", N_OTHERS, key=pad("k", database))
    copy_row(database, "job_summaries", N_OTHERS, job_id=pad("job_0", database))
    copy_row(database, "lineage_edges", N_OTHERS, child=pad("job_0", database))
    for kind in ("tag", "model"):
        of_all = {"kind": f"'job:{kind}'", "value": f"'{kind[0]}'"}
        copy_row(database, "search_terms", N_OTHERS, item_id=pad("job_0", database), **of_all)
    copy_row(
        database,
        "datasets",
        N_OTHERS,
        id=pad("ds_0", database),
        sha256=pad("a0", database),
        source_key=pad("s", database),
    )
    for table in ("run_history", "migrations_log"):
        copy_row(database, table, N_OTHERS, run_id=run)
    copy_row(database, "checkpoints", N_OTHERS, run_id=run, job_id=pad("job_0", database))
    with database.write_session() as session:
        writer = RunWriter(session, open_one.lease)
        writer.save_checkpoints([(ids[0], 1, b"state")])
    if statistics == "fresh":
        database.update_statistics()
        if not database.is_sqlite:
            with database.engine.connect() as connection:
                connection.execution_options(isolation_level="AUTOCOMMIT")
                connection.exec_driver_sql("VACUUM ANALYZE")
    return database, open_one, ids


def read_plan(database: Database, statement: str, given: Any) -> list[str]:
    """The steps of a statement's plan that read a table, as texts of SQLite's form."""
    with database.engine.connect() as connection:
        if database.is_sqlite:
            rows = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", given)
            return [str(row[3]) for row in rows]
        (answer,) = connection.exec_driver_sql(f"EXPLAIN (FORMAT JSON) {statement}", given)
    found = answer[0] if isinstance(answer[0], list) else json.loads(answer[0])
    return list(describe_node(found[0]["Plan"]))


def describe_node(node: dict[str, Any]) -> Iterator[str]:
    kind, name = node["Node Type"], node.get("Relation Name", "")
    if kind == "Seq Scan":
        yield f"SCAN {name}"
    elif "Index Name" in node:
        condition = node.get("Index Cond", "")
        yield f"SEARCH {name} USING INDEX {node['Index Name']} {condition}"
    for child in node.get("Plans", ()):
        yield from describe_node(child)


def find_faults(database: Database, statement: str, given: Any) -> list[str]:
    """The steps of a plan that read a whole table, or all rows of a project to choose from."""
    steps = read_plan(database, statement, given)
    is_ordered = "LIMIT" in statement and not any("TEMP B-TREE" in step for step in steps)
    faults = []
    for step in steps:
        if any(index in step for index in BOUNDED_INDEXES):
            continue
        whole = re.match(r"SCAN (\w+)", step)
        if whole and resolve_alias(statement, whole[1]) in GROWING:
            faults.append(step)
        if re.search(r"_project_id_\w+ \(project_id=\?\)$", step) and not is_ordered:
            faults.append(step)
    return faults


def resolve_alias(statement: str, name: str) -> str:
    found = re.search(rf"\b(\w+) AS {re.escape(name)}\b", statement)
    return found[1] if found else name


def submit(at: Filled) -> None:
    with at[0].write_session() as session:
        new = new_job(name="new", spec={"model": "tube"})
        job = JobRepository(session).submit(new, key="key", request_hash="h").job
        insert_runs(session, job, [new_run(number=0)])
        LineageRepository(session).add_links(job.id, ["ds_1"], "estimation")
        count_unfinished(session, DEFAULT_PROJECT)


def list_failed(at: Filled) -> None:
    with at[0].read_session() as session:
        jobs = JobRepository(session)
        page = jobs.list_page(states=[JobState.FAILED], limit=20)
        assert [job.state for job in page.items] == [JobState.FAILED] * 20
        assert len(jobs.list_page(cursor=page.next, states=[JobState.FAILED]).items) == 10
        jobs.list_page(cursor=page.next)


def search_lists(at: Filled) -> None:
    since = datetime(1970, 1, 1, tzinfo=UTC)
    chosen = ListFilter(name="tub", terms=(("tag", "t"), ("model", "m")), since=since)
    with at[0].read_session() as session:
        jobs, datasets = JobRepository(session), DatasetRepository(session)
        page = jobs.list_page(chosen=chosen, limit=20)
        assert len(page.items) == 20
        jobs.list_page(cursor=page.next, chosen=chosen, states=[JobState.FAILED], limit=20)
        later = ListFilter(until=datetime(2500, 1, 1, tzinfo=UTC))
        for part in (ListFilter(name="TUB"), later):
            assert len(jobs.list_page(chosen=part, limit=20).items) == 20
        for part in (ListFilter(name="TEP"), later):
            assert len(datasets.list_page(chosen=part, limit=20).items) == 20


def show_results(at: Filled) -> None:
    """A sorted list reads an index of all jobs of the project, but no row that it does not show."""
    with at[0].read_session() as session:
        jobs = JobRepository(session)
        for order in ("fit", "rms", "verdict"):
            page = jobs.list_page(order=order, limit=20)
            assert len(jobs.list_page(order=order, limit=20, cursor=page.next).items) == 20
        rows = list_results(session, limit=5).items
        list_results(session, limit=5, cursor=f"{LARGE}:7", only_best=True)
        read_estimates(session, [row.run for row in rows])
        lineage = LineageRepository(session)
        lineage.list_links_to_children(["ds_1"], 17)
        lineage.list_links_to_parents(["job_1"], 17)
        ReferenceRepository(session).list_of_jobs([LARGE, at[1].job.id])
        count_held_parcels(session)


def delete_what_is_old(at: Filled) -> None:
    limit = datetime(2020, 1, 1, tzinfo=UTC)
    with at[0].write_session() as session:
        assert not list_ended_jobs(session, limit)
        assert not list_deleted_jobs(session, limit)
        find_dependents(session, lock_item(session, "dataset", "ds_00000000001"))
        delete_item(session, "job", "job_00000000100")


def count_jobs(at: Filled) -> None:
    with at[0].read_session() as session:
        assert read_queue_state(session).jobs[JobState.SUCCEEDED] == N_JOBS * 99 // 100


def poll_and_claim(at: Filled) -> None:
    admission = Admission(8, 0)
    with at[0].write_session() as session:
        JobRepository(session).submit(new_job(name="waits", spec={}))
    with at[0].read_session() as session:
        assert read_queue_status(session, "d1", admission).has_waiting_job
        read_queue_status(session, "d1")
    with at[0].write_session() as session:
        queue = LeaseQueue(session)
        assert queue.recover_claim("d1", [at[1].lease]) is None
        claim = queue.claim_job("d1", admission=admission)
        assert claim is not None
        queue.renew_leases([claim.lease, at[1].lease])


def reap(at: Filled) -> None:
    owners = LeaseOwners(frozenset({"gone"}), frozenset({"d2"}), {"d1": timedelta(seconds=1)})
    with at[0].write_session() as session:
        queue = LeaseQueue(session)
        assert queue.claim_job("d1") is not None
        queue.has_expired(owners)
        assert queue.reap_expired(LeaseOwners(ended=frozenset({"d1"}))).requeued


def write_runs(at: Filled) -> None:
    database, claim, ids = at
    with database.write_session() as session:
        writer = RunWriter(session, claim.lease)
        writer.start_runs(ids)
        writer.list_pending()
        writer.list_unfinished([0, 1])
        writer.read_checkpoints()
        writer.write_kills({ids[0]: 1})
        delete_progress(session, claim.lease, ids)
        writer.record_outcomes([RunOutcome(run_id=ids[0], state=JobState.SUCCEEDED, best_rms=1.0)])
        find_computed_runs(session, ["h10000000001", "h10000000002"])


def read_next_runs(at: Filled) -> None:
    database, claim, ids = at
    with database.write_session() as session:
        summarize_attempts(session, claim.lease)
        list_failure_reasons(session, claim.job.id, 3)
        writer = RunWriter(session, claim.lease)
        assert writer.count_runs(range(2)) == 2
        writer.create_runs(new_run(number=number) for number in range(2))
        assert len(writer.list_pending(2, -1, 2)) == len(ids)


def take_over_and_edit_a_run(at: Filled) -> None:
    database, claim, ids = at
    with database.write_session() as session:
        assert take_over_runs(session, claim.lease, {ids[1]: ids[0]})
        edit_item(session, "run", ids[0], EditIn(note="odd"))


def divide_lose_and_end_parcels(at: Filled) -> None:
    """Parcels of a job with many runs, whose evaluations are counted when one is lost or split."""
    database, _, _ = at
    with database.write_session() as session:
        JobRepository(session).submit(new_job(name="parcels", spec={}, n_runs=6, priority=100))
        queue = LeaseQueue(session)
        first = queue.claim_job("d7", choose_size=lambda _: 4)
        assert first is not None
        writer = RunWriter(session, first.lease)
        runs = writer.create_runs(new_run(number=number) for number in range(4))
        ended = RunOutcome(run_id=runs[0].id, state=JobState.SUCCEEDED, evaluations=5)
        writer.record_outcomes([ended])
        queue.write_progress(first.lease, JobProgress(5))
        assert queue.reap_expired(LeaseOwners(ended=frozenset({"d7"}))).requeued
        again = queue.claim_job("d8", choose_size=lambda _: 1)
        other = queue.claim_job("d8", choose_size=lambda _: 5)
        assert again is not None
        assert other is not None
        assert (again.runs, other.runs) == (range(1), range(1, 4))
        assert queue.end_parcel(again.lease)
        queue.cancel_parcel(other.lease)


def write_pack(at: Filled) -> None:
    """Write the results of a pack in bulk; `explain_bulk_writes` looks at its own statements."""
    database, claim, ids = at
    with database.write_session() as session:
        results = encode_results({ids[0]: conclude(2.0, L=(0.5, 0.1))}, database)
        RunWriter(session, claim.lease).record_results([results])
        explained = list(explain_bulk_writes(session, claim))
    by_key = (
        r"sqlite_autoindex_runs_1 \(id=" if database.is_sqlite else r"pk_runs \(+id\)?(::text)? ="
    )
    (update_of_runs, *inserts) = explained
    assert [step for step in update_of_runs if not re.search(by_key, step)] == []
    assert update_of_runs
    assert not any(inserts)


def explain_bulk_writes(session: Session, claim: Claim) -> Iterator[list[str]]:
    """Steps on stored tables of the bulk statements, planned where they were carried out.

    They go past SQLAlchemy, into the driver. On PostgreSQL they need the temporary tables of this
    session, and its settings.
    """
    connection = session.connection()
    driver = connection.connection.driver_connection
    assert driver is not None
    if connection.dialect.name == "sqlite":
        inserts = [run_writes._build_sqlite_insert(layout) for layout in LAYOUTS[1:]]
        for statement in (run_writes._UPDATE_IN_SQLITE, *inserts):
            numbered = re.findall(r"\?(\d+)", statement)
            n_marks = max(map(int, numbered)) if numbered else statement.count("?")
            rows = driver.execute(f"EXPLAIN QUERY PLAN {statement}", [None] * n_marks)
            yield [str(row[3]) for row in rows if re.match("SCAN|SEARCH", str(row[3]))]
        return
    constants = [claim.lease.attempt, *2 * (datetime.now(UTC),), claim.job.id]
    inserts = [run_writes._build_postgres_insert(layout) for layout in LAYOUTS[1:]]
    for statement in (run_writes._UPDATE_IN_POSTGRES, *inserts):
        given = constants if "%s" in statement else None
        (answer,) = driver.execute(f"EXPLAIN (FORMAT JSON) {statement}", given).fetchone()
        steps = describe_node(answer[0]["Plan"])
        yield [step for step in steps if not step.startswith("SCAN packed_")]


def end_large_job(at: Filled) -> None:
    """End a job that has many results."""
    database, claim, _ = at
    with database.write_session() as session:
        writer = RunWriter(session, claim.lease)
        ends = [RunOutcome(run_id=run, state=JobState.SUCCEEDED) for run in at[2]]
        writer.record_outcomes(ends)
        session.get_one(Job, claim.job.id).n_runs = N_RUNS + 2
        session.flush()
        assert LeaseQueue(session).finish_job(claim.lease, JobState.SUCCEEDED).best_rms == 1.0


def lose_workers_cancel_and_resume(at: Filled) -> None:
    with at[0].write_session() as session:
        queue, jobs = LeaseQueue(session), JobRepository(session)
        claim = queue.recover_claim("d1", [])
        assert claim is not None
        assert not queue.has_progressed("d1")
        queue.release_job(claim.lease, lost=True)
        jobs.cancel(claim.job.id)
        assert jobs.resume(claim.job.id).state is JobState.QUEUED


def show_job(at: Filled) -> None:
    with at[0].read_session() as session:
        job = JobRepository(session).get(LARGE)
        runs = RunRepository(session)
        page = runs.list_page(LARGE, limit=20)
        runs.list_page(LARGE, cursor=page.next, limit=20, descending=True)
        (best,) = runs.list_page(LARGE, limit=1, order="best_rms").items
        assert best.number == 2
        worst = runs.list_page(LARGE, limit=3, order="best_rms", descending=True)
        runs.list_page(
            LARGE, limit=3, cursor=worst.next, order="best_rms", states=[JobState.SUCCEEDED]
        )
        runs.read_history(best.id)
        runs.read_migrations(best.id)
        assert len(EventRepository(session).list_latest(LARGE)) == 6
        read_summary(session, job)


def stream_events(at: Filled) -> None:
    with at[0].read_session() as session:
        events = EventRepository(session)
        heads = events.read_heads([LARGE, at[1].job.id])
        assert not events.list_after(LARGE, heads[LARGE].last)


def summarise(at: Filled) -> None:
    with at[0].write_session() as session:
        job = session.get_one(Job, LARGE)
        assert len(read_run_table(session, LARGE).numbers) == N_RUNS
        write_summary(session, job, {})
        find_quietest_run(session, LARGE, {})
        read_trend_rows(session, LARGE, 5)


def collect_garbage(at: Filled) -> None:
    with at[0].read_session() as session:
        assert len(_find_named_hashes(session, ["a00000000001", "c" * 64])) == 1
        DatasetRepository(session).list_page(limit=5)
        for query in select_hashes():
            column = query.selected_columns[0]
            part = session.scalars(query.where(column >= "ac", column < "acg").distinct())
            assert list(islice(part, 2)) == []


USE_CASES: dict[Callable[[Filled], None], tuple[str, ...]] = {
    submit: ("ix_jobs_open",),
    list_failed: ("ix_jobs_by_state",),
    search_lists: ("ix_jobs_named", "ix_datasets_named"),
    show_results: ("ix_jobs_sorted",),
    delete_what_is_old: ("ix_jobs_ended", "ix_jobs_deleted", "ix_lineage_edges_parent"),
    count_jobs: ("ix_jobs_by_state",),
    show_job: ("ix_runs_job_id_best_rms", "ix_events_told"),
    stream_events: ("ix_events_job_id_id",),
    summarise: (),
    collect_garbage: ("ix_runs_signals_sha256",),
    poll_and_claim: ("ix_jobs_open",),
    read_next_runs: ("ix_runs_job_id_state_number",),
    write_pack: (),
    divide_lose_and_end_parcels: ("ix_runs_job_id_state_number",),
    write_runs: ("ix_runs_project_id_spec_hash",),
    take_over_and_edit_a_run: (),
    end_large_job: ("ix_runs_job_id_best_rms", "ix_runs_job_id_state_number"),
    lose_workers_cancel_and_resume: ("ix_runs_job_id_state_number",),
    reap: ("ix_jobs_open",),
}
"""What is done often or under the write lock, and the indexes that it must use."""


def test_no_hot_query_reads_a_whole_table(database_with_jobs: Filled) -> None:
    faults, used = [], {}
    for use_case in USE_CASES:  # in this order
        with record_statements(database_with_jobs[0]) as statements:
            use_case(database_with_jobs)
        assert statements
        used[use_case] = " ".join(
            step
            for statement, given in statements
            for step in read_plan(database_with_jobs[0], statement, given)
        )
        faults += [
            (use_case.__name__, fault, statement)
            for statement, given in statements
            for fault in find_faults(database_with_jobs[0], statement, given)
        ]
    assert not faults, "\n".join(map(str, faults))
    for use_case, indexes in USE_CASES.items():
        assert {index for index in indexes if index not in used[use_case]} == set(), use_case
