"""The noise sweep: how far noise on the output moves what is found (Figure 15).

Draws depend on the sweep's seed and the replicate alone. So a run keeps its specification when the
grid of σ or the number of replicates grows, and is taken over then (`service.queue.reuse`).
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest, faults_of
from service.core.settings import Settings
from service.datasets.schemas import SimulateIn
from service.datasets.simulated import Simulated, simulated
from service.jobs import submit as jobs
from service.jobs.checks import JobChecker, fault_in_job
from service.jobs.schemas import JobIn, JobOut
from service.repositories.jobs import JobRepository
from service.storage.errors import KeyReused
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from service.storage.tables import Dataset
from service.sweeps.output_spread import relative_faults, spread
from service.sweeps.schemas import MOST_REPLICATES, NoiseSweepIn
from service.sweeps.true_parameters import truth_of
from sysid.core.errors import InvalidModel, SysidError, UnknownModel

UNSTORED = "the simulated record"
"""Stands for its identifier until it has one."""


class _Source(NamedTuple):
    """Where the record comes from: stored datasets, or a simulation that is not stored yet.

    `faults`: why there is no record, if it could not be simulated.
    """

    datasets: list[str]
    made: Simulated | None = None
    faults: tuple[FieldError, ...] = ()

    @property
    def is_missing(self) -> bool:
        return self.made is None and self.datasets == [UNSTORED]

    @property
    def unstored(self) -> list[Dataset]:
        return [] if self.made is None else [self.made.row(UNSTORED)]


class _Plain(NamedTuple):
    """The job without its axes, the values of σ as they were given, and the output they are of."""

    job: dict[str, Any]
    values: list[float]
    rows: list[Dataset]
    channel: str


def submit(
    database: Database, store: ObjectStore, settings: Settings, body: NoiseSweepIn,
    key: str | None = None,
) -> JobOut:  # fmt: skip
    """Queue the sweep as an ordinary job, after simulating its record if need be.

    All is checked before the record is stored: a body that is refused leaves nothing behind.

    Raises
    ------
    InvalidRequest
        With every fault that can be known before the job runs, at its place in this body.
    KeyReused
        If the idempotency key was used with another body.
    """
    source = _source(database, store, body)
    try:
        with database.read() as session:
            plain = _plain(session, body, source, settings.max_runs_per_job)
        job = _job(store, body, plain, source)
        if source.made is not None:
            with database.read() as session:
                jobs.check(session, job, settings, source.unstored)
                if key is not None and JobRepository(session).is_used(key):
                    raise KeyReused(key)  # with the same body the record would be stored
            stored = source.made.keep(database, store).dataset.id
            job = job.model_copy(update={"datasets": [stored]})
        return jobs.submit_to(database, job, settings, key)
    except InvalidRequest as error:
        raise InvalidRequest(_at_home(one, body) for one in error.errors) from None


def _grid_faults(body: NoiseSweepIn, most_runs: int) -> Iterator[FieldError]:
    if "method" in body.algorithm.model_fields_set:
        yield FieldError("/algorithm/method", "the sweep takes its methods from 'methods'")
    count = len(body.sigma) * body.replicates * len(body.methods)
    if count > most_runs:
        yield FieldError(
            "/replicates",
            f"{len(body.sigma)} σ × {body.replicates} replicates × {len(body.methods)} methods "
            f"are {count} runs; at most {most_runs} a job",
        )


def _source(database: Database, store: ObjectStore, body: NoiseSweepIn) -> _Source:
    if body.truth is None:
        return _Source(list(body.datasets or ()))
    document = {"model": body.model, **body.truth.model_dump()}
    try:
        found = simulated(database, store, SimulateIn.model_validate(document))
    except (InvalidModel, UnknownModel) as error:
        of_model = (fault_in_job(body.model, one) for one in faults_of(error))
        return _Source([UNSTORED], faults=tuple(of_model))
    except (InvalidRequest, SysidError) as error:
        faults = error.errors if isinstance(error, InvalidRequest) else faults_of(error)
        at_home = (FieldError(f"/truth{one.pointer}", one.detail, one.column) for one in faults)
        return _Source([UNSTORED], faults=tuple(at_home))
    if isinstance(found, Simulated):
        return _Source([UNSTORED], found)
    return _Source([found.dataset.id])


def _plain(session: Session, body: NoiseSweepIn, source: _Source, most_runs: int) -> _Plain:
    """What is known without the samples, of a body without faults.

    Where the truth is not known σ = 0 is among the values: its best run is what errors are told
    against.
    """
    fields = {"name": "noise sweep", **body.shared, "datasets": source.datasets}
    job = JobIn.model_validate(fields)
    checker = JobChecker(session, source.unstored)
    faults = [*_grid_faults(body, most_runs), *source.faults]
    faults += (
        one
        for one in checker.errors(job.normal_form())
        if not (source.is_missing and one.pointer.startswith("/datasets"))
    )
    rows = [one for name in job.datasets if isinstance(one := checker.dataset(name), Dataset)]
    model = checker.model(job.model)
    if body.relative and not isinstance(model, list):
        faults += relative_faults(model[0], rows)
    if faults or isinstance(model, list):
        raise InvalidRequest(dict.fromkeys(faults))
    values = list(body.sigma)
    if 0 not in values and truth_of(session, job.model, rows) is None:
        values.insert(0, 0.0)
    output = model[0].outputs[0].name
    return _Plain(fields, values, rows, job.channels.get(output, output))


def _job(store: ObjectStore, body: NoiseSweepIn, plain: _Plain, source: _Source) -> JobIn:
    """The whole job; where σ is relative, with the values in the output's unit and labels."""
    sigma: dict[str, Any] = {"path": "/noise/sigma", "values": plain.values}
    if body.relative:
        made = None if source.made is None else source.made.recording
        unit = spread(store, plain.rows, plain.channel, made)
        sigma["values"] = [unit * one for one in plain.values]
        sigma["labels"] = [{"relative": one} for one in plain.values]
    together = {
        "range": [body.seed * MOST_REPLICATES, body.seed * MOST_REPLICATES + body.replicates],
        "zip": "replicate",
    }
    axes = [
        sigma, {"path": "/noise/seed", **together}, {"path": "/seed", **together},
        {"path": "/algorithm/method", "values": body.methods},
    ]  # fmt: skip
    return JobIn.model_validate({**plain.job, "sweep": {"axes": axes}})


def _at_home(error: FieldError, body: NoiseSweepIn) -> FieldError:
    """The fault of the job at the place of this body that it comes from."""
    for theirs, ours in _places(body):
        if error.pointer.startswith(theirs):
            return FieldError(ours + error.pointer.removeprefix(theirs), error.detail, error.column)
    return error


def _places(body: NoiseSweepIn) -> Iterator[tuple[str, str]]:
    yield "/sweep/axes/0/values", "/sigma"
    yield "/sweep/axes/0", "/sigma"
    yield "/sweep/axes/3/values", "/methods"
    if body.truth is not None:
        yield "/datasets/0", "/truth"
