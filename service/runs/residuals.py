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
from service.formats.mcap import FittedOutput
from service.jobs.stored_run import StoredRun, load_run
from service.runs.fitted import fits_of
from service.runs.result import test_document
from service.runs.schemas import CorrelationOut, ResidualsOut
from service.storage.errors import StorageError
from service.storage.objects import ObjectStore
from sysid.core.errors import SysidError
from sysid.core.types import FloatArray
from sysid.data.records import Channel
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
    stored = load_run(session, run_id)
    tested = residuals_of(session, store, stored)
    if tested is None:
        raise NotFound("residuals of run", run_id, f"; the run is {stored.run.state.value}")
    return ResidualsOut(
        id=run_id, data=tested.verdict.data, passed=tested.verdict.passed, level=LEVEL,
        note=tested.missing, tests=[_out(one) for one in tested.found],
    )  # fmt: skip


def residuals_of(session: Session, store: ObjectStore, stored: StoredRun) -> Tested | None:
    """The same as values; None as long as no signals are stored."""
    if stored.run.signals_sha256 is None:
        return None
    fits = fits_of(store, stored.run)
    kept = [fit for fit in fits if fit.role == "validation"]
    inputs, missing = _inputs(session, store, stored, bool(kept))
    counts = {} if kept else _coefficients(session, stored)
    times = stored.result.get("correlation_times") or {}
    found = correlations(
        [
            one._replace(coefficients=counts.get(one.output, 0))
            for one in _series(stored.body, kept or list(fits), fits, inputs, times)
        ]
    )
    names = [name for name, _ in groupby(fit.experiment for fit in kept or fits)]
    data = "validation" if kept else "estimation"
    return Tested(names, found, verdict(found, data), missing)  # type: ignore[arg-type]


def _coefficients(session: Session, stored: StoredRun) -> dict[str, int]:
    """Of each output, the coefficients on past outputs of a prediction one step ahead."""
    if stored.body["prediction"] != "one-step":
        return {}
    return coefficients_on_past_outputs(stored.model, stored.parameters(session))


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
        number = fit.number - 1
        first = before.get((fit.number, fit.name), 0)
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
    return {(f.number, f.name): f.times.size for f in fits if f.role == "estimation"}


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
        if fit.name == name and fit.role == "estimation"
    ]
    values: FloatArray = np.concatenate(parts)
    deviation = float(np.std(values[np.isfinite(values)]))
    return 1.0 / deviation if deviation > 0 else 1.0


def _inputs(
    session: Session, store: ObjectStore, stored: StoredRun, is_validation: bool
) -> tuple[list[tuple[Channel, ...]], str]:
    """Inputs of every tested record, and a note if they are not to be had any more."""
    kept = stored.body["validation"] or {}
    names = kept["datasets"] if is_validation and kept.get("datasets") else stored.body["datasets"]
    try:
        return [record.inputs for record in stored.read_datasets(session, store, names)], ""
    except (SysidError, ServiceError, StorageError) as error:
        return [], f"the inputs are not to be had any more, so independence is not tested: {error}"
