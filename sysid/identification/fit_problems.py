"""Build the problem of a fit and that of its validation data from the records."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

from sysid.core.errors import InvalidSettings
from sysid.core.settings import FitSettings
from sysid.data.noise import Noise
from sysid.data.records import Record
from sysid.data.splitting import find_validation_start, split_record
from sysid.models.model import Model
from sysid.selection.select import select_model_terms
from sysid.simulation.problem import Problem
from sysid.simulation.process_noise import add_noise

ProblemPair: TypeAlias = tuple[Problem, Problem | None]
"""A problem, and that of its validation data if there are any."""


class FitRecords(NamedTuple):
    """The records of a fit, by what they are used for.

    Attributes
    ----------
    estimation : tuple of Record
        Records that the model is fitted to, including added noise.
    validation : tuple of Record or None
        Records that are not used for the estimate.
    validation_runs : tuple of Record or None
        Records simulated for validation: whole ones where `validation` is their last part.
    scored_from : tuple of float or None
        Time (s) at which validation begins in each of these. None: they count as a whole.
    """

    estimation: tuple[Record, ...]
    validation: tuple[Record, ...] | None
    validation_runs: tuple[Record, ...] | None
    scored_from: tuple[float, ...] | None


def prepare_records(
    model: Model,
    records: Sequence[Record],
    validation: Sequence[Record] | None = None,
    fraction: float | None = None,
    noise: Noise | None = None,
) -> FitRecords:
    """Split validation data off the records, and add noise to the estimation data.

    Parameters
    ----------
    validation : sequence of Record
        Records that are not used for the estimate.
    fraction : float
        Instead of `validation`: the last part of each record.

    Raises
    ------
    InvalidSettings
        If there are both, or if the fraction leaves a part without samples. Also if the noise has
        no place in the model.
    """
    whole = tuple(records)
    noise = noise or Noise()
    if fraction is None:
        other = None if validation is None else tuple(validation)
        return FitRecords(_add_noise(model, whole, noise), other, other, None)
    if validation is not None:
        raise InvalidSettings("/validation", "give either records or a fraction")
    parts = [split_record(record, fraction) for record in whole]
    starts = tuple(find_validation_start(record, fraction) for record in whole)
    first = tuple(part[0] for part in parts)
    last, runs = (
        tuple(map(_adopt_holds, later, first)) for later in ([part[1] for part in parts], whole)
    )
    return FitRecords(_add_noise(model, first, noise), last, runs, starts)


def build_problems(model: Model, records: FitRecords, settings: FitSettings) -> ProblemPair:
    """Build the problems of estimation and validation, after selection of polynomial terms.

    Both use the output weights of the estimation data.

    Raises
    ------
    InvalidRecord, RecordTooShort, InvalidSettings, InvalidBounds
        If model, records or settings cannot be used.
    """
    model, changes = select_model_terms(
        model, records.estimation, settings.parameters, settings.skip, settings.prediction
    )
    problem = Problem.from_settings(
        model, records.estimation, replace(settings, parameters=changes)
    )
    if records.validation_runs is None:
        return problem, None
    return problem, problem.rebuild(
        records=records.validation_runs,
        weights=problem.output_weights,
        deviations=None,
        scored_from=records.scored_from,
    )


def _adopt_holds(record: Record, estimation: Record) -> Record:
    """Read the inputs as those of the part that the model is fitted to."""
    holds = [channel.effective_hold for channel in estimation.inputs]
    if holds == [channel.effective_hold for channel in record.inputs]:
        return record
    pairs = zip(record.inputs, holds, strict=True)
    return replace(record, inputs=tuple(replace(channel, hold=hold) for channel, hold in pairs))


def _add_noise(model: Model, records: tuple[Record, ...], noise: Noise) -> tuple[Record, ...]:
    return tuple(add_noise(model, record, noise, number) for number, record in enumerate(records))
