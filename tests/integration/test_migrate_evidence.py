"""Rows that an earlier version wrote are carried over by the migrations, and back."""

import json
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import text

from service.repositories.history import PHASES
from service.repositories.runs import RunRepository
from service.storage import migrate, sessions

BEFORE = "0006"
HISTORY = [
    {"run_id": "run_a", "island": island, "number": number, "generation": 3 * number,
     "evaluations": 2**40 + number, "rms": 0.1 + 0.2 / (number + 1), "phase": PHASES[number],
     "parameters": [0.1 * number, -1e300]}
    for island in range(2) for number in range(5)
]  # fmt: skip
HISTORY += [{**HISTORY[0], "run_id": f"run_b{i:03}", "parameters": []} for i in range(450)]
MIGRANTS = [
    {"run_id": "run_a", "number": number, "epoch": number // 2, "source": 0, "destination": 1,
     "fitness": 1.0 / (number + 3)}
    for number in range(4)
]  # fmt: skip


@pytest.fixture
def former(empty_database):
    """A database of the version before, with history and migrants of its runs."""
    migrate.upgrade(empty_database, BEFORE)
    now = "2026-01-01 00:00:00+00:00"
    with empty_database.engine.begin() as connection:
        connection.execute(text(
            "INSERT INTO jobs (id, project_id, name, state, spec, priority, max_attempts, attempt, "
            "lost_leases, cancel_requested, n_runs, n_done, n_failed, evaluations, generation, "
            "created_at) VALUES ('job_a', 'proj_default', '', 'succeeded', '{}', 0, 3, 1, 0, "
            "FALSE, 451, 451, 0, 0, 0, :now)"), {"now": now})  # fmt: skip
        runs = sorted({one["run_id"] for one in HISTORY})
        connection.execute(text(
            "INSERT INTO runs (id, project_id, job_id, number, cell, labels, state, attempt, "
            "evaluations, generations, signals_sha256, created_at) VALUES (:id, 'proj_default', "
            "'job_a', :number, '{}', '{}', 'succeeded', 1, 0, 0, :sha, :now)"),
            [{"id": run, "number": i, "sha": "a" * 64, "now": now} for i, run in enumerate(runs)],
        )  # fmt: skip
        history = [{**one, "parameters": json.dumps(one["parameters"])} for one in HISTORY]
        insert(connection, "run_history", history)
        insert(connection, "migrations_log", MIGRANTS)
    return empty_database


def insert(connection, table, rows):
    names = ", ".join(rows[0])
    values = ", ".join(f":{name}" for name in rows[0])
    if connection.dialect.name == "postgresql":
        values = values.replace(":parameters", "CAST(:parameters AS JSONB)")
    connection.execute(text(f"INSERT INTO {table} ({names}) VALUES ({values})"), rows)


def stored(database, table, order):
    with database.engine.connect() as connection:
        rows = connection.execute(text(f"SELECT * FROM {table} ORDER BY {order}")).mappings()
        found = [dict(row) for row in rows]
    for row in found:
        if "parameters" in row:  # a text, or a document in which PostgreSQL wrote 1e300 out
            values = row["parameters"]
            values = json.loads(values) if isinstance(values, str) else values
            row["parameters"] = [float(value) for value in values]
    return found


def test_history_and_migrants_of_the_version_before_are_read_bit_for_bit(former):
    migrate.upgrade(former)
    assert migrate.differences(former) == []
    with former.read() as session:
        repository = RunRepository(session)
        found = [point._asdict() for point in repository.history("run_a")]
        others = [repository.history(f"run_b{i:03}") for i in range(450)]
        log = [line._asdict() for line in repository.migrations("run_a")]
        run = repository.get("run_a")
    assert found == HISTORY[:10]
    assert [one[0].run_id for one in others] == [one["run_id"] for one in HISTORY[10:]]
    assert log == MIGRANTS
    assert (run.signals_sha256, run.signals_start) == ("a" * 64, None)


def test_going_back_gives_the_rows_that_were_there(former):
    migrate.upgrade(former)
    migrate.downgrade(former, BEFORE)
    assert stored(former, "run_history", "run_id, island, number") == HISTORY
    assert stored(former, "migrations_log", "run_id, number") == MIGRANTS
    migrate.upgrade(former)
    assert migrate.differences(former) == []


def test_signals_that_share_an_object_are_not_told_as_one_runs_by_the_version_before(former):
    migrate.upgrade(former)
    with former.engine.begin() as connection:
        connection.execute(text("UPDATE runs SET signals_start = 8, signals_size = 9 "
                                "WHERE id = 'run_a'"))  # fmt: skip
    migrate.downgrade(former, BEFORE)
    first, second, *_ = stored(former, "runs", "id")
    assert (first["signals_sha256"], second["signals_sha256"]) == (None, "a" * 64)


def test_an_upgrade_waits_for_a_writer_that_has_begun_and_carries_over_what_it_wrote(former):
    late = {"run_id": "run_b001", "island": 7, "number": 0, "generation": 1, "evaluations": 2,
            "rms": 0.5, "phase": "genetic", "parameters": "[]"}  # fmt: skip
    with ThreadPoolExecutor(1) as pool:
        with former.engine.begin() as writer:
            writer.execute(text("UPDATE runs SET evaluations = 3 WHERE id = 'run_b001'"))
            upgraded = pool.submit(migrate.upgrade, former)
            wait_for_a_lock(former, upgraded)
            insert(writer, "run_history", [late])
        upgraded.result()
    with former.read() as session:
        points = RunRepository(session).history("run_b001")
    assert [one.island for one in points] == [0, 7]


def wait_for_a_lock(database, upgraded):
    """Until it waits on PostgreSQL; on SQLite nobody else can have begun."""
    with database.engine.connect() as looking:
        if looking.dialect.name == "sqlite":
            return
        waiting = text("SELECT count(*) FROM pg_locks WHERE NOT granted")
        while not (looking.scalar(waiting) or upgraded.done()):
            time.sleep(0.01)


def test_an_upgrade_waits_longer_for_its_turn_than_other_writers(former, monkeypatch):
    monkeypatch.setattr(sessions, "BUSY_SECONDS", 0.01)
    with ThreadPoolExecutor(1) as pool:
        with former.engine.begin() as writer:
            writer.execute(text("UPDATE runs SET evaluations = 3 WHERE id = 'run_b001'"))
            upgraded = pool.submit(migrate.upgrade, former)
            time.sleep(0.3)
        upgraded.result()
    assert migrate.differences(former) == []
