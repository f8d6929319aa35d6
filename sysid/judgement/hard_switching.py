"""Tell where a loss jumps because the equations switch, and name the smooth form.

An equation with the sign of a state, or with a condition on one, switches at some sample. As a
parameter moves, it switches one sample earlier, and the loss jumps. Such a loss has many minima.
If the islands ended at different ones, the estimate may not be the best.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from sysid.core.findings import Finding, note
from sysid.core.types import FloatArray
from sysid.core.units import format_unit
from sysid.language.printer import format_expression
from sysid.language.tree import Binary, Expression, FunctionCall, PastValue, walk
from sysid.models.model import Model
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit

_DISAGREEMENT = 0.01  # of the least RMS
_POINTS, _SPAN = 65, 1e-2  # of a line through the estimate; its length, of the range
_JUMP_SHARE = 0.5  # of the largest change between two points: of a smooth loss the next is alike
_ROUNDING = 1e-9  # of the loss


def find_hard_switches(
    problem: Problem, theta: FloatArray, rms: Sequence[float]
) -> Iterator[Finding]:
    """Find a loss that jumps near the estimate (D,) if islands ended at different `rms`."""
    finite = [value for value in rms if np.isfinite(value)]
    switch = problem.share("switch", lambda: next(_iterate_switches(problem.model), None))
    if switch is None or not finite or max(finite) <= (1.0 + _DISAGREEMENT) * min(finite):
        return
    if not _has_jumps(problem, theta):
        return
    yield note(
        "jumps of the loss",
        "numerics",
        f"the loss jumps because {format_expression(switch)} switches, and the islands ended at "
        f"different minima (RMS {min(finite):.4g} to {max(finite):.4g}{format_unit(problem.unit)})."
        f" Others may be better still. A smooth form has no jumps: {_format_smooth(switch)}, with "
        "e well below the values between which it switches.",
    )


def _iterate_switches(model: Model) -> Iterator[FunctionCall]:
    """Iterate over the functions that jump with a state: its sign, or a condition on it."""
    for tree in (*model.equations, *(output.expression for output in model.outputs)):
        for node in walk(tree):
            if (
                isinstance(node, FunctionCall)
                and node.function in ("sign", "where")
                and _reads_state(node.arguments[0])
            ):
                yield node


def _reads_state(tree: Expression) -> bool:
    return any(isinstance(node, PastValue) and node.kind == "state" for node in walk(tree))


def _format_smooth(switch: FunctionCall) -> str:
    """Format the smooth form of a function that jumps."""
    if switch.function == "sign":
        return f"tanh(({format_expression(switch.arguments[0])})/e)"
    condition, yes, no = switch.arguments
    if not (isinstance(condition, Binary) and condition.operator in ("<", "<=", ">", ">=")):
        return "tanh(z/e) instead of the sign of z"
    above, below = (yes, no) if condition.operator in (">", ">=") else (no, yes)
    high, low = format_expression(above), format_expression(below)
    left, right = format_expression(condition.left), format_expression(condition.right)
    return f"({low}) + (({high}) - ({low}))*(1 + tanh(({left} - ({right}))/e))/2"


def _has_jumps(problem: Problem, theta: FloatArray) -> bool:
    """Whether the loss jumps on a short line through the estimate, along any parameter."""
    point = to_unit(problem.evaluator, theta[None])[0]
    steps = np.linspace(-0.5 * _SPAN, 0.5 * _SPAN, _POINTS)
    points = np.repeat(point[None], point.size * _POINTS, axis=0)
    inside = np.clip(point, 0.5 * _SPAN, 1.0 - 0.5 * _SPAN)
    for d in range(point.size):
        points[d * _POINTS : (d + 1) * _POINTS, d] = inside[d] + steps
    losses = problem.evaluate_fitness(from_unit(problem.evaluator, points)) ** 2
    with np.errstate(invalid="ignore"):
        changes = np.diff(losses.reshape(point.size, _POINTS), axis=1)
        bends = np.max(np.abs(np.diff(changes, axis=1)), axis=1)
    largest = np.max(np.abs(changes), axis=1)
    return bool(np.any((largest > _ROUNDING * np.min(losses)) & (bends > _JUMP_SHARE * largest)))
