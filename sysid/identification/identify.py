"""Identify a model from records, in this process."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from sysid.core.distributions import load_in_background
from sysid.core.settings import FitSettings, GeneticAlgorithm, Loss
from sysid.core.text import rewrite_settings
from sysid.data.records import Record
from sysid.identification.conclude import conclude_run
from sysid.identification.fit_problems import build_problems, prepare_records
from sysid.identification.fitted_data import collect_fitted_data
from sysid.identification.identify_arguments import (
    Data,
    ReadRecords,
    check_warm,
    read_changes,
    read_records,
    write_setting,
)
from sysid.identification.options import RunOptions
from sysid.identification.request import IdentificationRequest, accept_fields
from sysid.identification.run import advance_run, begin_run, is_finished
from sysid.islands.run_state import RunState
from sysid.judgement.agreement import find_constant_outputs
from sysid.judgement.conclusions import add_reading_notes, list_warnings
from sysid.models.catalogue.load import resolve_model
from sysid.models.model import Model
from sysid.models.model_delays import check_unused_settings
from sysid.models.unit_checks import check_signal_units
from sysid.results.identification import Identification

_PROGRESS_SECONDS = 0.25


@accept_fields(IdentificationRequest)
def identify(request: IdentificationRequest) -> Identification:
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
    hold : mapping of str to {"auto", "zero", "first", "band-limited", "mean", "mean-after"}
        How an input is read between its samples: ``{"u": "first"}`` as straight lines, ``"zero"``
        held, ``"mean"`` as the mean of the period that ends at its time. Outputs may be means too:
        ``{"y": "mean"}``. Default: as the channel says, else by its values. It holds for
        `validation` too.
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
    initial : {"rest", "free", "measured", "auto"}
        Where the states start: at rest under the first inputs, at estimated or at measured values.
        ``"auto"`` compares them by the data. Default: as the model's document says, which is
        ``auto`` for processes with dead time.
    commands : sequence of str
        Inputs that a controller computes from the outputs: ``["u"]``. They are read held, and noise
        inside the plant is looked for. Default: the data tell. ``[]``: there is no controller.
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
    """  # noqa: DOC102 - the decorator gives the function these parameters
    model = resolve_model(request.model)
    read = _read_data(model, request, request.records)
    loss = request.loss or Loss()
    changes = read_changes(request.parameters)
    result = identify_records(
        model,
        read.records,
        request.settings or GeneticAlgorithm(),
        FitSettings(
            changes,
            request.prediction,
            loss,
            request.weights,
            request.skip,
            request.initial,
            commands=None if request.commands is None else tuple(request.commands),
        ),
        request,
        validation=(
            None
            if request.validation is None
            else _read_data(model, request, request.validation).records
        ),
        progress=request.progress,
    )
    assert result.data is not None
    warnings = tuple(rewrite_settings(note, write_setting) for note in result.warnings)
    data = replace(result.data, channels=read.channels)
    return add_reading_notes(replace(result, warnings=warnings, data=data), read.notes)


def _read_data(
    model: Model, request: IdentificationRequest, data: Data | Sequence[Data]
) -> ReadRecords:
    return read_records(model, data, request.channels, request.hold)


def identify_records(
    model: Model,
    records: Sequence[Record],
    algorithm: GeneticAlgorithm,
    fit: FitSettings,
    options: RunOptions,
    *,
    validation: Sequence[Record] | None = None,
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
    prepared = prepare_records(
        model, records, validation, options.validation_fraction, options.noise
    )
    problem, validation_problem = problems = build_problems(model, prepared, fit)
    check_warm(options.warm, [parameter.name for parameter in problem.all_parameters])
    if tell is not None:
        tell(list_warnings(list(find_constant_outputs(problem))))
    load_in_background()  # the conclusion needs them
    state = begin_run(problem, algorithm, options.seed, options.warm)
    while not is_finished(algorithm, state):
        state = advance_run(problem, algorithm, state, _PROGRESS_SECONDS)
        if progress is not None:
            progress(state)
    result = conclude_run(
        problem,
        algorithm,
        state,
        validation_problem,
        posterior=options.posterior,
        orders=options.compare_orders,
    )
    return replace(result, data=collect_fitted_data(model, prepared, problems, result))
