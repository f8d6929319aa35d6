"""Noise sweep: effect of noise on the estimates, of outputs or inside the plant (Figure 15).

Draws depend only on the sweep's seed and the replicate. A run therefore keeps its specification if
the grid of σ or the number of replicates grows. Its result is then reused (`service.queue.reuse`).
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest, to_field_errors
from service.core.process.concurrency import ReaderPlaces
from service.core.settings import Settings
from service.datasets.dataset_schemas import SimulateIn
from service.datasets.simulated import SimulatedDataset, simulate_or_find
from service.jobs import submit
from service.jobs.checks import JobChecker, fault_in_job
from service.jobs.job_schemas import JobIn, JobOut
from service.repositories.job_rows import JobRepository
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from service.storage.storage_errors import KeyReused
from service.storage.tables import Dataset
from service.sweeps.output_spread import compute_spread, relative_faults
from service.sweeps.sweep_schemas import MAX_REPLICATES, NoiseSweepIn
from service.sweeps.true_parameters import find_true_parameters
from sysid.core.errors import InvalidModel, SysidError, UnknownModel

UNSTORED_ID = "the simulated record"
"""Placeholder until the simulated record has an identifier."""


class _RecordSource(NamedTuple):
    """Source of the record: stored datasets, or a simulation that is not stored yet.

    `faults` explain why the record could not be simulated.
    """

    datasets: list[str]
    simulated: SimulatedDataset | None = None
    faults: tuple[FieldError, ...] = ()

    @property
    def is_missing(self) -> bool:
        return self.simulated is None and self.datasets == [UNSTORED_ID]

    @property
    def new_rows(self) -> list[Dataset]:
        return [] if self.simulated is None else [self.simulated.to_row(UNSTORED_ID)]


class _SweepBase(NamedTuple):
    """Job without its axes, the requested values of σ, and the output channel they refer to."""

    job: dict[str, Any]
    sigmas: list[float]
    rows: list[Dataset]
    channel: str


def submit_noise_sweep(
    database: Database,
    store: ObjectStore,
    readers: ReaderPlaces,
    settings: Settings,
    body: NoiseSweepIn,
    key: str | None = None,
) -> JobOut:
    """Queue the sweep as an ordinary job. Its record is simulated first if necessary.

    Everything is checked before the record is stored: a refused body leaves nothing behind.

    Raises
    ------
    InvalidRequest
        With every fault that can be known before the job runs, at its place in this body.
    KeyReused
        If the idempotency key was used with another body.
    """
    source = _prepare_source(database, store, readers, body)
    try:
        with database.read_session() as session:
            plain = _build_base(session, body, source, settings.max_runs_per_job)
        job = _build_job(store, body, plain, source)
        if source.simulated is not None:
            with database.read_session() as session:
                submit.check_job(session, job, settings, source.new_rows)
                if key is not None and JobRepository(session).is_key_used(key):
                    raise KeyReused(key)  # with the same body the record would already be stored
            stored = source.simulated.store_dataset(database, store).dataset.id
            job = job.model_copy(update={"datasets": [stored]})
        return submit.submit_job(database, job, settings, key)
    except InvalidRequest as error:
        raise InvalidRequest(_move_fault(fault, body) for fault in error.errors) from None


def _grid_faults(body: NoiseSweepIn, most_runs: int) -> Iterator[FieldError]:
    if "method" in body.algorithm.model_fields_set:
        yield FieldError(
            "/algorithm/method", "the sweep takes its methods from 'methods'. Leave this out"
        )
    count = len(body.sigma) * body.replicates * len(body.methods)
    if count > most_runs:
        yield FieldError(
            "/replicates",
            f"{len(body.sigma)} σ × {body.replicates} replicates × {len(body.methods)} methods "
            f"are {count} runs; a job may have at most {most_runs}",
        )


def _prepare_source(
    database: Database, store: ObjectStore, readers: ReaderPlaces, body: NoiseSweepIn
) -> _RecordSource:
    if body.truth is None:
        return _RecordSource(list(body.datasets or ()))
    document = {"model": body.model, **body.truth.model_dump()}
    try:
        simulation = simulate_or_find(database, store, readers, SimulateIn.model_validate(document))
    except (InvalidModel, UnknownModel) as error:
        of_model = (fault_in_job(body.model, fault) for fault in to_field_errors(error))
        return _RecordSource([UNSTORED_ID], faults=tuple(of_model))
    except (InvalidRequest, SysidError) as error:
        faults = error.errors if isinstance(error, InvalidRequest) else to_field_errors(error)
        at_home = (
            FieldError(f"/truth{fault.pointer}", fault.detail, fault.column) for fault in faults
        )
        return _RecordSource([UNSTORED_ID], faults=tuple(at_home))
    if isinstance(simulation, SimulatedDataset):
        return _RecordSource([UNSTORED_ID], simulation)
    return _RecordSource([simulation.dataset.id])


def _build_base(
    session: Session, body: NoiseSweepIn, source: _RecordSource, most_runs: int
) -> _SweepBase:
    """Build everything that needs no samples, for a body without faults.

    If the true parameters are unknown, σ = 0 is added: errors refer to its best run.
    """
    name = body.name or "noise sweep"
    fields = {**body.job_fields, "name": name, "datasets": source.datasets}
    if body.place == "plant" and body.truth is not None:
        fields["noise"] = {"place": body.place, "parameters": body.truth.parameters}
    job = JobIn.model_validate(fields)
    checker = JobChecker(session, source.new_rows)
    faults = [*_grid_faults(body, most_runs), *source.faults]
    faults += (
        fault
        for fault in checker.find_faults(job.to_normal_form())
        if not (source.is_missing and fault.pointer.startswith(("/datasets", "/noise")))
    )
    rows = [
        dataset
        for name in job.datasets
        if isinstance(dataset := checker.get_dataset(name), Dataset)
    ]
    model = checker.resolve_model(job.model)
    if body.relative and not isinstance(model, list):
        faults += relative_faults(model[0], rows)
    if faults or isinstance(model, list):
        raise InvalidRequest(dict.fromkeys(faults))
    values = list(body.sigma)
    if 0 not in values and find_true_parameters(session, job.model, rows) is None:
        values.insert(0, 0.0)
    output = model[0].outputs[0].name
    return _SweepBase(fields, values, rows, job.channels.get(output, output))


def _build_job(
    store: ObjectStore, body: NoiseSweepIn, plain: _SweepBase, source: _RecordSource
) -> JobIn:
    """Build the whole job. A relative σ is converted and becomes a label."""
    sigma: dict[str, Any] = {"path": "/noise/sigma", "values": plain.sigmas}
    if body.relative:
        recording = None if source.simulated is None else source.simulated.recording
        unit = compute_spread(store, plain.rows, plain.channel, recording)
        sigma["values"] = [unit * sigma_value for sigma_value in plain.sigmas]
        sigma["labels"] = [{"relative": sigma_value} for sigma_value in plain.sigmas]
    together = {
        "range": [body.seed * MAX_REPLICATES, body.seed * MAX_REPLICATES + body.replicates],
        "zip": "replicate",
    }
    axes = [
        sigma,
        {"path": "/noise/seed", **together},
        {"path": "/seed", **together},
        {"path": "/algorithm/method", "values": body.methods},
    ]
    return JobIn.model_validate({**plain.job, "sweep": {"axes": axes}})


def _move_fault(error: FieldError, body: NoiseSweepIn) -> FieldError:
    """Move a fault of the job to its pointer in this body."""
    for job_pointer, pointer in _list_moved_pointers(body):
        if error.pointer.startswith(job_pointer):
            return FieldError(
                pointer + error.pointer.removeprefix(job_pointer), error.detail, error.column
            )
    return error


def _list_moved_pointers(body: NoiseSweepIn) -> Iterator[tuple[str, str]]:
    yield "/sweep/axes/0/values", "/sigma"
    yield "/sweep/axes/0", "/sigma"
    yield "/sweep/axes/3/values", "/methods"
    yield "/noise/place", "/place"
    if body.truth is not None:
        yield "/datasets/0", "/truth"
        yield "/noise/parameters", "/truth/parameters"
