"""At which values of its unknown lags a polynomial explains most, one step ahead.

Lags are tried at whole samples inside their bounds. All combinations are tried if that is cheap;
otherwise a coarse grid, and from its best points one lag at a time in turn.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import islice, product
from math import ceil, floor, prod
from typing import NamedTuple

import numpy as np

from sysid.language.intervals import bound_expression
from sysid.models.model import Model
from sysid.models.parameters import Parameter
from sysid.models.sections import get_interval
from sysid.selection.regression import find_lag_parameters

_FULL_SEARCH = 4_000  # combinations up to which all are tried, if their cost allows
_READ_COST = 150.0  # operations that making one value of a column is worth
_FEWEST_TRIALS = 60
_COARSE_SHARE = 0.1  # share of the trials that the coarse grid may take
_MOST_OPERATIONS = 4e9  # of all trials together, about
_DESCENTS = 3
_MOST_ROUNDS = 6

LagScore = Callable[[Mapping[str, float]], float]


class LagTrial(NamedTuple):
    """Values of the lags, and the share of the output's squares left unexplained."""

    share: float
    lags: dict[str, float]


def list_lag_values(
    model: Model, parameters: Sequence[Parameter], period: float
) -> dict[str, tuple[float, ...]]:
    """Values of each parameter of a lag at which that lag is a whole number of samples.

    A parameter that is fixed has the one value; where no value inside the bounds makes the lag
    whole, the middle.
    """
    named = find_lag_parameters(model)
    spans = {one.name: get_interval(one) for one in parameters if one.name in named}
    found: dict[str, tuple[float, ...]] = {}
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
        reach, begin = max(slopes)
        found[name] = (
            _list_whole_lags(low, high, reach, begin) if reach > 0 else (0.5 * (low + high),)
        )
    return found


def _list_whole_lags(low: float, high: float, reach: float, begin: float) -> tuple[float, ...]:
    """Values between two bounds that move a lag by whole samples, `reach` in all."""
    step = (high - low) / reach
    first = low + (ceil(begin - 1e-9) - begin) * step
    count = floor((high - first) / step + 1e-9) + 1
    if count < 1:
        return (0.5 * (low + high),)
    return tuple(min(max(first + i * step, low), high) for i in range(count))


class SearchEffort(NamedTuple):
    """How many combinations may be tried, and on how many rows."""

    trials: int
    rows: int


def plan_effort(values: Mapping[str, Sequence[float]], terms: int) -> SearchEffort:
    """So much that all trials together stay cheap."""
    least = max(5 * terms, 500)
    each = 2.0 * (terms + 1) ** 2 + _READ_COST * (terms + 1)
    trials = int(min(max(_MOST_OPERATIONS / (each * least), _FEWEST_TRIALS), _FULL_SEARCH))
    expected = min(trials, prod(len(axis) for axis in values.values()))
    return SearchEffort(trials, max(least, int(_MOST_OPERATIONS / (each * max(expected, 1)))))


def search_lags(
    values: Mapping[str, Sequence[float]], score: LagScore, trials: int = _FULL_SEARCH
) -> list[LagTrial]:
    """The combinations that were tried, best first; about `trials` of them at most."""
    names = list(values)
    axes = [list(values[name]) for name in names]
    known: dict[tuple[int, ...], float] = {}

    def look(place: tuple[int, ...]) -> float:
        if place not in known:
            lags = {n: axis[i] for n, axis, i in zip(names, axes, place, strict=True)}
            known[place] = score(lags)
        return known[place]

    sizes = [len(axis) for axis in axes]
    if prod(sizes) <= trials:
        for place in product(*(range(size) for size in sizes)):
            look(place)
    else:
        coarse = product(
            *_choose_coarse_grid(sizes, max(_COARSE_SHARE * trials, _FEWEST_TRIALS / 2))
        )
        for place in islice(coarse, trials):  # of many lags, even two values each are too many
            look(place)
        for begin in sorted(known, key=lambda p: (known[p], p))[:_DESCENTS]:
            _descend_axes(begin, sizes, look, lambda: len(known) >= trials)
    ranked = sorted(known, key=lambda p: (known[p], p))
    return [
        LagTrial(known[place], {n: a[i] for n, a, i in zip(names, axes, place, strict=True)})
        for place in ranked
    ]


def _choose_coarse_grid(sizes: Sequence[int], combinations: float) -> list[list[int]]:
    """Evenly spread places on each axis, about so many combinations in all."""
    each = max(2, floor(combinations ** (1.0 / len(sizes))))
    return [
        sorted({int(i) for i in np.round(np.linspace(0, size - 1, min(each, size)))})
        for size in sizes
    ]


def _descend_axes(
    place: tuple[int, ...],
    sizes: Sequence[int],
    look: Callable[[tuple[int, ...]], float],
    is_over: Callable[[], bool],
) -> None:
    """One axis at a time: its best place, the others kept, until nothing gets better."""
    for _ in range(_MOST_ROUNDS):
        before = place
        for axis, size in enumerate(sizes):
            reach = max(1, size // 64)
            for line in (_choose_line(size), [place[axis] + i for i in range(-reach, reach + 1)]):
                if is_over():
                    return
                inside = [i for i in line if 0 <= i < size]
                tried = [(*place[:axis], i, *place[axis + 1 :]) for i in inside]
                place = min([place, *tried], key=lambda p: (look(p), p))
        if place == before:
            return


def _choose_line(size: int) -> list[int]:
    """Places of one axis: all of a short one, 64 of a long one."""
    return sorted({int(i) for i in np.round(np.linspace(0, size - 1, min(size, 64)))})
