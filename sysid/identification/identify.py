"""Identify a model from records, in this process."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sysid.core.settings import FitSettings, GeneticAlgorithm, Loss, PredictionKind
from sysid.data.noise import Noise
from sysid.data.records import Record
from sysid.identification.conclude import conclude_run
from sysid.identification.fit_problems import build_problems, prepare_records
from sysid.identification.result import Identification
from sysid.identification.run import advance_run, begin_run, is_finished
from sysid.islands.state import RunState
from sysid.models.delays import check_unused_settings
from sysid.models.model import Model
from sysid.models.units import check_signal_units
from sysid.simulation.problem import Problem

_PROGRESS_SECONDS = 0.25


def identify(
    model: Model,
    records: Record | Sequence[Record],
    settings: GeneticAlgorithm | None = None,
    *,
    seed: int = 1,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
    prediction: PredictionKind = "simulation",
    loss: Loss | None = None,
    weights: Mapping[str, float] | None = None,
    skip: int = 0,
    validation: Record | Sequence[Record] | None = None,
    validation_fraction: float | None = None,
    noise: Noise | None = None,
    warm: Mapping[str, float] | None = None,
    posterior: bool = False,
    progress: Callable[[RunState], None] | None = None,
) -> Identification:
    """Estimate the free parameters of a model, including its unknown time lags.

    If the terms of a polynomial are to be selected, they are selected on the records first.

    Parameters
    ----------
    records : Record or sequence of Record
        Experiments that are fitted jointly.
    settings : GeneticAlgorithm
        The improved algorithm with its defaults if not given.
    seed : int
        The same seed gives the same result, bit for bit.
    parameters, prediction, loss, weights, skip
        See `sysid.core.settings.FitSettings`.
    validation : Record or sequence of Record
        Data that are not used for the estimate.
    validation_fraction : float
        Instead of `validation`: the last part of each record. Simulation covers the whole record.
    noise : Noise
        Added to the outputs of `records` before fitting.
    warm : mapping of str to float
        Values that a part of the population starts from.
    posterior : bool
        Whether to sample the posterior of the free parameters.
    progress : callable
        Receives the run's state several times a second.

    Raises
    ------
    DivergedEverywhere
        If no candidate gave a finite simulation.
    InvalidRecord, RecordTooShort, InvalidSettings, InvalidBounds
        If an argument cannot be used.
    """
    algorithm = settings or GeneticAlgorithm()
    whole, validation_records = (
        _to_records(records),
        None if validation is None else _to_records(validation),
    )
    check_unused_settings(model, len(whole), parameters, weights)
    check_signal_units(model, (*whole, *(validation_records or ())))
    fit = FitSettings(parameters or {}, prediction, loss or Loss(), weights, skip)
    prepared = prepare_records(whole, validation_records, validation_fraction, noise)
    problem, validation_problem = build_problems(model, prepared, fit)
    return conclude_run(
        problem,
        algorithm,
        _run_search(problem, algorithm, seed, warm, progress),
        validation_problem,
        posterior=posterior,
    )


def _run_search(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    seed: int,
    warm: Mapping[str, float] | None,
    progress: Callable[[RunState], None] | None,
) -> RunState:
    state = begin_run(problem, algorithm, seed, warm)
    while not is_finished(algorithm, state):
        state = advance_run(problem, algorithm, state, _PROGRESS_SECONDS)
        if progress is not None:
            progress(state)
    return state


def _to_records(records: Record | Sequence[Record]) -> tuple[Record, ...]:
    return (records,) if isinstance(records, Record) else tuple(records)
