"""What the parcels of one job share in a dispatcher: specifications, records, warm starts."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

from service.core.bodies.json_pointer import build_run_body
from service.core.errors import ServiceError
from service.datasets.signal_channels import SignalChannels, map_channels
from service.datasets.stored_recordings import read_records
from service.dispatch.encoding import ResultEncoder
from service.dispatch.run_warm_starts import WarmStarts
from service.jobs.axes import AxisGroup
from service.jobs.stored_cells import build_stored_cells, read_axis_groups
from service.jobs.to_core import read_run_settings
from service.models.models import load_stored_model
from service.queue.run_writes import NewRun
from service.repositories.dataset_rows import DatasetRepository
from service.storage.objects import ObjectStore
from service.storage.retry import retry_transient
from service.storage.sessions import Database
from service.storage.storage_errors import ObjectStoreFailed, StorageError
from service.storage.tables import Dataset, Job
from sysid.core.errors import SysidError
from sysid.core.settings import GeneticAlgorithm
from sysid.data.noise import Noise
from sysid.identification.options import RunOptions
from sysid.models.model import Model
from workers.errors import RecordsDelayed, RecordsUnavailable
from workers.protocol import ProblemSpec, Records, RunSpec, WarmStartValues

CACHED_SAMPLES = 1_000_000
"""Samples that a job caches, 16 bytes each, in addition to the latest records."""
LOAD_SECONDS = 2.0
"""How long the dispatcher waits for recordings; then it goes on, and asks again soon."""
ASK_SECONDS = 0.3
RETRY_SECONDS = 5.0
"""Pause before an object store is asked again that did not answer."""


class DataKey(NamedTuple):
    """Datasets, and the channels of the model's signals."""

    datasets: tuple[str, ...]
    channels: SignalChannels


class SharedParts(NamedTuple):
    """What is equal in the runs of a sweep that differ only in `_OWN_PATHS`.

    `problem` has no noise. `warm_start` is what the runs name: none, a run, or the previous one.
    """

    problem: ProblemSpec
    algorithm: GeneticAlgorithm
    options: RunOptions
    warm_start: str | None

    def build_specification(self, cell: Mapping[str, Any], warm: WarmStartValues = ()) -> RunSpec:
        """Build the specification of one of these runs, with its warm start."""
        options, noise = self.options, self.options.noise or Noise()
        sigma, seed = cell.get("/noise/sigma", noise.sigma), cell.get("/noise/seed", noise.seed)
        return RunSpec(
            self.problem.replace_noise(replace(noise, sigma=float(sigma), seed=seed)),
            self.algorithm,
            cell.get("/seed", options.seed),
            warm,
            posterior=options.posterior,
            compare_orders=options.compare_orders,
        )


_OWN_PATHS = ("/seed", "/noise/seed", "/noise/sigma")
"""Fields that nearly every run has for itself. All else is built once for many runs."""
_MAX_SHARED_PARTS = 256


class JobParts:
    """Specifications and records of the runs of a claimed job, in all its parcels.

    Parameters
    ----------
    keeps_signals : bool
        Whether sweeps store fitted signals, unless the job says otherwise.
    """

    def __init__(
        self, database: Database, job: Job, store: ObjectStore, *, keeps_signals: bool = False
    ) -> None:
        self.job = job
        self.warm = WarmStarts(database, job)
        self.encoder = ResultEncoder(
            "sqlite" if database.is_sqlite else "postgresql",
            keeps_signals=_choose_keeping(job, default=keeps_signals),
            reports_estimates=self.warm.may_wait,
        )
        self._database, self._store = database, store
        self._data: dict[str, DataKey] = {}
        self._loading: dict[str, Future[Records]] = {}
        self._cached_records: OrderedDict[str, Records] = OrderedDict()
        self._groups: list[AxisGroup] | None = None
        self._shared: OrderedDict[str, SharedParts] = OrderedDict()

    def build_cells(self, numbers: range) -> list[NewRun]:
        """Build the rows of runs of the sweep that do not exist yet."""
        if self._groups is None:
            self._groups = read_axis_groups(self.job.spec)
        cells = build_stored_cells(self.job.spec, self._groups, numbers.start)
        return list(islice(cells, len(numbers)))

    def share_parts(self, cell: Mapping[str, Any]) -> SharedParts:
        """Return the parts of a cell's run that it shares with others, built at the first one.

        Raises
        ------
        SysidError, ServiceError, StorageError
            If its settings are invalid, or its model is missing.
        """
        key = repr([item for item in cell.items() if item[0] not in _OWN_PATHS])
        if key not in self._shared:
            self._shared[key] = self._build_shared_parts(build_run_body(self.job.spec, cell))
            if len(self._shared) > _MAX_SHARED_PARTS:
                self._shared.popitem(last=False)
        return self._shared[key]

    def _build_shared_parts(self, body: Mapping[str, Any]) -> SharedParts:
        model = load_stored_model(body["model"])
        in_sweep = bool(self.job.spec["sweep"]["axes"])
        algorithm, fit, options = read_run_settings(body, in_sweep=in_sweep)
        others = (body["validation"] or {}).get("datasets")
        problem = ProblemSpec(
            model=dict(model.document),
            records=self._register_data(body["datasets"], body, model),
            validation=None if others is None else self._register_data(others, body, model),
            validation_fraction=options.validation_fraction,
            settings=fit,
        )
        return SharedParts(problem, algorithm, options, body["warm_start"])

    def load_records(self, key: str) -> Records:
        """Load the records of that key from the object store, or from the cache.

        Raises
        ------
        RecordsUnavailable
            If a dataset or a channel is missing or invalid.
        RecordsDelayed
            If the object store does not answer, as long as that lasts; or if it takes its time.
        """
        if key not in self._cached_records:
            self._cached_records[key] = self._await_records(key)
            while len(self._cached_records) > 1 and self._count_cached_samples() > CACHED_SAMPLES:
                self._cached_records.popitem(last=False)
        self._cached_records.move_to_end(key)
        return self._cached_records[key]

    def _await_records(self, key: str) -> Records:
        """Wait a little for records that a thread reads: a disk or a network may hang."""
        if key not in self._loading:
            self._loading[key] = loading = Future[Records]()
            work = partial(_set_outcome, loading, partial(self._read_records, key))
            threading.Thread(target=work, name="records", daemon=True).start()
            wait([loading], LOAD_SECONDS)
        loading = self._loading[key]
        if not loading.done():
            raise RecordsDelayed("they are still being read", ASK_SECONDS)
        self._loading.pop(key, None)
        return loading.result()

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
        except ObjectStoreFailed as error:
            raise RecordsDelayed(str(error), RETRY_SECONDS) from error
        except (SysidError, ServiceError, StorageError) as error:
            raise RecordsUnavailable(str(error)) from error

    def _read_datasets(self, datasets: tuple[str, ...]) -> Sequence[Dataset]:
        with self._database.read_session() as session:
            return DatasetRepository(session, self.job.project_id).get_all(datasets)

    def _register_data(self, datasets: list[str], body: Mapping[str, Any], model: Model) -> str:
        channels = map_channels(model, body["channels"], body["hold"])
        data = DataKey(tuple(datasets), channels)
        key = repr(data)
        self._data[key] = data
        return key


def _set_outcome(future: "Future[Records]", work: Callable[[], Records]) -> None:
    try:
        future.set_result(work())
    except BaseException as error:  # noqa: BLE001 - raised by the future
        future.set_exception(error)


def _choose_keeping(job: Job, *, default: bool) -> bool:
    """Choose whether signals are stored: as the job says, else those of a single run."""
    wanted: bool | None = job.spec["keep_signals"]
    return job.n_runs == 1 or default if wanted is None else wanted
