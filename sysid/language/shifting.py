"""Trees as they were some time ago: what a signal made of others is worth in the past."""

from sysid.language.substitution import substitute
from sysid.language.tree import Binary, Expression, Number, Past, Symbol

_PERIOD = Symbol("h", "period")


def shifted(tree: Expression, steps: int, lag: Expression | None, *, counts: bool) -> Expression:
    """An expression as it was some whole steps and a lag ago; `counts`: lags are in samples."""

    def earlier(node: Expression) -> Expression | None:
        match node:
            case Past(name, kind, offset, own):
                return Past(name, kind, offset + steps, in_series(own, lag))
            case Symbol(_, "index"):
                return Binary("-", node, back)
            case Symbol(_, "time"):
                return Binary("-", node, Binary("*", back, _PERIOD) if counts else back)
            case _:
                return None

    back = Binary("+", Number(float(steps)), lag or Number(0.0))
    return tree if steps == 0 and lag is None else substitute(tree, earlier)


def in_series(lag: Expression | None, other: Expression | None) -> Expression | None:
    """Two lags, one after the other."""
    if lag is None or other is None:
        return other if lag is None else lag
    return Binary("+", lag, other)
