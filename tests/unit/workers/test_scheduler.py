"""The driver of a executor, with a executor that answers as the test says; no Ray, no numerics."""

from collections.abc import Callable
from typing import Any

import pytest

from sysid.core.errors import InvalidSettings
from sysid.identification.run import begin_run
from tests.support.cluster.inline_executor import InlineExecutor
from tests.support.cluster.small_runs import (
    RECORDS,
    ListedRuns,
    Notebook,
    bits,
    carry_out,
    encode_runs,
    spec,
)
from workers import packing, scheduler, tasks
from workers.errors import (
    PackCancelled,
    PackFailed,
    PackLost,
    RecordsDelayed,
    RecordsUnavailable,
    WorkerDied,
)
from workers.job_queue import JobQueue
from workers.packing import PACKS_PER_CPU
from workers.protocol import (
    AdvanceRun,
    EvolveIsland,
    InvalidRun,
    IslandProgress,
    ItemResult,
    Pack,
    PackResult,
    QueuedRun,
    Records,
    RunFailure,
    RunProgress,
    WorkItem,
)
from workers.scheduler import Scheduler
from workers.tasks import build_pack_problems, encode_pack

pytestmark = pytest.mark.usefixtures("time_to_read")

Answer = Callable[[WorkItem], ItemResult | PackLost]


class ScriptedExecutor:
    """Answers a pack, when it is waited for, with what the script says of its items."""

    def __init__(self, answer: Answer, slots: int = 2) -> None:
        self.slots, self.answer = slots, answer
        self.packs: dict[int, tuple[WorkItem, ...]] = {}
        self.sent: list[tuple[str, ...]] = []
        self.cancelled: list[tuple[int, bool]] = []
        self.is_slow = False

    def share_records(self, records: Records) -> Any:
        return records

    def submit_pack(self, pack: Pack) -> int:
        self.packs[len(self.sent)] = tuple(pack.items)
        self.sent.append(tuple(item.run for item in pack.items))
        return len(self.sent) - 1

    def wait_for_packs(self, timeout: float) -> tuple[int, ...]:
        return () if self.is_slow else tuple(reversed(self.packs))

    def fetch_results(self, handle: int) -> PackResult:
        items = self.packs.pop(handle)
        answers = [self.answer(item) for item in items]
        for one in answers:
            if isinstance(one, PackLost):
                raise one
        results = [one for one in answers if isinstance(one, ItemResult)]
        return encode_pack(encode_runs, items, results, {})

    def cancel_pack(self, handle: int, *, force: bool) -> None:
        self.cancelled.append((handle, force))

    def check_cluster_alive(self) -> None:
        pass

    def close(self) -> None:
        pass


def fails(item: WorkItem) -> ItemResult:
    """The quickest way to end a run."""
    return ItemResult(item.run, RunFailure("as told"), 0.01)


def jobs(feeder: Scheduler, **sizes: int) -> dict[str, Notebook]:
    notebooks = {}
    for job, size in sizes.items():
        notebooks[job] = Notebook()
        queued = (QueuedRun(f"{job}{number}", spec()) for number in range(size))
        feeder.add_job(job, ListedRuns(queued), notebooks[job])
    return notebooks


def finish(feeder: Scheduler) -> list[str]:
    ended: list[str] = []
    for _ in range(1000):
        ended += feeder.run_step(0.0)
        if not feeder._jobs:
            return ended
    raise AssertionError("the jobs did not end")


def test_every_run_ends_exactly_once_whatever_the_order_of_the_packs() -> None:
    feeder = Scheduler(ScriptedExecutor(fails))
    notebooks = jobs(feeder, a=150, b=1)
    assert sorted(finish(feeder)) == ["a", "b"]
    assert {run: len(told) for run, told in notebooks["a"].failures.items()} == {
        f"a{number}": 1 for number in range(150)
    }
    assert sorted(notebooks["a"].begun) == sorted(notebooks["a"].failures)


def test_the_packs_in_flight_are_shared_between_jobs() -> None:
    executor = ScriptedExecutor(fails)
    executor.is_slow = True
    feeder = Scheduler(executor)
    jobs(feeder, a=100, b=100)
    feeder.run_step(0.0)
    assert len(executor.packs) == PACKS_PER_CPU * executor.slots
    names = [pack[0][0] for pack in executor.sent]
    assert names.count("a") == names.count("b")


def test_results_are_collected_while_many_cores_are_being_filled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(scheduler, "READ_SECONDS", -1.0)
    executor, waits = ScriptedExecutor(fails, slots=1000), []
    wait_for_packs = executor.wait_for_packs

    def wait(timeout: float) -> tuple[int, ...]:
        waits.append((timeout, len(executor.sent)))
        return wait_for_packs(timeout)

    monkeypatch.setattr(executor, "wait_for_packs", wait)
    feeder = Scheduler(executor)
    notebooks = jobs(feeder, a=100)
    feeder.run_step(1.0)
    assert waits == [(0.0, scheduler.SENT_PACKS)]
    assert len(notebooks["a"].failures) == scheduler.SENT_PACKS
    finish(feeder)
    assert len(notebooks["a"].failures) == 100


def test_runs_of_known_cost_share_a_pack() -> None:
    executor = ScriptedExecutor(fails)
    feeder = Scheduler(executor)
    jobs(feeder, a=100)
    finish(feeder)
    assert len(executor.sent) < 40
    assert max(map(len, executor.sent)) > 1


def test_runs_of_different_records_do_not_share_a_pack() -> None:
    class Keeping(ScriptedExecutor):
        def submit_pack(self, pack: Pack) -> int:
            keys = tuple(pack.records)
            assert {item.spec.problem.record_keys for item in pack.items} == {keys}
            return super().submit_pack(pack)

    executor, notebook = Keeping(fails), Notebook()
    feeder: Scheduler[str] = Scheduler(executor)
    queued = (QueuedRun(f"a{n}", spec(records="long" if n % 7 else "short")) for n in range(100))
    feeder.add_job("a", ListedRuns(queued), notebook)
    finish(feeder)
    assert len(notebook.failures) == 100
    assert max(map(len, executor.sent)) > 1


def test_a_run_whose_worker_dies_once_is_sent_again() -> None:
    died: list[str] = []

    def answer(item: WorkItem) -> ItemResult | PackLost:
        if item.run == "a1" and not died:
            died.append(item.run)
            return WorkerDied("killed")
        return fails(item)

    feeder = Scheduler(ScriptedExecutor(answer))
    notebook = jobs(feeder, a=4)["a"]
    finish(feeder)
    assert [failure.reason for failure in notebook.failures["a1"]] == ["as told"]


def test_a_run_that_kills_every_worker_fails_alone_and_says_so() -> None:
    def answer(item: WorkItem) -> ItemResult | PackLost:
        return WorkerDied("out of memory") if item.run == "a1" else fails(item)

    feeder = Scheduler(ScriptedExecutor(answer))
    notebook = jobs(feeder, a=4)["a"]
    finish(feeder)
    (failure,) = notebook.failures.pop("a1")
    assert failure.reason == "its worker process died 2 times; the last time: out of memory"
    assert all(told == [RunFailure("as told")] for told in notebook.failures.values())


def test_a_run_packed_with_one_that_kills_its_worker_goes_alone_and_is_not_blamed() -> None:
    executor = ScriptedExecutor(lambda item: WorkerDied("x") if item.run == "a40" else fails(item))
    feeder = Scheduler(executor)
    notebook = jobs(feeder, a=100)["a"]
    finish(feeder)
    shared = [set(pack) for pack in executor.sent if len(pack) > 1]
    mates = next(runs for runs in shared if "a40" in runs)
    alone = [pack[0] for pack in executor.sent if len(pack) == 1]
    assert all(alone.count(mate) == 1 for mate in mates - {"a40"})
    assert notebook.kills == {"a40": [1, 2]}
    assert len(notebook.failures) == 100


def test_a_death_counted_by_a_dispatcher_before_is_counted_on() -> None:
    executor = ScriptedExecutor(lambda item: WorkerDied("killed"))
    feeder, notebook = Scheduler(executor), Notebook()
    feeder.add_job("a", ListedRuns([QueuedRun("a0", spec(), kills=1)]), notebook)
    finish(feeder)
    assert len(executor.sent) == 1
    assert notebook.kills == {"a0": [2]}


def test_a_run_that_went_on_between_two_deaths_is_not_given_up() -> None:
    state = begin_run(build_pack_problems(spec().problem, RECORDS)[0], spec().algorithm, 1)
    turns = iter([WorkerDied("x"), RunProgress(state), WorkerDied("x"), RunProgress(state)])

    def answer(item: WorkItem) -> ItemResult | PackLost:
        one = next(turns, None)
        if one is None:
            return fails(item)
        return one if isinstance(one, PackLost) else ItemResult(item.run, one, 0.1)

    feeder = Scheduler(ScriptedExecutor(answer))
    notebook = jobs(feeder, a=1)["a"]
    finish(feeder)
    assert notebook.kills == {"a0": [1, 0, 1, 0]}
    assert notebook.failures["a0"] == [RunFailure("as told")]


def test_a_programming_error_fails_the_runs_of_its_pack_with_its_last_line() -> None:
    def answer(item: WorkItem) -> ItemResult | PackLost:
        return PackFailed("Traceback\n  …\nKeyError: 'x'") if item.run == "a0" else fails(item)

    feeder = Scheduler(ScriptedExecutor(answer))
    notebook = jobs(feeder, a=2)["a"]
    finish(feeder)
    assert notebook.failures["a0"][0].reason == "internal error: KeyError: 'x'"
    assert notebook.failures["a1"][0].reason == "as told"


def test_work_whose_turn_did_not_come_is_sent_again() -> None:
    late: list[str] = []

    def answer(item: WorkItem) -> ItemResult:
        if item.run in late:
            return fails(item)
        late.append(item.run)
        return ItemResult(item.run, None, 0.0)

    feeder = Scheduler(ScriptedExecutor(answer))
    notebook = jobs(feeder, a=3)["a"]
    finish(feeder)
    assert sorted(notebook.failures) == ["a0", "a1", "a2"]


def test_a_stopped_job_begins_nothing_more_and_is_told_nothing_more() -> None:
    executor = ScriptedExecutor(fails)
    executor.is_slow = True
    feeder = Scheduler(executor, grace_seconds=60.0)
    notebook = jobs(feeder, a=100)["a"]
    feeder.run_step(0.0)
    sent = len(executor.sent)
    notebook.is_stopped = True
    feeder.run_step(0.0)
    assert sorted(executor.cancelled) == [(handle, False) for handle in range(sent)]
    executor.is_slow, executor.answer = False, lambda item: PackCancelled("cancelled")
    assert finish(feeder) == ["a"]
    assert len(executor.sent) == sent
    assert notebook.failures == {}


def test_a_pack_that_outlives_the_grace_period_is_killed() -> None:
    executor = ScriptedExecutor(fails)
    executor.is_slow = True
    feeder = Scheduler(executor, grace_seconds=0.0)
    notebook = jobs(feeder, a=1)["a"]
    feeder.run_step(0.0)
    notebook.is_stopped = True
    for _ in range(3):
        feeder.run_step(0.0)
    assert executor.cancelled == [(0, False), (0, True)]


def test_a_run_without_records_fails_with_the_reason() -> None:
    class Empty(ListedRuns):
        def load_records(self, key: str) -> Records:
            raise RecordsUnavailable("there is no dataset ds_1")

    feeder, notebook = Scheduler(ScriptedExecutor(fails)), Notebook()
    feeder.add_job("a", Empty([QueuedRun("a0", spec())]), notebook)
    assert finish(feeder) == ["a"]
    assert notebook.failures["a0"][0].reason == "there is no dataset ds_1"


def test_runs_wait_while_the_store_of_their_records_is_away_and_other_jobs_go_on() -> None:
    asked: list[str] = []

    class Away(ListedRuns):
        def load_records(self, key: str) -> Records:
            asked.append(key)
            if len(asked) < 5:
                raise RecordsDelayed("the store is away", 0.0)
            return super().load_records(key)

    feeder, waiting = Scheduler(ScriptedExecutor(fails)), Notebook()
    feeder.add_job("a", Away(QueuedRun(f"a{number}", spec()) for number in range(3)), waiting)
    jobs(feeder, b=1)
    assert sorted(finish(feeder)) == ["a", "b"]
    assert waiting.told == ["the store is away"]  # once
    assert {run: failure.reason for run, (failure,) in waiting.failures.items()} == dict.fromkeys(
        ("a0", "a1", "a2"), "as told"
    )
    assert waiting.begun == ["a0", "a1", "a2"]


def test_a_store_that_is_away_is_not_asked_at_every_step() -> None:
    asked: list[str] = []

    class NeverThere(ListedRuns):
        def load_records(self, key: str) -> Records:
            asked.append(key)
            raise RecordsDelayed("the store is away", 60.0)

    feeder = Scheduler(ScriptedExecutor(fails))
    feeder.add_job("a", NeverThere([QueuedRun("a0", spec())]), Notebook())
    for _ in range(20):
        assert feeder.run_step(0.0) == ()
    assert len(asked) == 1


def test_a_refused_run_fails_with_its_reason_and_the_others_go_on() -> None:
    feeder, notebook = Scheduler(ScriptedExecutor(fails)), Notebook()
    refused = InvalidRun("a0", RunFailure(str(InvalidSettings("/seed", "negative"))))
    feeder.add_job("a", ListedRuns([refused, QueuedRun("a1", spec())]), notebook)
    finish(feeder)
    assert notebook.failures["a0"][0].reason == "/seed: negative"
    assert notebook.failures["a1"][0].reason == "as told"


@pytest.mark.parametrize("n_runs", [0, 1])
def test_a_job_ends_when_nothing_of_it_is_left(n_runs: int) -> None:
    feeder = Scheduler(ScriptedExecutor(fails))
    jobs(feeder, a=n_runs)
    assert finish(feeder) == ["a"]


def test_a_pack_of_no_job_is_let_go(caplog: pytest.LogCaptureFixture) -> None:
    executor = ScriptedExecutor(fails)
    feeder = Scheduler(executor)
    notebook = jobs(feeder, a=1)["a"]
    executor.submit_pack(Pack([AdvanceRun("stray", spec(), None, 1.0)], {}, encode_runs))
    assert finish(feeder) == ["a"]
    assert (executor.packs, list(notebook.failures)) == ({}, ["a0"])
    assert "a pack of no job came back" in caplog.messages


def test_a_run_is_told_to_begin_once_also_when_it_goes_on_from_a_checkpoint() -> None:
    problem, _ = build_pack_problems(spec().problem, RECORDS)
    kept = begin_run(problem, spec().algorithm, 1)
    answers = iter([RunProgress(kept), RunProgress(kept), RunFailure("as told")])
    feeder = Scheduler(ScriptedExecutor(lambda item: ItemResult(item.run, next(answers), 0.01)))
    notebook = Notebook()
    feeder.add_job("a", ListedRuns([QueuedRun("a0", spec(), kept)]), notebook)
    finish(feeder)
    assert notebook.begun == ["a0"]


def test_islands_whose_turn_did_not_come_are_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    one = spec(3, "long", generations=60, islands=8, population=64)
    plain = carry_out(InlineExecutor(), {"r": one})
    monkeypatch.setattr(packing, "WORTH_SPREADING_SECONDS", 0.0)
    monkeypatch.setattr(packing, "FIRST_SLICE_SECONDS", 0.001)
    monkeypatch.setattr(tasks, "PACK_LIMIT_SECONDS", 0.0)  # one island of a pack at a time
    spread = carry_out(InlineExecutor(slots=2), {"r": one})
    assert bits(spread.results["r"][0]) == bits(plain.results["r"][0])


def spread(monkeypatch: pytest.MonkeyPatch) -> tuple[JobQueue, ScriptedExecutor, Notebook]:
    """A run of four islands, of which the first two are one pack and the others another."""
    monkeypatch.setattr(packing, "WORTH_SPREADING_SECONDS", 0.0)
    one = spec(islands=4)
    kept = begin_run(build_pack_problems(one.problem, RECORDS)[0], one.algorithm, 1)
    executor, notebook = ScriptedExecutor(fails), Notebook()
    work = JobQueue(ListedRuns([QueuedRun("a0", one, kept)]), notebook, executor)
    assert work.read_ahead(1, 0.0)
    work.send_next_pack(2)
    assert sorted(map(len, work.in_flight.values())) == [2, 2]
    return work, executor, notebook


@pytest.mark.parametrize(("others", "is_spread"), [(1, True), (20, False)])
def test_the_islands_of_one_run_take_no_cores_for_which_runs_of_others_wait(
    others: int, is_spread: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packing, "WORTH_SPREADING_SECONDS", 0.0)
    one = spec(islands=4)
    kept = begin_run(build_pack_problems(one.problem, RECORDS)[0], one.algorithm, 1)
    executor = ScriptedExecutor(fails, slots=4)
    executor.is_slow = True
    feeder: Scheduler[str] = Scheduler(executor)
    jobs(feeder, b=others)
    feeder.add_job("a", ListedRuns([QueuedRun("a0", one, kept)]), Notebook())
    feeder.run_step(0.0)
    items = [item for pack in executor.packs.values() for item in pack if item.run == "a0"]
    assert any(isinstance(item, EvolveIsland) for item in items) == is_spread
    assert len(items) == (4 if is_spread else 1)


def test_islands_of_a_run_that_goes_on_without_their_pack_are_not_sent_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    work, executor, _ = spread(monkeypatch)
    first, second = work.in_flight
    work.requeue_lost_pack(second, "killed")
    assert bool(work.n_waiting)
    island = executor.packs[first][0]
    assert isinstance(island, EvolveIsland)
    done = (
        ItemResult("a0", IslandProgress(island.island, island.target), 0.1),
        ItemResult("a0", None, 0.0),
    )
    work.absorb_pack(first, PackResult(done))
    assert (work.in_flight, bool(work.n_waiting)) == ({}, True)


def test_a_run_that_goes_on_is_not_sent_a_second_time_when_an_older_pack_is_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    work, _, notebook = spread(monkeypatch)
    first, second = work.in_flight
    work.requeue_lost_pack(first, "killed")
    work.send_next_pack(0)
    work.requeue_lost_pack(second, "killed")
    assert (len(work.in_flight), bool(work.n_waiting)) == (1, False)
    assert notebook.kills == {"a0": [1]}
    [whole] = work.in_flight
    work.absorb_pack(whole, PackResult((ItemResult("a0", RunFailure("as told"), 0.1),)))
    assert notebook.failures == {"a0": [RunFailure("as told")]}


def test_what_an_older_pack_says_of_a_run_that_goes_on_is_not_heard(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    work, _, notebook = spread(monkeypatch)
    first, second = work.in_flight
    work.requeue_lost_pack(first, "killed")
    work.absorb_pack(
        second,
        PackResult((ItemResult("a0", RunFailure("too late"), 0.1), ItemResult("a0", None, 0.0))),
    )
    assert (notebook.failures, bool(work.n_waiting)) == ({}, True)
    work.send_next_pack(2)
    third, fourth = work.in_flight
    work.fail_pack(third, "internal error")
    work.fail_pack(fourth, "internal error")
    assert [one.reason for one in notebook.failures["a0"]] == ["internal error"]
    assert (work.in_flight, bool(work.n_waiting)) == ({}, False)
