"""Whether parameters in another unit of time than seconds are read in seconds.

Units are labels to a model: dx/dt is per second, so ``(u - x)/T`` reads T in seconds, whatever its
unit says. A time constant in minutes would be estimated in seconds and told in minutes. Equations
that convert it, as ``(u - x)/(60*T)``, multiply it by a number wherever they read it; those that
read it as it stands, or within a function, may do so on purpose: they are warned of, not refused.
Lags, which have nothing but a time in them, are refused (`sysid.models.lag_units`).
"""

from collections.abc import Iterator

from sysid.language.laurent import Monomial, collect
from sysid.language.tree import Binary, Call, Expression, Symbol, Unary
from sysid.models.model import Model
from sysid.units import factor


def time_unit_notes(model: Model) -> list[str]:
    """One sentence for each parameter of a differential model that is read as if in seconds."""
    if model.form != "differential":
        return []
    sizes = {one.name: factor(one.unit, "s") for one in model.parameters}
    units = {one.name: one.unit for one in model.parameters}
    bare = {name for tree in model.equations for name in _bare(tree)}
    return [
        f"{name} has the unit {units[name]}, but the equations read it as it stands, and their "
        f"rates are per second: unless that is meant, give it in s, or write {size:.12g}*{name}"
        for name, size in sizes.items()
        if name in bare and size not in (None, 1.0)
    ]


def _bare(tree: Expression) -> Iterator[str]:
    """Parameters that a term has without a number to multiply them."""
    for monomial, coefficient in collect(tree).items():
        if abs(coefficient) == 1.0:
            yield from _names(monomial)
        for one, _ in monomial:
            for part in _inside(one):
                yield from _bare(part)


def _names(monomial: Monomial) -> Iterator[str]:
    for one, _ in monomial:
        match one:
            case Symbol(name, "parameter"):
                yield name


def _inside(node: Expression) -> tuple[Expression, ...]:
    """Of what is neither a sum nor a product, the terms inside."""
    match node:
        case Call(_, arguments):
            return arguments
        case Unary(_, operand):
            return (operand,)
        case Binary(_, left, right):
            return (left, right)
        case _:
            return ()
