"""Past values: an index such as ``k - 1 - L/h`` is split into whole samples and a delay."""

from math import floor, inf, isinf
from typing import NamedTuple

from sysid.language.monomials import (
    CONSTANT,
    LaurentPolynomial,
    add_polynomials,
    collect_terms,
    multiply_factor,
    scale_polynomial,
    to_expression,
)
from sysid.language.printer import format_expression, format_number
from sysid.language.scope import Scope
from sysid.language.tree import Expression, PastValue, Symbol, walk
from sysid.language.value_intervals import bound_expression

_PERIOD = Symbol("h", "period")
_MOST_SAMPLES, _MOST_SECONDS = 1e6, 1e9  # of a delay: thirty years, in slow processes


class PastIndex(NamedTuple):
    """Distance of a past value: whole samples, and an unknown delay in addition."""

    offset: int
    delay: Expression | None


def split_index(index: Expression, scope: Scope) -> PastIndex | str:
    """Split an index into offset and delay, or return the message of a fault.

    In the difference form the offset is as large as the bounds allow. ``y(k - d)`` with d from 1
    to 20 has an offset of 1 and a delay of d - 1.
    """
    clock = Symbol(scope.clock, "index" if scope.form == "difference" else "time")
    terms = collect_terms(index)
    slope = terms.pop(((clock, 1),), 0.0)
    back = scale_polynomial(terms, -1.0)
    rest = to_expression(back)
    if slope == 1.0 and set(back) == {CONSTANT} and back[CONSTANT] < 0:
        return "this is a value in the future, which cannot be read"
    if not mentions_time(rest) and not slope:
        return f"the index does not count from {scope.clock}; {_describe_form(scope)}"
    if scope.form == "difference" and mentions_time(rest, "time"):
        return f"the index counts seconds; {_describe_form(scope)}"
    if abs(slope - 1.0) > 1e-9 or mentions_time(rest):
        return f"the delay changes with time; {_describe_form(scope)} with a constant delay"
    if collect_past_values(rest):  # its limits follow from the record
        return PastIndex(0, rest)
    return _split_bounded(back, rest, scope)


def _split_bounded(back: LaurentPolynomial, rest: Expression, scope: Scope) -> PastIndex | str:
    """Split a delay that the bounds of its parameters must limit."""
    if (low := bound_expression(rest, scope.parameters)[0]) < 0:
        return _describe_negative(back, low, scope)
    if not back:
        return PastIndex(0, None)
    # Any period shows an unlimited delay; back[CONSTANT] counts samples or seconds.
    most = _MOST_SECONDS if scope.form == "differential" else _MOST_SAMPLES
    high = max(bound_expression(rest, scope.parameters, 1.0)[1], back.get(CONSTANT, 0.0))
    if high > most:
        written = format_expression(rest, scope.clock)
        limit = f"reaches {high:.3g}, above {most:g}," if high < inf else "has no upper limit"
        return f"the delay {written} {limit} inside the bounds of its parameters"
    return PastIndex(0, rest) if scope.form == "differential" else _split_offset(back, low, scope)


def mentions_time(expression: Expression, *kinds: str) -> bool:
    """Whether an expression depends on t or k, or on one of some kinds of symbol."""
    wanted = kinds or ("time", "index")
    return any(isinstance(node, Symbol) and node.kind in wanted for node in walk(expression))


def collect_past_values(expression: Expression) -> tuple[PastValue, ...]:
    """Collect every signal value in an expression, in the order of the text."""
    return tuple(node for node in walk(expression) if isinstance(node, PastValue))


def has_varying_delay(past: PastValue) -> bool:
    """Whether the delay of a past value changes with inputs, as ``u(t - V/q(t))``."""
    return past.delay is not None and bool(collect_past_values(past.delay))


def _split_offset(back: LaurentPolynomial, low: float, scope: Scope) -> PastIndex:
    constant = back.get(CONSTANT, 0.0)
    unknown = {monomial: value for monomial, value in back.items() if monomial != CONSTANT}
    offset = 1 if low >= 1 else 0
    if bound_expression(to_expression(unknown), scope.parameters)[0] >= 0:
        offset = max(offset, floor(constant))
    delay = add_polynomials(back, {CONSTANT: -float(offset)})
    return PastIndex(offset, to_expression(delay) if delay else None)


def _describe_negative(back: LaurentPolynomial, low: float, scope: Scope) -> str:
    unit = "samples" if scope.form == "difference" else "s"
    if isinf(low):  # h has no lower bound: express the delay in seconds
        low, unit = (
            bound_expression(to_expression(multiply_factor(back, _PERIOD)), scope.parameters)[0],
            "s",
        )
    smallest = "" if isinf(low) else f"; its smallest value is {format_number(low)} {unit}"
    written = format_expression(to_expression(back), scope.clock)
    return (
        f"the delay {written} may be negative inside the bounds{smallest}; "
        "give its parameters bounds that keep it at 0 or more"
    )


def _describe_form(scope: Scope) -> str:
    if scope.form == "difference":
        return "in the difference form write x(k - n - L/h)"
    return "in the differential form write x(t - L)"
