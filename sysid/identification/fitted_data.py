"""Collect what an identification was made from, with the correlation of its residuals."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid.core.settings import FILTERED
from sysid.core.threads import use_one_thread
from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.identification.fit_problems import FitRecords, ProblemPair
from sysid.models.model import Model
from sysid.residuals.past_outputs import count_past_output_coefficients
from sysid.residuals.residual_tests import compute_correlations, list_residual_series
from sysid.results.result import FittedData, FullResult
from sysid.simulation.problem import Problem


def collect_fitted_data(
    model: Model, records: FitRecords, problems: ProblemPair, result: FullResult
) -> FittedData:
    """Collect model and records of a result, and correlate its residuals with both sides' lags."""
    problem, validation_problem = problems
    validation = tuple(
        replace(_select_signals(model, record), inputs=_select_signals(model, run).inputs)
        for record, run in zip(records.validation or (), records.validation_runs or (), strict=True)
    )
    tested, simulated = (
        (problem, result.simulated)
        if validation_problem is None
        else (validation_problem, result.simulated_validation)
    )
    counts = {}
    if result.noise_model in FILTERED or result.commands:
        is_filter = result.noise_model in FILTERED
        loss = replace(problem.loss, noise_model=result.noise_model) if is_filter else problem.loss
        problem = problem.rebuild(loss=loss, commands=result.commands)
    if not problem.is_free_run and validation_problem is None:
        counts = count_past_output_coefficients(problem.model, problem.all_parameters)
    series = list_residual_series(
        tested, _join_outputs(tested, simulated), result.correlation_times
    )
    with use_one_thread():  # more of them spend more time, and change the last bit
        correlations = compute_correlations(
            [one._replace(coefficients=counts.get(one.output, 0)) for one in series]
        )
    return FittedData(
        model,
        tuple(_select_signals(model, record) for record in records.estimation),
        validation,
        records.scored_from is not None,
        tuple(correlations),
        problem.loss.kind,
        problem.prediction,
        {
            name: fields["tied"]
            for name, fields in problem.settings.parameters.items()
            if fields.get("tied") is not None
        },
    )


def _select_signals(model: Model, record: Record) -> Record:
    """Select the signals of a model, in its order."""
    inputs = {channel.name: channel for channel in record.inputs}
    outputs = {channel.name: channel for channel in record.outputs}
    return replace(
        record,
        inputs=tuple(inputs[signal.name] for signal in model.inputs),
        outputs=tuple(outputs[output.name] for output in model.outputs),
    )


def _join_outputs(problem: Problem, simulated: Sequence[Sequence[FloatArray]]) -> FloatArray:
    """Join simulated outputs to values (M,) of a problem; parts that are not scored are missing."""
    values = np.full(problem.evaluator.measured.size, np.nan)
    indices = problem.split_by_output(np.arange(values.size, dtype=np.float64))
    for rows, outputs in zip(indices, simulated, strict=True):
        for row, part in zip(rows.values(), outputs, strict=True):
            values[row[row.size - part.size :].astype(np.int64)] = part
    return values
