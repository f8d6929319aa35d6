"""Parameters that can change places, such as two time constants in series.

No data tell which is the first. It need not show in the equations, whose inner states differ, so
it is looked for as the sums of `sysid.identifiability.translations` are: parameters of one unit are
exchanged, apart from one another, and the model is simulated, once more with all others moved: two
gains at one bound make parallel sections alike at that estimate only. What changes nothing then
counts. One order is given, the largest first; bounds that do not hold the other order tell which is
which, and leave nothing to be exchanged.

Parallel sections change places as a whole, gains and initial states with them. What goes with what
is read off the equations (`sysid.identifiability.subsystems`), and tried in the same way. Of S
states that are at most S(S - 1)/2 times five simulations.
"""

from collections.abc import Iterator
from itertools import chain, combinations

import numpy as np

from sysid.core.types import FloatArray
from sysid.identifiability.scaling import find_scalings
from sysid.identifiability.subsystems import ExchangeUnit, find_equivalent_subsystems
from sysid.models.delays import list_past_values
from sysid.models.ties import collect_parameter_names
from sysid.simulation.problem import Problem

ExchangeGroup = tuple[ExchangeUnit, ...]
"""Units of places in the problem's space, any two of which can be exchanged: (k, w)."""

ExchangeGroups = tuple[ExchangeGroup, ...]

_LEAST_DISTANCE = 0.05  # of their size: how far the two are set apart at least
_LEAST_SIZE = 1e-3  # of the range: values nearer 0 are taken to be of that size
_MOVE_SHARES = 0.02, 0.05  # of its size: by how much each of the others is moved
_SAME_TOLERANCE = 1e-9  # of the output's size: rounding
_BATCH_SIZE = 8  # simulations
_COMPARED_SAMPLES = 10_000  # samples, about, by which what cannot be is ruled out
_PAIR_SIMULATIONS, _REPEAT_SIMULATIONS = 3, 2  # simulations for a pair, and with the others moved


def find_exchanges(
    problem: Problem, theta: FloatArray, most: int | None = None
) -> tuple[ExchangeGroups, int]:
    """What can be exchanged around an estimate (D,), and the simulations this took.

    Parameters
    ----------
    most : int or None
        Simulations that may be run; pairs beyond are not looked at.
    """
    groups: list[ExchangeGroup] = []
    pairs, spent = _exclude_unlikely(
        problem, theta, list(_iterate_candidates(problem, theta)), most
    )
    single = (((one,), (other,)) for one, other in pairs)
    together = (
        pair
        for pair in find_equivalent_subsystems(problem)
        if _bounds_allow_exchange(problem, theta, *pair)
    )
    for one, other in chain(single, together):
        if _find_group(groups, one) == _find_group(groups, other):
            continue
        if most is not None and spent + _PAIR_SIMULATIONS + _REPEAT_SIMULATIONS > most:
            break
        found, count = _test_exchange(problem, theta, one, other)
        spent += count
        if found:
            groups = _merge_units(groups, one, other)
    every = sorted(tuple(sorted(group)) for group in groups)
    return tuple(
        one for one in every if _is_decreasing(order_exchangeable(problem, theta, (one,)), one)
    ), spent


def _is_decreasing(theta: FloatArray, group: ExchangeGroup) -> bool:
    """Whether bounds let a group be put in order: those of some pairs do not need to be of all."""
    return bool(np.all(np.diff(theta[[unit[0] for unit in group]]) <= 0.0))


def _bounds_allow_exchange(
    problem: Problem, theta: FloatArray, one: ExchangeUnit, other: ExchangeUnit
) -> bool:
    """Whether bounds let two units change places."""
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    here, there = [*one, *other], [*other, *one]
    return bool(np.all((lower[here] <= theta[there]) & (theta[there] <= upper[here])))


def _find_group(groups: list[ExchangeGroup], unit: ExchangeUnit) -> ExchangeGroup:
    found = (one for one in groups if any(set(unit) == set(own) for own in one))
    return next(found, (unit,))


def _merge_units(
    groups: list[ExchangeGroup], one: ExchangeUnit, other: ExchangeUnit
) -> list[ExchangeGroup]:
    """Groups with two units in one of them, the places of all in the order of its first."""
    first, second = _find_group(groups, one), _find_group(groups, other)
    goes_to = dict(zip(one, other, strict=True))
    here = next(own for own in first if set(own) == set(one))
    there = next(own for own in second if set(own) == set(other))
    order = [there.index(goes_to[d]) for d in here]
    beside = tuple(tuple(own[i] for i in order) for own in second)
    return [*(group for group in groups if group not in (first, second)), first + beside]


def order_exchangeable(problem: Problem, theta: FloatArray, groups: ExchangeGroups) -> FloatArray:
    """Values (..., D) with those of each group falling, where the bounds hold them so."""
    found = np.array(theta)
    for group in groups:
        units = np.array(group)
        values = found[..., units]  # (..., k, w)
        order = np.argsort(-values[..., 0], axis=-1, kind="stable")
        falling = np.take_along_axis(values, order[..., None], axis=-2)
        lower, upper = problem.evaluator.lower[units], problem.evaluator.upper[units]
        fits = np.all((lower <= falling) & (falling <= upper), axis=(-2, -1), keepdims=True)
        found[..., units] = np.where(fits, falling, values)
    return found


def describe_exchanges(problem: Problem, groups: ExchangeGroups, told: set[str]) -> tuple[str, ...]:
    """Notes of what can be exchanged among the names `told`: those with standard errors."""
    return tuple(
        _describe_group(problem, group)
        for group in groups
        if _has_reported_values(problem, group, told)
    )


def _has_reported_values(problem: Problem, group: ExchangeGroup, told: set[str]) -> bool:
    """Whether of each unit something is told that the others have another value of."""
    columns = zip(*group, strict=True)
    return any(all(problem.free_parameters[d].name in told for d in one) for one in columns)


def _describe_group(problem: Problem, group: ExchangeGroup) -> str:
    names = [[problem.free_parameters[d].name for d in unit] for unit in group]
    if len(names[0]) == 1:
        return (
            f"{' and '.join(one for (one,) in names)} can be exchanged without any effect on the "
            "output: which is which no data tell; they are given from the largest to the smallest"
        )
    units = " and ".join(f"({', '.join(unit)})" for unit in names)
    return (
        f"{units} can be exchanged as a whole without any effect on the output: which is which no "
        f"data tell; they are given from the largest {names[0][0]} to the smallest"
    )


def _iterate_candidates(problem: Problem, theta: FloatArray) -> Iterator[tuple[int, int]]:
    """Pairs of one unit, both of them in lags or neither, whose bounds hold both orders.

    Factors of a product that alone is known can do more than change places.
    """
    if problem.model.form == "polynomial":
        return  # each coefficient has a term of its own
    own = {one.name for one in problem.model.parameters}
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    units = [one.unit if one.name in own else None for one in problem.free_parameters]
    alike = [
        (i, j)
        for i, j in combinations(range(theta.size), 2)
        if units[i] is not None
        and units[i] == units[j]
        and lower[i] <= theta[j] <= upper[i]
        and lower[j] <= theta[i] <= upper[j]
    ]
    if not alike:
        return
    lagged = set().union(
        *(collect_parameter_names(p.delay) for p in list_past_values(problem.model) if p.delay),
        set(),
    )
    scaled = np.any(find_scalings(problem.model, problem.all_parameters) != 0.0, axis=0)
    for i, j in alike:
        in_lags = [problem.free_parameters[d].name in lagged for d in (i, j)]
        if in_lags[0] == in_lags[1] and not (scaled[i] or scaled[j]):
            yield i, j


def _merge_members(groups: list[set[int]], one: int, other: int) -> list[set[int]]:
    """Groups with two members in one of them."""
    near = [group for group in groups if group & {one, other}]
    far = [group for group in groups if not group & {one, other}]
    return [*far, set().union({one, other}, *near)]


def _exclude_unlikely(
    problem: Problem, theta: FloatArray, pairs: list[tuple[int, int]], most: int | None
) -> tuple[list[tuple[int, int]], int]:
    """Pairs without those that a simulation for each parameter rules out, and how many it took.

    For each pair it would be several: of 24 gains hundreds. Where all have one value a little more
    of either of two that can be exchanged has the same effect.
    """
    groups: list[set[int]] = []
    for pair in pairs:
        groups = _merge_members(groups, *pair)
    kept, spent = list(pairs), 0
    for group in groups:
        members = sorted(group)
        low = float(np.max(problem.evaluator.lower[members]))
        high = float(np.min(problem.evaluator.upper[members]))
        if (
            len(members) <= _PAIR_SIMULATIONS
            or low >= high
            or (most is not None and spent + len(group) > most)
        ):
            continue
        spent += len(members)
        answers = _simulate_perturbed(problem, theta, members, low, high)
        kept = [
            (i, j)
            for i, j in kept
            if i not in group
            or not np.isfinite([answers[i], answers[j]]).all()
            or _is_same_output(answers[i], answers[j])
        ]
    return kept, spent


def _simulate_perturbed(
    problem: Problem, theta: FloatArray, members: list[int], low: float, high: float
) -> dict[int, FloatArray]:
    """For each of some parameters the output, in part, with all at one value and it a bit above."""
    value = float(np.median(theta[members]))
    more = _LEAST_DISTANCE * float(_scale_values(np.array(value), high - low))
    value = min(max(value, low), high - more)
    found: dict[int, FloatArray] = {}
    for first in range(0, len(members), _BATCH_SIZE):  # of a long record there is no room for all
        some = members[first : first + _BATCH_SIZE]
        tried = np.repeat(theta[None], len(some), axis=0)
        tried[:, members] = value
        tried[np.arange(len(some)), some] += more
        outputs = problem.predict(tried)
        step = max(1, outputs.shape[1] // _COMPARED_SAMPLES)
        found |= dict(zip(some, outputs[:, ::step].copy(), strict=True))
    return found


def _test_exchange(
    problem: Problem, theta: FloatArray, one: ExchangeUnit, other: ExchangeUnit
) -> tuple[bool, int]:
    """Whether two units that are exchanged leave the output as it is, and their mean does not.

    And the simulations this took.
    """
    evaluator, pair = problem.evaluator, np.array([one, other])
    low, high = evaluator.lower[pair].max(axis=0), evaluator.upper[pair].min(axis=0)
    least = 0.5 * _LEAST_DISTANCE * _scale_values(theta[pair], high - low).max(axis=0)
    half = np.minimum(
        np.maximum(0.5 * np.abs(np.diff(theta[pair], axis=0)[0]), least), 0.5 * (high - low)
    )
    middle = np.minimum(np.maximum(0.5 * theta[pair].sum(axis=0), low + half), high - half)
    # Each to the side on which it is, so that sections stay what they are.
    half = np.where(theta[pair[0]] < theta[pair[1]], -half, half)
    tried = np.repeat(theta[None], _PAIR_SIMULATIONS, axis=0)
    tried[:, pair[0]] = middle + half, middle - half, middle
    tried[:, pair[1]] = middle - half, middle + half, middle
    here, there, equal = problem.predict(tried)
    if not _is_same_output(here, there) or _is_same_output(here, equal):
        return False, _PAIR_SIMULATIONS
    others = np.delete(np.arange(theta.size), pair.ravel())
    tried[:, others] = _move_inward(problem, theta)[others]
    return _is_same_output(
        *problem.predict(tried[:_REPEAT_SIMULATIONS])
    ), _PAIR_SIMULATIONS + _REPEAT_SIMULATIONS


def _is_same_output(here: FloatArray, there: FloatArray) -> bool:
    with np.errstate(invalid="ignore"):
        return bool(np.max(np.abs(there - here)) <= _SAME_TOLERANCE * np.max(np.abs(here)))


def _scale_values(values: FloatArray, span: FloatArray | float) -> FloatArray:
    """Of values: their own, or where they are small beside the range a small part of that."""
    return np.asarray(np.minimum(np.maximum(np.abs(values), _LEAST_SIZE * span), span))


def _move_inward(problem: Problem, theta: FloatArray) -> FloatArray:
    """Values a little off, away from the nearer bound, and no two of them by as much."""
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    inward = np.where(theta - lower < upper - theta, 1.0, -1.0)
    return np.asarray(
        theta
        + inward * np.linspace(*_MOVE_SHARES, theta.size) * _scale_values(theta, upper - lower)
    )
