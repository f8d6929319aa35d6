"""Export an identified model in a format for other programs."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from sysid.control.linear_form import Covariance, IdentifiedModel, IdentifiedValue
from sysid.core.errors import InvalidSettings, suggest_name
from sysid.data.records import Hold
from sysid.export.c import write_c_source
from sysid.export.description import write_json_source
from sysid.export.observer import Observer, build_observer
from sysid.export.python import write_python_source
from sysid.export.python_control import write_control_source
from sysid.language.evaluation import evaluate_expression
from sysid.models.kalman_filter import is_noise_parameter
from sysid.models.model import Model, name_initial_state
from sysid.models.parse import keep_terms
from sysid.models.starts import replace_starts
from sysid.models.ties import resolve_ties
from sysid.results.identification import Identification
from sysid.simulation.data_bounds import find_signal_units

ExportFormat = Literal["json", "python", "c", "control"]
EXPORT_FORMATS: tuple[ExportFormat, ...] = get_args(ExportFormat)
MAX_PADE_ORDER = 20
_HOLDS: tuple[Hold, ...] = get_args(Hold)

_WRITERS: Mapping[str, Callable[[IdentifiedModel, Observer | None], str]] = {
    "python": write_python_source,
    "c": write_c_source,
}


def export_model(
    model: Model,
    result: Identification | Mapping[str, float],
    format: ExportFormat = "python",
    *,
    sample_time: float | None = None,
    hold: Mapping[str, Hold] | None = None,
    version: str = "",
    provenance: Mapping[str, Any] | None = None,
    pade_order: int = 3,
) -> str:
    """Write an identified model as text.

    Parameters
    ----------
    model : Model
        The model that was identified. Selected terms are taken from the result.
    result : Identification or mapping of str to float
        A result, or every parameter's value, with initial values such as ``x(0)`` if the model
        estimates them. Tied parameters may be left out.
    format : {"json", "python", "c", "control"}
    sample_time : float, optional
        Sampling period of the data in s; a transfer function in z needs it. Default: the one of
        the result.
    hold : mapping of str to {"zero", "first", "band-limited", "mean", "mean-after"}, optional
        Behaviour of inputs between their samples. Default: as in the data of the result, or
        ``first``.
    version, provenance : optional
        Written into the text: version of the program, run, data sets.
    pade_order : int
        Order of the approximation of dead times in format ``control``, 1 to 20.

    Raises
    ------
    InvalidSettings
        If a value is missing or unknown, or an option cannot be used.
    NotLinear
        If the format is ``control`` and the model has no transfer function.

    Examples
    --------
    >>> values = {"K": 3.0, "T": 1.0, "L": 0.5, "y0": 0.0, "x(0)": 0.0}
    >>> "tf(" in export_model(load_model("fopdt"), values, "control")
    True
    """
    holds, units = dict(hold or {}), {}
    if isinstance(result, Identification):
        if model.rule is not None and result.selection:
            model = keep_terms(model, [term.term for term in result.selection])
        model = replace_starts(model, result.initial)
        input_names = {signal.name for signal in model.inputs}
        holds = {**{k: v for k, v in result.holds.items() if k in input_names}, **holds}
        sample_time = result.sample_time if sample_time is None else sample_time
        units = {} if result.data is None else find_signal_units(result.data.records)
    values, covariance = _collect_values(model, result)
    _check_options(model, values, sample_time, holds)
    identified = IdentifiedModel(
        model, values, covariance, sample_time, holds, version, dict(provenance or {}), units
    )
    observer = build_observer(identified, result) if isinstance(result, Identification) else None
    return write_export(identified, format, pade_order, observer)


def write_export(
    identified: IdentifiedModel,
    format: str,
    pade_order: int = 3,
    observer: Observer | None = None,
) -> str:
    """Write an identified model in one of `EXPORT_FORMATS`; programs have an observer too.

    Raises
    ------
    InvalidSettings
        If there is no such format, or the order is out of its range.
    NotLinear
        If the format is ``control`` and the model has no transfer function.
    """
    if format not in EXPORT_FORMATS:
        detail = f"{format!r} is not a format{suggest_name(format, EXPORT_FORMATS)}"
        raise InvalidSettings("/format", detail)
    if not 1 <= pade_order <= MAX_PADE_ORDER:
        raise InvalidSettings(
            "/pade_order", f"{pade_order!r} is not an order from 1 to {MAX_PADE_ORDER}"
        )
    if identified.model.rule is not None:
        raise InvalidSettings("/model/terms", "the terms are not selected yet; there is no model")
    if format == "control":
        return write_control_source(identified, pade_order)
    if format == "json":
        return write_json_source(identified)
    return _WRITERS[format](identified, observer)


def _collect_values(
    model: Model, result: Identification | Mapping[str, float]
) -> tuple[tuple[IdentifiedValue, ...], Covariance | None]:
    if isinstance(result, Identification):
        values = tuple(
            IdentifiedValue(
                estimate.name, estimate.value, estimate.unit, estimate.stderr, estimate.status
            )
            for estimate in result.parameters
            if not is_noise_parameter(estimate.name)
        )
        if result.correlation is None or result.covariance is None:
            return values, None
        names = result.correlation.names
        rows = [i for i, name in enumerate(names) if not is_noise_parameter(name)]
        covariance = result.covariance[np.ix_(rows, rows)]
        return values, Covariance(tuple(names[i] for i in rows), covariance)
    units = {estimate.name: estimate.unit for estimate in model.parameters}
    units |= {name_initial_state(state.name, 0): state.unit for state in model.states}
    numbers = _add_tied_values(model, result)
    return tuple(IdentifiedValue(n, float(v), units.get(n, "1")) for n, v in numbers.items()), None


def _add_tied_values(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """Add the values of tied parameters that are missing."""
    free = [replace(p, tied=None) if p.name in values else p for p in model.parameters]
    for parameter in free:
        if parameter.tied is None and parameter.name not in values:
            raise InvalidSettings(f"/values/{parameter.name}", "a value is missing")
    return {
        **{
            name: evaluate_expression(tie, values)
            for name, tie in resolve_ties(model, free).items()
        },
        **values,
    }


def _check_options(
    model: Model,
    values: tuple[IdentifiedValue, ...],
    sample_time: float | None,
    hold: Mapping[str, Hold],
) -> None:
    _check_values(model, {value.name: value.value for value in values})
    if sample_time is not None and not 0.0 < sample_time < float("inf"):
        raise InvalidSettings("/sample_time", f"{sample_time!r} is not a period in s")
    inputs = [signal.name for signal in model.inputs]
    for name, kind in hold.items():
        if name not in inputs:
            detail = f"the model has no input {name!r}{suggest_name(name, inputs)}"
            raise InvalidSettings(f"/hold/{name}", detail)
        if kind not in _HOLDS:
            raise InvalidSettings(f"/hold/{name}", f"{kind!r} is not one of {', '.join(_HOLDS)}")


def _check_values(model: Model, numbers: Mapping[str, float]) -> None:
    names = [parameter.name for parameter in model.parameters]
    starts = {state.name for state in model.states}
    for name, value in numbers.items():
        if name not in names and name.partition("(0)")[0] not in starts:
            detail = f"the model has no parameter {name!r}{suggest_name(name, names)}"
            raise InvalidSettings(f"/values/{name}", detail)
        if not np.isfinite(value):
            raise InvalidSettings(f"/values/{name}", f"{value!r} is not a finite number")
