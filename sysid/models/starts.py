"""One rule for the starts of all states of a model, instead of those of its document.

A plant that stands still before its record needs no start to be estimated: its states follow from
the first inputs. Any other start is estimated, or taken from the first measured values.
"""

from dataclasses import replace
from typing import Any

from sysid.core.errors import InvalidModel, InvalidSettings
from sysid.core.memo import cache_by_identity
from sysid.core.settings import INITIAL_SETTINGS, InitialSetting
from sysid.language.printer import format_expression
from sysid.models.model import EstimatedInitial, Model
from sysid.models.normal_form import write_starts
from sysid.models.parse import find_measured_states, parse_model
from sysid.models.rest import NoRestError, solve_standstill
from sysid.models.sections import AUTO, OPEN_START, STEADY, get_interval


@cache_by_identity
def replace_starts(model: Model, initial: InitialSetting | None) -> Model:
    """Return a model whose states start by one rule; ``auto`` and None leave the document's.

    Parameters
    ----------
    initial : {"rest", "free", "measured", "auto"} or None
        ``rest``: the states stand still under the first inputs. An integrator may do so at any
        level, which keeps the start that it has. ``free``: starts are estimated, within their
        bounds or those of the data. ``measured``: measured states start at their first values, and
        the others as before.

    Raises
    ------
    InvalidSettings
        If the rule has no meaning for this model.
    """
    if initial is None or initial == AUTO:
        return model
    starts = _write_free(model) if initial == "free" else dict(write_starts(model))
    if initial == "rest":
        starts |= _solve_rest(model)
    elif initial == "measured":
        starts |= dict.fromkeys(_list_measured(model), "measured")
    try:
        started = parse_model({**model.document, "initial": starts})
    except InvalidModel as error:
        raise _refuse(initial, model, error.faults[0].detail) from None
    return replace(model, initial=started.initial, document=started.document)


def compares_starts(model: Model, initial: InitialSetting | None) -> bool:
    """Whether the data decide where the states start: by the setting, else by the document."""
    return (model.document["initial"] if initial is None else initial) == AUTO


def _write_free(model: Model) -> dict[str, object]:
    """Write estimated starts; those that are not estimated yet have bounds of the data."""
    initial = (
        start if isinstance(start, EstimatedInitial) else OPEN_START for start in model.initial
    )
    return write_starts(replace(model, initial=tuple(initial)))


def _solve_rest(model: Model) -> dict[str, Any]:
    if model.histories:
        detail = f"/history says what {model.histories[0].state!r} did before the start"
        raise _refuse("rest", model, detail)
    names = [state.name for state in model.states]
    try:
        solved = solve_standstill(
            dict(zip(names, model.equations, strict=True)),
            {parameter.name: get_interval(parameter) for parameter in model.parameters},
            is_rate=model.form == "differential",
        )
    except NoRestError as error:
        raise _refuse("rest", model, str(error)) from None
    if len(solved) == len(names):
        return dict.fromkeys(names, STEADY)
    return {name: format_expression(tree) for name, tree in solved.items()}


def _list_measured(model: Model) -> list[str]:
    names = [state.name for state in model.states]
    measured = find_measured_states(
        names, model.equations, model.outputs, is_rate=model.form == "differential"
    )
    if not measured:
        raise _refuse("measured", model, "no output is a state by itself")
    return sorted(measured, key=names.index)


def _refuse(initial: str, model: Model, reason: str) -> InvalidSettings:
    others = ", ".join(kind for kind in INITIAL_SETTINGS if kind != initial)
    return InvalidSettings(
        "/initial", f"{initial!r} has no meaning for model {model.name!r}: {reason}. Use {others}"
    )
