"""Runs, their history, checkpoints and lists, on SQLite and on PostgreSQL alike."""

import pytest

from service.core.states import JobState
from service.queue.leases import LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter, insert_runs
from service.repositories.history_rows import HistoryPoint, MigrantPoint
from service.repositories.job_rows import JobRepository
from service.repositories.run_rows import RunRepository
from service.storage.storage_errors import InvalidCursor, RowNotFound, UnstorableValue
from tests.support.storage.job_rows import (
    job_of,
    new_run,
    record_outcomes,
    runs_of,
    submit,
    submit_and_claim,
)

RESULT = {
    "parameters": [
        {"name": "L", "unit": "s", "value": 0.12, "stderr": 0.01},
        {"name": "m", "unit": "1", "value": 1.0, "stderr": None},
    ],
    "rms": 0.01,
}


def good(run_id, rms=0.01):
    return RunOutcome(
        run_id=run_id,
        state=JobState.SUCCEEDED,
        result=RESULT,
        valid=True,
        best_rms=rms,
        fit_estimation=98.0,
        evaluations=200,
        generations=4,
        seconds=0.5,
        signals_sha256="b" * 64,
    )


def sweep(database, cells):
    """A claimed job with these cells; its identifier."""
    submit(database, n_runs=len(cells))
    with database.write_session() as session:
        got = LeaseQueue(session).claim_job("d1")
        RunWriter(session, got.lease).create_runs(
            new_run(number=i, cell=cell, labels={"length_m": i % 2}) for i, cell in enumerate(cells)
        )
    return got


def read_numbers(database, job_id, **filters):
    with database.read_session() as session:
        return [run.number for run in RunRepository(session).list_page(job_id, **filters).items]


def test_runs_are_made_in_bulk_and_a_second_time_changes_nothing(database):
    got, before = submit_and_claim(database, n_runs=1500)
    with database.write_session() as session:
        ledger = RunWriter(session, got.lease)
        ledger.create_runs(new_run(number=i) for i in range(1500))
        assert [run.id for run in ledger.list_pending(limit=2000)] == before
    assert before == sorted(before)
    assert len(set(before)) == 1500


def test_runs_can_be_made_with_their_job(database):
    job_id = submit(database)
    with database.write_session() as session:
        job = JobRepository(session).get(job_id)
        insert_runs(session, job, [new_run(number=0, cell={"/seed": 3}, seed=3, method="simple")])
    (run,) = runs_of(database, job_id)
    assert (run.job_id, run.project_id, run.seed, run.method) == (
        job_id,
        "proj_default",
        3,
        "simple",
    )
    assert run.state is JobState.QUEUED


def test_pending_runs_come_in_order_and_in_parts(database):
    got, ids = submit_and_claim(database, n_runs=5)
    with database.write_session() as session:
        ledger = RunWriter(session, got.lease)
        first = ledger.list_pending(limit=2)
        rest = ledger.list_pending(limit=9, after=first[-1].number)
    assert [run.id for run in first + rest] == ids


def test_started_runs_carry_the_attempt_that_started_them(database):
    got, ids = submit_and_claim(database, n_runs=2)
    with database.write_session() as session:
        RunWriter(session, got.lease).start_runs(ids[:1])
    first, second = runs_of(database, got.job.id)
    assert (first.state, first.attempt) == (JobState.RUNNING, 1)
    assert first.started_at is not None
    assert (second.state, second.attempt) == (JobState.QUEUED, 0)


@pytest.mark.parametrize("end", [JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED])
def test_a_run_that_has_ended_is_not_started_again(database, end):
    got, (run_id, other) = submit_and_claim(database, n_runs=2)
    record_outcomes(database, got.lease, RunOutcome(run_id=run_id, state=end))
    with database.write_session() as session:
        RunWriter(session, got.lease).start_runs([run_id, other])
    assert [run.state for run in runs_of(database, got.job.id)] == [end, JobState.RUNNING]
    assert job_of(database, got.job.id).n_done == 1


def test_writes_under_one_lease_change_no_run_of_another_job(database):
    _, (foreign,) = submit_and_claim(database)
    got, (own,) = submit_and_claim(database)
    with database.write_session() as session:
        writer = RunWriter(session, got.lease)
        writer.start_runs([foreign, own])
        assert [run.id for run in writer.list_pending()] == [own]
        assert [run.id for run in writer.list_unfinished([0])] == [own]
        writer.save_checkpoints([(own, 10, b"own")])
    with database.read_session() as session:
        runs = RunRepository(session)
        assert (runs.get(foreign).state, runs.get(foreign).attempt) == (JobState.QUEUED, 0)
        assert runs.get(own).state is JobState.RUNNING


def test_checkpoints_are_read_for_one_job(database):
    (first, (a,)), (second, (b,)) = submit_and_claim(database), submit_and_claim(database)
    for got, run in ((first, a), (second, b)):
        with database.write_session() as session:
            RunWriter(session, got.lease).save_checkpoints([(run, 10, run.encode())])
    with database.write_session() as session:
        assert RunWriter(session, first.lease).read_checkpoints() == {a: a.encode()}


def test_a_result_is_stored_whole_with_the_columns_that_lists_use(database):
    got, (run_id,) = submit_and_claim(database)
    assert record_outcomes(database, got.lease, good(run_id)) == (run_id,)
    with database.read_session() as session:
        run = RunRepository(session).get(run_id)
    assert run.result == RESULT
    assert run.estimates == {
        "L": {"value": 0.12, "stderr": 0.01},
        "m": {"value": 1.0, "stderr": None},
    }
    assert (run.state, run.best_rms, run.attempt) == (JobState.SUCCEEDED, 0.01, 1)
    assert run.finished_at is not None


def test_a_result_is_written_exactly_once(database):
    got, (run_id,) = submit_and_claim(database)
    record_outcomes(database, got.lease, good(run_id, 0.01))
    assert record_outcomes(database, got.lease, good(run_id, 0.005)) == ()
    (run,) = runs_of(database, got.job.id)
    assert run.best_rms == 0.01
    job = job_of(database, got.job.id)
    assert (job.n_done, job.best_rms) == (1, 0.01)


def test_a_job_counts_its_finished_and_failed_runs_and_keeps_the_least_rms(database):
    got, ids = submit_and_claim(database, n_runs=4)
    record_outcomes(database, got.lease, good(ids[0], 0.3), good(ids[1], 0.2))
    record_outcomes(
        database, got.lease, RunOutcome(run_id=ids[2], state=JobState.FAILED, error="diverged")
    )
    job = job_of(database, got.job.id)
    assert (job.n_done, job.n_failed, job.best_rms) == (3, 1, 0.2)
    with database.read_session() as session:
        counts = RunRepository(session).count_states(got.job.id)
    assert counts == {
        JobState.QUEUED: 1,
        JobState.RUNNING: 0,
        JobState.SUCCEEDED: 2,
        JobState.FAILED: 1,
        JobState.CANCELLED: 0,
    }


def test_a_run_of_another_job_is_not_written(database):
    _, (foreign,) = submit_and_claim(database)
    got, _ = submit_and_claim(database)
    assert record_outcomes(database, got.lease, good(foreign)) == ()


def test_results_and_history_stand_or_fall_together(database):
    got, ids = submit_and_claim(database, n_runs=2)
    bad = HistoryPoint("run_none", 0, 0, 0, 0, 1.0, "start", [])
    with pytest.raises(Exception, match=r"(?i)foreign key"):
        record_outcomes(database, got.lease, good(ids[0]), history=[bad])
    assert {run.state for run in runs_of(database, got.job.id)} == {JobState.QUEUED}
    assert job_of(database, got.job.id).n_done == 0


def test_history_written_again_after_a_resume_changes_nothing(database):
    got, (run_id,) = submit_and_claim(database)
    points = [
        HistoryPoint(run_id, island, number, 10 * number, 50, 1.0 / (number + 1), "genetic", [1.5])
        for island in range(2)
        for number in range(3)
    ]
    migrants = [MigrantPoint(run_id, 0, 1, 0, 1, 0.5)]
    with database.write_session() as session:
        RunWriter(session, got.lease).append_history(points[:4], migrants)
    record_outcomes(database, got.lease, good(run_id), history=points, migrants=migrants)
    with database.read_session() as session:
        history = RunRepository(session).read_history(run_id)
        log = RunRepository(session).read_migrations(run_id)
    assert [(one.island, one.number) for one in history] == [
        (i, n) for i in (0, 1) for n in range(3)
    ]
    assert history[2].rms == 1.0 / 3
    assert history[2].parameters == [1.5]
    assert [(one.epoch, one.source, one.destination) for one in log] == [(1, 0, 1)]


def test_only_the_last_checkpoint_is_kept_and_a_finished_run_has_none(database):
    got, (a, b) = submit_and_claim(database, n_runs=2)
    with database.write_session() as session:
        RunWriter(session, got.lease).save_checkpoints([(a, 10, b"\x00old"), (b, 10, b"b")])
        RunWriter(session, got.lease).save_checkpoints([(a, 20, b"\x00new")])
        assert RunWriter(session, got.lease).read_checkpoints() == {a: b"\x00new", b: b"b"}
    record_outcomes(database, got.lease, good(b))
    with database.write_session() as session:
        assert RunWriter(session, got.lease).read_checkpoints() == {a: b"\x00new"}


def test_the_next_holder_goes_on_from_the_checkpoint(database):
    got, (run_id,) = submit_and_claim(database)
    with database.write_session() as session:
        RunWriter(session, got.lease).save_checkpoints([(run_id, 10, b"half way")])
        LeaseQueue(session).release_job(got.lease)
    with database.write_session() as session:
        again = LeaseQueue(session).claim_job("d2")
        assert RunWriter(session, again.lease).read_checkpoints() == {run_id: b"half way"}


def test_pages_of_runs_follow_each_other_without_gap_or_repeat(database):
    got, _ = submit_and_claim(database, n_runs=7)
    seen, cursor = [], None
    while True:
        with database.read_session() as session:
            page = RunRepository(session).list_page(got.job.id, limit=3, cursor=cursor)
        seen += [run.number for run in page.items]
        if (cursor := page.next) is None:
            break
    assert seen == list(range(7))


@pytest.mark.parametrize("descending", [False, True])
def test_pages_sorted_by_a_column_have_every_run_once_and_those_without_a_value_last(
    database, descending
):
    got, ids = submit_and_claim(database, n_runs=7)
    values = [0.3, 0.1, 0.3, None, 0.2, None, 0.3]
    record_outcomes(
        database, got.lease, *(good(i, rms) for i, rms in zip(ids, values, strict=True))
    )
    seen, cursor = [], None
    while True:
        with database.read_session() as session:
            page = RunRepository(session).list_page(
                got.job.id, limit=2, cursor=cursor, order="best_rms", descending=descending
            )
        seen += [run.number for run in page.items]
        if (cursor := page.next) is None:
            break
    assert seen == ([0, 2, 6, 4, 1, 3, 5] if descending else [1, 4, 0, 2, 6, 3, 5])


def test_a_cursor_from_elsewhere_is_refused(sqlite_database):
    got, _ = submit_and_claim(sqlite_database)
    for cursor in ("", "x", "[1]", "[1,2,3]", '["a",1]', "null", '[1,"b"]', "{}"):
        with pytest.raises(InvalidCursor, match="not a cursor"):
            read_numbers(sqlite_database, got.job.id, cursor=cursor)


AXES = [0, 0.1, 1, True, False, None, "0.1", "improved", ["a"], ["a", "b"], {"k": 1}, "true"]


@pytest.mark.parametrize("place", range(len(AXES)), ids=[repr(value) for value in AXES])
def test_runs_are_found_by_the_exact_value_of_an_axis(database, place):
    got = sweep(database, [{"/noise/sigma": value, "/seed": 3} for value in AXES])
    assert read_numbers(database, got.job.id, cell={"/noise/sigma": AXES[place]}) == [place]


def test_whole_and_broken_numbers_of_an_axis_are_the_same(database):
    got = sweep(database, [{"/noise/sigma": 0}, {"/noise/sigma": 0.0}, {"/noise/sigma": 2.0}])
    assert read_numbers(database, got.job.id, cell={"/noise/sigma": 0.0}) == [0, 1]
    assert read_numbers(database, got.job.id, cell={"/noise/sigma": 2}) == [2]


def test_filters_hold_together(database):
    cells = [{"/seed": seed, "/x": x} for seed in range(2) for x in ("a", 'b"\\')]
    got = sweep(database, cells)
    assert read_numbers(database, got.job.id, cell={"/seed": 1, "/x": 'b"\\'}) == [3]
    assert read_numbers(database, got.job.id, labels={"length_m": 0}) == [0, 2]
    assert read_numbers(database, got.job.id, cell={"/none": 1}) == []
    assert read_numbers(database, got.job.id, states=[JobState.SUCCEEDED]) == []


def test_another_projects_runs_are_not_seen(database):
    got, (run_id,) = submit_and_claim(database)
    with database.read_session() as session:
        foreign = RunRepository(session, "proj_other")
        assert foreign.list_page(got.job.id).items == ()
        for read in (foreign.get, foreign.read_history, foreign.read_migrations):
            with pytest.raises(RowNotFound, match="no run"):
                read(run_id)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "a\x00b", "\ud800"])
def test_a_document_that_not_every_database_can_keep_is_refused(database, value):
    got, (run_id,) = submit_and_claim(database)
    bad = RunOutcome(
        run_id=run_id, state=JobState.SUCCEEDED, result={"parameters": [], "note": [value]}
    )
    with pytest.raises(UnstorableValue):
        record_outcomes(database, got.lease, bad)


def test_text_that_only_looks_like_an_escape_is_kept(database):
    got, (run_id,) = submit_and_claim(database)
    text = "\\u0000 and \\\\u0000 and \N{GREEK SMALL LETTER SIGMA}\N{PILE OF POO}"
    record_outcomes(
        database,
        got.lease,
        RunOutcome(
            run_id=run_id,
            state=JobState.FAILED,
            result={"parameters": [], "note": text},
            error=text,
        ),
    )
    (run,) = runs_of(database, got.job.id)
    assert run.result == {"parameters": [], "note": text}
    assert run.error == text


def test_a_job_succeeds_although_runs_of_another_one_wait(database):
    submit_and_claim(database, n_runs=2)
    got, (run_id,) = submit_and_claim(database)
    record_outcomes(database, got.lease, good(run_id))
    with database.write_session() as session:
        LeaseQueue(session).finish_job(got.lease, JobState.SUCCEEDED)
    assert job_of(database, got.job.id).state is JobState.SUCCEEDED
