"""Whether the unit of an unknown lag is the one in which lags are counted.

Units are labels to a model: ``u(t - L)`` reads L in seconds, whatever its unit says. A lag in
minutes would be estimated in seconds and told in minutes.
"""

from collections.abc import Iterator

from sysid.language.lags import past_values
from sysid.language.laurent import Monomial, collect
from sysid.language.scope import Timing
from sysid.language.tree import Past, Symbol
from sysid.models.model import Model
from sysid.models.reader import Reader, pointer
from sysid.units import factor

_PERIOD = (Symbol("h", "period"), -1)
_SECONDS = "s"


def check_lag_units(reader: Reader, model: Model) -> None:
    """Report each parameter that is a lag as it stands, in another unit than that of lags."""
    units = {one.name: one.unit for one in model.parameters}
    form: Timing = "differential" if model.form == "differential" else "difference"
    told = set()
    for tree in (*model.equations, *(one.expression for one in model.outputs)):
        for past in past_values(tree):
            for name, in_periods in _bare(past):
                size = factor(units.get(name, "1"), _SECONDS)
                in_seconds = form == "differential" or in_periods
                if size is None or (size == 1.0 and in_seconds) or name in told:
                    continue
                told.add(name)
                detail = _detail(name, units[name], size, form, in_periods=in_periods)
                reader.fault(pointer("parameters", name, "unit"), detail)


def _bare(past: Past) -> Iterator[tuple[str, bool]]:
    """Parameters that a lag adds without a factor, and whether they are divided by the period."""
    if past.lag is None:
        return
    for monomial, coefficient in collect(past.lag).items():
        name = _single(tuple(one for one in monomial if one != _PERIOD))
        if name is not None and coefficient == 1.0:
            yield name, _PERIOD in monomial


def _single(monomial: Monomial) -> str | None:
    match monomial:
        case ((Symbol(name, "parameter"), 1),):
            return name
        case _:
            return None


def _detail(name: str, unit: str, size: float, form: Timing, *, in_periods: bool) -> str:
    if size == 1.0:
        return f"found {unit!r}, but this lag counts samples: write {name}/h, or the unit samples"
    clock = "t" if form == "differential" else "k"
    right = f"{clock} - {size:.12g}*{name}" + ("" if form == "differential" else "/h")
    if form == "difference" and not in_periods:
        return f"found {unit!r}, but this lag counts samples: write {right}, or the unit samples"
    return f"found {unit!r}, but this lag counts seconds: give it in s, or write {right}"
