"""Search of the unknown lags at which a polynomial explains most, one step ahead.

Lags are tried at whole samples inside their bounds. If it is cheap, all combinations are tried.
Otherwise a coarse grid is tried first, and then from its best points one lag after the other.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import islice, product
from math import ceil, floor, prod
from typing import NamedTuple

import numpy as np

from sysid.language.value_intervals import bound_expression
from sysid.models.model import Model
from sysid.models.parameters import Parameter
from sysid.models.sections import get_interval
from sysid.selection.regression import find_lag_parameters

_FULL_SEARCH = 4_000  # combinations: up to here all are tried, if their cost allows
_READ_COST = 150.0  # operations equivalent to computing one value of a column
_MIN_TRIALS = 60
_COARSE_SHARE = 0.1  # share of the trials that the coarse grid may take
_MAX_OPERATIONS = 4e9  # of all trials together, about
_DESCENTS = 3
_MAX_ROUNDS = 6

LagScore = Callable[[Mapping[str, float]], float]


class LagTrial(NamedTuple):
    """Values of the lags, and the unexplained share of the output's squares."""

    share: float
    lags: dict[str, float]


def list_lag_values(
    model: Model, parameters: Sequence[Parameter], period: float
) -> dict[str, tuple[float, ...]]:
    """List for each parameter of a lag the values at which the lag is a whole number of samples.

    A fixed parameter has one value. If no value inside the bounds makes the lag whole, the list has
    the middle of the bounds.
    """
    named = find_lag_parameters(model)
    spans = {
        parameter.name: get_interval(parameter)
        for parameter in parameters
        if parameter.name in named
    }
    values: dict[str, tuple[float, ...]] = {}
    for name, (low, high) in spans.items():
        middle = {other: (0.5 * sum(ends),) * 2 for other, ends in spans.items()}
        slopes = [(0.0, 0.0)]
        for past in {factor for term in model.terms for factor in term.factors}:
            if past.delay is not None:
                ends = [
                    bound_expression(past.delay, middle | {name: (x, x)}, period)[0]
                    for x in (low, high)
                ]
                slopes.append((abs(ends[1] - ends[0]), ends[0]))
        span, first_lag = max(slopes)
        values[name] = (
            _list_whole_lags(low, high, span, first_lag) if span > 0 else (0.5 * (low + high),)
        )
    return values


def _list_whole_lags(low: float, high: float, reach: float, begin: float) -> tuple[float, ...]:
    """List values between two bounds that move a lag by whole samples, `reach` samples in all."""
    step = (high - low) / reach
    first = low + (ceil(begin - 1e-9) - begin) * step
    count = floor((high - first) / step + 1e-9) + 1
    if count < 1:
        return (0.5 * (low + high),)
    return tuple(min(max(first + i * step, low), high) for i in range(count))


class SearchEffort(NamedTuple):
    """Limits on the combinations to try and on the rows to use."""

    trials: int
    rows: int


def plan_effort(values: Mapping[str, Sequence[float]], terms: int) -> SearchEffort:
    """Plan the effort so that all trials together stay cheap."""
    least_rows = max(5 * terms, 500)
    cost_per_row = 2.0 * (terms + 1) ** 2 + _READ_COST * (terms + 1)
    trials = int(min(max(_MAX_OPERATIONS / (cost_per_row * least_rows), _MIN_TRIALS), _FULL_SEARCH))
    expected = min(trials, prod(len(axis) for axis in values.values()))
    return SearchEffort(
        trials, max(least_rows, int(_MAX_OPERATIONS / (cost_per_row * max(expected, 1))))
    )


def search_lags(
    values: Mapping[str, Sequence[float]], score: LagScore, trials: int = _FULL_SEARCH
) -> list[LagTrial]:
    """Search the lags; return the combinations tried, best first, at most about `trials`."""
    names = list(values)
    axes = [list(values[name]) for name in names]
    scores: dict[tuple[int, ...], float] = {}

    def evaluate(point: tuple[int, ...]) -> float:
        if point not in scores:
            lags = {n: axis[i] for n, axis, i in zip(names, axes, point, strict=True)}
            scores[point] = score(lags)
        return scores[point]

    sizes = [len(axis) for axis in axes]
    if prod(sizes) <= trials:
        for point in product(*(range(size) for size in sizes)):
            evaluate(point)
    else:
        coarse = product(*_choose_coarse_grid(sizes, max(_COARSE_SHARE * trials, _MIN_TRIALS / 2)))
        for point in islice(coarse, trials):  # with many lags, even two values each are too many
            evaluate(point)
        for start in sorted(scores, key=lambda p: (scores[p], p))[:_DESCENTS]:
            _descend_axes(start, sizes, evaluate, lambda: len(scores) >= trials)
    ranked = sorted(scores, key=lambda p: (scores[p], p))
    return [
        LagTrial(scores[point], {n: a[i] for n, a, i in zip(names, axes, point, strict=True)})
        for point in ranked
    ]


def _choose_coarse_grid(sizes: Sequence[int], combinations: float) -> list[list[int]]:
    """Choose evenly spread points on each axis, about `combinations` in all."""
    each = max(2, floor(combinations ** (1.0 / len(sizes))))
    return [
        sorted({int(i) for i in np.round(np.linspace(0, size - 1, min(each, size)))})
        for size in sizes
    ]


def _descend_axes(
    point: tuple[int, ...],
    sizes: Sequence[int],
    evaluate: Callable[[tuple[int, ...]], float],
    is_over: Callable[[], bool],
) -> None:
    """Minimise along one axis after the other until there is no improvement."""
    for _ in range(_MAX_ROUNDS):
        before = point
        for axis, size in enumerate(sizes):
            reach = max(1, size // 64)
            for line in (_choose_line(size), [point[axis] + i for i in range(-reach, reach + 1)]):
                if is_over():
                    return
                inside = [i for i in line if 0 <= i < size]
                trials = [(*point[:axis], i, *point[axis + 1 :]) for i in inside]
                point = min([point, *trials], key=lambda p: (evaluate(p), p))
        if point == before:
            return


def _choose_line(size: int) -> list[int]:
    """Choose the points of one axis: all of a short one, 64 of a long one."""
    return sorted({int(i) for i in np.round(np.linspace(0, size - 1, min(size, 64)))})
