"""The library call: from a model and records to an identification, in this process."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm, Loss, Prediction
from sysid.data.noise import Noise, with_noise
from sysid.data.records import Record
from sysid.data.splitting import split_record, start_of_validation
from sysid.identification.conclude import conclude
from sysid.identification.result import Identification
from sysid.identification.run import advance, begin, is_finished
from sysid.islands.state import RunState
from sysid.models.delays import check_used
from sysid.models.model import Model
from sysid.models.units import check_units
from sysid.selection.select import selected
from sysid.simulation.problem import Problem

_PROGRESS_SECONDS = 0.25


def identify(
    model: Model,
    records: Record | Sequence[Record],
    settings: GeneticAlgorithm | None = None,
    *,
    seed: int = 1,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
    prediction: Prediction = "simulation",
    loss: Loss | None = None,
    weights: Mapping[str, float] | None = None,
    skip: int = 0,
    validation: Record | Sequence[Record] | None = None,
    validation_fraction: float | None = None,
    noise: Noise | None = None,
    warm: Mapping[str, float] | None = None,
    progress: Callable[[RunState], None] | None = None,
) -> Identification:
    """Find the free parameters of a model, its unknown lags among them.

    A polynomial whose terms are to be selected first has them selected on the records.

    Parameters
    ----------
    records : Record or sequence of Record
        Experiments that are fitted jointly.
    settings : GeneticAlgorithm
        The improved algorithm with its defaults if not given.
    seed : int
        The same seed gives the same result, bit for bit.
    parameters, prediction, loss, weights, skip
        See `Problem.build`.
    validation : Record or sequence of Record
        Data that are not used for the estimate.
    validation_fraction : float
        Instead of `validation`: the last part of each record, simulated with all before it.
    noise : Noise
        Added to the outputs of `records` before fitting.
    warm : mapping of str to float
        Values that a part of the population begins with.
    progress : callable
        Told the run's state several times a second.

    Raises
    ------
    DivergedEverywhere
        If no candidate gave a finite simulation.
    InvalidRecord, RecordTooShort, InvalidSettings, InvalidBounds
        If an argument cannot be used.
    """
    algorithm = settings or GeneticAlgorithm()
    whole = _checked(model, records, validation, parameters, weights)
    estimation = _estimation(whole, validation_fraction, noise)
    model, parameters = selected(model, estimation, parameters, skip)
    pose = partial(
        Problem.build, model, parameters=parameters, prediction=prediction, loss=loss, skip=skip
    )
    posed = pose(estimation, weights=weights)
    kept, since = _kept(whole, validation, validation_fraction)
    judged = None if kept is None else pose(kept, weights=posed.output_weights, scored_from=since)
    return conclude(posed, algorithm, _searched(posed, algorithm, seed, warm, progress), judged)


def _checked(
    model: Model, records: Record | Sequence[Record], validation: Record | Sequence[Record] | None,
    parameters: Mapping[str, Mapping[str, Any]] | None, weights: Mapping[str, float] | None,
) -> tuple[Record, ...]:  # fmt: skip
    """The records, after a look at the units of all, and at what would have no effect."""
    whole = _several(records)
    check_used(model, len(whole), parameters, weights)
    check_units(model, (*whole, *_several(validation or ())))
    return whole


def _searched(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    seed: int,
    warm: Mapping[str, float] | None,
    progress: Callable[[RunState], None] | None,
) -> RunState:
    state = begin(problem, algorithm, seed, warm)
    while not is_finished(algorithm, state):
        state = advance(problem, algorithm, state, _PROGRESS_SECONDS)
        if progress is not None:
            progress(state)
    return state


def _estimation(
    records: tuple[Record, ...], fraction: float | None, noise: Noise | None
) -> tuple[Record, ...]:
    """Records that the model is fitted to."""
    if fraction is not None:
        records = tuple(split_record(record, fraction)[0] for record in records)
    if noise is None:
        return records
    return tuple(with_noise(record, noise, e) for e, record in enumerate(records))


def _kept(
    whole: tuple[Record, ...], validation: Record | Sequence[Record] | None, fraction: float | None
) -> tuple[tuple[Record, ...] | None, list[float] | None]:
    """Records for validation, and from when on they are scored where only their last part is."""
    if fraction is None:
        return None if validation is None else _several(validation), None
    if validation is not None:
        raise InvalidSettings("/validation", "give either records or a fraction")
    return whole, [start_of_validation(record, fraction) for record in whole]


def _several(records: Record | Sequence[Record]) -> tuple[Record, ...]:
    return (records,) if isinstance(records, Record) else tuple(records)
