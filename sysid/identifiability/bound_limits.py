"""How far a bound may be moved before it allows what is impossible.

A lag reaches neither into the future nor as far back as a record lasts; what an equation divides
by, or takes the root or the logarithm of, keeps the sign that the bounds give it, as a time
constant does.
"""

from collections.abc import Callable, Iterator, Mapping
from math import inf

from sysid.core.types import Interval
from sysid.language.intervals import bound_expression
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, walk
from sysid.models.delays import compute_longest_delay, list_past_values
from sysid.models.parameters import Parameter
from sysid.models.sections import get_interval
from sysid.models.ties import collect_parameter_names
from sysid.simulation.problem import Problem

_UNLIMITED_WIDTHS = 1e6  # times the range: what is possible there has no limit
_BISECTIONS = 80
_ZERO_TOLERANCE = 1e-9  # of the range: a limit nearer to 0 is that


def find_widest_bounds(problem: Problem, parameter: Parameter) -> Interval:
    """Lowest and highest value that a free parameter's bounds may have; infinite where any may."""
    spans = {one.name: get_interval(one) for one in problem.all_parameters}
    own, width = spans[parameter.name], parameter.upper - parameter.lower
    least = 0.0 if parameter.scale == "log" else -inf
    signs = [
        one for one in _iterate_signed(problem) if parameter.name in collect_parameter_names(one)
    ]
    pasts = [
        one
        for one in list_past_values(problem.model)
        if one.delay is not None and parameter.name in collect_parameter_names(one.delay)
    ]
    grids = {(one.grid.integration_step, one.grid.duration) for one in problem.experiments}

    def is_possible(value: float) -> bool:
        wide = {**spans, parameter.name: (min(own[0], value), max(own[1], value))}
        kept = all(
            _keeps_sign(bound_expression(one, spans), bound_expression(one, wide)) for one in signs
        )
        return value >= least and kept and all(is_past(one, wide) for one in pasts)

    def is_past(past: PastValue, wide: Mapping[str, Interval]) -> bool:
        if past.delay is None or bound_expression(past.delay, wide)[0] < 0:
            return False
        return all(compute_longest_delay(problem.model, past, wide, h) < last for h, last in grids)

    ends = (
        _bisect_limit(end, way * width, is_possible) for end, way in zip(own, (-1, 1), strict=True)
    )
    low, high = (0.0 if abs(end) < _ZERO_TOLERANCE * width else end for end in ends)
    return low, high


def _bisect_limit(start: float, width: float, is_possible: Callable[[float], bool]) -> float:
    """The last possible value from `start` on; widths below 0 lead downwards."""
    inside, outside = start, start + _UNLIMITED_WIDTHS * width
    if is_possible(outside):
        return inf if width > 0 else -inf
    for _ in range(_BISECTIONS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if is_possible(middle) else (inside, middle)
    return inside


def _keeps_sign(now: Interval, then: Interval) -> bool:
    return (now[0] < 0 or then[0] >= 0) and (now[1] > 0 or then[1] <= 0)


def _iterate_signed(problem: Problem) -> Iterator[Expression]:
    """Divisors, bases of powers that need a sign, and arguments of roots and logarithms."""
    outputs = (output.expression for output in problem.model.outputs)
    for tree in (*problem.model.equations, *outputs):
        yield from _iterate_divisors(tree)


def _iterate_divisors(tree: Expression) -> Iterator[Expression]:
    for node in walk(tree):
        match node:
            case Binary("/", _, divisor):
                yield divisor
                if isinstance(divisor, Binary) and divisor.operator == "**":
                    yield divisor.left  # whose square would pass 0 without a change of its sign
            case Binary("**", base, exponent) if not _is_whole_power(exponent):
                yield base
            case FunctionCall("sqrt" | "log", (argument,)):
                yield argument


def _is_whole_power(exponent: Expression) -> bool:
    """Whether any base, of either sign and 0, has such a power."""
    return isinstance(exponent, Number) and exponent.value >= 0 and exponent.value % 1 == 0
