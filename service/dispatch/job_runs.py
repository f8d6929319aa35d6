"""Unfinished runs of a claimed parcel, read and created as the workers need them."""

import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from functools import partial

from service.core.errors import ServiceError
from service.core.process.loop_watch import allow_long_step
from service.dispatch.checkpoints import UnreadableCheckpoint, unpack_state
from service.dispatch.job_parts import JobParts
from service.dispatch.overlap import RunBeside, run_at_once
from service.dispatch.run_warm_starts import OpenChains
from service.queue.leases import Claim, LeaseQueue
from service.queue.previous_attempts import delete_progress
from service.queue.reuse import find_computed_runs
from service.queue.run_writes import RunWriter, WaitingRun
from service.storage.objects import ObjectStore
from service.storage.retry import GIVE_UP_SECONDS, retry_transient
from service.storage.sessions import Database
from service.storage.statements import CHUNK_ROWS, split_chunks
from service.storage.storage_errors import LeaseLost, StorageError
from sysid.core.errors import SysidError
from sysid.islands.run_state import RunState
from workers.protocol import (
    InvalidRun,
    JobEntry,
    QueuedRun,
    Records,
    ReusedRun,
    RunFailure,
    RunNotReady,
)

_log = logging.getLogger(__name__)

BUILT_RUNS = 250
"""Specifications that are built before the first of them is sent."""
MAX_READY_RUNS = 64
"""Runs of different chains read at a time."""


class JobRuns:
    """Runs and records of one claimed parcel; implements `workers.protocol.JobSource`.

    Parameters
    ----------
    keeps_signals : bool
        Whether sweeps store fitted signals, unless the job says otherwise.
    parts : JobParts, optional
        What is shared with other parcels of the job.
    run_beside : callable, optional
        Reads the next runs while these are sent. By default they are read when they are needed.

    Attributes
    ----------
    n_unread : int
        Runs of the parcel that were not read yet.
    """

    def __init__(
        self,
        database: Database,
        claim: Claim,
        store: ObjectStore,
        *,
        keeps_signals: bool = False,
        parts: JobParts | None = None,
        run_beside: RunBeside | None = None,
    ) -> None:
        self.parts = parts or JobParts(database, claim.job, store, keeps_signals=keeps_signals)
        self.n_unread = len(claim.runs)
        self._database, self._lease, self._job = database, claim.lease, self.parts.job
        self._numbers, self._is_new = claim.runs, claim.is_new
        self._run_beside = run_beside

    @property
    def has_whole_job(self) -> bool:
        """Whether the parcel has all runs of its job."""
        return len(self._numbers) == self._job.n_runs

    def iterate_runs(self) -> Iterator[JobEntry]:
        """Iterate over the unfinished runs, each from its checkpoint if it has one.

        Runs come in order. In chains of warm starts, the runs that need not wait come first.
        """
        try:
            checkpoints = {} if self._is_new else retry_transient(self._read_checkpoints)
            chains = retry_transient(self.parts.warm.open_chains)
            for rows in (
                self._iterate_in_order() if chains is None else self._iterate_chains(chains)
            ):
                if not rows:
                    yield RunNotReady()
                    continue
                states, unreadable = _unpack_states(rows, checkpoints)
                fresh = [run for run, state in states.items() if state is None]
                retry_transient(partial(self._forget_progress, fresh, unreadable))
                yield from self._to_coming_runs([(row, states.pop(row.id)) for row in rows])
        except LeaseLost as error:  # the recorder meets it too, and stops the parcel
            _log.warning("no more runs are read: %s", error)

    def _iterate_in_order(self) -> Iterator[list[WaitingRun]]:
        """Iterate over the runs in order, some at a time. The next ones are read meanwhile."""
        coming: Future[list[WaitingRun]] | None = None
        for window in _split_range(self._numbers):
            with allow_long_step(GIVE_UP_SECONDS):
                rows = (coming or self._begin_reading(window, run_at_once)).result()
            following = range(window.stop, min(window.stop + CHUNK_ROWS, self._numbers.stop))
            self.n_unread = self._numbers.stop - window.stop
            coming = None
            if following and self._run_beside is not None:
                coming = self._begin_reading(following, self._run_beside)
            yield from split_chunks(rows, BUILT_RUNS)

    def _begin_reading(self, window: range, begin: RunBeside) -> Future[list[WaitingRun]]:
        return begin(partial(retry_transient, partial(self._read_window, window)))

    def _read_window(self, window: range) -> list[WaitingRun]:
        """Read the unfinished runs of these numbers. Those that do not exist are created.

        The database tells which exist, so that any dispatcher can continue.
        """
        with self._database.write_session() as session:
            writer = RunWriter(session, self._lease)
            n_existing = writer.count_runs(window)
            if n_existing < len(window):
                waiting = writer.create_runs(self.parts.build_cells(window))
                if n_existing == 0:
                    return waiting
            return writer.list_pending(len(window), window.start - 1, window.stop)

    def _iterate_chains(self, chains: OpenChains) -> Iterator[list[WaitingRun]]:
        """Iterate over ready runs of many chains. Yields no rows while all remaining runs wait.

        The parcel has all runs of the job.
        """
        windows = _split_range(self._numbers)
        n_created = 0
        while not chains.is_exhausted:
            numbers = chains.take_ready(MAX_READY_RUNS, n_created)
            if not numbers and chains.has_ready and (window := next(windows, None)) is not None:
                retry_transient(partial(self._read_window, window))
                n_created = window.stop
                self.n_unread = self._numbers.stop - n_created
                continue
            rows = retry_transient(partial(self._read_unfinished, numbers)) if numbers else []
            for row in rows:
                self.parts.warm.register_run(row)
            for number in set(numbers).difference(row.number for row in rows):
                chains.end_run(number)
            yield rows

    def _to_coming_runs(self, rows: list[tuple[WaitingRun, RunState | None]]) -> Iterator[JobEntry]:
        """Convert rows to runs, or to earlier runs with the same specification."""
        queued = retry_transient(
            lambda: [self._build_queued_run(row, state) for row, state in rows]
        )
        sources = retry_transient(partial(self._find_computed_runs, queued))
        for run in queued:
            source = sources.get(run.run)
            if source is not None:
                retry_transient(partial(self.parts.warm.record_reuse, run.run, source))
            yield run if source is None else ReusedRun(run.run, source)

    def load_records(self, key: str) -> Records:
        """Load the records of that key; else `RecordsUnavailable`, or `RecordsDelayed`."""
        return self.parts.load_records(key)

    def _read_checkpoints(self) -> dict[str, bytes]:
        with self._database.write_session() as session:
            return RunWriter(session, self._lease).read_checkpoints()

    def _read_unfinished(self, numbers: list[int]) -> list[WaitingRun]:
        with self._database.write_session() as session:
            return RunWriter(session, self._lease).list_unfinished(numbers)

    def _forget_progress(self, runs: list[str], messages: list[str]) -> None:
        if not self._is_new and runs:
            with self._database.write_session() as session:
                delete_progress(session, self._lease, runs)
                for message in messages:
                    LeaseQueue(session).append_event(self._lease, "log", {"message": message})

    def _build_queued_run(self, row: WaitingRun, state: RunState | None) -> QueuedRun | InvalidRun:
        try:
            shared = self.parts.share_parts(row.cell)
            warm = self.parts.warm.find_values(row, shared.warm_start)
            spec = shared.build_specification(row.cell, warm)
        except (SysidError, ServiceError, StorageError) as error:
            return InvalidRun(row.id, RunFailure(str(error), type(error).__name__))
        return QueuedRun(row.id, spec, state, row.kills)

    def _find_computed_runs(self, queued: list[QueuedRun | InvalidRun]) -> dict[str, str]:
        """Find earlier runs with the same specification."""
        if not self._job.spec["reuse"]:
            return {}
        hashes = {
            entry.run: key
            for entry in queued
            if isinstance(entry, QueuedRun) and (key := entry.spec.reuse_key) is not None
        }
        with self._database.read_session() as session:
            sources = find_computed_runs(
                session,
                set(hashes.values()),
                self._job.project_id,
                with_signals=self.parts.encoder.keeps_signals,
            )
        return {run: sources[key] for run, key in hashes.items() if key in sources}


def _split_range(numbers: range) -> Iterator[range]:
    for start in range(numbers.start, numbers.stop, CHUNK_ROWS):
        yield range(start, min(start + CHUNK_ROWS, numbers.stop))


def _unpack_states(
    rows: Sequence[WaitingRun], checkpoints: dict[str, bytes]
) -> tuple[dict[str, RunState | None], list[str]]:
    """Take the checkpoints of these runs; return their states, and what cannot be read."""
    states: dict[str, RunState | None] = {row.id: None for row in rows}
    unreadable = []
    for row in rows:
        data = checkpoints.pop(row.id, None)
        if data is not None:
            try:
                states[row.id] = unpack_state(data)
            except UnreadableCheckpoint as error:
                unreadable.append(f"{row.id} starts anew: its checkpoint cannot be read, {error}")
    return states, unreadable
