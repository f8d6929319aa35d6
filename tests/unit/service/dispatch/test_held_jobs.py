"""Sizes of parcels: small at first, then some seconds of work, and equal parts at the end."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from service.dispatch.held_jobs import (
    FIRST_RUNS,
    MAX_CHANGE,
    MAX_RUNS,
    PARCEL_SECONDS,
    UNREAD_PART,
    HeldJob,
    choose_first_size,
)
from service.queue.leases import Claim, Lease

READ_SECONDS = PARCEL_SECONDS * (1 - UNREAD_PART)


def describe_job(n_runs: int = 1_000_000, n_done: int = 0, warm_start: str | None = None) -> Any:
    spec = {"sweep": {"axes": []}, "warm_start": warm_start}
    return SimpleNamespace(n_runs=n_runs, n_done=n_done, spec=spec)


def hold(size: int, seconds: float, **fields: Any) -> tuple[HeldJob, Any]:
    """A job whose last parcel had so many runs, `seconds` ago."""
    now = [0.0]
    parts: Any = SimpleNamespace(job=describe_job(**fields))
    held = HeldJob(parts, cast(Any, None), stopwatch=lambda: now[0])
    source: Any = SimpleNamespace(n_unread=0)
    held.add_parcel(Claim(Lease("job", 1, "d"), parts.job, range(size)), source)
    now[0] = seconds
    return held, source


@pytest.mark.parametrize(
    ("seconds", "factor"),
    [(READ_SECONDS, 1.0), (2 * READ_SECONDS, 0.5), (0.0, MAX_CHANGE), (1e6, 1 / MAX_CHANGE)],
)
def test_a_parcel_is_as_much_larger_as_the_last_one_was_read_too_soon(seconds, factor):
    held, _ = hold(4_000, seconds)
    assert held.choose_size(describe_job()) == 4_000 * factor


def test_the_last_runs_are_divided_between_the_dispatchers():
    held, _ = hold(MAX_RUNS, READ_SECONDS)
    assert held.choose_size(describe_job(100_000, 60_000), n_sharing=4) == 5_000
    assert held.choose_size(describe_job(100_000, 99_990), n_sharing=4) == FIRST_RUNS
    held, _ = hold(MAX_RUNS, 0.0)
    assert held.choose_size(describe_job()) == MAX_RUNS


def test_a_chain_is_never_divided():
    """Neither by a dispatcher that was taken for dead, and claims its own job again."""
    held, _ = hold(FIRST_RUNS, 1.0, warm_start="previous")
    assert held.choose_size(describe_job(warm_start="previous")) == 1_000_000


def test_another_parcel_is_wanted_when_little_is_unread():
    held, source = hold(1_000, 1.0)
    assert held.wants_parcel
    source.n_unread = 1_000 * UNREAD_PART + 1
    assert not held.wants_parcel


def test_a_first_parcel_grows_with_the_cores_and_a_chain_is_whole():
    assert choose_first_size(describe_job(), 2) == FIRST_RUNS
    assert choose_first_size(describe_job(), 1_000) > FIRST_RUNS
    assert choose_first_size(describe_job(warm_start="previous"), 2) == 1_000_000
