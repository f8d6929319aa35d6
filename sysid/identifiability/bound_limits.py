"""Limits of the bounds of a parameter, beyond which values are impossible.

A physical limit is not passed. A delay is neither negative nor as long as a record. Divisors and
arguments of roots and logarithms keep the sign that the bounds imply; a time constant, for example,
stays positive.
"""

from collections.abc import Callable, Iterator, Mapping
from math import inf
from typing import get_args

import numpy as np

from sysid.core.types import FloatArray
from sysid.language.functions import Interval
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, walk
from sysid.language.value_intervals import bound_expression
from sysid.models.model_delays import compute_longest_delay, has_known_past, list_past_values
from sysid.models.parameters import BoundSide, Parameter
from sysid.models.sections import get_interval
from sysid.models.ties import collect_parameter_names
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import is_at_bounds

_UNLIMITED_WIDTHS = 1e6  # times the range: a bound that may move so far has no limit
_BISECTIONS = 80
_ZERO_TOLERANCE = 1e-9  # of the range: a limit nearer to 0 is 0


def list_widest_bounds(problem: Problem, point: FloatArray) -> tuple[Interval, ...]:
    """List the widest bounds of parameters at a bound, and the bounds of the others.

    Parameters
    ----------
    problem : Problem
    point : FloatArray, shape (D,)
        In [0, 1].
    """
    at_end = np.logical_or(*is_at_bounds(point))
    return tuple(
        find_widest_bounds(problem, parameter) if is_at_end else (parameter.lower, parameter.upper)
        for parameter, is_at_end in zip(problem.free_parameters, at_end, strict=True)
    )


def find_widest_bounds(problem: Problem, parameter: Parameter) -> Interval:
    """Find the lowest and highest value that a parameter's bounds may have; infinite: no limit."""
    spans = {item.name: get_interval(item) for item in problem.all_parameters}
    spans |= problem.delaying_ranges
    present, width = spans[parameter.name], parameter.upper - parameter.lower
    lowest = 0.0 if parameter.scale == "log" else -inf
    signed = [
        item for item in _iterate_signed(problem) if parameter.name in collect_parameter_names(item)
    ]
    pasts = [
        item
        for item in list_past_values(problem.model)
        if item.delay is not None and parameter.name in collect_parameter_names(item.delay)
    ]
    grids = {(item.grid.integration_step, item.grid.duration) for item in problem.experiments}

    def is_possible(value: float) -> bool:
        wide = {**spans, parameter.name: (min(present[0], value), max(present[1], value))}
        keeps_signs = all(
            _keeps_sign(bound_expression(item, spans), bound_expression(item, wide))
            for item in signed
        )
        return (
            value >= lowest and keeps_signs and all(is_delay_possible(item, wide) for item in pasts)
        )

    def is_delay_possible(past: PastValue, wide: Mapping[str, Interval]) -> bool:
        if past.delay is None or bound_expression(past.delay, wide)[0] < 0:
            return False
        if has_known_past(problem.model, past):
            return True
        return all(compute_longest_delay(problem.model, past, wide, h) < last for h, last in grids)

    ends = (
        end if parameter.is_physical(side) else _bisect_limit(end, direction * width, is_possible)
        for side, end, direction in zip(get_args(BoundSide), present, (-1, 1), strict=True)
    )
    low, high = (0.0 if abs(end) < _ZERO_TOLERANCE * width else end for end in ends)
    return low, high


def _bisect_limit(start: float, width: float, is_possible: Callable[[float], bool]) -> float:
    """Bisect for the last possible value from `start` on; a negative width leads downwards."""
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
    """Iterate over divisors, bases of powers that need a sign, and arguments of roots and logs."""
    outputs = (output.expression for output in problem.model.outputs)
    for tree in (*problem.model.equations, *outputs):
        yield from _iterate_divisors(tree)


def _iterate_divisors(tree: Expression) -> Iterator[Expression]:
    for node in walk(tree):
        match node:
            case Binary("/", _, divisor):
                yield divisor
                if isinstance(divisor, Binary) and divisor.operator == "**":
                    yield divisor.left  # its square passes 0 without a change of sign
            case Binary("**", base, exponent) if not _is_whole_power(exponent):
                yield base
            case FunctionCall("sqrt" | "log" | "log10", (argument,)):
                yield argument
            case FunctionCall("mod", (_, divisor)):
                yield divisor


def _is_whole_power(exponent: Expression) -> bool:
    """Return whether a base of any sign, or 0, has such a power."""
    return isinstance(exponent, Number) and exponent.value >= 0 and exponent.value % 1 == 0
