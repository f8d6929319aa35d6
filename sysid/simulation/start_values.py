"""Where the states of a problem start at an estimate, and estimates for other starts."""

from collections.abc import Mapping

import numpy as np

from sysid.core.errors import SysidError
from sysid.core.types import FloatArray
from sysid.language.evaluation import evaluate_expression
from sysid.language.transform import substitute
from sysid.language.tree import Expression, Number, PastValue
from sysid.models.model import DerivedInitial, EstimatedInitial, name_initial_state
from sysid.simulation.problem import Problem

_ROUNDING = 1e-9  # of the largest start: smaller differences are none


def list_starts(problem: Problem, theta: FloatArray) -> dict[str, float]:
    """List where the states start at an estimate (D,), by the names of initial states."""
    numbers = problem.evaluator.template.copy()
    numbers[problem.evaluator.free_rows] = theta
    names = (parameter.name for parameter in problem.all_parameters)
    values = dict(zip(names, numbers.tolist(), strict=True))
    model, starts = problem.model, dict[str, float]()
    inputs = [signal.name for signal in model.inputs]
    for e, experiment in enumerate(problem.experiments):
        first_values = dict(zip(inputs, experiment.first_inputs, strict=True))
        for i, (state, start) in enumerate(zip(model.states, model.initial, strict=True)):
            name = name_initial_state(state.name, e)
            if isinstance(start, EstimatedInitial):
                starts[name] = values[name]
            elif isinstance(start, DerivedInitial):
                tree = _insert_values(start.expression, first_values)
                known = {**values, "h": experiment.grid.integration_step}
                starts[name] = evaluate_expression(tree, known)
            else:
                starts[name] = float(experiment.starts[i].first_values[0])
            first_values[state.name] = starts[name]  # a lagged state starts there too
    return starts


def _insert_values(tree: Expression, first_values: Mapping[str, float]) -> Expression:
    def find_value(node: Expression) -> Expression | None:
        return Number(first_values[node.name]) if isinstance(node, PastValue) else None

    return substitute(tree, find_value)


def convert_point(
    before: Problem, after: Problem, theta: FloatArray, added: Mapping[str, float] | None = None
) -> FloatArray:
    """Convert an estimate (D,) to a problem with other starts, and the same ones if it has them.

    `added` are values of parameters that only the other problem has. Its bounds hold.
    """
    own = dict(zip(before.free_names, theta.tolist(), strict=True))
    values = {**(added or {}), **list_starts(before, theta), **own}
    point = np.array([values[name] for name in after.free_names])
    return np.asarray(np.clip(point, after.evaluator.lower, after.evaluator.upper))


def starts_at_rest(problem: Problem, theta: FloatArray) -> bool:
    """Whether no start is estimated, and the states stand still at an estimate (D,)."""
    declared = {parameter.name for parameter in problem.model.parameters}
    if not declared.issuperset(problem.free_names):
        return False
    changes = {name: one for name, one in problem.settings.parameters.items() if name in declared}
    try:
        rest = problem.rebuild(initial="rest", parameters=changes)
    except SysidError:  # the model has no rest
        return False
    if not declared.issuperset(rest.free_names):
        return False  # a level of an integrator
    starts, resting = list_starts(problem, theta), list_starts(rest, theta)
    size = max(map(abs, starts.values()), default=0.0)
    return all(abs(value - resting[name]) <= _ROUNDING * size for name, value in starts.items())
