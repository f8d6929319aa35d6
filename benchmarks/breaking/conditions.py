"""Faults that last for some time: a full disk, no Ray, a stopped service.

Recovery counts from the time when space or Ray is available again. After a restart it counts from
the order to stop. Upgrades are not tested, since there are no earlier tables yet.
"""

import contextlib
import time

import httpx
import psutil

from benchmarks.breaking.audit import list_owners
from benchmarks.breaking.disks import fill_folders
from benchmarks.breaking.faults import (
    LIMIT_SECONDS,
    Bench,
    goes_on,
    kill,
    list_known_dispatchers,
    renewal,
)
from benchmarks.breaking.stand import until

FULL_SECONDS = 8.0
"""So long a disk stays full, if the database does not complain before."""
TRIES = 2
"""So often a dispatcher tries to start Ray in vain."""
REFUSED = "Ray could not be started"
FULL = ("the database does not answer", "are not stored", "no heartbeat could be written")


def fill_disks(bench: Bench) -> float:
    """Leave no space for objects and checkpoints; a recording that comes now is refused."""
    before = _complaints(bench)
    with fill_folders(*bench.disks):
        until(
            lambda: _is_refused(bench), "a recording was refused for want of space", LIMIT_SECONDS
        )
        with contextlib.suppress(TimeoutError):
            until(lambda: _complaints(bench) > before, "the dispatcher met it too", FULL_SECONDS)
    bench.stream.counts["full disks that the dispatcher met"] += _complaints(bench) > before
    begun = time.monotonic()
    goes_on(bench, begun)
    until(lambda: bench.stand.answers() == httpx.codes.OK, "the web answered", LIMIT_SECONDS)
    return time.monotonic() - begun


def _is_running(owner: str) -> bool:
    """Whether a dispatcher runs: a second one may have begun before Ray was withheld."""
    _, pid, _ = owner.rsplit("-", 2)
    return psutil.pid_exists(int(pid))


def _complaints(bench: Bench) -> int:
    return sum(bench.stand.log.count(text) for text in FULL)


def _is_refused(bench: Bench) -> bool:
    """Whether an upload meets the full disk, as a problem document."""
    new = time.monotonic()  # else it would be one that is stored already
    rows = [f"{0.02 * i:.2f},{new + i},{new - i}" for i in range(5_000)]
    text = "\n".join(["t,q [N],y [m]", *rows, ""])
    answer = httpx.post(
        f"{bench.stand.url}/v1/datasets",
        content=text,
        headers={"Content-Type": "text/csv"},
        timeout=60.0,
    )
    if answer.status_code == httpx.codes.INTERNAL_SERVER_ERROR:
        raise AssertionError(f"the web answered 500 while its disk was full: {answer.text}")
    return answer.status_code == httpx.codes.SERVICE_UNAVAILABLE


def withhold_ray(bench: Bench) -> float:
    """Kill the dispatcher while Ray cannot be started; meanwhile no job may be shown as running."""
    flag = bench.ray_away
    assert flag is not None
    before, before_dispatchers = bench.stand.log.count(REFUSED), list_known_dispatchers(bench)
    flag.touch()
    try:
        kill(bench.stand.family.dispatchers())
        until(lambda: bench.stand.log.count(REFUSED) >= before + TRIES, "tries", LIMIT_SECONDS)
        if held := {owner for owner in list_owners(bench.stand) if not _is_running(owner)}:
            raise AssertionError(f"jobs are shown as running by {held}, and nobody runs them")
        if bench.stand.answers() != httpx.codes.OK:
            raise AssertionError("the web does not answer without Ray")
    finally:
        flag.unlink()
    begun = time.monotonic()
    until(
        lambda: bool(list_owners(bench.stand) - before_dispatchers),
        "another dispatcher",
        LIMIT_SECONDS,
    )
    return goes_on(bench, begun)


def restart(bench: Bench) -> float:
    """Stop the service in order with jobs in its queue, and start it again."""

    def stop_and_start() -> None:
        with bench.stand.down():
            pass

    return renewal(bench, stop_and_start)
