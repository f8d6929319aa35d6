"""Exchangeable parameters (label switching), such as two time constants in series.

No data can tell which is the first. The equations need not show it, because the inner states
differ. So it is tested by simulation, as in `sysid.identifiability.translations`. Parameters of the
same unit are set apart and exchanged, and the model is simulated. If the output stays the same, the
test is repeated with all other parameters moved. The repetition is needed because two gains at one
bound make parallel subsystems alike at that estimate only.

The estimates are reported in one order, the largest first. If the bounds exclude the other order,
they tell which is which, and nothing is exchanged.

Parallel subsystems are exchanged as a whole, with gains and initial states. The equations show
which parameters belong together (`sysid.identifiability.subsystems`), and the same test follows.
For S states this takes at most S(S - 1)/2 times five simulations.
"""

from collections.abc import Iterator
from itertools import chain, combinations

import numpy as np

from sysid.core.types import FloatArray
from sysid.identifiability.scaling_symmetries import find_scalings
from sysid.identifiability.subsystems import ExchangeUnit, find_equivalent_subsystems
from sysid.models.model_delays import list_past_values
from sysid.models.ties import collect_parameter_names
from sysid.simulation.problem import Problem

ExchangeGroup = tuple[ExchangeUnit, ...]
"""Exchangeable units (k, w), as indices of free parameters."""

ExchangeGroups = tuple[ExchangeGroup, ...]

_MIN_DISTANCE = 0.05  # of their size: least distance of the two in the test
_MIN_SIZE = 1e-3  # of the range: values nearer 0 count as of this size
_MOVE_SHARES = 0.02, 0.05  # of their size: the moves of the other parameters
_SAME_TOLERANCE = 1e-9  # of the output's size: rounding
_BATCH_SIZE = 8  # simulations
_COMPARED_SAMPLES = 10_000  # samples, about, that are compared to exclude pairs
_PAIR_SIMULATIONS, _REPEAT_SIMULATIONS = 3, 2  # simulations for a pair, and with the others moved


def find_exchanges(
    problem: Problem, theta: FloatArray, most: int | None = None
) -> tuple[ExchangeGroups, int]:
    """Find exchangeable parameters around an estimate (D,), and count the simulations.

    Parameters
    ----------
    most : int or None
        Limit on the simulations; pairs beyond are not tested.
    """
    groups: list[ExchangeGroup] = []
    pairs, spent = _exclude_unlikely(
        problem, theta, list(_iterate_candidates(problem, theta)), most
    )
    single = (((first,), (second,)) for first, second in pairs)
    subsystems = (
        pair
        for pair in find_equivalent_subsystems(problem)
        if _bounds_allow_exchange(problem, theta, *pair)
    )
    for first, second in chain(single, subsystems):
        if _find_group(groups, first) == _find_group(groups, second):
            continue
        if most is not None and spent + _PAIR_SIMULATIONS + _REPEAT_SIMULATIONS > most:
            break
        is_exchangeable, count = _test_exchange(problem, theta, first, second)
        spent += count
        if is_exchangeable:
            groups = _merge_units(groups, first, second)
    sorted_groups = sorted(tuple(sorted(group)) for group in groups)
    return tuple(
        group
        for group in sorted_groups
        if _is_decreasing(order_exchangeable(problem, theta, (group,)), group)
    ), spent


def _is_decreasing(theta: FloatArray, group: ExchangeGroup) -> bool:
    """Return whether a group is in decreasing order, which bounds can prevent."""
    return bool(np.all(np.diff(theta[[unit[0] for unit in group]]) <= 0.0))


def _bounds_allow_exchange(
    problem: Problem, theta: FloatArray, first: ExchangeUnit, second: ExchangeUnit
) -> bool:
    """Return whether the bounds allow the exchange of two units."""
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    present, exchanged = [*first, *second], [*second, *first]
    return bool(np.all((lower[present] <= theta[exchanged]) & (theta[exchanged] <= upper[present])))


def _find_group(groups: list[ExchangeGroup], unit: ExchangeUnit) -> ExchangeGroup:
    matches = (group for group in groups if any(set(unit) == set(member) for member in group))
    return next(matches, (unit,))


def _merge_units(
    groups: list[ExchangeGroup], first: ExchangeUnit, second: ExchangeUnit
) -> list[ExchangeGroup]:
    """Merge the groups of two units; all units follow the order of the first."""
    first_group, second_group = _find_group(groups, first), _find_group(groups, second)
    goes_to = dict(zip(first, second, strict=True))
    first_unit = next(unit for unit in first_group if set(unit) == set(first))
    second_unit = next(unit for unit in second_group if set(unit) == set(second))
    order = [second_unit.index(goes_to[d]) for d in first_unit]
    reordered = tuple(tuple(unit[i] for i in order) for unit in second_group)
    return [
        *(group for group in groups if group not in (first_group, second_group)),
        first_group + reordered,
    ]


def order_exchangeable(problem: Problem, theta: FloatArray, groups: ExchangeGroups) -> FloatArray:
    """Sort the values (..., D) of each group in decreasing order, where the bounds allow it."""
    ordered = np.array(theta)
    for group in groups:
        units = np.array(group)
        values = ordered[..., units]  # (..., k, w)
        order = np.argsort(-values[..., 0], axis=-1, kind="stable")
        falling = np.take_along_axis(values, order[..., None], axis=-2)
        lower, upper = problem.evaluator.lower[units], problem.evaluator.upper[units]
        fits = np.all((lower <= falling) & (falling <= upper), axis=(-2, -1), keepdims=True)
        ordered[..., units] = np.where(fits, falling, values)
    return ordered


def find_ordered_partners(
    groups: ExchangeGroups, theta: FloatArray, d: int
) -> tuple[list[int], list[int]]:
    """Find the partners of a parameter that are larger than it in an estimate (D,), and smaller."""
    columns = [pair for group in groups for pair in zip(*group, strict=True) if d in pair]
    partners = [(i, theta[i] - theta[d] or d - i) for pair in columns for i in pair if i != d]
    return [i for i, above in partners if above > 0], [i for i, above in partners if above < 0]


def describe_exchanges(
    problem: Problem, groups: ExchangeGroups, reported: set[str]
) -> tuple[str, ...]:
    """Describe exchangeable groups among the `reported` names, those with standard errors."""
    return tuple(
        _describe_group(problem, group)
        for group in groups
        if _has_reported_values(problem, group, reported)
    )


def _has_reported_values(problem: Problem, group: ExchangeGroup, reported: set[str]) -> bool:
    """Return whether some parameter of the units is reported for each of them."""
    columns = zip(*group, strict=True)
    return any(
        all(problem.free_parameters[d].name in reported for d in column) for column in columns
    )


def _describe_group(problem: Problem, group: ExchangeGroup) -> str:
    names = [[problem.free_parameters[d].name for d in unit] for unit in group]
    if len(names[0]) == 1:
        return (
            f"{' and '.join(name for (name,) in names)} can be exchanged without any effect on the "
            "output. No data can tell which is which. They are reported in decreasing order"
        )
    units = " and ".join(f"({', '.join(unit)})" for unit in names)
    return (
        f"{units} can be exchanged as a whole without any effect on the output. No data can tell "
        f"which is which. They are reported in decreasing order of {names[0][0]}"
    )


def _iterate_candidates(problem: Problem, theta: FloatArray) -> Iterator[tuple[int, int]]:
    """Iterate over pairs of the same unit, both delays or neither, whose bounds allow both orders.

    Factors of which only the product is identifiable are excluded: they can do more than swap.
    """
    if problem.model.form == "polynomial":
        return  # each coefficient has its own term
    model_names = {parameter.name for parameter in problem.model.parameters}
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    units = [
        parameter.unit if parameter.name in model_names else None
        for parameter in problem.free_parameters
    ]
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
    delay_names = set().union(
        *(collect_parameter_names(p.delay) for p in list_past_values(problem.model) if p.delay),
        set(),
    )
    scaled = np.any(find_scalings(problem.model, problem.all_parameters) != 0.0, axis=0)
    for i, j in alike:
        in_delays = [problem.free_parameters[d].name in delay_names for d in (i, j)]
        if in_delays[0] == in_delays[1] and not (scaled[i] or scaled[j]):
            yield i, j


def _merge_members(groups: list[set[int]], first: int, second: int) -> list[set[int]]:
    """Merge the groups of two members."""
    near = [group for group in groups if group & {first, second}]
    far = [group for group in groups if not group & {first, second}]
    return [*far, set().union({first, second}, *near)]


def _exclude_unlikely(
    problem: Problem, theta: FloatArray, pairs: list[tuple[int, int]], most: int | None
) -> tuple[list[tuple[int, int]], int]:
    """Exclude pairs by one simulation for each parameter; return the rest and the simulations.

    A full test of each pair takes several simulations, so hundreds for 24 gains. Here all
    parameters get one value. A small increase of either of two exchangeable ones then has the same
    effect.
    """
    groups: list[set[int]] = []
    for pair in pairs:
        groups = _merge_members(groups, *pair)
    remaining, spent = list(pairs), 0
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
        remaining = [
            (i, j)
            for i, j in remaining
            if i not in group
            or not np.isfinite([answers[i], answers[j]]).all()
            or _is_same_output(answers[i], answers[j])
        ]
    return remaining, spent


def _simulate_perturbed(
    problem: Problem, theta: FloatArray, members: list[int], low: float, high: float
) -> dict[int, FloatArray]:
    """Simulate, for each member, all members at one value and this one slightly above."""
    value = float(np.median(theta[members]))
    increase = _MIN_DISTANCE * float(_scale_values(np.array(value), high - low))
    value = min(max(value, low), high - increase)
    perturbed: dict[int, FloatArray] = {}
    for first in range(0, len(members), _BATCH_SIZE):  # a long record leaves no room for all
        batch = members[first : first + _BATCH_SIZE]
        individuals = np.repeat(theta[None], len(batch), axis=0)
        individuals[:, members] = value
        individuals[np.arange(len(batch)), batch] += increase
        outputs = problem.predict(individuals)
        step = max(1, outputs.shape[1] // _COMPARED_SAMPLES)
        perturbed |= dict(zip(batch, outputs[:, ::step].copy(), strict=True))
    return perturbed


def _test_exchange(
    problem: Problem, theta: FloatArray, first: ExchangeUnit, second: ExchangeUnit
) -> tuple[bool, int]:
    """Test whether the exchange of two units keeps the output and their mean changes it.

    Returns the result and the number of simulations.
    """
    evaluator, pair = problem.evaluator, np.array([first, second])
    low, high = evaluator.lower[pair].max(axis=0), evaluator.upper[pair].min(axis=0)
    least_half = 0.5 * _MIN_DISTANCE * _scale_values(theta[pair], high - low).max(axis=0)
    half = np.minimum(
        np.maximum(0.5 * np.abs(np.diff(theta[pair], axis=0)[0]), least_half), 0.5 * (high - low)
    )
    middle = np.minimum(np.maximum(0.5 * theta[pair].sum(axis=0), low + half), high - half)
    # Each stays on its side, so that subsystems stay the same.
    half = np.where(theta[pair[0]] < theta[pair[1]], -half, half)
    individuals = np.repeat(theta[None], _PAIR_SIMULATIONS, axis=0)
    individuals[:, pair[0]] = middle + half, middle - half, middle
    individuals[:, pair[1]] = middle - half, middle + half, middle
    original, exchanged, averaged = problem.predict(individuals)
    if not _is_same_output(original, exchanged) or _is_same_output(original, averaged):
        return False, _PAIR_SIMULATIONS
    others = np.delete(np.arange(theta.size), pair.ravel())
    individuals[:, others] = _move_inward(problem, theta)[others]
    return _is_same_output(
        *problem.predict(individuals[:_REPEAT_SIMULATIONS])
    ), _PAIR_SIMULATIONS + _REPEAT_SIMULATIONS


def _is_same_output(first: FloatArray, second: FloatArray) -> bool:
    with np.errstate(invalid="ignore"):
        return bool(np.max(np.abs(second - first)) <= _SAME_TOLERANCE * np.max(np.abs(first)))


def _scale_values(values: FloatArray, span: FloatArray | float) -> FloatArray:
    """Compute the size of values: their own, or a small part of the range if that is larger."""
    return np.asarray(np.minimum(np.maximum(np.abs(values), _MIN_SIZE * span), span))


def _move_inward(problem: Problem, theta: FloatArray) -> FloatArray:
    """Move values away from the nearer bound, each by a different share of its size."""
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    inward = np.where(theta - lower < upper - theta, 1.0, -1.0)
    return np.asarray(
        theta
        + inward * np.linspace(*_MOVE_SHARES, theta.size) * _scale_values(theta, upper - lower)
    )
