"""Runs that wait for others: asked for again, in the way of nobody, and ended by a cancel."""

from collections.abc import Iterator

from tests.runs import RECORDS, Notebook, spec
from tests.unit.test_feeding import ScriptedCrew, fails, finish, jobs
from workers.feeding import Feeder
from workers.ports import Coming, NotYet, QueuedRun, Records


class Chained:
    """Each run comes when the one before it has ended, or never."""

    def __init__(self, notebook: Notebook, runs: int, *, is_stuck: bool = False) -> None:
        self._notebook, self._runs, self._is_stuck = notebook, runs, is_stuck

    def runs(self) -> Iterator[Coming]:
        for number in range(self._runs):
            while self._is_stuck or len(self._notebook.failures) < number:
                yield NotYet()
            yield QueuedRun(f"chain{number}", spec())

    def records(self, key: str) -> Records:
        return RECORDS[key]


def test_a_chain_is_sent_run_by_run() -> None:
    crew, notebook = ScriptedCrew(fails), Notebook()
    feeder: Feeder[str] = Feeder(crew)
    feeder.add("chain", Chained(notebook, 5), notebook)
    assert finish(feeder) == ["chain"]
    assert crew.sent == [(f"chain{number}",) for number in range(5)]


def test_a_job_that_waits_does_not_keep_others_from_the_workers() -> None:
    notebook = Notebook()
    feeder: Feeder[str] = Feeder(ScriptedCrew(fails))
    feeder.add("chain", Chained(notebook, 1, is_stuck=True), notebook)
    other = jobs(feeder, a=20)["a"]
    for _ in range(200):
        feeder.step(0.0)
    assert len(other.failures) == 20
    assert len(feeder) == 1


def test_a_job_that_waits_can_be_cancelled() -> None:
    notebook = Notebook()
    feeder: Feeder[str] = Feeder(ScriptedCrew(fails))
    feeder.add("chain", Chained(notebook, 1, is_stuck=True), notebook)
    feeder.step(0.0)
    notebook.is_stopped = True
    assert finish(feeder) == ["chain"]
