"""Parameters to identify, with their search intervals."""

import re
from collections.abc import Mapping, Set
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Literal, get_args

from sysid.core.errors import InvalidBounds, InvalidSettings, suggest_name
from sysid.core.units import is_blank_unit

ParameterScale = Literal["linear", "log"]
BoundsRule = Literal["gain", "rate", "offset", "time", "delay", "state"]
BoundSide = Literal["lower", "upper"]
PhysicalBounds = Literal["lower", "upper", "both"]
RATE_UNIT = "1/s"
"""Unit of an integral gain between two signals without units."""

_INITIAL_STATE_NAME = re.compile(r"(\w+)\(0\)(?:\[\d+\])?")


@dataclass(frozen=True, slots=True)
class Parameter:
    """A quantity to identify.

    Attributes
    ----------
    name : str
        Symbol used in equations, reports and stored results.
    lower, upper : float
        Closed search interval, in `unit`.
    unit : str
        Unit symbol; ``"1"`` for a dimensionless quantity.
    scale : {"linear", "log"}
        Spacing of the coded values in the interval; ``"log"`` if it spans decades.
    fixed : float or None
        Fixed value; the parameter is then not searched.
    tied : str or None
        Expression of other parameters, such as ``"2*a"``. The parameter is then not searched, and
        its bounds have no effect.
    bounds : str or None
        What the parameter is, if its bounds follow the data; `lower` and `upper` are then those
        without data.
    physical : {"lower", "upper", "both"} or None
        Bounds that are limits of the quantity by its nature or definition, as 1 of a ratio of the
        smaller to the larger. Without it a bound is one of the search.

    Raises
    ------
    InvalidBounds
        If a bound is not finite, ``lower >= upper``, a log scale starts at or below zero, or
        `fixed` lies outside the bounds.

    Examples
    --------
    >>> Parameter("L", 0.0, 5.0, unit="s").is_free
    True
    """

    name: str
    lower: float
    upper: float
    unit: str = "1"
    scale: ParameterScale = "linear"
    fixed: float | None = None
    tied: str | None = None
    bounds: BoundsRule | None = None
    physical: PhysicalBounds | None = None

    def __post_init__(self) -> None:
        if not (isfinite(self.lower) and isfinite(self.upper) and self.lower < self.upper):
            raise InvalidBounds(self.name, self.lower, self.upper)
        if self.scale == "log" and self.lower <= 0:
            raise InvalidBounds(self.name, self.lower, self.upper, "a log scale needs lower > 0")
        if self.fixed is not None and not self.lower <= self.fixed <= self.upper:
            detail = f"but is fixed at {self.fixed:g}, outside them"
            raise InvalidBounds(self.name, self.lower, self.upper, detail)

    @property
    def is_free(self) -> bool:
        """Whether the parameter is searched."""
        return self.fixed is None and self.tied is None

    def is_physical(self, side: BoundSide) -> bool:
        """Whether the bound on that side is a limit of the quantity itself."""
        return self.physical in (side, "both")

    def follows_data(self, side: BoundSide) -> bool:
        """Whether the bound on that side is that of the data; a delay is never below 0."""
        return self.bounds is not None and (self.bounds, side) != ("delay", "lower")

    @property
    def has_unit_of_data(self) -> bool:
        """Whether the unit is that of the channels: the model says what it is, but no unit."""
        if self.bounds == "rate":
            return is_blank_unit(self.unit) or self.unit == RATE_UNIT
        return self.bounds in ("gain", "offset", "state") and is_blank_unit(self.unit)


_CHANGEABLE_FIELDS = ("lower", "upper", "scale", "fixed", "tied", "physical")
_WORDS = {"scale": get_args(ParameterScale), "physical": get_args(PhysicalBounds)}
_SIDES: tuple[BoundSide, ...] = get_args(BoundSide)


def override_parameters(
    parameters: tuple[Parameter, ...], changes: Mapping[str, Mapping[str, Any]]
) -> tuple[Parameter, ...]:
    """Replace bounds, scales, fixed values, ties or physical limits of some parameters.

    A change of both bounds frees a parameter that its model fixes or ties. A bound that is changed
    is no physical limit any more, unless the change says so.

    Raises
    ------
    InvalidSettings
        If a name or a field is unknown, or a value is not a number. Also if a parameter is fixed
        outside its bounds, or tied with other changes.
    InvalidBounds
        If the result is not a usable interval.
    """
    valid_names = {p.name for p in parameters}
    for name, fields in changes.items():
        if name not in valid_names:
            raise InvalidSettings(
                f"/parameters/{name}",
                f"the model has no parameter {name!r}{_suggest_parameter(name, valid_names)}",
            )
        for field, value in fields.items():
            _check_field(f"/parameters/{name}/{field}", field, value)
        if "tied" in fields and len(fields) > 1:
            others = ", ".join(repr(field) for field in fields if field != "tied")
            raise InvalidSettings(
                f"/parameters/{name}", f"a tied parameter is not searched; leave out {others}"
            )
    return tuple(_change_parameter(p, changes.get(p.name, {})) for p in parameters)


def _suggest_parameter(name: str, valid_names: Set[str]) -> str:
    """Suggest a parameter for an unknown name."""
    match = _INITIAL_STATE_NAME.fullmatch(name)
    if match is None:
        return suggest_name(name, valid_names)
    state, initial_state = match[1], f"{match[1]}(0)"
    if initial_state in valid_names:
        count = sum(
            other == initial_state or other.startswith(f"{initial_state}[") for other in valid_names
        )
        return (
            f": the records have {count} initial state(s) of {state!r}: {initial_state} and so on"
        )
    return (
        f": an initial state is a parameter if the model's document gives it bounds, "
        f"initial: {{{state}: {{lower: …, upper: …}}}}"
    )


def _check_field(pointer: str, field: str, value: object) -> None:
    if field not in _CHANGEABLE_FIELDS:
        raise InvalidSettings(pointer, f"unknown field{suggest_name(field, _CHANGEABLE_FIELDS)}")
    if field == "tied":
        if not isinstance(value, str):
            raise InvalidSettings(pointer, f"{value!r} is not an expression, such as '2*a'")
    elif field in _WORDS:
        if value not in _WORDS[field]:
            *others, last = map(repr, _WORDS[field])
            raise InvalidSettings(pointer, f"{value!r} is not {', '.join(others)} or {last}")
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise InvalidSettings(pointer, f"{value!r} is not a number")


def _change_parameter(parameter: Parameter, fields: Mapping[str, Any]) -> Parameter:
    if "tied" in fields:
        return replace(parameter, tied=fields["tied"], fixed=None)
    values: dict[str, Any] = {k: v if k in _WORDS else float(v) for k, v in fields.items()}
    if {"lower", "upper"} <= values.keys() and "fixed" not in values:
        values |= {"fixed": None, "tied": None}  # an interval to search frees the parameter
    fixed = values.get("fixed")
    if fixed is not None:
        values["tied"] = None
    if parameter.bounds is not None:
        values = _move_other_bounds(parameter, values)
    lower, upper = (values.get(k, getattr(parameter, k)) for k in ("lower", "upper"))
    if fixed is not None and not lower <= fixed <= upper:
        raise InvalidSettings(
            f"/parameters/{parameter.name}/fixed",
            f"{fixed:g} lies outside the bounds [{lower:g}, {upper:g}] of {parameter.name!r}; give "
            "a value inside them, or wider 'lower' and 'upper'",
        )
    if "physical" in fields:
        _check_limits(parameter, fields)
    else:
        values["physical"] = _keep_limits(parameter, {"lower": lower, "upper": upper})
    return replace(parameter, **values)


def _check_limits(parameter: Parameter, fields: Mapping[str, Any]) -> None:
    """Check that no bound of the data is called a physical limit."""
    for side in _SIDES:
        is_said = fields["physical"] in (side, "both")
        if is_said and side not in fields and parameter.follows_data(side):
            raise InvalidSettings(
                f"/parameters/{parameter.name}/physical",
                f"the {side} bound of {parameter.name!r} follows the data, so it is no physical "
                f"limit; give {side!r} as well",
            )


def _keep_limits(parameter: Parameter, bounds: Mapping[BoundSide, float]) -> PhysicalBounds | None:
    """Keep the physical limits among bounds that have not changed."""
    kept = [
        side
        for side in _SIDES
        if parameter.is_physical(side) and bounds[side] == getattr(parameter, side)
    ]
    return "both" if len(kept) > 1 else kept[0] if kept else None


def _move_other_bounds(parameter: Parameter, given: dict[str, Any]) -> dict[str, Any]:
    """Move bounds that follow the data out of the way of a given bound or fixed value.

    Given bounds are kept. An upper bound that is given no longer follows the data. The lower bound
    of a delay stays: it cannot be negative.
    """
    width = parameter.upper - parameter.lower
    lower, upper = parameter.lower, parameter.upper
    if "fixed" in given and given["fixed"] is not None:
        lower, upper = min(lower, given["fixed"]), max(upper, given["fixed"])
    if "lower" in given and not given["lower"] < upper:
        upper = given["lower"] + width
    if "upper" in given and not lower < given["upper"] and parameter.bounds != "delay":
        is_log = given.get("scale", parameter.scale) == "log"
        lower = (
            given["upper"] * parameter.lower / parameter.upper if is_log else given["upper"] - width
        )
    rule = None if "upper" in given else parameter.bounds
    return {"lower": lower, "upper": upper, **given, "bounds": rule}
