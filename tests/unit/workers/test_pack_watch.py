"""Packs that do not come back are given away once, and no worker that answers is suspected."""

import pytest

from tests.support.cluster.small_runs import ListedRuns, Notebook, spec
from tests.unit.workers.test_scheduler import ScriptedExecutor, fails, jobs
from workers import scheduler
from workers.errors import WorkerDied
from workers.pack_watch import (
    FIRST_LIMIT_SECONDS,
    LIMIT_FACTOR,
    MIN_LIMIT_SECONDS,
    PACK_LIMIT_SECONDS,
    PackWatch,
    compute_time_limit,
)
from workers.protocol import ItemResult, Pack, PackResult, QueuedRun, WorkItem
from workers.scheduler import Scheduler

pytestmark = pytest.mark.usefixtures("time_to_read")


class Time:
    """Seconds that the test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class HangingExecutor(ScriptedExecutor):
    """Does not return the first pack of each of these runs; its killed worker ends, or stays."""

    def __init__(self, *hanging: str, ends: bool = True) -> None:
        super().__init__(fails)
        self.hanging, self.ends = set(hanging), ends
        self.stuck: set[int] = set()
        self.killed: list[int] = []

    def submit_pack(self, pack: Pack) -> int:
        handle = super().submit_pack(pack)
        names = set(self.sent[handle])
        if self.hanging & names:
            self.hanging -= names
            self.stuck.add(handle)
        return handle

    def wait_for_packs(self, timeout: float) -> tuple[int, ...]:
        dead = self.killed if self.ends else ()
        return tuple(one for one in self.packs if one not in self.stuck or one in dead)

    def fetch_results(self, handle: int) -> PackResult:
        if handle in self.stuck:
            del self.packs[handle]
            raise WorkerDied("killed")
        return super().fetch_results(handle)

    def cancel_pack(self, handle: int, *, force: bool) -> None:
        if force:
            self.killed.append(handle)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Time:
    made = Time()
    monkeypatch.setattr(scheduler, "read_awake_seconds", made)
    return made


def turn(feeder: Scheduler, clock: Time, seconds: float, step: float = 1.0) -> list[str]:
    ended: list[str] = []
    for _ in range(int(seconds / step)):
        clock.now += step
        ended += feeder.run_step(0.0)
    return ended


def test_the_limit_of_a_pack_is_that_of_its_job_and_generous_while_nothing_is_known() -> None:
    assert compute_time_limit(None) == FIRST_LIMIT_SECONDS
    assert compute_time_limit(0.1) == MIN_LIMIT_SECONDS
    assert compute_time_limit(5.0) == (PACK_LIMIT_SECONDS + 5.0) * LIMIT_FACTOR


def test_only_packs_that_compute_have_a_time() -> None:
    watch: PackWatch[str] = PackWatch()
    limits = dict.fromkeys("abcd", 10.0)
    assert watch.find_overdue(limits, 2, 0.0) == []
    assert watch.find_overdue(limits, 2, 11.0) == ["a", "b"]
    del limits["a"]
    assert watch.find_overdue(limits, 2, 11.0) == ["b"]  # c has just begun
    assert watch.find_overdue(limits, 2, 22.0) == ["b", "c"]
    assert watch.find_overdue(dict.fromkeys("xyz", 1.0), 0, 99.0) == []


def test_a_pack_whose_worker_hangs_is_given_away_once_and_the_job_says_so(clock: Time) -> None:
    executor = HangingExecutor("a3")
    feeder = Scheduler(executor)
    book = jobs(feeder, a=20)["a"]
    turn(feeder, clock, MIN_LIMIT_SECONDS - 5)
    assert executor.killed == []
    assert turn(feeder, clock, 10) == ["a"]
    assert len(executor.killed) == 1
    assert {run: len(told) for run, told in book.failures.items()} == {
        f"a{number}": 1 for number in range(20)
    }
    (text,) = book.told
    assert text.startswith("a worker did not answer for 30 s. Another one computes a")


def test_a_worker_that_does_not_even_end_is_not_waited_for(clock: Time) -> None:
    executor = HangingExecutor("a3", ends=False)
    feeder = Scheduler(executor)
    book = jobs(feeder, a=20)["a"]
    turn(feeder, clock, MIN_LIMIT_SECONDS + 5)
    assert executor.killed
    assert "a3" not in book.failures
    ended = turn(feeder, clock, scheduler.ABANDON_SECONDS + 2)
    assert ended == ["a"]
    assert len(book.failures["a3"]) == 1


def test_the_worker_of_a_cancelled_job_that_does_not_end_is_not_waited_for(clock: Time) -> None:
    executor = HangingExecutor("a0", ends=False)
    feeder = Scheduler(executor)
    jobs(feeder, a=1)
    turn(feeder, clock, 2)
    feeder.stop_jobs()
    assert turn(feeder, clock, scheduler.GRACE_SECONDS + scheduler.ABANDON_SECONDS + 3) == ["a"]


def test_a_run_on_which_two_workers_hang_fails_and_tells_how_long(clock: Time) -> None:
    executor = HangingExecutor("h")
    feeder, book = Scheduler(executor), Notebook()
    runs = [QueuedRun(name, spec(), kills=int(name == "h")) for name in ("a", "h")]
    feeder.add_job("job", ListedRuns(iter(runs)), book)
    turn(feeder, clock, FIRST_LIMIT_SECONDS + 30, step=10.0)
    (failure,) = book.failures["h"]
    assert failure.reason == (
        "its worker process died 2 times; the last time: it did not answer for 3600 s"
    )


def test_a_long_item_of_a_job_gives_the_others_time(clock: Time) -> None:
    def long(item: WorkItem) -> ItemResult:
        return ItemResult(item.run, fails(item).outcome, 9.0 if item.run == "a0" else 0.01)

    executor = HangingExecutor("a1")
    executor.answer = long
    feeder = Scheduler(executor)
    jobs(feeder, a=2)
    turn(feeder, clock, (PACK_LIMIT_SECONDS + 9.0) * LIMIT_FACTOR - 5)
    assert executor.killed == []
    turn(feeder, clock, 10)
    assert len(executor.killed) == 1
