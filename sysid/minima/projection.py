"""Points over the whole range with the linear parameters solved for, by variable projection.

The output of a linear plant depends linearly on gains, offsets and initial states. Wide bounds of
these hide the minimum in the others, a time lag above all: at a random point they are all wrong
together. For given other parameters the best linear ones follow from one linear least-squares
problem (variable projection: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413). So only the
others are drawn, by Latin hypercube sampling.

Which parameters are linear is tested on the outputs, not read from the equations.

A filter's likelihood is flat far from its minima, and no gain is linear in it. There the points
are those of the free run, with the sizes of noise kept. They show whether the search missed a
minimum, so they are drawn even if nothing is linear.
"""

import numpy as np

from sysid.core.types import RANK_TOLERANCE, FloatArray
from sysid.simulation.free_run import convert_to_free_run
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit
from sysid.uncertainty.linear_model import make_move_generator

_POINTS = 512
_FEWEST_POINTS = 32
_SHARE = 0.6  # of the budget; least squares from the best points takes the rest
_REACH = 0.25  # of the range: moves that test whether a parameter is linear
_TOLERANCE = 1e-6  # of the change of the output
_MAX_VALUES = 4_000_000  # of the outputs simulated at once: 32 MB


def find_linear_parameters(problem: Problem, theta: FloatArray) -> tuple[list[int], int]:
    """Find free parameters on which the outputs depend linearly, all together, at a point (D,).

    Returns their numbers, and the simulations that the test took.
    """
    moves = _choose_moves(problem, theta)
    points = np.concatenate([theta[None], theta + np.diag(moves), theta + np.diag(0.5 * moves)])
    base, *moved = problem.predict(points)
    full, half = np.array(moved[: theta.size]) - base, np.array(moved[theta.size :]) - base
    spent = len(points)
    linear: list[int] = []
    for d in range(theta.size):
        if not _is_same(full[d], 2.0 * half[d]):
            continue
        together = [*linear, d]
        if linear:
            point = theta.copy()
            point[together] += moves[together]
            spent += 1
            if not _is_same(problem.predict(point[None])[0] - base, full[together].sum(axis=0)):
                continue
        linear = together
    return linear, spent


def draw_projected_points(
    problem: Problem, theta: FloatArray, seed: int, budget: int
) -> tuple[FloatArray, FloatArray, int]:
    """Draw points over the whole range, with the linear parameters solved for.

    Beside a filter these are points of the free run, and their fitness is the filter's.

    Parameters
    ----------
    theta : FloatArray, shape (D,)
        Where the linear parameters are tested.
    budget : int
        Simulations at most. If they suffice for few points only, or if no parameter of a free run
        is linear, there are none.

    Returns
    -------
    points : FloatArray, shape (P, D)
    fitness : FloatArray, shape (P,)
    evaluations : int
    """
    free, start = convert_to_free_run(problem, theta)
    drawn, spent = _draw_free_points(free, start, seed, budget, needs_linear=free is problem)
    points = np.repeat(theta[None], len(drawn), axis=0)
    points[:, [problem.free_names.index(name) for name in free.free_names]] = drawn
    fitness = problem.evaluate_fitness(points) if len(points) else np.empty(0)
    return points, fitness, spent + len(points)


def _draw_free_points(
    problem: Problem, theta: FloatArray, seed: int, budget: int, *, needs_linear: bool
) -> tuple[FloatArray, int]:
    """Draw the points (P, D) without their fitness; return the simulations so far too."""
    nothing = np.empty((0, theta.size))
    if budget < 3 * theta.size + 1:
        return nothing, 0
    linear, spent = find_linear_parameters(problem, theta)
    count = min(_POINTS, int(_SHARE * (budget - spent)) // (len(linear) + 2))
    if len(linear) == theta.size or count < _FEWEST_POINTS or (needs_linear and not linear):
        return nothing, spent
    random = make_move_generator(seed)
    unit = np.array([random.permutation(count) for _ in theta]).T
    points = from_unit(problem.evaluator, (unit + random.random(unit.shape)) / count)
    if not linear:
        return points, spent
    points[:, linear] = theta[linear]
    at_once = max(1, _MAX_VALUES // ((len(linear) + 1) * problem.evaluator.weight.size))
    moves = _choose_moves(problem, theta)
    for first in range(0, count, at_once):
        part = points[first : first + at_once]
        _solve_linear_parameters(problem, part, linear, moves[linear])
    return points, spent + count * (len(linear) + 1)


def _choose_moves(problem: Problem, theta: FloatArray) -> FloatArray:
    """Choose a move (D,) of each parameter that stays inside its bounds."""
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    move = _REACH * (upper - lower)
    return np.where(theta + move <= upper, move, -move)


def _is_same(change: FloatArray, expected: FloatArray) -> bool:
    """Whether two changes of the outputs (M,) agree and are not zero; False if one diverged."""
    size = float(np.max(np.abs(expected), initial=0.0))
    with np.errstate(invalid="ignore"):
        error = float(np.max(np.abs(change - expected), initial=0.0))
    return 0.0 < size < np.inf and error <= _TOLERANCE * size


def _solve_linear_parameters(
    problem: Problem, points: FloatArray, linear: list[int], moves: FloatArray
) -> None:
    """Replace the linear parameters of points (P, D) by the best ones inside their bounds."""
    rows, evaluator = problem.scored_rows, problem.evaluator
    weight = evaluator.weight[rows]
    moved = np.repeat(points[:, None], len(linear) + 1, axis=1)
    for i, d in enumerate(linear):
        moved[:, 1 + i, d] += moves[i]
    with np.errstate(all="ignore"):
        outputs = weight * problem.predict(moved.reshape(-1, points.shape[1]))[:, rows]
    outputs = outputs.reshape(len(points), len(linear) + 1, rows.size)
    measured = weight * evaluator.measured[rows]
    for point, values in zip(points, outputs, strict=True):
        if np.isfinite(values).all():
            base, columns = values[0], (values[1:] - values[0]).T / moves
            point[linear] += np.linalg.lstsq(columns, measured - base, rcond=RANK_TOLERANCE)[0]
    lower, upper = evaluator.lower[linear], evaluator.upper[linear]
    points[:, linear] = np.clip(points[:, linear], lower, upper)
