"""Preparation: what is known of records and model before any estimate."""

from collections.abc import Iterator, Sequence

import numpy as np

from sysid.core.findings import Finding, note
from sysid.core.types import FloatArray
from sysid.kernels.signals.past_reads import list_delayed_values
from sysid.models.unit_checks import (
    list_mixed_unit_warnings,
    list_time_unit_warnings,
    list_unread_unit_warnings,
)
from sysid.residuals.onset_delay import find_unprompted_output
from sysid.residuals.past_outputs import reads_outputs
from sysid.residuals.sandwich import MIN_REPEATS, count_repeats
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis


def find_unit_faults(problem: Problem) -> tuple[Finding, ...]:
    """Find units that do not fit together, or that are not read."""
    return problem.share(
        "unit findings",
        lambda: tuple(
            note("units", "record", text)
            for text in (
                *list_mixed_unit_warnings(problem.model, problem.records),
                *list_time_unit_warnings(problem.model),
                *list_unread_unit_warnings(problem.model, problem.records),
            )
        ),
    )


def find_record_events(problem: Problem, explained: Sequence[Finding]) -> Iterator[Finding]:
    """Find what happened to the recordings, unless it is an explanation of the residuals already.

    Each recording was inspected before it was cut into experiments.
    """
    told = {one.explanation for one in explained}
    events = dict.fromkeys(event for record in problem.records for event in record.findings)
    yield from (event for event in events if event.explanation not in told)


def find_early_responses(problem: Problem) -> Iterator[Finding]:
    """Find outputs that leave their rest before any input has moved."""
    if not list_delayed_values(problem.model, "input"):
        return
    spans = {
        one.name: float(np.ptp(values))
        for one in problem.model.outputs
        if (values := _join_outputs(problem, one.name)).size
    }
    for number, record in enumerate(problem.records, 1):
        if unprompted := find_unprompted_output(record, spans):
            where = f" in experiment {number}" if len(problem.records) > 1 else ""
            yield Finding(
                "response before its cause",
                "clocks",
                "caution",
                f"{unprompted[0]} moves before any input",
                f"output {unprompted[0]!r} begins to move at t = {unprompted[1]:.4g} s{where}, "
                "before any input. If the record begins with the step itself, the estimated time "
                "lag is wrong: the input is assumed constant before the record.",
                "Put some rows of the input at rest before the record, or look at the clocks.",
                parameters=(),
            )


def _join_outputs(problem: Problem, name: str) -> FloatArray:
    """Join the measured values (N,) of an output over all records."""
    values = [
        one.values for record in problem.records for one in record.outputs if one.name == name
    ]
    joined = np.concatenate(values)
    return np.asarray(joined[np.isfinite(joined)])


def find_useless_prediction(problem: Problem) -> Iterator[Finding]:
    """Find one-step predictions that are requested of a model that reads no measured output."""
    if problem.prediction == "simulation" or reads_outputs(problem.model):
        return
    names = ", ".join(output.name for output in problem.model.outputs)
    yield note(
        "no prediction",
        "noise",
        f"no output ({names}) is a state by itself, so one-step predictions equal the free run. "
        "To start each step from the measured output, make it a state in the model's document.",
    )


def find_few_repeats(problem: Problem, analysis: Analysis) -> Iterator[Finding]:
    """Find samples of repeats whose spread says too little of the errors."""
    uncertainty, repeats = analysis.uncertainty, count_repeats(problem)
    if not repeats or uncertainty is None or uncertainty.noise_colour == "clustered":
        return
    needed = max(MIN_REPEATS, len(uncertainty.names) + 2)
    cause = (
        f"too few for errors by repeat. Record at least {needed}"
        if repeats < needed
        else "one of which alone tells of a parameter"
    )
    yield note(
        "few repeats",
        "variance",
        f"the samples are pooled from {repeats} repeats, {cause}. The standard errors are those of "
        "one record. They ignore what the samples of a repeat have in common, and may be far off.",
    )
