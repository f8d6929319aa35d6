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
from sysid.identifiability.scaling import scalings
from sysid.identifiability.subsystems import Unit, alike
from sysid.models.delays import past_signals
from sysid.models.ties import names_in
from sysid.simulation.problem import Problem

Exchange = tuple[Unit, ...]
"""Units of places in the problem's space, any two of which can be exchanged: (k, w)."""

Exchanges = tuple[Exchange, ...]

_APART = 0.05  # of their size: how far the two are set apart at least
_LEAST = 1e-3  # of the range: values nearer 0 are taken to be of that size
_MOVED = 0.02, 0.05  # of its size: by how much each of the others is moved
_SAME = 1e-9  # of the output's size: rounding
_AT_ONCE = 8  # simulations
_LOOKED_AT = 10_000  # samples, about, by which what cannot be is ruled out
_ALONE, _AGAIN = 3, 2  # simulations for a pair, and with the others moved


def exchanges(
    problem: Problem, theta: FloatArray, most: int | None = None
) -> tuple[Exchanges, int]:
    """What can be exchanged around an estimate (D,), and the simulations this took.

    Parameters
    ----------
    most : int or None
        Simulations that may be run; pairs beyond are not looked at.
    """
    groups: list[Exchange] = []
    pairs, spent = _likely(problem, theta, list(_candidates(problem, theta)), most)
    single = (((one,), (other,)) for one, other in pairs)
    together = (pair for pair in alike(problem) if _holds_both(problem, theta, *pair))
    for one, other in chain(single, together):
        if _group_of(groups, one) == _group_of(groups, other):
            continue
        if most is not None and spent + _ALONE + _AGAIN > most:
            break
        found, count = _changes_nothing(problem, theta, one, other)
        spent += count
        if found:
            groups = _with(groups, one, other)
    every = sorted(tuple(sorted(group)) for group in groups)
    return tuple(one for one in every if _is_falling(ordered(problem, theta, (one,)), one)), spent


def _is_falling(theta: FloatArray, group: Exchange) -> bool:
    """Whether bounds let a group be put in order: those of some pairs do not need to be of all."""
    return bool(np.all(np.diff(theta[[unit[0] for unit in group]]) <= 0.0))


def _holds_both(problem: Problem, theta: FloatArray, one: Unit, other: Unit) -> bool:
    """Whether bounds let two units change places."""
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    here, there = [*one, *other], [*other, *one]
    return bool(np.all((lower[here] <= theta[there]) & (theta[there] <= upper[here])))


def _group_of(groups: list[Exchange], unit: Unit) -> Exchange:
    found = (one for one in groups if any(set(unit) == set(own) for own in one))
    return next(found, (unit,))


def _with(groups: list[Exchange], one: Unit, other: Unit) -> list[Exchange]:
    """Groups with two units in one of them, the places of all in the order of its first."""
    first, second = _group_of(groups, one), _group_of(groups, other)
    goes_to = dict(zip(one, other, strict=True))
    here = next(own for own in first if set(own) == set(one))
    there = next(own for own in second if set(own) == set(other))
    order = [there.index(goes_to[d]) for d in here]
    beside = tuple(tuple(own[i] for i in order) for own in second)
    return [*(group for group in groups if group not in (first, second)), first + beside]


def ordered(problem: Problem, theta: FloatArray, groups: Exchanges) -> FloatArray:
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


def exchange_notes(problem: Problem, groups: Exchanges, told: set[str]) -> tuple[str, ...]:
    """Notes of what can be exchanged among the names `told`: those with standard errors."""
    return tuple(_note(problem, group) for group in groups if _is_told(problem, group, told))


def _is_told(problem: Problem, group: Exchange, told: set[str]) -> bool:
    """Whether of each unit something is told that the others have another value of."""
    columns = zip(*group, strict=True)
    return any(all(problem.space[d].name in told for d in one) for one in columns)


def _note(problem: Problem, group: Exchange) -> str:
    names = [[problem.space[d].name for d in unit] for unit in group]
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


def _candidates(problem: Problem, theta: FloatArray) -> Iterator[tuple[int, int]]:
    """Pairs of one unit, both of them in lags or neither, whose bounds hold both orders.

    Factors of a product that alone is known can do more than change places.
    """
    if problem.model.form == "polynomial":
        return  # each coefficient has a term of its own
    own = {one.name for one in problem.model.parameters}
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    units = [one.unit if one.name in own else None for one in problem.space]
    alike = [
        (i, j)
        for i, j in combinations(range(theta.size), 2)
        if units[i] is not None and units[i] == units[j]
        and lower[i] <= theta[j] <= upper[i] and lower[j] <= theta[i] <= upper[j]
    ]  # fmt: skip
    if not alike:
        return
    lagged = set().union(*(names_in(p.lag) for p in past_signals(problem.model) if p.lag), set())
    scaled = np.any(scalings(problem.model, problem.all_parameters) != 0.0, axis=0)
    for i, j in alike:
        in_lags = [problem.space[d].name in lagged for d in (i, j)]
        if in_lags[0] == in_lags[1] and not (scaled[i] or scaled[j]):
            yield i, j


def _joined(groups: list[set[int]], one: int, other: int) -> list[set[int]]:
    """Groups with two members in one of them."""
    near = [group for group in groups if group & {one, other}]
    far = [group for group in groups if not group & {one, other}]
    return [*far, set().union({one, other}, *near)]


def _likely(
    problem: Problem, theta: FloatArray, pairs: list[tuple[int, int]], most: int | None
) -> tuple[list[tuple[int, int]], int]:
    """Pairs without those that a simulation for each parameter rules out, and how many it took.

    For each pair it would be several: of 24 gains hundreds. Where all have one value a little more
    of either of two that can be exchanged has the same effect.
    """
    groups: list[set[int]] = []
    for pair in pairs:
        groups = _joined(groups, *pair)
    kept, spent = list(pairs), 0
    for group in groups:
        members = sorted(group)
        low = float(np.max(problem.evaluator.lower[members]))
        high = float(np.min(problem.evaluator.upper[members]))
        if (
            len(members) <= _ALONE
            or low >= high
            or (most is not None and spent + len(group) > most)
        ):
            continue
        spent += len(members)
        answers = _answers(problem, theta, members, low, high)
        kept = [
            (i, j) for i, j in kept
            if i not in group or not np.isfinite([answers[i], answers[j]]).all()
            or _is_same(answers[i], answers[j])
        ]  # fmt: skip
    return kept, spent


def _answers(
    problem: Problem, theta: FloatArray, members: list[int], low: float, high: float
) -> dict[int, FloatArray]:
    """For each of some parameters the output, in part, with all at one value and it a bit above."""
    value = float(np.median(theta[members]))
    more = _APART * float(_size(np.array(value), high - low))
    value = min(max(value, low), high - more)
    found: dict[int, FloatArray] = {}
    for first in range(0, len(members), _AT_ONCE):  # of a long record there is no room for all
        some = members[first : first + _AT_ONCE]
        tried = np.repeat(theta[None], len(some), axis=0)
        tried[:, members] = value
        tried[np.arange(len(some)), some] += more
        outputs = problem.predictions(tried)
        step = max(1, outputs.shape[1] // _LOOKED_AT)
        found |= dict(zip(some, outputs[:, ::step].copy(), strict=True))
    return found


def _changes_nothing(
    problem: Problem, theta: FloatArray, one: Unit, other: Unit
) -> tuple[bool, int]:
    """Whether two units that are exchanged leave the output as it is, and their mean does not.

    And the simulations this took.
    """
    evaluator, pair = problem.evaluator, np.array([one, other])
    low, high = evaluator.lower[pair].max(axis=0), evaluator.upper[pair].min(axis=0)
    least = 0.5 * _APART * _size(theta[pair], high - low).max(axis=0)
    half = np.minimum(np.maximum(0.5 * np.abs(np.diff(theta[pair], axis=0)[0]), least),
                      0.5 * (high - low))  # fmt: skip
    middle = np.minimum(np.maximum(0.5 * theta[pair].sum(axis=0), low + half), high - half)
    # Each to the side on which it is, so that sections stay what they are.
    half = np.where(theta[pair[0]] < theta[pair[1]], -half, half)
    tried = np.repeat(theta[None], _ALONE, axis=0)
    tried[:, pair[0]] = middle + half, middle - half, middle
    tried[:, pair[1]] = middle - half, middle + half, middle
    here, there, equal = problem.predictions(tried)
    if not _is_same(here, there) or _is_same(here, equal):
        return False, _ALONE
    others = np.delete(np.arange(theta.size), pair.ravel())
    tried[:, others] = _moved(problem, theta)[others]
    return _is_same(*problem.predictions(tried[:_AGAIN])), _ALONE + _AGAIN


def _is_same(here: FloatArray, there: FloatArray) -> bool:
    with np.errstate(invalid="ignore"):
        return bool(np.max(np.abs(there - here)) <= _SAME * np.max(np.abs(here)))


def _size(values: FloatArray, span: FloatArray | float) -> FloatArray:
    """Of values: their own, or where they are small beside the range a small part of that."""
    return np.asarray(np.minimum(np.maximum(np.abs(values), _LEAST * span), span))


def _moved(problem: Problem, theta: FloatArray) -> FloatArray:
    """Values a little off, away from the nearer bound, and no two of them by as much."""
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    inward = np.where(theta - lower < upper - theta, 1.0, -1.0)
    return np.asarray(
        theta + inward * np.linspace(*_MOVED, theta.size) * _size(theta, upper - lower)
    )
