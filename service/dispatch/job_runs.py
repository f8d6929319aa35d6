"""Conversion of a job's rows to specifications for the workers."""

import logging
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

from service.core.errors import ServiceError
from service.core.json_pointer import build_run_body
from service.datasets.recordings import read_records
from service.datasets.signal_channels import SignalChannels, map_channels
from service.dispatch.checkpoints import UnreadableCheckpoint, unpack_state
from service.dispatch.encoding import ResultEncoder
from service.dispatch.warm_starts import OpenChains, WarmStarts
from service.jobs.axes import AxisGroup
from service.jobs.stored_cells import build_stored_cells, read_axis_groups
from service.jobs.to_core import fit_settings_of, to_algorithm
from service.models.models import load_stored_model
from service.queue.leases import Claim, LeaseQueue
from service.queue.previous_attempts import delete_progress
from service.queue.reuse import find_computed_runs
from service.queue.run_writes import RunWriter, WaitingRun
from service.repositories.datasets import DatasetRepository
from service.repositories.runs import RunRepository
from service.storage.errors import LeaseLost, StorageError
from service.storage.objects import ObjectStore
from service.storage.retry import retry_transient
from service.storage.sessions import Database
from service.storage.statements import CHUNK_ROWS
from service.storage.tables import Dataset, Job
from sysid.core.errors import SysidError
from sysid.core.settings import GeneticAlgorithm
from sysid.data.noise import Noise
from sysid.islands.state import RunState
from sysid.models.model import Model
from workers.errors import RecordsUnavailable
from workers.protocol import (
    InvalidRun,
    JobEntry,
    ProblemSpec,
    QueuedRun,
    Records,
    ReusedRun,
    RunFailure,
    RunNotReady,
    RunSpec,
    WarmStartValues,
)

_log = logging.getLogger(__name__)

READ_AHEAD = 500
"""Runs read in one transaction."""
MAX_READY_RUNS = 64
"""Runs of different chains read at a time."""
CACHED_SAMPLES = 1_000_000
"""Samples that a job caches, 16 bytes each, in addition to the latest records."""


class DataKey(NamedTuple):
    """Datasets, and the channels of the model's signals."""

    datasets: tuple[str, ...]
    channels: SignalChannels


class _SharedParts(NamedTuple):
    """What is equal in the runs of a sweep that differ only in `_OWN_PATHS`.

    `problem` has no noise. `body` is the body of any of these runs.
    """

    body: Mapping[str, Any]
    problem: ProblemSpec
    algorithm: GeneticAlgorithm


_OWN_PATHS = ("/seed", "/noise/seed", "/noise/sigma")
"""Fields that nearly every run has for itself. All else is built once for many runs."""
_MAX_SHARED_PARTS = 256


class JobRuns:
    """Runs and records of one claimed job; implements `workers.protocol.JobSource`.

    Parameters
    ----------
    keeps_signals : bool
        Whether sweeps store fitted signals, unless the job says otherwise.
    """

    def __init__(
        self,
        database: Database,
        claim: Claim,
        store: ObjectStore,
        *,
        keeps_signals: bool = False,
    ) -> None:
        self._database, self._lease, self._job = database, claim.lease, claim.job
        self._store = store
        self._data: dict[str, DataKey] = {}
        self._cached_records: OrderedDict[str, Records] = OrderedDict()
        self._warm = WarmStarts(database, claim.job)
        self._groups: list[AxisGroup] | None = None
        self._shared: OrderedDict[str, _SharedParts] = OrderedDict()
        self.encoder = ResultEncoder(
            "sqlite" if database.is_sqlite else "postgresql",
            keeps_signals=_choose_keeping(claim.job, default=keeps_signals),
            reports_estimates=self._warm.may_wait,
        )

    def iterate_runs(self) -> Iterator[JobEntry]:
        """Iterate over the unfinished runs, each from its checkpoint if it has one.

        Runs come in order. In chains of warm starts, the runs that need not wait come first.
        """
        try:
            checkpoints = retry_transient(self._read_checkpoints)
            chains = retry_transient(self._warm.open_chains)
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
        except LeaseLost as error:  # the recorder meets it too, and stops the job
            _log.warning("no more runs are read: %s", error)

    def _iterate_in_order(self) -> Iterator[list[WaitingRun]]:
        rows = self._read_next_rows(-1)
        while rows:
            yield rows
            rows = self._read_next_rows(rows[-1].number)

    def _iterate_chains(self, chains: OpenChains) -> Iterator[list[WaitingRun]]:
        """Iterate over ready runs of many chains. Yields no rows while all remaining runs wait."""
        n_created = retry_transient(self._count_made_runs)
        while not chains.is_exhausted:
            numbers = chains.take_ready(MAX_READY_RUNS, n_created)
            if not numbers and chains.has_ready and retry_transient(self._make_runs):
                n_created = retry_transient(self._count_made_runs)
            rows = retry_transient(partial(self._read_unfinished, numbers)) if numbers else []
            for row in rows:
                self._warm.register_run(row)
            for number in set(numbers).difference(row.number for row in rows):
                chains.end_run(number)
            yield rows

    def _to_coming_runs(self, rows: list[tuple[WaitingRun, RunState | None]]) -> Iterator[JobEntry]:
        """Convert rows to runs, or to earlier runs with the same specification."""
        queued = [
            retry_transient(partial(self._build_queued_run, row, state)) for row, state in rows
        ]
        sources = retry_transient(partial(self._find_computed_runs, queued))
        for run in queued:
            source = sources.get(run.run)
            if source is not None:
                retry_transient(partial(self._warm.record_reuse, run.run, source))
            yield run if source is None else ReusedRun(run.run, source)

    def build_specification(self, cell: Mapping[str, Any], warm: WarmStartValues = ()) -> RunSpec:
        """Build the specification of one cell's run, with its warm start.

        Raises
        ------
        SysidError, ServiceError, StorageError
            If its settings are invalid, or its model is missing.
        """
        return self._specify_run(cell, self._share_parts(cell), warm)

    def _specify_run(
        self, cell: Mapping[str, Any], shared: _SharedParts, warm: WarmStartValues
    ) -> RunSpec:
        body = shared.body
        sigma = cell.get("/noise/sigma", body["noise"]["sigma"])
        noise = Noise(float(sigma), int(cell.get("/noise/seed", body["noise"]["seed"])))
        return RunSpec(
            shared.problem.replace_noise(noise),
            shared.algorithm,
            int(cell.get("/seed", body["seed"])),
            warm,
            posterior=body.get("posterior", False),  # older jobs do not have it
        )

    def _share_parts(self, cell: Mapping[str, Any]) -> _SharedParts:
        """Return the parts of a cell's run that it shares with others, built at the first one."""
        key = repr([(path, value) for path, value in cell.items() if path not in _OWN_PATHS])
        if key not in self._shared:
            self._shared[key] = self._build_shared_parts(build_run_body(self._job.spec, cell))
            if len(self._shared) > _MAX_SHARED_PARTS:
                self._shared.popitem(last=False)
        return self._shared[key]

    def _build_shared_parts(self, body: Mapping[str, Any]) -> _SharedParts:
        model = load_stored_model(body["model"])
        validation = body["validation"] or {}
        validation_datasets = validation.get("datasets")
        problem = ProblemSpec(
            model=dict(model.document),
            records=self._register_data(body["datasets"], body, model),
            validation=None
            if validation_datasets is None
            else self._register_data(validation_datasets, body, model),
            validation_fraction=validation.get("fraction"),
            settings=fit_settings_of(body),
        )
        return _SharedParts(body, problem, to_algorithm(body["algorithm"]))

    def load_records(self, key: str) -> Records:
        """Load the records of that key from the object store, or from the cache.

        Raises
        ------
        RecordsUnavailable
            If a dataset or a channel is missing or invalid.
        """
        if key not in self._cached_records:
            self._cached_records[key] = self._read_records(key)
            while len(self._cached_records) > 1 and self._count_cached_samples() > CACHED_SAMPLES:
                self._cached_records.popitem(last=False)
        self._cached_records.move_to_end(key)
        return self._cached_records[key]

    def _count_cached_samples(self) -> int:
        channels = (
            channel
            for records in self._cached_records.values()
            for record in records
            for channel in (*record.inputs, *record.outputs)
        )
        return sum(channel.total_samples for channel in channels)

    def _read_records(self, key: str) -> Records:
        datasets, channels = self._data[key]
        try:
            rows = retry_transient(partial(self._read_datasets, datasets))
            return read_records(self._store, rows, channels)
        except (SysidError, ServiceError, StorageError) as error:
            raise RecordsUnavailable(str(error)) from error

    def _read_datasets(self, datasets: tuple[str, ...]) -> Sequence[Dataset]:
        with self._database.read_session() as session:
            return DatasetRepository(session, self._job.project_id).get_all(datasets)

    def note_end(self, run: str, estimates: Mapping[str, float] | None) -> None:
        """Record that a run has ended, so that later runs of its chain stop waiting."""
        self._warm.record_end(run, estimates)

    def _read_checkpoints(self) -> dict[str, bytes]:
        with self._database.write_session() as session:
            return RunWriter(session, self._lease).read_checkpoints()

    def _read_next_rows(self, after: int) -> list[WaitingRun]:
        """Read unfinished runs after that number. If none is left, the next ones are created."""
        while not (rows := retry_transient(partial(self._read_pending, after))):
            if not retry_transient(self._make_runs):
                break
        return rows

    def _make_runs(self) -> bool:
        """Create the next runs of the sweep, and return whether some were left to create.

        The database counts the created runs, so that any dispatcher can continue.
        """
        n_created = self._count_made_runs()
        if n_created >= self._job.n_runs:
            return False
        if self._groups is None:
            self._groups = read_axis_groups(self._job.spec)
        cells = list(
            islice(build_stored_cells(self._job.spec, self._groups, n_created), CHUNK_ROWS)
        )
        with self._database.write_session() as session:
            RunWriter(session, self._lease).create_runs(cells)
        return bool(cells)

    def _count_made_runs(self) -> int:
        with self._database.read_session() as session:
            return RunRepository(session, self._job.project_id).count_created(self._job.id)

    def _read_unfinished(self, numbers: list[int]) -> list[WaitingRun]:
        with self._database.write_session() as session:
            return RunWriter(session, self._lease).list_unfinished(numbers)

    def _read_pending(self, after: int) -> list[WaitingRun]:
        with self._database.write_session() as session:
            return RunWriter(session, self._lease).list_pending(READ_AHEAD, after)

    def _forget_progress(self, runs: list[str], messages: list[str]) -> None:
        if self._lease.attempt > 1 and runs:
            with self._database.write_session() as session:
                delete_progress(session, self._lease, runs)
                for message in messages:
                    LeaseQueue(session).append_event(self._lease, "log", {"message": message})

    def _build_queued_run(self, row: WaitingRun, state: RunState | None) -> QueuedRun | InvalidRun:
        try:
            shared = self._share_parts(row.cell)
            warm = self._warm.find_values(row, shared.body["warm_start"])
            spec = self._specify_run(row.cell, shared, warm)
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
                with_signals=self.encoder.keeps_signals,
            )
        return {run: sources[key] for run, key in hashes.items() if key in sources}

    def _register_data(self, datasets: list[str], body: Mapping[str, Any], model: Model) -> str:
        channels = map_channels(model, body["channels"], body["hold"])
        data = DataKey(tuple(datasets), channels)
        key = repr(data)
        self._data[key] = data
        return key


def _choose_keeping(job: Job, *, default: bool) -> bool:
    """Choose whether signals are stored: as the job says, else those of a single run."""
    wanted = job.spec.get("keep_signals")  # older jobs do not have it
    return job.n_runs == 1 or default if wanted is None else bool(wanted)


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
