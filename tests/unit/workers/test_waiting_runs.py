"""Runs that wait for others: asked for again, in the way of nobody, and ended by a cancel."""

from collections.abc import Iterator

import pytest

from service.dispatch.run_warm_starts import OpenChains
from service.jobs.warm_start_order import ChainLayout
from tests.support.cluster.small_runs import RECORDS, Notebook, spec
from tests.unit.workers.test_scheduler import ScriptedExecutor, fails, finish, jobs
from workers.protocol import JobEntry, QueuedRun, Records, RunNotReady
from workers.scheduler import Scheduler

pytestmark = pytest.mark.usefixtures("time_to_read")


class Chained:
    """Each run comes when the one before it has ended, or never."""

    def __init__(self, notebook: Notebook, runs: int, *, is_stuck: bool = False) -> None:
        self._notebook, self._runs, self._is_stuck = notebook, runs, is_stuck

    def iterate_runs(self) -> Iterator[JobEntry]:
        for number in range(self._runs):
            while self._is_stuck or len(self._notebook.failures) < number:
                yield RunNotReady()
            yield QueuedRun(f"chain{number}", spec())

    def load_records(self, key: str) -> Records:
        return RECORDS[key]


def test_a_chain_is_sent_run_by_run() -> None:
    executor, notebook = ScriptedExecutor(fails), Notebook()
    feeder: Scheduler[str] = Scheduler(executor)
    feeder.add_job("chain", Chained(notebook, 5), notebook)
    assert finish(feeder) == ["chain"]
    assert executor.sent == [(f"chain{number}",) for number in range(5)]


def test_a_job_that_waits_does_not_keep_others_from_the_workers() -> None:
    notebook = Notebook()
    feeder: Scheduler[str] = Scheduler(ScriptedExecutor(fails))
    feeder.add_job("chain", Chained(notebook, 1, is_stuck=True), notebook)
    other = jobs(feeder, a=20)["a"]
    for _ in range(200):
        feeder.run_step(0.0)
    assert len(other.failures) == 20
    assert len(feeder._jobs) == 1


def test_a_job_that_waits_can_be_cancelled() -> None:
    notebook = Notebook()
    feeder: Scheduler[str] = Scheduler(ScriptedExecutor(fails))
    feeder.add_job("chain", Chained(notebook, 1, is_stuck=True), notebook)
    feeder.run_step(0.0)
    notebook.is_stopped = True
    assert finish(feeder) == ["chain"]


class SeveralChains:
    """Crossed chains as the dispatcher has them; each run is named by chain and number."""

    def __init__(self, notebook: Notebook, chain: ChainLayout, n_runs: int) -> None:
        self._notebook, self._chain, self._n_runs = notebook, chain, n_runs
        self._chains = OpenChains(chain, n_runs, lambda number: True)

    def iterate_runs(self) -> Iterator[JobEntry]:
        seen: set[str] = set()
        while not self._chains.is_exhausted:
            for run in set(self._notebook.failures) - seen:
                seen.add(run)
                self._chains.end_run(int(run.split("-")[1]))
            for number in self._chains.take_ready(3, self._n_runs):
                yield QueuedRun(f"{self._chain.find_chain(number)}-{number}", spec())
            yield RunNotReady()

    def load_records(self, key: str) -> Records:
        return RECORDS[key]


@pytest.mark.parametrize("chain", [ChainLayout(1, 5), ChainLayout(4, 5)])
def test_chains_go_side_by_side_and_each_run_by_run(chain: ChainLayout) -> None:
    executor, notebook = ScriptedExecutor(fails), Notebook()
    feeder: Scheduler[str] = Scheduler(executor)
    feeder.add_job("chains", SeveralChains(notebook, chain, 20), notebook)
    assert finish(feeder) == ["chains"]
    numbers = [int(run.split("-")[1]) for pack in executor.sent for run in pack]
    assert sorted(numbers) == list(range(20))
    firsts = {numbers.index(chain.list_runs(key)[0]) for key in range(4)}
    last_steps = [numbers.index(chain.list_runs(key)[-1]) for key in range(4)]
    assert max(firsts) < min(last_steps)
    for key in range(4):
        assert [n for n in numbers if chain.find_chain(n) == key] == list(chain.list_runs(key))


def test_runs_that_nothing_follows_at_present_are_shared_by_all_cores() -> None:
    executor, notebook = ScriptedExecutor(fails), Notebook()
    feeder: Scheduler[str] = Scheduler(executor)
    feeder.add_job("chains", SeveralChains(notebook, ChainLayout(1, 5), 20), notebook)
    finish(feeder)
    assert max(map(len, executor.sent)) <= 2
