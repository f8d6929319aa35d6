"""Runs on two workers of a local Ray."""

import os
import signal
import time
from pathlib import Path

import pytest

from sysid.core.awake_clock import read_awake_seconds
from tests.support.cluster.inline_executor import InlineExecutor
from tests.support.cluster.small_runs import ListedRuns, Notebook, bits, carry_out, spec
from tests.support.limits import LIMIT_SECONDS
from workers import packing
from workers import ray_executor as module
from workers.errors import ClusterLost
from workers.protocol import QueuedRun
from workers.scheduler import Scheduler

pytestmark = [pytest.mark.ray, pytest.mark.slow]


def test_many_small_runs_on_ray_give_the_bits_of_the_plain_loop(ray_executor) -> None:
    specs = {f"r{seed}": spec(seed, generations=20) for seed in range(1, 9)}
    plain, spread = carry_out(InlineExecutor(), specs), carry_out(ray_executor, specs)
    assert plain.failures == spread.failures == {}
    for run in specs:
        assert [bits(one) for one in spread.results[run]] == [bits(plain.results[run][0])]


def test_one_large_run_spread_by_islands_gives_the_bits_of_the_plain_loop(
    ray_executor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packing, "WORTH_SPREADING_SECONDS", 0.0)
    monkeypatch.setattr(packing, "FIRST_SLICE_SECONDS", 0.001)
    specs = {"r": spec(2, "long", generations=120, islands=4, migration=every(20))}
    spread = carry_out(ray_executor, specs)
    assert spread.failures == {}
    assert len(spread.states["r"]) >= 4
    monkeypatch.setattr(packing, "FIRST_SLICE_SECONDS", 1000.0)
    monkeypatch.setattr(packing, "PACK_SECONDS", 1000.0)
    plain = carry_out(InlineExecutor(), specs)
    assert len(plain.states.get("r", [])) == 0  # one call, from the start to the end
    assert bits(spread.results["r"][0]) == bits(plain.results["r"][0])


def cut_into_many_packs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let packs be so short that a run has many of them, however fast the machine is."""
    monkeypatch.setattr(packing, "FIRST_SLICE_SECONDS", 0.01)
    monkeypatch.setattr(packing, "PACK_SECONDS", 0.05)


def test_a_run_goes_on_from_a_checkpoint_with_the_same_bits(
    ray_executor, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut_into_many_packs(monkeypatch)
    one = spec(3, "long", generations=4000)
    whole = carry_out(ray_executor, {"r": one})
    middle = whole.states["r"][0]
    feeder, notebook = Scheduler(ray_executor), Notebook()
    feeder.add_job("job", ListedRuns([QueuedRun("r", one, middle)]), notebook)
    while not feeder.run_step(0.05):
        pass
    assert bits(notebook.results["r"][0]) == bits(whole.results["r"][0])


def test_a_cancelled_job_frees_the_workers_soon_and_they_go_on_working(ray_executor) -> None:
    feeder, notebook = Scheduler(ray_executor, grace_seconds=5.0), Notebook()
    feeder.add_job(
        "job", ListedRuns([QueuedRun("r", spec(1, "long", generations=10**6))]), notebook
    )
    while not notebook.states:
        feeder.run_step(0.05)
    notebook.is_stopped = True
    begun = time.monotonic()
    while not feeder.run_step(0.05):
        assert time.monotonic() - begun < LIMIT_SECONDS
    assert carry_out(ray_executor, {"r": spec()}).failures == {}


def test_a_run_survives_the_death_of_its_worker(
    ray_executor, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut_into_many_packs(monkeypatch)
    one = spec(4, "long", generations=4000)  # each of its packs is fed from here
    feeder, notebook = Scheduler(ray_executor), Notebook()
    feeder.add_job("job", ListedRuns([QueuedRun("r", one)]), notebook)
    killed: list[int] = []
    while not feeder.run_step(0.01):
        if not killed and (killed := workers_of(os.getpid())[:1]):
            os.kill(killed[0], signal.SIGKILL)
    assert killed
    assert notebook.failures == {}
    assert len(notebook.results["r"]) == 1


def test_a_ray_that_does_not_answer_a_probe_is_lost(
    ray_executor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SILENCE_SECONDS", 0.0)
    monkeypatch.setattr(module, "ANSWER_SECONDS", 0.5)
    never = ray_executor._noop.options(resources={"of no machine": 1.0})
    monkeypatch.setattr(ray_executor, "_noop", never)
    monkeypatch.setattr(ray_executor, "_probe", None)
    monkeypatch.setattr(ray_executor, "_last_answer", read_awake_seconds())
    try:
        with pytest.raises(ClusterLost, match="has not answered"):
            check_until_lost(ray_executor)
    finally:
        ray_executor.cancel_pack(ray_executor._probe, force=False)


def check_until_lost(executor: module.RayExecutor) -> None:
    limit = time.monotonic() + LIMIT_SECONDS
    while time.monotonic() < limit:
        executor.check_cluster_alive()
        time.sleep(0.02)


def workers_of(pid: int) -> list[int]:
    """Processes of this session's Ray that compute a pack now."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes()
            session = os.getsid(int(entry.name))
        except (OSError, ProcessLookupError):
            continue
        if command.startswith(b"ray::process_pack") and session == os.getsid(pid):
            found.append(int(entry.name))
    return found


def every(generations: int):
    from sysid.core.settings import Migration

    return Migration(every=generations)
