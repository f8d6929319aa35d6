"""Use case of a run's residuals: correlation functions with their bands, and residual tests.

A result stores the verdicts only, so that a sweep of 100,000 runs stays small. The functions are
computed again on request, from the fitted signals and the inputs.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import NotFound, ServiceError
from service.formats.mcap.mcap_files import FittedOutput
from service.jobs.stored_run import StoredRun, load_run
from service.runs.fitted import load_fitted_signals
from service.runs.run_schemas import CorrelationOut, ResidualsOut
from service.storage.objects import ObjectStore
from service.storage.storage_errors import StorageError
from sysid.core.errors import SysidError
from sysid.core.types import FloatArray
from sysid.core.value_documents import encode
from sysid.data.records import Channel
from sysid.residuals.past_outputs import count_past_output_coefficients
from sysid.residuals.residual_tests import (
    TEST_LEVEL,
    CorrelationFunction,
    ResidualSeries,
    ResidualTests,
    compute_correlations,
    judge_tests,
    make_residual_series,
)

JobBody = Mapping[str, Any]


class ResidualAnalysis(NamedTuple):
    """Correlation functions of a run's residuals and their verdict.

    `experiments` are the names of the experiments; `input_note` says which inputs could not be
    read.
    """

    experiments: list[str]
    correlations: list[CorrelationFunction]
    verdict: ResidualTests
    input_note: str


def get_residuals(session: Session, store: ObjectStore, run_id: str) -> ResidualsOut:
    """Compute the correlation functions of a run's residuals.

    Raises
    ------
    NotFound
        If the run has no signals: it has not succeeded, or not yet.
    """
    stored = load_run(session, run_id)
    analysis = analyse_residuals(session, store, stored)
    if analysis is None:
        raise NotFound("residuals of run", run_id, f"; the run is {stored.run.state.value}")
    return ResidualsOut(
        id=run_id,
        data=analysis.verdict.data,
        passed=analysis.verdict.passed,
        level=TEST_LEVEL,
        note=analysis.input_note,
        tests=[_to_correlation_out(function) for function in analysis.correlations],
    )


def analyse_residuals(
    session: Session, store: ObjectStore, stored: StoredRun
) -> ResidualAnalysis | None:
    """Analyse residuals as `get_residuals` does, but return values; None without signals."""
    fits = load_fitted_signals(session, store, stored)
    if fits is None:
        return None
    validation = [fit for fit in fits if fit.role == "validation"]
    inputs, missing = _read_inputs(session, store, stored, bool(validation))
    counts = {} if validation else _count_past_coefficients(session, stored)
    times = {} if stored.result is None else stored.result.correlation_times
    correlations = compute_correlations(
        [
            series._replace(coefficients=counts.get(series.output, 0))
            for series in _build_series(stored.body, validation or list(fits), fits, inputs, times)
        ]
    )
    names = [name for name, _ in groupby(fit.experiment for fit in validation or fits)]
    data = "validation" if validation else "estimation"
    return ResidualAnalysis(names, correlations, judge_tests(correlations, data), missing)  # type: ignore[arg-type]


def _count_past_coefficients(session: Session, stored: StoredRun) -> dict[str, int]:
    """Count each output's coefficients on past outputs, for one-step predictions."""
    if stored.body["prediction"] != "one-step":
        return {}
    return count_past_output_coefficients(stored.model, stored.parameters(session))


def _to_correlation_out(function: CorrelationFunction) -> CorrelationOut:
    document = encode(function)
    return CorrelationOut.model_validate({**document.pop("test"), **document})


def _build_series(
    body: JobBody,
    tested: Sequence[FittedOutput],
    fits: Sequence[FittedOutput],
    inputs: Sequence[tuple[Channel, ...]],
    times: Mapping[str, float],
) -> Iterator[ResidualSeries]:
    """Build the residuals of the tested outputs as the loss uses them, without skipped samples."""
    loss = body["loss"]
    scale = float(loss["scale"]) if loss["kind"] == "soft-l1" else 0.0
    weights = _compute_weights(body, fits)
    before = _count_earlier_samples(body, fits)
    for fit in tested:
        number = fit.number - 1
        first = before.get((fit.number, fit.name), 0)
        scored = np.arange(first, first + fit.times.size) >= body["skip"]
        given = weights[fit.name]
        if not isinstance(given, list):
            weight = given
        elif fit.role == "estimation":
            weight = given[number]
        else:
            weight = float(np.sqrt(np.mean(np.square(given))))
        yield make_residual_series(
            number,
            fit.name,
            fit.times,
            weight * fit.measured,
            weight * fit.simulated,
            scored & np.isfinite(fit.measured),
            inputs[number] if number < len(inputs) else (),
            scale,
            times.get(fit.name, 0.0),
        )


def _count_earlier_samples(
    body: JobBody, fits: Sequence[FittedOutput]
) -> dict[tuple[int, str], int]:
    """Count the samples of a record before its validation part."""
    if (body["validation"] or {}).get("fraction") is None:
        return {}
    return {(f.number, f.name): f.times.size for f in fits if f.role == "estimation"}


def _compute_weights(body: JobBody, fits: Sequence[FittedOutput]) -> dict[str, float | list[float]]:
    """Compute the output weights of the problem. They matter for a loss with a scale."""
    names = {fit.name for fit in fits}
    if len(names) == 1:
        return dict.fromkeys(names, 1.0)
    return {
        name: (body["weights"] or {}).get(name) or _compute_default_weight(body, fits, name)
        for name in names
    }


def _compute_default_weight(body: JobBody, fits: Sequence[FittedOutput], name: str) -> float:
    parts = [
        fit.measured[body["skip"] :]
        for fit in fits
        if fit.name == name and fit.role == "estimation"
    ]
    values: FloatArray = np.concatenate(parts)
    deviation = float(np.std(values[np.isfinite(values)]))
    return 1.0 / deviation if deviation > 0 else 1.0


def _read_inputs(
    session: Session, store: ObjectStore, stored: StoredRun, is_validation: bool
) -> tuple[list[tuple[Channel, ...]], str]:
    """Read the inputs of every tested record, with a note if they cannot be read."""
    validation = stored.body["validation"] or {}
    names = (
        validation["datasets"]
        if is_validation and validation.get("datasets")
        else stored.body["datasets"]
    )
    try:
        return [record.inputs for record in stored.read_datasets(session, store, names)], ""
    except (SysidError, ServiceError, StorageError) as error:
        return [], f"the inputs cannot be read any more, so independence is not tested: {error}"
