"""A quantity to identify and the interval in which it is sought."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Literal

from sysid.errors import InvalidBounds, InvalidSettings, nearest

Scale = Literal["linear", "log"]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One quantity to identify.

    Attributes
    ----------
    name : str
        Symbol used in equations, reports and stored results.
    lower, upper : float
        Closed search interval, in `unit`.
    unit : str
        Unit symbol; ``"1"`` for a dimensionless quantity.
    scale : {"linear", "log"}
        How the interval is divided by the chromosome; ``"log"`` where it spans decades.
    fixed : float or None
        A known value; the parameter is then not searched.

    Raises
    ------
    InvalidBounds
        If a bound is not finite, ``lower >= upper``, a log scale starts at or below zero, or
        `fixed` lies outside the bounds.
    """

    name: str
    lower: float
    upper: float
    unit: str = "1"
    scale: Scale = "linear"
    fixed: float | None = None

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
        return self.fixed is None


_FIELDS = ("lower", "upper", "scale", "fixed")


def override(
    parameters: tuple[Parameter, ...], changes: Mapping[str, Mapping[str, Any]]
) -> tuple[Parameter, ...]:
    """Parameters with some bounds, scales or fixed values replaced.

    Raises
    ------
    InvalidSettings
        If a name or a field is unknown, or a value is not a number.
    InvalidBounds
        If the result is not a usable interval.
    """
    known = {p.name for p in parameters}
    for name, fields in changes.items():
        if name not in known:
            raise InvalidSettings(
                f"/parameters/{name}", f"the model has no parameter {name!r}{nearest(name, known)}"
            )
        for field, value in fields.items():
            if field not in _FIELDS:
                raise InvalidSettings(
                    f"/parameters/{name}/{field}", f"unknown field{nearest(field, _FIELDS)}"
                )
            if field != "scale" and (isinstance(value, bool) or not isinstance(value, int | float)):
                raise InvalidSettings(f"/parameters/{name}/{field}", f"{value!r} is not a number")
            if field == "scale" and value not in ("linear", "log"):
                raise InvalidSettings(
                    f"/parameters/{name}/scale", f"{value!r} is not 'linear' or 'log'"
                )
    return tuple(_changed(p, changes.get(p.name, {})) for p in parameters)


def _changed(parameter: Parameter, fields: Mapping[str, Any]) -> Parameter:
    values: dict[str, Any] = {k: v if k == "scale" else float(v) for k, v in fields.items()}
    fixed = values.get("fixed")
    if fixed is not None:  # a value fixed by the user may lie outside the catalogue's bounds
        values.setdefault("lower", min(parameter.lower, fixed))
        values.setdefault("upper", max(parameter.upper, fixed))
    return replace(parameter, **values)
