"""The noise sweep: how far noise on the output moves what is found (Figure 15).

Draws depend on the sweep's seed and the replicate alone. So a run keeps its specification when the
grid of σ or the number of replicates grows, and is taken over then (`service.storage.reuse`).
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service import jobs
from service.checks import JobChecker
from service.conversion import faults_of
from service.errors import FieldError, InvalidRequest
from service.recordings import recording_of
from service.schemas_datasets import SimulateIn
from service.schemas_jobs import JobIn, JobOut
from service.schemas_noise import MOST_REPLICATES, NoiseSweepIn
from service.settings import Settings
from service.simulations import simulate
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from service.storage.tables import Dataset
from service.truth import truth_of
from sysid.errors import SysidError


def submit(
    database: Database, store: ObjectStore, settings: Settings, body: NoiseSweepIn,
    key: str | None = None,
) -> JobOut:  # fmt: skip
    """Queue the sweep as an ordinary job, after simulating its record if need be.

    Raises
    ------
    InvalidRequest
        With every fault that can be known before the job runs, at its place in this body.
    KeyReused
        If the idempotency key was used with another body.
    """
    _check(body, settings)
    datasets = body.datasets or [_simulated(database, store, body)]
    try:
        with database.read() as session:
            job = _job(session, store, body, datasets)
        return jobs.submit_to(database, job, settings, key)
    except InvalidRequest as error:
        raise InvalidRequest(_at_home(one, body) for one in error.errors) from None


def _check(body: NoiseSweepIn, settings: Settings) -> None:
    if "method" in body.algorithm.model_fields_set:
        raise InvalidRequest.at("/algorithm/method", "the sweep takes its methods from 'methods'")
    count = len(body.sigma) * body.replicates * len(body.methods)
    if count > settings.max_runs_per_job:
        raise InvalidRequest.at(
            "/replicates",
            f"{len(body.sigma)} σ × {body.replicates} replicates × {len(body.methods)} methods "
            f"are {count} runs; at most {settings.max_runs_per_job} a job",
        )


def _simulated(database: Database, store: ObjectStore, body: NoiseSweepIn) -> str:
    assert body.truth is not None
    document = {"model": body.model, **body.truth.model_dump()}
    try:
        return simulate(database, store, SimulateIn.model_validate(document)).dataset.id
    except (InvalidRequest, SysidError) as error:
        faults = error.errors if isinstance(error, InvalidRequest) else faults_of(error)
        raise InvalidRequest(
            FieldError(
                one.pointer if one.pointer.startswith("/model") else f"/truth{one.pointer}",
                one.detail, one.column,
            )
            for one in faults
        ) from None  # fmt: skip


def _job(session: Session, store: ObjectStore, body: NoiseSweepIn, datasets: list[str]) -> JobIn:
    together = {
        "range": [body.seed * MOST_REPLICATES, body.seed * MOST_REPLICATES + body.replicates],
        "zip": "replicate",
    }
    job = {"name": "noise sweep", **body.shared, "datasets": datasets}
    sigma = {"path": "/noise/sigma", **_sigmas(session, store, body, JobIn.model_validate(job))}
    axes = [
        sigma, {"path": "/noise/seed", **together}, {"path": "/seed", **together},
        {"path": "/algorithm/method", "values": body.methods},
    ]  # fmt: skip
    return JobIn.model_validate({**job, "sweep": {"axes": axes}})


def _sigmas(session: Session, store: ObjectStore, body: NoiseSweepIn, job: JobIn) -> dict[str, Any]:
    """Values of σ in the output's unit, with the relative ones as labels.

    Where the truth is not known σ = 0 is among them: its best run is what errors are told against.
    """
    checker, document = JobChecker(session), job.normal_form()
    faults = checker.errors(document)
    if faults:
        raise InvalidRequest(faults)
    rows = [one for name in job.datasets if isinstance(one := checker.dataset(name), Dataset)]
    values = list(body.sigma)
    if 0 not in values and truth_of(session, job.model, rows) is None:
        values.insert(0, 0.0)
    if not body.relative:
        return {"values": values}
    unit = _spread(checker, store, document, rows)
    return {
        "values": [unit * one for one in values], "labels": [{"relative": one} for one in values],
    }  # fmt: skip


def _spread(
    checker: JobChecker, store: ObjectStore, document: dict[str, Any], rows: list[Dataset]
) -> float:
    """Standard deviation of the output about its mean in each dataset, over all of them."""
    found = checker.model(document["model"])
    assert isinstance(found, tuple)
    names = [one.name for one in found[0].outputs]
    if len(names) > 1:
        raise InvalidRequest.at(
            "/relative",
            f"the model has the outputs {', '.join(names)}, and σ is one number for all; "
            "give σ in their unit, with relative: false",
        )
    channel = document["channels"].get(names[0], names[0])
    values = [recording_of(store, row.sha256).channel(channel).values for row in rows]
    known = [one[np.isfinite(one)] for one in values]
    centred = np.concatenate([one - np.mean(one) for one in known if one.size])
    spread = float(np.sqrt(np.mean(np.square(centred)))) if centred.size else 0.0
    largest = max(float(np.max(np.abs(one))) for one in known if one.size) if centred.size else 0.0
    if not spread > 1e-12 * largest:
        raise InvalidRequest.at(
            "/relative",
            f"the output {channel!r} does not vary (its standard deviation is {spread:g}), so "
            "that there is nothing σ could be relative to; give σ in its unit",
        )
    return spread


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
