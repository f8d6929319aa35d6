"""Collect what an identification was made from, with the correlation of its residuals."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.identification.fit_problems import FitRecords
from sysid.identification.result import FittedData, Identification
from sysid.models.model import Model
from sysid.residuals.fitted_series import FittedSeries, list_fitted_residuals
from sysid.residuals.past_outputs import count_past_output_coefficients
from sysid.residuals.residual_tests import compute_correlations
from sysid.simulation.problem import Problem


def collect_fitted_data(
    model: Model, records: FitRecords, problem: Problem, found: Identification
) -> FittedData:
    """Collect model and records of a result, and correlate its residuals with both sides' lags.

    `problem` is that of the estimation data.
    """
    estimation = tuple(_select_signals(model, record) for record in records.estimation)
    is_part = records.scored_from is not None
    validation = tuple(
        replace(_select_signals(model, record), inputs=_select_signals(model, run).inputs)
        for record, run in zip(records.validation or (), records.validation_runs or (), strict=True)
    )
    if validation:
        before = estimation if is_part else ()
        fits = _list_fits(validation, found.simulated_validation, before)
    else:
        fits = _list_fits(estimation, found.simulated)
    series = list_fitted_residuals(
        fits,
        [record.inputs for record in validation or estimation],
        problem.output_weights,
        problem.settings.skip,
        problem.loss_scale,
        found.correlation_times,
    )
    counts = {}
    if problem.prediction == "one-step" and not validation:
        counts = count_past_output_coefficients(problem.model, problem.all_parameters)
    correlations = compute_correlations(
        [one._replace(coefficients=counts.get(one.output, 0)) for one in series]
    )
    return FittedData(
        model, estimation, validation, is_part, tuple(correlations), problem.loss.kind
    )


def _select_signals(model: Model, record: Record) -> Record:
    """Select the signals of a model, in its order."""
    channels = {channel.name: channel for channel in record.inputs}
    measured = {channel.name: channel for channel in record.outputs}
    return replace(
        record,
        inputs=tuple(channels[signal.name] for signal in model.inputs),
        outputs=tuple(measured[output.name] for output in model.outputs),
    )


def _list_fits(
    records: Sequence[Record],
    simulated: Sequence[Sequence[FloatArray]],
    before: Sequence[Record] = (),
) -> Iterator[FittedSeries]:
    """List measured and simulated outputs; `before` are the first parts of the same records."""
    for number, (record, outputs) in enumerate(zip(records, simulated, strict=True)):
        for place, (channel, values) in enumerate(zip(record.outputs, outputs, strict=True)):
            first = before[number].outputs[place].times.size if before else 0
            yield FittedSeries(number, channel.name, channel.times, channel.values, values, first)
