"""From a job's rows to specifications that workers can carry out."""

import logging
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

from service.core.errors import ServiceError
from service.core.json_pointer import body_of
from service.datasets.recordings import read_records
from service.datasets.signal_channels import SignalChannels, map_channels
from service.dispatch.checkpoints import unpacked
from service.dispatch.fitted_signals import FittedPart, Shelf, Shelved, save_fit
from service.dispatch.warm_starts import OpenChains, WarmStarts
from service.jobs.axes import Steps
from service.jobs.stored_cells import stored_cells, stored_groups
from service.jobs.to_core import algorithm_of, fit_settings_of
from service.models.models import load_stored_model
from service.queue.leases import Claim
from service.queue.previous_attempts import forget_progress
from service.queue.reuse import computed, mark
from service.queue.run_writes import RunLedger
from service.repositories.datasets import DatasetRepository
from service.repositories.runs import RunRepository
from service.storage.errors import LeaseLost, StorageError
from service.storage.objects import ObjectStore
from service.storage.retry import patiently
from service.storage.sessions import Database
from service.storage.statements import CHUNK
from service.storage.tables import Dataset, Run
from sysid.core.errors import SysidError
from sysid.data.noise import Noise
from sysid.identification.result import Identification
from sysid.islands.state import RunState
from sysid.models.model import Model
from workers.errors import RecordsUnavailable
from workers.ports import (
    Coming,
    Failure,
    KnownRun,
    NotYet,
    ProblemSpec,
    QueuedRun,
    Records,
    RefusedRun,
    RunSpec,
    Warm,
)
from workers.tasks import prepared

_log = logging.getLogger(__name__)

READ_AHEAD = 200
TOGETHER = 64
"""Runs of different chains that are read at a time."""
KEPT_SAMPLES = 1_000_000
"""Of records that a job keeps in memory, 16 bytes each, besides those last asked for."""


class DataKey(NamedTuple):
    """Which datasets, and which of their channels are the signals of the model."""

    datasets: tuple[str, ...]
    channels: SignalChannels


class JobRuns:
    """The runs and records of one claimed job; implements `workers.ports.JobSource`."""

    def __init__(
        self,
        database: Database,
        claim: Claim,
        store: ObjectStore,
    ) -> None:
        self._database, self._lease, self._job = database, claim.lease, claim.job
        self._store = store
        self._shelf = Shelf(store)
        self._problems: dict[str, ProblemSpec] = {}
        self._data: dict[str, DataKey] = {}
        self._read: OrderedDict[str, Records] = OrderedDict()
        self._warm = WarmStarts(database, claim.job)
        self._groups: list[Steps] | None = None

    def runs(self) -> Iterator[Coming]:
        """The unfinished runs, each from its checkpoint if it has one.

        In order; where runs wait for others in their chains, those come first that need not wait.
        """
        try:
            checkpoints = patiently(self._checkpoints)
            chains = patiently(self._warm.chains)
            for rows in self._in_order() if chains is None else self._along(chains):
                if not rows:
                    yield NotYet()
                    continue
                states = {row.id: unpacked(checkpoints.pop(row.id, None)) for row in rows}
                fresh = [run for run, state in states.items() if state is None]
                patiently(partial(self._begin_anew, fresh))
                yield from self._coming([(row, states.pop(row.id)) for row in rows])
        except LeaseLost as error:  # the recorder will meet it too, and stop the job
            _log.warning("no more runs: %s", error)

    def _in_order(self) -> Iterator[list[Run]]:
        rows = self._following(-1)
        while rows:
            yield rows
            rows = self._following(rows[-1].number)

    def _along(self, chains: OpenChains) -> Iterator[list[Run]]:
        """Runs that may begin, of many chains; no runs while all that are left wait."""
        made = patiently(self._n_made)
        while not chains.is_empty:
            numbers = chains.ready(TOGETHER, made)
            if not numbers and chains.has_free and patiently(self._make_runs):
                made = patiently(self._n_made)
            rows = patiently(partial(self._unfinished, numbers)) if numbers else []
            for row in rows:
                self._warm.given(row)
            for number in set(numbers).difference(row.number for row in rows):
                chains.over(number)
            yield rows

    def _coming(self, rows: list[tuple[Run, RunState | None]]) -> Iterator[Coming]:
        """The runs of these rows, or what is known of them already."""
        queued = [patiently(partial(self._queued, row, state)) for row, state in rows]
        sources = patiently(partial(self._computed, queued))
        for one in queued:
            source = sources.get(one.run)
            if source is not None:
                patiently(partial(self._warm.note_known, one.run, source))
            elif isinstance(one, QueuedRun):
                self._problems[one.run] = one.spec.problem
            yield one if source is None else KnownRun(one.run, source)

    def specification(self, cell: Mapping[str, Any], warm: Warm = ()) -> RunSpec:
        """The run of one cell, with what it begins with.

        Raises
        ------
        SysidError, ServiceError, StorageError
            If its settings cannot be used, or its model is not there.
        """
        body = body_of(self._job.spec, cell)
        model = load_stored_model(body["model"])
        validation = body["validation"] or {}
        kept = validation.get("datasets")
        problem = ProblemSpec(
            model=dict(model.document),
            records=self._key(body["datasets"], body, model),
            validation=None if kept is None else self._key(kept, body, model),
            validation_fraction=validation.get("fraction"),
            settings=fit_settings_of(body),
            noise=Noise(float(body["noise"]["sigma"]), int(body["noise"]["seed"])),
        )
        return RunSpec(problem, algorithm_of(body["algorithm"]), int(body["seed"]), warm)

    def records(self, key: str) -> Records:
        """The records of that key, read from the object store.

        Raises
        ------
        RecordsUnavailable
            If a dataset or a channel is not there, or cannot be used.
        """
        if key not in self._read:  # every run of a sweep asks, to store its signals
            self._read[key] = self._from_store(key)
            while len(self._read) > 1 and self._n_samples() > KEPT_SAMPLES:
                self._read.popitem(last=False)
        self._read.move_to_end(key)
        return self._read[key]

    def _n_samples(self) -> int:
        channels = (
            channel
            for records in self._read.values()
            for record in records
            for channel in (*record.inputs, *record.outputs)
        )
        return sum(channel.known_samples for channel in channels)

    def _from_store(self, key: str) -> Records:
        datasets, channels = self._data[key]
        try:
            rows = patiently(partial(self._datasets, datasets))
            return read_records(self._store, rows, channels)
        except (SysidError, ServiceError, StorageError) as error:
            raise RecordsUnavailable(str(error)) from error

    def _datasets(self, datasets: tuple[str, ...]) -> Sequence[Dataset]:
        with self._database.read() as session:
            return DatasetRepository(session, self._job.project_id).get_all(datasets)

    def save(self, run: str, found: Identification) -> Shelved | None:
        """Make the file of a run's fitted signals, to be stored with those of others.

        Raises
        ------
        ObjectStoreFailed
            If it cannot be written.
        """
        self._warm.note(run, found)
        problem = self._problems.pop(run)
        records = {key: self.records(key) for key in problem.needs}
        fit_records = prepared(problem, records)
        parts: list[FittedPart] = [("estimation", fit_records.estimation, found.simulated)]
        if fit_records.validation is not None:
            parts.append(("validation", fit_records.validation, found.simulated_validation))
        return save_fit(self._shelf, run, parts)

    def failed(self, run: str) -> None:
        """Nothing will be saved of a run: those behind it in its chain wait no longer."""
        self._problems.pop(run, None)
        self._warm.note_failed(run)

    def _checkpoints(self) -> dict[str, bytes]:
        with self._database.write() as session:
            return RunLedger(session, self._lease).checkpoints()

    def _following(self, after: int) -> list[Run]:
        """Unfinished runs behind that number; the next ones are made where none is left."""
        while not (rows := patiently(partial(self._pending, after))):
            if not patiently(self._make_runs):
                break
        return rows

    def _make_runs(self) -> bool:
        """Make the next runs of the sweep; whether some were left to be made.

        Which are made already the database knows, so that any dispatcher goes on from there.
        """
        made = self._n_made()
        if made >= self._job.n_runs:
            return False
        if self._groups is None:
            self._groups = stored_groups(self._job.spec)
        cells = list(islice(stored_cells(self._job.spec, self._groups, made), CHUNK))
        with self._database.write() as session:
            RunLedger(session, self._lease).create(cells)
        return bool(cells)

    def _n_made(self) -> int:
        with self._database.read() as session:
            return RunRepository(session, self._job.project_id).n_made(self._job.id)

    def _unfinished(self, numbers: list[int]) -> list[Run]:
        with self._database.write() as session:
            return RunLedger(session, self._lease).unfinished(numbers)

    def _pending(self, after: int) -> list[Run]:
        with self._database.write() as session:
            return RunLedger(session, self._lease).pending(READ_AHEAD, after)

    def _begin_anew(self, runs: list[str]) -> None:
        if self._lease.attempt > 1 and runs:
            with self._database.write() as session:
                forget_progress(session, self._lease, runs)

    def _queued(self, row: Run, state: RunState | None) -> QueuedRun | RefusedRun:
        try:
            warm = self._warm.of(row, body_of(self._job.spec, row.cell))
            spec = self.specification(row.cell, warm)
        except (SysidError, ServiceError, StorageError) as error:
            return RefusedRun(row.id, Failure(str(error), type(error).__name__))
        return QueuedRun(row.id, spec, state, row.kills)

    def _computed(self, queued: list[QueuedRun | RefusedRun]) -> dict[str, str]:
        """Runs that were computed before, each with the run that did; all are marked."""
        hashes = {
            one.run: key
            for one in queued
            if isinstance(one, QueuedRun) and (key := one.spec.key) is not None
        }
        with self._database.write() as session:
            mark(session, self._lease, hashes)
            if not self._job.spec["reuse"]:
                return {}
            known = computed(session, set(hashes.values()), self._job.project_id)
        return {run: known[one] for run, one in hashes.items() if one in known}

    def _key(self, datasets: list[str], body: Mapping[str, Any], model: Model) -> str:
        channels = map_channels(model, body["channels"], body["hold"])
        data = DataKey(tuple(datasets), channels)
        key = repr(data)
        self._data[key] = data
        return key
