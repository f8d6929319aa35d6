"""A cluster that is joined by its address: two nodes, one of which dies; a wrong token."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from service.core.states import JobState
from service.storage.tables import Run
from tests.support.cluster.dispatch_place import Place, until
from tests.support.cluster.two_nodes import two_nodes
from tests.support.limits import LIMIT_SECONDS

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(300)]

WRONG_TOKEN = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}
SWEEP = {"axes": [{"path": "/seed", "range": [0, 16]}]}
ALGORITHM = {"generations": 600, "islands": 2, "stop": {"settled": None}}

JOIN = """
import sys
from workers.ray_executor import ClusterSettings
from workers.ray_executor import RayExecutor
from workers.errors import ClusterUnavailable
try:
    RayExecutor(ClusterSettings(sys.argv[1]))
except ClusterUnavailable as error:
    print(error)
"""


def plain(place: Place, job: str) -> list[dict[str, Any]]:
    """What the job's runs give in this process, without Ray."""
    from service.dispatch.dispatcher import Dispatcher
    from service.dispatch.held_leases import HeldLeases
    from tests.support.cluster.inline_executor import InlineExecutor

    dispatcher = Dispatcher(
        place.database, place.store, InlineExecutor(), HeldLeases(place.database, 30)
    )
    while not place.job(job).state.is_terminal:
        dispatcher.run_round()
    return list_results(place.runs(job))


def list_results(runs: tuple[Run, ...]) -> list[dict[str, Any]]:
    assert all(run.result is not None for run in runs)
    return [{**(run.result or {}), "seconds": 0} for run in runs]


def join_in_vain(address: str, environment: dict[str, str]) -> str:
    """What a process prints that tries to join; it must end by itself."""
    inherited = {name: text for name, text in os.environ.items() if not name.startswith("RAY_")}
    done = subprocess.run(
        [sys.executable, "-c", JOIN, address],
        env={**inherited, "HOME": "/nonexistent", **environment},
        capture_output=True,
        text=True,
        timeout=LIMIT_SECONDS,
        check=True,
    )
    return done.stdout


def test_two_nodes_give_the_bits_of_the_plain_loop_also_when_one_of_them_dies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = Place(tmp_path / "data")
    with two_nodes(tmp_path) as cluster, ThreadPoolExecutor(1) as pool:
        # It takes 20 s: Ray tries again and again.
        joining = pool.submit(join_in_vain, cluster.address, WRONG_TOKEN)
        for name, value in cluster.environment.items():
            monkeypatch.setenv(name, value)
        place.settings = place.settings.model_copy(
            update={"ray_address": cluster.address, "cpus": None}
        )
        shaken = place.submit(algorithm=ALGORITHM, sweep=SWEEP)
        with place.dispatcher():
            until(lambda: place.job(shaken).n_done > 3, "some runs")
            assert "with 2 cores" in log_of(place)
            # The second node compiles for itself.
            until(lambda: any((tmp_path / "cache").glob("*.o")), "code of its own")
            cluster.order("kill")
            ended = place.until(shaken, JobState.SUCCEEDED, JobState.FAILED)
            until(lambda: "has 1 cores now" in log_of(place), "one core")
            cluster.order("add")
            until(lambda: "has 2 cores now" in log_of(place), "two cores again")
        wrong = joining.result()
        assert wrong.count("\n") == 1
        assert "refuses the connection. Most likely its token is a different one" in wrong
    assert (ended.state, ended.attempt, ended.n_done, ended.n_failed) == (
        JobState.SUCCEEDED,
        1,
        16,
        0,
    )
    alone = place.submit(algorithm=ALGORITHM, sweep=SWEEP)
    assert list_results(place.runs(shaken)) == plain(place, alone)


def log_of(place: Place) -> str:
    return (place.settings.data_dir / "dispatcher.log").read_text()


def test_an_address_that_is_wrong_ends_the_dispatcher_with_one_line(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "service.cli.main", "dispatcher"],
        env={
            **os.environ,
            "LAGID_DATA_DIR": str(tmp_path),
            "LAGID_RAY_ADDRESS": "127.0.0.1:1",
        },
        capture_output=True,
        text=True,
        timeout=LIMIT_SECONDS,
        check=False,
    )
    assert done.returncode == 1
    (line,) = [line for line in done.stderr.splitlines() if "ERROR" in line]
    assert "no Ray cluster answers at 127.0.0.1:1 (Connection refused)" in line
    assert "Traceback" not in done.stderr
