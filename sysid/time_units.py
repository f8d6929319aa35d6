"""Whether parameters in another unit of time than seconds are read in seconds.

Units are labels to a model: dx/dt is per second, so ``(u - x)/T`` reads T in seconds, whatever its
unit says. A time constant in minutes would be estimated in seconds and told in minutes. Equations
that convert it, as ``(u - x)/(60*T)``, multiply it by a number wherever they read it, or the sum in
which it stands; those that read it as it stands, or within a function, may do so on purpose: they
are warned of, not refused. Of a ratio of two such parameters nothing is to be converted.
Lags, which have nothing but a time in them, are refused (`sysid.models.lag_units`).
"""

from collections.abc import Iterator, Mapping
from math import isclose, prod

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
    known = {name: size for name, size in sizes.items() if size is not None}
    bare = {name for tree in model.equations for name in _bare(tree, known)}
    return [
        f"{name} has the unit {units[name]}, but the equations read it as it stands, and their "
        f"rates are per second: unless that is meant, give it in s, or write {size:.12g}*{name}"
        for name, size in sizes.items()
        if name in bare and size not in (None, 1.0)
    ]


def _bare(tree: Expression, sizes: Mapping[str, float]) -> Iterator[str]:
    """Parameters that a term has without a number to multiply them; `sizes` in seconds."""
    for monomial, coefficient in collect(tree).items():
        if abs(coefficient) == 1.0:
            yield from _names(monomial, sizes)
        for one, _ in monomial:
            for part in _inside(one):
                yield from _bare(part, sizes)


def _names(monomial: Monomial, sizes: Mapping[str, float]) -> list[str]:
    """Parameters of a product, none where their units cancel out."""
    found = {
        one.name: power
        for one, power in monomial
        if isinstance(one, Symbol) and one.kind == "parameter" and one.name in sizes
    }
    cancel = isclose(prod(sizes[name] ** power for name, power in found.items()), 1.0)
    return [] if cancel else list(found)


def _inside(node: Expression) -> tuple[Expression, ...]:
    """Of what stands in a product as a whole, the terms inside."""
    match node:
        case Call(_, arguments):
            return arguments
        case Unary(_, operand):
            return (operand,)
        case Binary(_, left, right):  # a denominator has its own sum, with its factor in it
            return (left, right) if collect(node) == {((node, 1),): 1.0} else (node,)
        case _:
            return ()
