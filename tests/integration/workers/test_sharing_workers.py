"""Jobs that share the workers of a real Ray, and dispatchers that share a queue."""

import threading
import time
from pathlib import Path
from typing import Any

import pytest

from service.core.states import JobState
from service.dispatch.dispatcher import Dispatcher
from service.dispatch.held_leases import HeldLeases
from service.queue.admission import Admission
from service.queue.leases import Claim
from service.storage.objects import open_store
from service.storage.sessions import Database
from tests.support.cluster.dispatch_place import Place
from tests.support.cluster.inline_executor import InlineExecutor
from tests.support.cluster.small_runs import ListedRuns, Notebook, bits, carry_out, spec
from tests.support.limits import LIMIT_SECONDS
from workers import packing
from workers.protocol import EvolveIsland, Pack, QueuedRun
from workers.scheduler import Scheduler

QUICK = {"generations": 60, "population": 16, "stop": {"settled": None}}


def sweep(runs: int) -> dict[str, Any]:
    return {"axes": [{"path": "/seed", "range": [0, runs]}]}


@pytest.mark.ray
@pytest.mark.slow
def test_a_single_identification_gets_in_while_nine_sweeps_of_thousands_of_runs_go_on(
    tmp_path: Path, ray_executor
) -> None:
    place = Place(tmp_path / "data")
    dispatcher = Dispatcher(
        place.database, place.store, ray_executor, HeldLeases(place.database, 60.0)
    )
    sweeps = [place.submit(sweep=sweep(2000), algorithm=QUICK) for _ in range(9)]

    def turn_until(job: str, *states: JobState) -> None:
        limit = time.monotonic() + LIMIT_SECONDS
        while place.job(job).state not in states:
            assert time.monotonic() < limit
            dispatcher.run_round()

    for job in sweeps:
        turn_until(job, JobState.RUNNING)
    single = place.submit(seed=5)
    turn_until(single, JobState.SUCCEEDED)
    assert all(place.job(job).state is JobState.RUNNING for job in sweeps)
    for job in sweeps:
        place.cancel(job)
    for job in sweeps:
        turn_until(job, JobState.CANCELLED)


class Counted(HeldLeases):
    """Leases that count what they claim; after the first, the rival's first is waited for."""

    claimed = 0

    def __init__(self, database: Database, seconds: float, both: threading.Barrier) -> None:
        super().__init__(database, seconds)
        self._both = both

    def claim_job(self, admission: Admission | None = None, **chosen: Any) -> Claim | None:
        found = super().claim_job(admission, **chosen)
        self.claimed += found is not None
        if found is not None and self.claimed == 1:
            self._both.wait(LIMIT_SECONDS)
        return found


def test_two_dispatchers_split_the_jobs_of_one_database_and_each_run_is_done_once(
    tmp_path: Path, database: Database
) -> None:
    place = Place(tmp_path / "data", database)
    jobs = [place.submit(sweep=sweep(4), algorithm=QUICK, seed=n) for n in range(6)]
    url = database.engine.url.render_as_string(hide_password=False)
    own = [Database(url), Database(url)]
    both = threading.Barrier(2)  # a quick one could have them all before the other begins
    leases = [Counted(one, 60.0, both) for one in own]
    dispatchers = [
        Dispatcher(one, open_store(place.settings.store_location), InlineExecutor(), mine)
        for one, mine in zip(own, leases, strict=True)
    ]
    threads = [threading.Thread(target=one.run_until_stopped) for one in dispatchers]
    for thread in threads:
        thread.start()
    try:
        for job in jobs:
            place.until(job, JobState.SUCCEEDED, JobState.FAILED)
    finally:
        for dispatcher, thread in zip(dispatchers, threads, strict=True):
            dispatcher.stopping.set()
            thread.join()
        for one in own:
            one.dispose()
    assert sum(one.claimed for one in leases) == len(jobs)
    assert min(one.claimed for one in leases) > 0
    for job in jobs:
        ended = place.job(job)
        assert (ended.state, ended.attempt, ended.n_done) == (JobState.SUCCEEDED, 1, 4)
        assert [run.number for run in place.runs(job)] == [0, 1, 2, 3]


@pytest.mark.ray
@pytest.mark.slow
def test_the_islands_of_one_long_run_keep_both_workers_busy_with_the_same_bits(
    ray_executor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packing, "WORTH_SPREADING_SECONDS", 0.0)
    monkeypatch.setattr(packing, "FIRST_SLICE_SECONDS", 0.001)
    one = spec(3, "long", generations=120, islands=8, population=64)
    plain = carry_out(InlineExecutor(), {"r": one})
    flying: set[Any] = set()
    most = 0
    submit, fetch = ray_executor.submit_pack, ray_executor.fetch_results

    def count_and_submit(pack: Pack) -> Any:
        nonlocal most
        handle = submit(pack)
        if isinstance(pack.items[0], EvolveIsland):
            flying.add(handle)
            most = max(most, len(flying))
        return handle

    def count_and_fetch(handle) -> Any:
        flying.discard(handle)
        return fetch(handle)

    monkeypatch.setattr(ray_executor, "submit_pack", count_and_submit)
    monkeypatch.setattr(ray_executor, "fetch_results", count_and_fetch)
    spread = carry_out(ray_executor, {"r": one})
    assert most == ray_executor.slots
    assert bits(spread.results["r"][0]) == bits(plain.results["r"][0])


@pytest.mark.ray
@pytest.mark.slow
def test_a_short_job_passes_a_sweep_on_real_workers(ray_executor) -> None:
    feeder: Scheduler[str] = Scheduler(ray_executor)
    long, short = Notebook(), Notebook()
    runs = (QueuedRun(f"s{n}", spec(n)) for n in range(3000))
    feeder.add_job("sweep", ListedRuns(runs), long)
    limit = time.monotonic() + LIMIT_SECONDS
    while not long.results and time.monotonic() < limit:
        feeder.run_step(0.05)
    feeder.add_job(
        "single", ListedRuns([QueuedRun("one", spec(9, "long", generations=300))]), short
    )
    while "single" not in feeder.run_step(0.05):
        assert time.monotonic() < limit
    assert len(short.results["one"]) == 1
    assert len(long.results) < 3000
    long.is_stopped = True
    while feeder._jobs:
        feeder.run_step(0.05)
        assert time.monotonic() < limit
