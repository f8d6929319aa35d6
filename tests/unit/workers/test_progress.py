"""Results come back as bytes of a pack: each once, and a run that cannot be encoded fails alone."""

import pickle
from collections.abc import Iterator, Mapping, Sequence

import pytest

from tests.support.cluster.small_runs import RECORDS, Notebook, encode_runs, spec
from tests.unit.workers.test_scheduler import ScriptedExecutor, jobs
from workers.packing import PACK_SECONDS
from workers.protocol import (
    AdvanceRun,
    CompleteRun,
    ItemResult,
    Records,
    RunConclusion,
    RunEnd,
    RunFailure,
    RunProgress,
    WorkItem,
)
from workers.scheduler import Scheduler
from workers.tasks import encode_pack, process_pack

pytestmark = pytest.mark.usefixtures("time_to_read")


@pytest.fixture(scope="module")
def concluded_run() -> RunConclusion:
    item = AdvanceRun("any", spec(generations=2, refine=False), None, 60.0)
    (done,) = process_pack((item,), ("short",), RECORDS["short"])
    assert isinstance(done.outcome, RunConclusion)
    return done.outcome


@pytest.fixture(scope="module")
def advanced_run() -> RunProgress:
    (done,) = process_pack((AdvanceRun("any", spec(), None, 0.0),), ("short",), RECORDS["short"])
    assert isinstance(done.outcome, RunProgress)
    return done.outcome


def list_recorded(notebook: Notebook) -> list[str]:
    return [run for run, results in notebook.results.items() for _ in results]


def make_steps(feeder: Scheduler[str], most: int = 1000) -> Iterator[tuple[str, ...]]:
    for _ in range(most):
        if not feeder._jobs:
            return
        yield feeder.run_step(0.0)
    raise AssertionError("the jobs did not end")


def test_every_result_is_told_once_before_the_job_ends(concluded_run: RunConclusion) -> None:
    feeder = Scheduler(ScriptedExecutor(lambda item: ItemResult(item.run, concluded_run, 0.01)))
    notebook = jobs(feeder, a=60)["a"]
    for ended in make_steps(feeder):
        assert bool(ended) == (len(list_recorded(notebook)) == 60)
    assert sorted(list_recorded(notebook)) == sorted(f"a{number}" for number in range(60))


def test_a_slice_of_a_single_run_goes_on_while_results_of_a_sweep_are_told(
    concluded_run: RunConclusion, advanced_run: RunProgress
) -> None:
    slices = 0

    def answer(item: WorkItem) -> ItemResult:
        nonlocal slices
        if not item.run.startswith("single"):
            return ItemResult(item.run, concluded_run, 0.01)
        slices += 1
        outcome = concluded_run if slices == 8 else advanced_run
        return ItemResult(item.run, outcome, PACK_SECONDS)

    feeder = Scheduler(ScriptedExecutor(answer))
    notebook = jobs(feeder, sweep=400)["sweep"]
    while len(notebook.begun) < 100:  # by then its packs have many runs each
        feeder.run_step(0.0)
    single = jobs(feeder, single=1)["single"]
    before = len(list_recorded(notebook))
    for _ in range(8 + 2):  # a slice a step, and a step for its way in and out
        feeder.run_step(0.0)
    assert list_recorded(single) == ["single0"]
    assert len(list_recorded(notebook)) > before


def test_a_job_that_is_stopped_alone_still_tells_what_has_come_back(
    concluded_run: RunConclusion,
) -> None:
    executor = ScriptedExecutor(lambda item: ItemResult(item.run, concluded_run, 0.01))
    feeder = Scheduler(executor)
    notebook = jobs(feeder, a=400)["a"]
    for _ in range(20):
        feeder.run_step(0.0)
    come = len(notebook.begun) - sum(len(pack) for pack in executor.packs.values())
    feeder.stop_jobs(["a"])
    for _ in make_steps(feeder):
        pass
    assert len(list_recorded(notebook)) == come


def test_a_run_that_cannot_be_encoded_fails_and_no_other(concluded_run: RunConclusion) -> None:
    def encode(complete: Sequence[CompleteRun], records: Mapping[str, Records]) -> bytes:
        if any(run.run == "bad" for run in complete):
            raise ValueError("as told")
        return encode_runs(complete, records)

    items = [AdvanceRun(run, spec(), None, 1.0, spent=2.0) for run in ("a", "bad", "b")]
    results = [ItemResult(item.run, concluded_run, 0.5) for item in items]
    pack = encode_pack(encode, items, results, {})
    assert [type(one.outcome) for one in pack.results] == [RunEnd, RunFailure, RunEnd]
    failure = pack.results[1].outcome
    assert isinstance(failure, RunFailure)
    assert failure.reason == "internal error: its result cannot be stored: ValueError: as told"
    assert failure.evaluations == concluded_run.identification.evaluations
    assert pack.encoded is not None
    assert [run for run, _ in pickle.loads(pack.encoded)] == ["a", "b"]
    alone = encode_pack(encode, items[1:2], results[1:2], {})
    assert (len(alone.results), alone.encoded) == (1, None)


def test_an_encoder_is_told_the_whole_time_of_a_run_and_what_was_reported(
    concluded_run: RunConclusion, advanced_run: RunProgress
) -> None:
    seen: list[CompleteRun] = []

    def encode(complete: Sequence[CompleteRun], records: Mapping[str, Records]) -> bytes:
        seen.extend(complete)
        return b""

    state = advanced_run.state
    items = [
        AdvanceRun("new", spec(), None, 1.0),
        AdvanceRun("saved", spec(), state, 1.0, spent=0.0),
        AdvanceRun("sliced", spec(), state, 1.0, spent=2.0, is_reported=True),
    ]
    encode_pack(encode, items, [ItemResult(item.run, concluded_run, 0.5) for item in items], {})
    assert [(run.run, run.seconds, run.reported) for run in seen] == [
        ("new", 0.5, None),
        ("saved", 0.5, None),
        ("sliced", 2.5, state),
    ]
