"""Use case of a run's residuals: correlation functions with their bands, and their tests.

A result stores the verdicts only: the functions are computed again from the fitted signals and
the inputs when somebody asks, so that a sweep of 100,000 runs does not carry them.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import NotFound, ServiceError
from service.core.json_pointer import body_of
from service.datasets.recordings import recording_of
from service.formats.mcap import FittedOutput
from service.models.models import model_of_run
from service.repositories.datasets import DatasetRepository
from service.repositories.jobs import JobRepository
from service.repositories.runs import RunRepository
from service.runs.fitted import fits_of
from service.runs.result import test_document
from service.runs.schemas import CorrelationOut, ResidualsOut
from service.storage.errors import StorageError
from service.storage.objects import ObjectStore
from service.storage.tables import Job, Run
from sysid.core.errors import SysidError
from sysid.core.types import FloatArray
from sysid.data.records import Channel
from sysid.models.model import Model
from sysid.models.parameters import override
from sysid.residuals.past_outputs import coefficients_on_past_outputs
from sysid.residuals.residual_tests import (
    LEVEL,
    Correlation,
    ResidualTests,
    Series,
    correlations,
    series,
    verdict,
)

Body = Mapping[str, Any]


class Tested(NamedTuple):
    """Correlation functions of a run's residuals and the verdict on them.

    `names` are those of the experiments; `missing` says which inputs could not be read.
    """

    names: list[str]
    found: list[Correlation]
    verdict: ResidualTests
    missing: str


def residuals(session: Session, store: ObjectStore, run_id: str) -> ResidualsOut:
    """Correlation functions of a run's residuals.

    Raises
    ------
    NotFound
        If the run has no signals: it has not succeeded, or not yet.
    """
    run = RunRepository(session).get(run_id)
    job = JobRepository(session).get(run.job_id)
    tested = residuals_of(session, store, job, run)
    if tested is None:
        raise NotFound("residuals of run", run_id, f"; the run is {run.state.value}")
    return ResidualsOut(
        id=run.id, data=tested.verdict.data, passed=tested.verdict.passed, level=LEVEL,
        note=tested.missing, tests=[_out(one) for one in tested.found],
    )  # fmt: skip


def residuals_of(session: Session, store: ObjectStore, job: Job, run: Run) -> Tested | None:
    """The same as values; None as long as no signals are stored."""
    if run.signals_sha256 is None:
        return None
    body = body_of(job.spec, run.cell)
    fits = fits_of(store, run)
    kept = [fit for fit in fits if fit.experiment.startswith("validation")]
    model = model_of_run(session, run, job)
    inputs, missing = _inputs(session, store, model, body, bool(kept))
    counts = {} if kept else _coefficients(model, body)
    times = (run.result or {}).get("correlation_times") or {}
    found = correlations(
        [
            one._replace(coefficients=counts.get(one.output, 0))
            for one in _series(body, kept or list(fits), fits, inputs, times)
        ]
    )
    names = [name for name, _ in groupby(fit.experiment for fit in kept or fits)]
    data = "validation" if kept else "estimation"
    return Tested(names, found, verdict(found, data), missing)  # type: ignore[arg-type]


def _coefficients(model: Model, body: Body) -> dict[str, int]:
    """Of each output, the coefficients on past outputs of a prediction one step ahead."""
    if body["prediction"] != "one-step":
        return {}
    names = {one.name for one in model.parameters}
    changes = {name: fields for name, fields in body["parameters"].items() if name in names}
    return coefficients_on_past_outputs(model, override(model.parameters, changes))


def _out(one: Correlation) -> CorrelationOut:
    functions = {
        name: getattr(one, name).tolist() for name in ("lags", "values", "band95", "band99")
    }
    return CorrelationOut.model_validate(
        {**test_document(one.test), "period": one.period, **functions}
    )


def _series(
    body: Body, tested: Sequence[FittedOutput], fits: Sequence[FittedOutput],
    inputs: Sequence[tuple[Channel, ...]], times: Mapping[str, float],
) -> Iterator[Series]:  # fmt: skip
    """Residuals of the tested outputs as the loss saw them, less those that were skipped."""
    loss = body["loss"]
    scale = float(loss["scale"]) if loss["kind"] == "soft-l1" else 0.0
    weights = _weights(body, fits)
    before = _earlier(body, fits)
    for fit in tested:
        number = int(fit.experiment.partition(" ")[2]) - 1
        first = before.get((number, fit.name), 0)
        scored = np.arange(first, first + fit.times.size) >= body["skip"]
        weight = weights[fit.name]
        yield series(
            number, fit.name, fit.times, weight * fit.measured, weight * fit.simulated,
            scored & np.isfinite(fit.measured), inputs[number] if number < len(inputs) else (),
            scale, times.get(fit.name, 0.0),
        )  # fmt: skip


def _earlier(body: Body, fits: Sequence[FittedOutput]) -> dict[tuple[int, str], int]:
    """Samples of a record that lie before the part that was kept for validation."""
    if (body["validation"] or {}).get("fraction") is None:
        return {}
    estimation = (fit for fit in fits if fit.experiment.startswith("estimation"))
    return {(int(f.experiment.partition(" ")[2]) - 1, f.name): f.times.size for f in estimation}


def _weights(body: Body, fits: Sequence[FittedOutput]) -> dict[str, float]:
    """Weights of the outputs as the problem had them: they matter to a loss with a scale."""
    names = {fit.name for fit in fits}
    if len(names) == 1:
        return dict.fromkeys(names, 1.0)
    return {name: (body["weights"] or {}).get(name) or _reciprocal(body, fits, name)
            for name in names}  # fmt: skip


def _reciprocal(body: Body, fits: Sequence[FittedOutput], name: str) -> float:
    parts = [
        fit.measured[body["skip"] :]
        for fit in fits
        if fit.name == name and fit.experiment.startswith("estimation")
    ]
    values: FloatArray = np.concatenate(parts)
    deviation = float(np.std(values[np.isfinite(values)]))
    return 1.0 / deviation if deviation > 0 else 1.0


def _inputs(
    session: Session, store: ObjectStore, model: Model, body: Body, is_validation: bool
) -> tuple[list[tuple[Channel, ...]], str]:
    """Inputs of every tested record, and a note if they are not to be had any more."""
    kept = body["validation"] or {}
    names = kept["datasets"] if is_validation and kept.get("datasets") else body["datasets"]
    channels = body["channels"]
    inputs, outputs = (
        {one.name: channels.get(one.name, one.name) for one in kind}
        for kind in (model.inputs, model.outputs)
    )
    holds = {channels.get(name, name): hold for name, hold in body.get("hold", {}).items()}
    try:
        return [
            record.inputs
            for row in DatasetRepository(session).get_all(names)
            for record in recording_of(store, row.sha256)
            .held(holds)
            .records(inputs, outputs, row.name)
        ], ""
    except (SysidError, ServiceError, StorageError) as error:
        return [], f"the inputs are not to be had any more, so independence is not tested: {error}"
