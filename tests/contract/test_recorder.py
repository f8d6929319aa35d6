"""What a dispatcher writes about the runs of a job, and when; the stopwatch is the test's."""

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from prometheus_client import REGISTRY

from service.core.states import JobState
from service.dispatch import fitted_signals, recorder
from service.dispatch.checkpoints import unpack_state
from service.dispatch.encoding import ResultEncoder
from service.dispatch.recorder import (
    CHECKPOINT_SECONDS,
    MAX_REASONS,
    PROGRESS_SECONDS,
    RESULTS_SECONDS,
    RunRecorder,
)
from service.queue.leases import LeaseOwners, LeaseQueue
from service.queue.packed_results import LAYOUTS, Dialect, PackedResults, pack_rows
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.event_rows import EventRepository
from service.repositories.job_rows import JobRepository
from service.repositories.run_rows import RunRepository
from service.storage.objects import StoredObject
from service.storage.sessions import Database
from service.storage.storage_errors import LeaseLost, ObjectStoreFailed
from service.storage.tables import Checkpoint
from sysid.islands.run_state import RunState
from sysid.search.archive import make_archive
from sysid.search.island import Island
from sysid.search.state import SEARCH_RECORD, Improvement, Migrant
from tests.support.cluster.dispatch_place import Place
from tests.support.cluster.small_runs import encode_runs, spec
from tests.support.library.search_problems import bits
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.run_results import conclude, encode_results
from workers.protocol import CompleteRun, RunConclusion, RunFailure

N_RUNS, GENERATIONS = 4, 100


class Stopwatch:
    """Elapsed seconds that only tests move."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Desk:
    """A job of four runs that a dispatcher holds, and the recorder of its runs."""

    def __init__(self, place: Place) -> None:
        self.place, self.stopwatch, self.run_beside = place, Stopwatch(), None
        self.ended: list[tuple[str, Mapping[str, float] | None]] = []
        self.states_told: dict[str, RunState] = {}
        axes = [{"path": "/seed", "range": [0, N_RUNS]}]
        self.job = place.submit(sweep={"axes": axes}, algorithm={"generations": GENERATIONS})
        self.runs = [run.id for run in place.runs(self.job)]
        self.recorder = self.claim()

    def claim(self, n_runs: int = N_RUNS) -> RunRecorder:
        with self.place.database.write_session() as session:
            claim = LeaseQueue(session).claim_job("d1", choose_size=lambda job: n_runs)
        assert claim is not None
        assert claim.job.id == self.job
        return RunRecorder(
            self.place.database,
            claim,
            self.place.store,
            encode_runs,
            lambda run, estimates: self.ended.append((run, estimates)),
            run_beside=self.run_beside,
            stopwatch=self.stopwatch,
        )

    def tell_progress(self, run: str, state: RunState, seconds: float) -> None:
        """Tell the recorder of a state, from which the run goes on."""
        self.states_told[run] = state
        self.recorder.record_progress(run, state, seconds)

    def tell_result(self, run: str, state: RunState) -> None:
        """Tell the recorder of a run that ended in this state, by itself in a pack."""
        results, told = {run: conclude_run(state)}, {run: self.states_told.get(run)}
        reported = {name: one for name, one in told.items() if one is not None}
        self.recorder.record_results(encode_results(results, self.place.database, reported))

    def claim_again(self, n_runs: int = N_RUNS) -> RunRecorder:
        """Give the job back and claim it, or its first runs, under the next attempt."""
        with self.place.database.write_session() as session:
            LeaseQueue(session).release_job(self.recorder.lease)
        return self.claim(n_runs)

    def write_after(self, seconds: float) -> None:
        """Let time pass, then write what is due."""
        self.stopwatch.now += seconds
        self.recorder.write_due()

    def checkpoints(self) -> dict[str, int]:
        """Evaluations in the checkpoint of each run that has one."""
        with self.place.database.read_session() as session:
            return {row.run_id: row.evaluations for row in session.query(Checkpoint)}

    def states(self) -> list[JobState]:
        return [run.state for run in self.place.runs(self.job)]

    def messages(self) -> list[str]:
        with self.place.database.read_session() as session:
            events = EventRepository(session).list_after(self.job)
        return [event.data["message"] for event in events if event.kind == "log"]


@pytest.fixture
def desk(tmp_path: Path, database: Database) -> Desk:
    return Desk(Place(tmp_path / "data", database))


def make_run_state(
    generation: int, evaluations: int, *rms: float, migrants: tuple[Migrant, ...] = ()
) -> RunState:
    """A run that found these RMS one after the other, with one island."""
    search = np.zeros((), SEARCH_RECORD)
    search["generation"], search["evaluations"] = generation, evaluations
    history = tuple(
        Improvement(number, 10 * number, value, "genetic", (float(number),))
        for number, value in enumerate(rms)
    )
    nothing = np.zeros((0, 1), np.uint32), np.zeros(0)
    island = Island(0, 1, *nothing, search, np.zeros(1), make_archive(1), history)
    return RunState(1, (island,), generation, migrations=migrants)


def conclude_run(state: RunState) -> RunConclusion:
    """The result of a run that ended in this state."""
    return conclude(
        state.rms,
        evaluations=state.evaluations,
        generations=state.generation,
        history=state.history,
        migrations=state.migrations,
    )


def test_progress_is_written_every_second_and_checkpoints_every_four(desk: Desk) -> None:
    run = desk.runs[0]
    desk.tell_progress(run, make_run_state(10, 100, 0.5), 1.0)
    desk.recorder.write_due()
    assert desk.checkpoints() == {run: 100}
    assert desk.place.job(desk.job).evaluations == 100
    desk.tell_progress(run, make_run_state(20, 200, 0.5), 2.0)
    desk.write_after(PROGRESS_SECONDS - 0.1)
    assert desk.place.job(desk.job).evaluations == 100
    desk.write_after(0.2)
    assert desk.place.job(desk.job).evaluations == 200
    assert desk.checkpoints() == {run: 100}
    desk.write_after(CHECKPOINT_SECONDS - PROGRESS_SECONDS - 0.2)
    assert desk.checkpoints() == {run: 100}
    desk.write_after(0.2)
    assert desk.checkpoints() == {run: 200}
    with desk.place.database.read_session() as session:
        stored = unpack_state(session.query(Checkpoint).one().state)
    assert bits(stored) == bits(make_run_state(20, 200, 0.5))


def test_a_run_that_did_not_go_on_is_not_saved_again(desk: Desk) -> None:
    def read_save_times() -> list[object]:
        with desk.place.database.read_session() as session:
            return [session.get_one(Checkpoint, run).created_at for run in desk.runs[:2]]

    for run in desk.runs[:2]:
        desk.tell_progress(run, make_run_state(10, 100, 0.5), 1.0)
    desk.recorder.write_due()
    before = read_save_times()
    desk.tell_progress(desk.runs[0], make_run_state(20, 200, 0.5), 2.0)
    desk.write_after(CHECKPOINT_SECONDS + 0.1)
    assert [old == new for old, new in zip(before, read_save_times(), strict=True)] == [False, True]


def test_starts_are_collected_for_a_second_and_deaths_are_written_at_once(desk: Desk) -> None:
    first, second = desk.runs[:2]
    desk.recorder.record_start(first)
    desk.recorder.write_due()
    desk.recorder.record_start(second)
    desk.write_after(RESULTS_SECONDS - 0.1)
    assert desk.states()[:2] == [JobState.RUNNING, JobState.QUEUED]
    desk.write_after(0.2)
    assert desk.states()[:2] == [JobState.RUNNING, JobState.RUNNING]
    desk.recorder.record_worker_death(second, 1)
    desk.write_after(0.01)
    assert [run.kills for run in desk.place.runs(desk.job)] == [0, 1, 0, 0]


class HeldDesk:
    """A thread whose work waits until it is let go."""

    def __init__(self) -> None:
        self.gate, self.pool = threading.Event(), ThreadPoolExecutor(1)

    def __call__(self, work: Callable[[], Any]) -> Future[Any]:
        return self.pool.submit(lambda: (self.gate.wait(LIMIT_SECONDS), work()))

    def let_go(self) -> None:
        self.gate.set()
        self.pool.shutdown()


def test_a_death_is_written_at_once_also_while_a_batch_is_being_written(desk: Desk) -> None:
    desk.run_beside = held = HeldDesk()
    desk.recorder = desk.claim_again()
    desk.recorder.record_start(desk.runs[0])
    desk.recorder.write_due()
    desk.recorder.record_worker_death(desk.runs[1], 1)
    threading.Timer(0.2, held.gate.set).start()
    desk.recorder.write_due()
    held.let_go()
    assert [run.kills for run in desk.place.runs(desk.job)] == [0, 1, 0, 0]


def test_the_end_of_a_parcel_is_written_beside_what_goes_on(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "FEW_ENDED", 0)
    desk.run_beside = held = HeldDesk()
    desk.recorder = desk.claim_again()
    for run in desk.runs:
        desk.tell_result(run, make_run_state(5, 50, 0.5))
    desk.recorder.end_parcel()
    desk.recorder.write_due()
    assert desk.recorder.has_ended is None
    assert desk.place.job(desk.job).n_done == 0
    held.let_go()
    desk.recorder.wait_for_end()
    assert desk.recorder.has_ended is False  # the last parcel of its job stays
    assert desk.place.job(desk.job).n_done == N_RUNS
    desk.recorder.finish_job()
    assert desk.place.job(desk.job).state is JobState.SUCCEEDED


def test_a_recorder_writes_nothing_after_its_parcel(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "MAX_STARTED", 0)  # starts are left for later
    first, *_ = desk.runs
    desk.recorder = desk.claim_again(1)
    desk.recorder.record_start(first)
    desk.recorder.record_failure(first, RunFailure("as told"))
    desk.recorder.end_parcel()
    assert desk.recorder.has_ended
    desk.write_after(RESULTS_SECONDS + 0.1)
    assert desk.states() == [JobState.FAILED] + [JobState.QUEUED] * (N_RUNS - 1)


def test_nothing_is_written_while_nothing_happens(desk: Desk) -> None:
    desk.tell_progress(desk.runs[0], make_run_state(10, 100, 0.5), 1.0)
    desk.recorder.write_due()
    with desk.place.database.read_session() as session:
        before = EventRepository(session).list_after(desk.job)[-1].id
    desk.write_after(PROGRESS_SECONDS + 0.1)
    with desk.place.database.read_session() as session:
        assert EventRepository(session).list_after(desk.job)[-1].id == before


def test_each_evaluation_counts_once_whatever_becomes_of_its_run(desk: Desk) -> None:
    done, fails, goes_on, refused = desk.runs
    for run in (done, fails, goes_on):
        desk.tell_progress(run, make_run_state(10, 100, 0.5), 1.0)
    desk.recorder.write_due()
    desk.tell_result(done, make_run_state(30, 310, 0.5, 0.2))
    desk.recorder.record_failure(fails, RunFailure("as told"))
    desk.recorder.record_failure(refused, RunFailure("late", evaluations=40))
    desk.recorder.write_all()
    job = desk.place.job(desk.job)
    assert (job.evaluations, job.generation, job.best_rms) == (310 + 100 + 40 + 100, 30, 0.2)
    assert (job.n_done, job.n_failed) == (3, 2)
    assert desk.checkpoints() == {goes_on: 100}
    runs = {run.id: run for run in desk.place.runs(desk.job)}
    assert [runs[run].evaluations for run in desk.runs] == [310, 100, 0, 40]
    assert desk.ended == [(fails, None), (refused, None)]


def read_counters() -> dict[str, float]:
    """The numbers of runs and evaluations that this process shows to Prometheus."""
    read, name = REGISTRY.get_sample_value, "lagid_runs_total"
    counted = {one: read(name, {"outcome": one}) for one in ("succeeded", "failed", "reused")}
    counted["evaluations"] = read("lagid_evaluations_total")
    assert None not in counted.values()
    return {name: float(value or 0) for name, value in counted.items()}


def test_the_metrics_count_each_run_and_each_evaluation_of_this_attempt_once(desk: Desk) -> None:
    first, second, third, fourth = desk.runs
    desk.tell_progress(first, make_run_state(10, 100, 0.5), 1.0)
    desk.recorder.write_all()
    before = read_counters()
    desk.recorder = desk.claim_again()  # of the first run, 100 evaluations belong to the past
    desk.tell_progress(first, make_run_state(20, 170, 0.5), 1.0)
    desk.tell_progress(first, make_run_state(30, 250, 0.4), 1.0)
    desk.tell_result(first, make_run_state(40, 300, 0.3))
    desk.tell_result(second, make_run_state(40, 1000, 0.3))
    desk.tell_progress(third, make_run_state(5, 7, 0.5), 1.0)
    desk.recorder.record_failure(third, RunFailure("no way", evaluations=9))
    desk.recorder.record_reuse(fourth, second)
    counted = {name: value - before[name] for name, value in read_counters().items()}
    assert counted == {"succeeded": 2, "failed": 1, "reused": 1, "evaluations": 200 + 1000 + 9}


def test_a_run_that_begins_and_ends_between_two_writes_has_both_times(desk: Desk) -> None:
    run = desk.runs[0]
    desk.recorder.record_start(run)
    desk.tell_result(run, make_run_state(5, 50, 0.5))
    desk.recorder.write_due()
    row = desk.place.runs(desk.job)[0]
    assert row.state is JobState.SUCCEEDED
    assert row.started_at is not None
    assert row.finished_at is not None


def test_history_is_whole_whatever_was_written_before_the_end(desk: Desk) -> None:
    first, second = desk.runs[:2]
    migrants = tuple(Migrant(epoch, 0, 1, 0.5) for epoch in range(3))
    for run in (first, second):
        desk.tell_progress(run, make_run_state(10, 100, 0.9, 0.8, migrants=migrants[:1]), 1.0)
    desk.recorder.write_due()
    desk.tell_progress(first, make_run_state(20, 200, 0.9, 0.8, 0.7, migrants=migrants[:2]), 2.0)
    desk.write_after(PROGRESS_SECONDS + 0.1)
    end = make_run_state(30, 300, 0.9, 0.8, 0.7, 0.6, migrants=migrants)
    for run in (first, second):
        desk.tell_result(run, end)
    desk.write_after(PROGRESS_SECONDS + 0.1)
    with desk.place.database.read_session() as session:
        for run in (first, second):
            history = RunRepository(session).read_history(run)
            assert [(point.number, point.rms) for point in history] == [
                (0, 0.9),
                (1, 0.8),
                (2, 0.7),
                (3, 0.6),
            ]
            log = RunRepository(session).read_migrations(run)
            assert [(one.number, one.epoch) for one in log] == [(0, 0), (1, 1), (2, 2)]


def test_points_that_were_told_but_not_written_before_the_end_are_not_lost(desk: Desk) -> None:
    run = desk.runs[0]
    migrants = tuple(Migrant(epoch, 0, 1, 0.5) for epoch in range(2))
    desk.recorder.write_all()
    desk.tell_progress(run, make_run_state(10, 100, 0.9, 0.8, migrants=migrants[:1]), 1.0)
    desk.tell_result(run, make_run_state(30, 300, 0.9, 0.8, 0.7, migrants=migrants))
    desk.recorder.write_all()
    with desk.place.database.read_session() as session:
        history = RunRepository(session).read_history(run)
        log = RunRepository(session).read_migrations(run)
    assert [point.rms for point in history] == [0.9, 0.8, 0.7]
    assert [one.epoch for one in log] == [0, 1]


def end_all(desk: Desk, n_failed: int) -> None:
    for number, run in enumerate(desk.runs):
        if number < n_failed:
            desk.recorder.record_failure(run, RunFailure(f"reason {number}"))
        else:
            desk.tell_result(run, make_run_state(5, 50, 0.5))
    desk.recorder.finish_job()


@pytest.mark.parametrize(
    ("n_failed", "state", "error"),
    [
        (0, JobState.SUCCEEDED, None),
        (1, JobState.INCOMPLETE, "1 of 4 runs failed: reason 0"),
        (4, JobState.FAILED, "4 of 4 runs failed: reason 0; reason 1; reason 2"),
    ],
)
def test_a_job_fails_when_all_its_runs_failed_and_tells_some_reasons(
    desk: Desk, n_failed: int, state: JobState, error: str | None
) -> None:
    end_all(desk, n_failed)
    job = desk.place.job(desk.job)
    assert (job.state, job.error, job.n_failed) == (state, error, n_failed)
    assert len(desk.messages()) == min(n_failed, MAX_REASONS)


def test_a_job_that_stops_or_is_cancelled_goes_on_from_its_last_states(desk: Desk) -> None:
    run = desk.runs[0]
    desk.tell_progress(run, make_run_state(10, 100, 0.5), 1.0)
    desk.recorder.write_due()
    desk.tell_progress(run, make_run_state(20, 200, 0.5), 1.5)
    desk.recorder.write_all()
    assert desk.checkpoints() == {run: 200}
    desk.recorder = desk.claim_again()
    desk.tell_progress(run, make_run_state(30, 300, 0.5), 2.0)
    desk.recorder.cancel_parcel()
    assert desk.place.job(desk.job).state is JobState.CANCELLED
    assert desk.place.job(desk.job).evaluations == 300  # those of its checkpoint are among them
    with desk.place.database.write_session() as session:
        JobRepository(session).resume(desk.job)
    desk.recorder = desk.claim()
    assert desk.checkpoints() == {run: 300}
    desk.recorder.write_all()
    assert desk.place.job(desk.job).evaluations == 300


def test_a_checkpoint_counts_until_its_run_goes_on_or_ends(desk: Desk) -> None:
    fails, ends, waits, _ = desk.runs
    for run in (fails, ends, waits):
        desk.tell_progress(run, make_run_state(10, 100, 0.5), 1.0)
    desk.recorder.write_all()
    desk.recorder = desk.claim_again()
    desk.recorder.write_all()
    assert desk.place.job(desk.job).evaluations == 300
    desk.recorder.record_failure(fails, RunFailure("as told"))
    desk.tell_result(ends, make_run_state(30, 310, 0.5))
    desk.recorder.write_all()
    assert desk.place.job(desk.job).evaluations == 100 + 310 + 100
    assert [run.evaluations for run in desk.place.runs(desk.job)[:2]] == [100, 310]
    assert desk.checkpoints() == {waits: 100}


def add_computed_run(desk: Desk, evaluations: int) -> str:
    """A run of another job that has succeeded with so many evaluations."""
    job = desk.place.submit()
    with desk.place.database.write_session() as session:
        claim = LeaseQueue(session).claim_job("other")
        assert claim is not None
        assert claim.job.id == job
        writer = RunWriter(session, claim.lease)
        (run,) = writer.list_pending()
        result = {"parameters": []}
        writer.record_outcomes(
            [
                RunOutcome(
                    run_id=run.id,
                    state=JobState.SUCCEEDED,
                    result=result,
                    best_rms=0.1,
                    evaluations=evaluations,
                    generations=70,
                )
            ]
        )
    return run.id


def test_a_result_that_is_taken_over_counts_once(desk: Desk) -> None:
    source = add_computed_run(desk, 1000)
    desk.recorder.record_reuse(desk.runs[0], source)
    desk.recorder.write_due()
    for number, run in enumerate(desk.runs[1:]):
        desk.tell_result(run, make_run_state(5, 50, 0.5))
        desk.write_after(PROGRESS_SECONDS + 0.1)
        assert desk.place.job(desk.job).evaluations == 1000 + 50 * (number + 1)
    desk.recorder.finish_job()
    job = desk.place.job(desk.job)
    assert (job.evaluations, job.generation, job.best_rms) == (1150, 70, 0.1)
    assert (job.n_reused, job.n_done) == (1, 4)
    assert desk.messages() == ["1 of 4 runs were taken over from earlier runs"]


def test_what_is_left_is_told_from_what_was_computed_in_this_attempt(desk: Desk) -> None:
    first, second, third, _ = desk.runs
    source = add_computed_run(desk, 1000)
    desk.tell_progress(first, make_run_state(50, 100, 0.5), 1.0)
    desk.recorder.write_all()
    desk.recorder = desk.claim_again()
    desk.tell_progress(first, make_run_state(60, 120, 0.5), 1.0)
    desk.tell_progress(second, make_run_state(10, 20, 0.5), 1.0)
    desk.stopwatch.now += 10.0
    desk.recorder.write_all()
    # 10 generations in 10 s: those of the second run, as the first one went on at 60.
    assert desk.place.job(desk.job).seconds_left == pytest.approx(400 - 60 - 10)
    desk.recorder.record_reuse(third, source)
    desk.recorder.write_all()
    assert desk.place.job(desk.job).seconds_left == pytest.approx(300 - 60 - 10)
    desk.tell_result(second, make_run_state(100, 200, 0.5))
    desk.recorder.write_all()
    assert desk.place.job(desk.job).seconds_left == pytest.approx(10 * (200 - 60) / 100)


def pack_signals(desk: Desk, runs: list[str], signals: bytes) -> PackedResults:
    """Results of runs whose signals are one object, in parts of two bytes."""
    complete = [
        CompleteRun(run, spec(), conclude_run(make_run_state(5, 50, 0.5)), 1.0) for run in runs
    ]
    plain = ResultEncoder("sqlite", keeps_signals=False)(complete, {})
    name = sha256(signals).hexdigest()
    tables = [list(rows) for rows in plain.rows]
    tables[0] = [(*row[:-3], name, 2 * i, 2) for i, row in enumerate(tables[0])]
    dialect: Dialect = "sqlite" if desk.place.database.is_sqlite else "postgresql"
    rows = tuple(
        pack_rows(rows, layout, dialect) for rows, layout in zip(tables, LAYOUTS, strict=True)
    )
    return replace(plain, rows=rows, signals=signals, signals_sha256=name)


def test_signals_that_the_store_refuses_cost_no_result_and_are_told(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    put, first = desk.place.store.put_stream, desk.runs[:2]

    def refuse_first(blocks: list[bytes]) -> StoredObject:
        if blocks == [b"aabb"]:
            raise ObjectStoreFailed("the disk is full")
        return put(blocks)

    monkeypatch.setattr(fitted_signals, "RETRY_SECONDS", -1.0)
    monkeypatch.setattr(desk.place.store, "put_stream", refuse_first)
    desk.recorder.record_results(pack_signals(desk, first, b"aabb"))
    desk.recorder.record_results(pack_signals(desk, desk.runs[2:], b"ccdd"))
    desk.recorder.finish_job()
    rows = desk.place.runs(desk.job)
    assert {row.state for row in rows} == {JobState.SUCCEEDED}
    stored = sha256(b"ccdd").hexdigest()
    assert [(row.signals_sha256, row.signals_start, row.signals_size) for row in rows] == [
        (None, None, None),
        (None, None, None),
        (stored, 0, 2),
        (stored, 2, 2),
    ]
    assert desk.place.store.get_bytes(stored) == b"ccdd"
    assert desk.messages() == [
        f"the signals of {desk.runs[0]} and 1 others are not stored: the disk is full"
    ]


def test_a_run_that_has_ended_already_keeps_its_result_and_counts_once(desk: Desk) -> None:
    first, second = desk.runs[:2]
    desk.tell_result(first, make_run_state(5, 50, 0.5))
    desk.recorder.write_all()
    results = {run: conclude_run(make_run_state(9, 90, 0.7)) for run in (first, second)}
    desk.recorder.record_results(encode_results(results, desk.place.database))
    desk.recorder.write_all()
    rows = desk.place.runs(desk.job)[:2]
    assert [(row.best_rms, row.evaluations) for row in rows] == [(0.5, 50), (0.7, 90)]
    assert [row.estimates for row in rows] == [{}, {}]
    assert desk.place.job(desk.job).n_done == 2
    with desk.place.database.read_session() as session:
        points = [RunRepository(session).read_history(row.id) for row in rows]
    assert [len(one) for one in points] == [1, 1]


@pytest.mark.parametrize("is_refused", [False, True])
def test_many_results_are_written_in_several_transactions_each_once(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, is_refused: bool
) -> None:
    monkeypatch.setattr(recorder, "MAX_ENDED", 2)
    written: list[int] = []
    record_results = RunWriter.record_results

    def record(writer: RunWriter, packs: list[PackedResults], lost: set[str]) -> None:
        if is_refused and len(written) == 1 and written[0] >= 0:
            written[0] = -written[0]
            raise ConnectionError("as told")
        record_results(writer, packs, lost)
        written.append(len(packs))

    monkeypatch.setattr(RunWriter, "record_results", record)
    for run in desk.runs:
        desk.tell_result(run, make_run_state(5, 50, 0.5))
    if is_refused:
        with pytest.raises(ConnectionError):
            desk.recorder.finish_job()
    desk.recorder.finish_job()
    assert [abs(count) for count in written] == [2, 2]
    assert desk.states() == [JobState.SUCCEEDED] * 4
    assert (desk.place.job(desk.job).n_done, desk.place.job(desk.job).evaluations) == (4, 200)


def test_of_many_runs_that_begin_the_first_are_marked_and_the_others_later(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "MAX_STARTED", 1)
    _, second, third, _ = desk.runs
    for run in desk.runs:
        desk.recorder.record_start(run)
    desk.tell_result(second, make_run_state(5, 50, 0.5))
    expected = [JobState.RUNNING, JobState.SUCCEEDED, JobState.QUEUED, JobState.QUEUED]
    desk.recorder.write_due()
    assert desk.states() == expected
    desk.tell_result(third, make_run_state(5, 50, 0.5))
    desk.write_after(RESULTS_SECONDS + 0.1)
    assert desk.states()[2:] == [JobState.SUCCEEDED, JobState.RUNNING]


def test_results_of_another_jobs_runs_change_nothing(desk: Desk) -> None:
    other = desk.place.runs(desk.place.submit())[0].id
    desk.tell_result(other, make_run_state(5, 50, 0.5))
    desk.recorder.write_all()
    assert desk.place.job(desk.job).n_done == 0
    with desk.place.database.read_session() as session:
        assert RunRepository(session).get(other).state is JobState.QUEUED


def test_under_a_lost_lease_nothing_is_written_and_the_recorder_learns_it(desk: Desk) -> None:
    with desk.place.database.write_session() as session:
        LeaseQueue(session).reap_expired(LeaseOwners(ended=frozenset({"d1"})))
    desk.recorder.record_start(desk.runs[0])
    with pytest.raises(LeaseLost):
        desk.recorder.write_due()
    desk.tell_result(desk.runs[0], make_run_state(5, 50, 0.5))
    desk.tell_progress(desk.runs[1], make_run_state(5, 50, 0.5), 0.2)
    for write in (
        desk.recorder.write_due,
        desk.recorder.cancel_parcel,
        desk.recorder.end_parcel,
        desk.recorder.wait_for_end,
        desk.recorder.finish_job,
    ):
        with pytest.raises(LeaseLost):
            write()
    assert desk.states() == [JobState.QUEUED] * 4
    assert desk.checkpoints() == {}
    assert desk.place.job(desk.job).n_done == 0
