"""Faults as functions: each breaks a running service and returns the recovery time.

A service has recovered when the broken part works again and a result computed after the fault is
stored.
"""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from sqlalchemy import select

from benchmarks.breaking.audit import count_steps, list_owners
from benchmarks.breaking.stand import Stand, until
from benchmarks.breaking.work import Stream
from service.storage.tables import DispatcherHeartbeat

LIMIT_SECONDS = 300.0
LATE_SECONDS = 1.0
"""A dispatcher is stopped for its lease and so much more."""


@dataclass(frozen=True, slots=True)
class Bench:
    """A service at work: its jobs, and what else of it can be broken.

    Attributes
    ----------
    postgres : PostgresServer or None
        Its server, if it has one.
    door : SilentProxy or None
        What the service reaches that server through.
    clock, ray_away : Path or None
        Files that break it from inside (`shim`).
    disks : tuple of Path
        Folders on small file systems, with its objects and checkpoints.
    """

    stand: Stand
    stream: Stream
    postgres: Any = None
    door: Any = None
    clock: Path | None = None
    ray_away: Path | None = None
    disks: tuple[Path, ...] = ()


def kill_worker(bench: Bench) -> float:
    """Kill a process that computes."""
    family = bench.stand.family
    busy = family.named("ray::process_pack") or family.named("ray::IDLE")
    before = len(family.named("ray::process_pack") + family.named("ray::IDLE"))
    return recovery(bench, lambda: kill(busy[:1]), lambda: len(_workers(bench)) >= before)


def kill_raylet(bench: Bench) -> float:
    """Kill the raylet of the dispatcher."""
    return renewal(bench, lambda: kill(bench.stand.family.named("raylet")))


def kill_gcs(bench: Bench) -> float:
    """Kill Ray's store of what is where."""
    return renewal(bench, lambda: kill(bench.stand.family.named("gcs_server")))


def kill_dispatcher(bench: Bench) -> float:
    """Kill the dispatcher."""
    return renewal(bench, lambda: kill(bench.stand.family.dispatchers()))


def kill_web(bench: Bench) -> float:
    """Kill the web process; its dispatcher ends with it, and comes again with the next."""
    web = bench.stand.web
    assert web is not None
    return renewal(bench, lambda: kill([web.pid]))


def kill_postgres(bench: Bench) -> float:
    """Kill the database's server and start it again; meanwhile the web must not answer 500."""

    def restart() -> None:
        killed = bench.postgres.get_pid()
        kill([killed])
        until(lambda: not psutil.pid_exists(killed), "it was buried", LIMIT_SECONDS)
        status = bench.stand.answers()
        if status not in (200, 503, None):
            raise AssertionError(f"the web answered {status} while its database was away")
        until(lambda: _is_started(bench.postgres), "PostgreSQL started again", LIMIT_SECONDS)

    return recovery(bench, restart, lambda: bench.stand.answers() == 200)


def _is_started(server: Any) -> bool:
    """Try to start it: the children of the killed one hold its memory for a moment."""
    with contextlib.suppress(subprocess.SubprocessError):
        server.ensure_postgres_running()
        return True
    return False


def pause_dispatcher(bench: Bench) -> float:
    """Stop a dispatcher past its lease beside another, then let it go on."""
    (first,) = bench.stand.family.dispatchers()[:1]
    with bench.stand.another_dispatcher() as second:
        mark = f"-{second.pid}-"
        log = bench.stand.folder / "second.log"
        until(lambda: mark in log.read_text(), "a second dispatcher", LIMIT_SECONDS)
        os.kill(first, signal.SIGSTOP)
        begun = time.monotonic()
        try:
            held = f"-{first}-"
            until(
                lambda: not any(held in owner for owner in list_owners(bench.stand)),
                "the paused dispatcher's jobs were given to another",
                LIMIT_SECONDS,
            )
            took = goes_on(bench, begun)
            paused = bench.stand.lease_seconds + LATE_SECONDS
            time.sleep(max(0.0, paused - (time.monotonic() - begun)))
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(first, signal.SIGCONT)
        time.sleep(1.0)
    return took


def step_clock_back(bench: Bench) -> float:
    """Set the clock back by an hour more."""
    return recovery(bench, lambda: set_clock_back(bench))


def step_clock_and_kill(bench: Bench) -> float:
    """Set the clock back by an hour and kill the dispatcher, whose leases then end in an hour."""

    def both() -> None:
        kill(bench.stand.family.dispatchers())
        set_clock_back(bench)

    return renewal(bench, both)


def renewal(bench: Bench, fault: Callable[[], None]) -> float:
    """Of what only another dispatcher than the present one mends."""
    before = list_known_dispatchers(bench)
    begun = time.monotonic()
    fault()
    until(
        lambda: bool(list_owners(bench.stand) - before) and bench.stand.answers() == 200,
        "another dispatcher has the jobs",
        LIMIT_SECONDS,
    )
    return goes_on(bench, begun)


def list_known_dispatchers(bench: Bench) -> set[str]:
    """Dispatchers that were ever heard of."""
    with bench.stand.database.read_session() as session:
        return {*session.scalars(select(DispatcherHeartbeat.owner)), *list_owners(bench.stand)}


def recovery(
    bench: Bench, fault: Callable[[], None], works: Callable[[], bool] = lambda: True
) -> float:
    """Of what mends itself under the same dispatcher."""
    begun = time.monotonic()
    fault()
    goes_on(bench, begun)
    until(works, "what was broken works again", LIMIT_SECONDS)
    return time.monotonic() - begun


def goes_on(bench: Bench, begun: float) -> float:
    """Wait until a result is stored that was not yet there; gives the seconds since `begun`."""
    seen: dict[str, int] = {}

    def is_further() -> bool:
        for job in bench.stream.jobs():
            now = count_steps(bench.stand, [job])
            if now is not None and now > seen.setdefault(job, now):
                return True
        return False

    until(is_further, "the work went on", LIMIT_SECONDS)
    return time.monotonic() - begun


def _workers(bench: Bench) -> list[int]:
    family = bench.stand.family
    return family.named("ray::process_pack") + family.named("ray::IDLE")


def kill(pids: list[int]) -> None:
    """Kill processes, those that have ended meanwhile excepted."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def set_clock_back(bench: Bench) -> None:
    """Set the clock of the service back by an hour."""
    clock = bench.clock
    assert clock is not None
    fresh = clock.with_suffix(".new")
    fresh.write_text(str(float(clock.read_text() or 0) - 3600.0))
    fresh.replace(clock)
