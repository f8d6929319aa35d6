"""Identify a model from records, in this process."""

from __future__ import annotations  # the help of `identify` shows `Data`, not all that it is

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from sysid.core.distributions import load_in_background
from sysid.core.settings import FitSettings, GeneticAlgorithm, Loss, PredictionKind, Weights
from sysid.core.text import rewrite_settings
from sysid.data.holds import HoldSetting
from sysid.data.noise import Noise
from sysid.data.records import Record
from sysid.diagnosis.warnings import warn_constant_outputs
from sysid.identification.arguments import (
    Change,
    Data,
    check_kinds,
    check_warm,
    read_changes,
    read_records,
    write_setting,
)
from sysid.identification.conclude import conclude_run
from sysid.identification.fit_problems import build_problems, prepare_records
from sysid.identification.fitted_data import collect_fitted_data
from sysid.identification.run import advance_run, begin_run, is_finished
from sysid.islands.state import RunState
from sysid.models.catalogue.load import ModelSource, resolve_model
from sysid.models.delays import check_unused_settings
from sysid.models.model import Model
from sysid.models.units import check_signal_units
from sysid.results.identification import Identification
from sysid.simulation.problem import Problem

_PROGRESS_SECONDS = 0.25


def identify(
    model: ModelSource,
    records: Data | Sequence[Data],
    settings: GeneticAlgorithm | None = None,
    *,
    channels: Mapping[str, str] | None = None,
    hold: Mapping[str, HoldSetting] | None = None,
    seed: int = 1,
    parameters: Mapping[str, Change] | None = None,
    prediction: PredictionKind = "simulation",
    loss: Loss | None = None,
    weights: Weights | None = None,
    skip: int = 0,
    validation: Data | Sequence[Data] | None = None,
    validation_fraction: float | None = None,
    noise: Noise | None = None,
    warm: Mapping[str, float] | None = None,
    posterior: bool = False,
    compare_orders: bool = True,
    progress: Callable[[RunState], None] | None = None,
) -> Identification:
    """Estimate the free parameters of a model, including its unknown time lags.

    The result has each estimate with its standard error, its unit and a status, tests of the
    residuals, and warnings. It shows itself as a table.

    Parameters
    ----------
    model : Model, str, Path or mapping
        A name of the catalogue such as ``"fopdt"``, a YAML or JSON file, a document, or a model.
    records : Record, Recording, table, or sequence of them
        Experiments that are fitted jointly. A table is one of pandas, xarray or polars, or a
        mapping of lists, with its time as index or in a column ``t`` or ``time``.
    settings : GeneticAlgorithm
        Settings of the search. Default: the improved genetic algorithm.
    channels : mapping of str to str
        Channel of each signal of the model: ``{"u": "P1"}``. A signal that is not given takes the
        channel of its name, then one of a usual name such as ``output`` or ``PV``. If as many
        channels are left as signals, their order decides, inputs first. A warning of the result
        says so.
    hold : mapping of str to {"auto", "zero", "first", "band-limited"}
        How an input is read between its samples: ``{"u": "first"}`` as straight lines, ``"zero"``
        held. Default: as its channel says, else by its values. It holds for `validation` too.
    seed : int
        The same seed gives the same result, bit for bit.
    parameters : mapping
        Changes by parameter: its bounds ``{"L": (0, 2)}``, a fixed value ``{"K": 1.5}``, or fields
        ``{"T": {"upper": 2, "scale": "log"}}`` (lower, upper, scale, fixed, tied).
    prediction : {"simulation", "one-step"}
        What is compared with the outputs: the model driven by the inputs alone, or its
        predictions one sample ahead.
    loss : Loss
        Squares by default. ``Loss("soft-l1")`` for data with outliers; also the noise model.
    weights : mapping of str to float or list of float
        Weight of each output, or one for each experiment: ``{"y": [1, 0.1]}``. By default each
        residual counts by the variance that the noise has in its output and its experiment.
    skip : int
        Number of first samples of each output that are not compared.
    validation : Record, Recording, table, or sequence of them
        Data that are not used for the estimate.
    validation_fraction : float
        Instead of `validation`: the last part of each record. Simulation covers the whole record.
    noise : Noise
        Added to the outputs of `records` before fitting, to study its effect.
    warm : mapping of str to float
        Values that a part of the population starts from.
    posterior : bool
        Whether to sample the posterior of the free parameters.
    compare_orders : bool
        Whether to fit a process with dead time with one order more and one less, too. It takes
        milliseconds; `Identification.order_comparison` has the answer.
    progress : callable
        Receives the run's state several times a second.

    Returns
    -------
    Identification
        Estimates with their errors and statuses, and the evidence; `Identification.plot` draws it.

    Raises
    ------
    DivergedEverywhere
        If no candidate gave a finite simulation.
    UnknownModel, InvalidModel
        If the model cannot be found or has faults.
    InvalidRecord, RecordTooShort, InvalidSettings, InvalidBounds
        If an argument cannot be used.

    Notes
    -----
    If the terms of a polynomial are to be selected, they are selected on the records first.

    Examples
    --------
    A step of 2 % at 1 s; the answer follows 0.5 s later with a time constant of 1 s.

    >>> t = [0.1 * k for k in range(100)]
    >>> u = [2.0 if time >= 1 else 0.0 for time in t]
    >>> y = [3 * (1 - 2.718281828 ** -(time - 1.5)) if time > 1.5 else 0.0 for time in t]
    >>> found = identify("fopdt", {"t": t, "u": u, "y": y})
    >>> round(found["L"].value, 2)
    0.5
    """
    check_kinds(
        {
            "settings": settings,
            "loss": loss,
            "noise": noise,
            "seed": seed,
            "skip": skip,
            "weights": weights,
            "warm": warm,
            "validation_fraction": validation_fraction,
            "posterior": posterior,
            "compare_orders": compare_orders,
            "progress": progress,
        }
    )
    algorithm = settings or GeneticAlgorithm()
    model = resolve_model(model)
    read = read_records(model, records, channels, hold)
    found = identify_records(
        model,
        read.records,
        algorithm,
        FitSettings(read_changes(parameters), prediction, loss or Loss(), weights, skip),
        seed=seed,
        validation=(
            None if validation is None else read_records(model, validation, channels, hold).records
        ),
        validation_fraction=validation_fraction,
        noise=noise,
        warm=warm,
        posterior=posterior,
        compare_orders=compare_orders,
        progress=progress,
    )
    assert found.data is not None
    notes = (rewrite_settings(note, write_setting) for note in found.warnings)
    data = replace(found.data, channels=read.channels)
    return replace(found, warnings=(*read.notes, *notes), data=data)


def identify_records(
    model: Model,
    records: Sequence[Record],
    algorithm: GeneticAlgorithm,
    fit: FitSettings,
    *,
    seed: int,
    validation: Sequence[Record] | None = None,
    validation_fraction: float | None = None,
    noise: Noise | None = None,
    warm: Mapping[str, float] | None = None,
    posterior: bool = False,
    compare_orders: bool = True,
    progress: Callable[[RunState], None] | None = None,
    tell: Callable[[Sequence[str]], None] | None = None,
) -> Identification:
    """Estimate the parameters of a model from its records; see `identify`.

    Warnings name settings as a job does: ``hold: {u: first}``.

    Parameters
    ----------
    tell : callable
        Receives, before the search, those warnings of the result that do not depend on it.
    """
    check_unused_settings(model, len(records), fit.parameters, fit.weights)
    check_signal_units(model, (*records, *(validation or ())))
    prepared = prepare_records(records, validation, validation_fraction, noise)
    problem, validation_problem = problems = build_problems(model, prepared, fit)
    check_warm(warm, [parameter.name for parameter in problem.all_parameters])
    if tell is not None:
        tell(warn_constant_outputs(problem))
    load_in_background()  # the conclusion needs them
    found = conclude_run(
        problem,
        algorithm,
        _run_search(problem, algorithm, seed, warm, progress),
        validation_problem,
        posterior=posterior,
        orders=compare_orders,
    )
    return replace(found, data=collect_fitted_data(model, prepared, problems, found))


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
