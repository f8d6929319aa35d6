"""Telling of results takes time: it holds up no other job's slices, and no result is forgotten."""

from collections.abc import Iterator

import pytest

from tests.runs import RECORDS, Notebook, spec
from tests.unit.workers.test_scheduler import ScriptedExecutor, jobs
from workers import scheduler
from workers.packing import PACK_SECONDS, PACKS_PER_CPU
from workers.protocol import AdvanceRun, ItemResult, RunConclusion, RunProgress, WorkItem
from workers.scheduler import Scheduler
from workers.tasks import process_pack

pytestmark = pytest.mark.usefixtures("time_to_read")


@pytest.fixture(scope="module")
def concluded() -> RunConclusion:
    item = AdvanceRun("any", spec(generations=2, refine=False), None, 60.0)
    (done,) = process_pack((item,), ("short",), RECORDS["short"])
    assert isinstance(done.outcome, RunConclusion)
    return done.outcome


@pytest.fixture(scope="module")
def advanced() -> RunProgress:
    (done,) = process_pack((AdvanceRun("any", spec(), None, 0.0),), ("short",), RECORDS["short"])
    assert isinstance(done.outcome, RunProgress)
    return done.outcome


@pytest.fixture(autouse=True)
def slow_observers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every observer takes all the time that a step has for it: each is told of one result."""
    monkeypatch.setattr(scheduler, "MIN_REPORT_SECONDS", 0.0)
    monkeypatch.setattr(scheduler, "MAX_REPORT_SECONDS", 0.0)


def told(notebook: Notebook) -> list[str]:
    return [run for run, results in notebook.results.items() for _ in results]


def steps(feeder: Scheduler[str], most: int = 1000) -> Iterator[tuple[str, ...]]:
    for _ in range(most):
        if not feeder._jobs:
            return
        yield feeder.run_step(0.0)
    raise AssertionError("the jobs did not end")


def test_every_result_is_told_once_before_the_job_ends(concluded: RunConclusion) -> None:
    feeder = Scheduler(ScriptedExecutor(lambda item: ItemResult(item.run, concluded, 0.01)))
    notebook = jobs(feeder, a=60)["a"]
    for ended in steps(feeder):
        assert bool(ended) == (len(told(notebook)) == 60)
    assert sorted(told(notebook)) == sorted(f"a{number}" for number in range(60))


def test_a_slice_of_a_single_run_goes_on_while_results_of_a_sweep_are_told(
    concluded: RunConclusion, advanced: RunProgress
) -> None:
    slices = 0

    def answer(item: WorkItem) -> ItemResult:
        nonlocal slices
        if not item.run.startswith("single"):
            return ItemResult(item.run, concluded, 0.01)
        slices += 1
        outcome = concluded if slices == 8 else advanced
        return ItemResult(item.run, outcome, PACK_SECONDS)

    feeder = Scheduler(ScriptedExecutor(answer))
    notebook = jobs(feeder, sweep=400)["sweep"]
    while len(notebook.begun) < 100:  # by then its packs have many runs each
        feeder.run_step(0.0)
    single = jobs(feeder, single=1)["single"]
    before = len(told(notebook))
    for _ in range(8 + 2):  # a slice a step, and a step for its way in and out
        feeder.run_step(0.0)
    assert told(single) == ["single0"]
    assert len(told(notebook)) - before <= 10  # one a step
    assert len(notebook.begun) - len(told(notebook)) > 10  # and more had come back


def test_a_job_whose_results_are_not_told_yet_gets_no_more_packs(concluded: RunConclusion) -> None:
    executor = ScriptedExecutor(lambda item: ItemResult(item.run, concluded, 0.05))
    feeder = Scheduler(executor)
    notebook = jobs(feeder, a=500)["a"]
    most = 0
    for _ in steps(feeder):
        flying = sum(len(pack) for pack in executor.packs.values())
        most = max(most, len(notebook.begun) - len(told(notebook)) - flying)
    # One core's pack above what it may leave, and those in flight when it came to that.
    room = scheduler.MAX_UNREPORTED_SECONDS * executor.slots / 0.05
    in_flight = PACKS_PER_CPU * executor.slots * PACK_SECONDS / 0.05
    assert room < most <= room + in_flight + 1


def test_what_has_come_back_is_told_when_the_dispatcher_stops(concluded: RunConclusion) -> None:
    executor = ScriptedExecutor(lambda item: ItemResult(item.run, concluded, 0.01))
    feeder = Scheduler(executor)
    notebook = jobs(feeder, a=400)["a"]
    for _ in range(20):
        feeder.run_step(0.0)
    flying = sum(len(pack) for pack in executor.packs.values())
    feeder.stop_jobs()
    assert len(told(notebook)) == len(notebook.begun) - flying > 20


def test_a_job_that_is_stopped_alone_still_tells_what_has_come_back(
    concluded: RunConclusion,
) -> None:
    executor = ScriptedExecutor(lambda item: ItemResult(item.run, concluded, 0.01))
    feeder = Scheduler(executor)
    notebook = jobs(feeder, a=400)["a"]
    for _ in range(20):
        feeder.run_step(0.0)
    come = len(notebook.begun) - sum(len(pack) for pack in executor.packs.values())
    feeder.stop_jobs(["a"])
    for _ in steps(feeder):
        pass
    assert len(told(notebook)) == come
