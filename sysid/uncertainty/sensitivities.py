"""Sensitivities of the simulated output to each free parameter, also across jumps.

If the sign of a velocity changes one sample earlier, the output jumps. A difference quotient across
such a jump grows as its step shrinks, and a standard error from it is far too small. Searches end
near jumps, because the loss jumps too. So if the slopes to both sides disagree, each side is
divided into segments from 1e-6 to 1e-2 of the range. The slopes of two neighbouring segments that
agree are used.

A time lag that is rounded to whole samples (nearest interpolation) leaves the output unchanged on a
*plateau* and changes it at the plateau's ends. A small difference is useless there: it is zero, or
grows as its step shrinks. So each side is searched for the nearest jump. The slope is taken from
the middle of the plateau below to the middle of the plateau above.
"""

from typing import NamedTuple

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import BoolArray, FloatArray, IntArray
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit

_DIFFERENCE_STEP = 1e-5  # of the range
_SLOPE_AGREEMENT = 0.1  # of a slope: two that differ by less do not straddle a jump
_SEGMENT_EDGES = np.array([1e-6, _DIFFERENCE_STEP, 1e-4, 1e-3, 1e-2])  # of segments, of the range
_STEP_GROWTH = 4.0  # from one step of the search for a jump to the next
_MAX_STEP = 0.7  # of the range: the last step of that search
_HALVINGS = 6  # locate a jump to about 1 % of its distance


class Sensitivities(NamedTuple):
    """Weighted residuals and their slopes at an estimate, in unit coordinates p.

    Attributes
    ----------
    residuals : FloatArray, shape (n,)
    columns : FloatArray, shape (n, D)
        ∂ŷ/∂p, weighted; zero if undefined.
    plateau_width : FloatArray, shape (D,)
        Width on which the output does not change with that parameter; 0: no plateau.
    one_sided : BoolArray, shape (D,)
        The output jumps on one side of the estimate only: no slope.
    plateau_offset : FloatArray, shape (D,)
        Distance from the estimate up to the middle of its plateau; 0: no plateau.
    evaluations : int
    """

    residuals: FloatArray
    columns: FloatArray
    plateau_width: FloatArray
    one_sided: BoolArray
    plateau_offset: FloatArray
    evaluations: int


class BudgetSpentError(Exception):
    """The budget of simulations does not suffice; `evaluations` of them were run.

    `residuals` are the weighted residuals (n,) at the estimate; None if no simulation was left.
    """

    def __init__(self, evaluations: int, error: FloatArray | None) -> None:
        super().__init__(f"{evaluations} simulations were not enough")
        self.evaluations, self.residuals = evaluations, error


def compute_sensitivities(
    problem: Problem, theta: FloatArray, max_simulations: int | None = None
) -> Sensitivities:
    """Compute sensitivities at an estimate (D,) by central differences; one-sided at a bound.

    Raises
    ------
    BudgetSpentError
        If they take more than `max_simulations` simulations.
    """
    probe = _OutputProbe(problem, theta, max_simulations)
    d = probe.point.size
    plateau, middle = np.zeros(d), np.zeros(d)
    one_sided = np.zeros(d, dtype=np.bool_)
    parameters = np.arange(2 * d)
    steps, shifted = probe.simulate_steps(
        parameters % d, np.where(parameters < d, -_DIFFERENCE_STEP, _DIFFERENCE_STEP)
    )
    columns, moves, differ = _compute_central_differences(probe.predicted, steps, shifted)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        for d in np.flatnonzero(moves & differ).tolist():
            columns[:, d] = _estimate_slope_near_jumps(probe, d)
        jumping = np.flatnonzero(~moves)
        if jumping.size:
            down, below = probe.find_jumps(jumping, -1.0)
            up, above = probe.find_jumps(jumping, 1.0)
            parameters = np.isfinite(down) & np.isfinite(up)
            width = np.where(parameters, up + down, 0.0)
            plateau[jumping], one_sided[jumping] = width, np.isfinite(down) != np.isfinite(up)
            middle[jumping] = np.where(parameters, 0.5 * (up - down), 0.0)
            steps = np.where(parameters, 2.0 * width, np.inf)
            columns[:, jumping] = np.where(parameters, (above - below) / steps, 0.0)
        columns = probe.weight[:, None] * np.where(np.isfinite(columns), columns, 0.0)
        error = probe.residuals
    return Sensitivities(error, columns, plateau, one_sided, middle, probe.evaluations)


@jit_compile
def _compute_central_differences(
    predicted: FloatArray, steps: FloatArray, shifted: FloatArray
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Compute central differences (n, D), and compare both sides of each parameter.

    Also returned: whether the output moves on both sides, and whether the slopes differ.

    Parameters
    ----------
    predicted, shifted : FloatArray, shape (n,), (n, 2D)
        Output at the estimate, and after `steps` (2D,) of each parameter down and then up.
    """
    d = steps.size // 2
    slopes = np.zeros((predicted.size, d))
    moves, differ = np.empty(d, dtype=np.bool_), np.empty(d, dtype=np.bool_)
    for j in range(d):
        low, high = steps[j], steps[d + j]
        falls, rises, apart, left, right = low == 0.0, high == 0.0, 0.0, 0.0, 0.0
        for i in range(predicted.size):
            below, above = shifted[i, j], shifted[i, d + j]
            falls |= below != predicted[i]
            rises |= above != predicted[i]
            down, up = (predicted[i] - below) / -low, (above - predicted[i]) / high
            left, right, apart = left + down**2, right + up**2, apart + (up - down) ** 2
        moves[j] = falls and rises
        differ[j] = not apart <= _SLOPE_AGREEMENT**2 * min(
            left, right
        )  # also where there is one side only
        if moves[j]:
            for i in range(predicted.size):
                slopes[i, j] = (shifted[i, d + j] - shifted[i, j]) / (high - low)
    return slopes, moves, differ


def _estimate_slope_near_jumps(probe: "_OutputProbe", d: int) -> FloatArray:
    """Estimate the slope (n,) in one parameter: the mean of the sides that have one."""
    sides = [_estimate_side_slope(probe, d, side) for side in (-1.0, 1.0)]
    best = min(doubt for doubt, _ in sides)
    slopes = [slope for doubt, slope in sides if doubt <= max(best, _SLOPE_AGREEMENT)]
    return np.asarray(np.mean(slopes, axis=0))


def _estimate_side_slope(probe: "_OutputProbe", d: int, side: float) -> tuple[float, FloatArray]:
    """Find the neighbouring segments that agree best: their difference and slope (n,)."""
    room = 1.0 - probe.point[d] if side > 0 else probe.point[d]
    ends = side * _SEGMENT_EDGES[room >= _SEGMENT_EDGES]
    if ends.size < 2:
        return np.inf, np.zeros(probe.predicted.size)
    steps, outputs = probe.simulate_steps(np.full(ends.size, d), ends)
    lengths = np.diff(steps, prepend=0.0)
    slopes = (np.diff(outputs, prepend=probe.predicted[:, None]) / lengths).T
    sizes = np.linalg.norm(slopes, axis=1)
    apart = np.linalg.norm(np.diff(slopes, axis=0), axis=1)
    doubt = apart / np.maximum(np.minimum(sizes[1:], sizes[:-1]), np.finfo(float).tiny)
    best = int(np.argmin(np.where(np.isfinite(doubt), doubt, np.inf)))
    return float(doubt[best]), slopes[best + 1]


class _OutputProbe:
    """Scored output near an estimate, with one parameter moved at a time."""

    def __init__(self, problem: Problem, theta: FloatArray, max_simulations: int | None) -> None:
        if max_simulations is not None and max_simulations < 1:
            raise BudgetSpentError(0, None)
        self._problem, self._theta, self._most = problem, theta, max_simulations
        self.weight = problem.evaluator.weight[problem.scored_rows]
        self.measured = problem.evaluator.measured[problem.scored_rows]
        self.point = to_unit(problem.evaluator, theta[None])[0]
        self.predicted = problem.predict(theta[None])[0][problem.scored_rows]
        self.evaluations = 1

    @property
    def residuals(self) -> FloatArray:
        """Weighted residuals (n,) at the estimate."""
        return np.asarray(self.weight * (self.predicted - self.measured))

    def simulate_steps(self, which: IntArray, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Simulate steps, cut off at the bounds: steps taken and outputs (n, len(which)).

        The other parameters keep their bits. Converted to points and back they might be rounded,
        and the output would seem to change on a plateau.
        """
        if self._most is not None and self.evaluations + which.size > self._most:
            raise BudgetSpentError(self.evaluations, self.residuals)
        moved = np.clip(self.point[which] + steps, 0.0, 1.0)
        rows = np.arange(which.size)
        points = np.repeat(self.point[None], which.size, axis=0)
        points[rows, which] = moved
        around = np.repeat(self._theta[None], which.size, axis=0)
        around[rows, which] = from_unit(self._problem.evaluator, points)[rows, which]
        predicted = self._problem.predict(around)
        self.evaluations += which.size
        scored = predicted[:, self._problem.scored_rows]
        return moved - self.point[which], np.ascontiguousarray(scored.T)

    def find_jumps(self, which: IntArray, side: float) -> tuple[FloatArray, FloatArray]:
        """Find each parameter's nearest jump on one side: its distance and the outputs beyond it.

        The distance is infinite if there is no jump.
        """
        near, far = np.zeros(which.size), np.full(which.size, np.inf)
        beyond = np.repeat(self.predicted[:, None], which.size, axis=1)
        step = _DIFFERENCE_STEP
        while step < _MAX_STEP and np.any(np.isinf(far)):
            self._narrow_jumps(which, side, np.full(which.size, step), near, far, beyond)
            step *= _STEP_GROWTH
        for _ in range(_HALVINGS):
            self._narrow_jumps(which, side, 0.5 * (near + far), near, far, beyond)
        return far, beyond

    def _narrow_jumps(
        self,
        which: IntArray,
        side: float,
        steps: FloatArray,
        near: FloatArray,
        far: FloatArray,
        beyond: FloatArray,
    ) -> None:
        """Narrow down each jump, in place, by one more simulation of each parameter."""
        open_ = np.flatnonzero((near < steps) & (steps < far))
        if open_.size == 0:
            return
        taken, predicted = self.simulate_steps(which[open_], side * steps[open_])
        moved = np.any(predicted != self.predicted[:, None], axis=0)
        far[open_[moved]] = np.abs(taken[moved])
        beyond[:, open_[moved]] = predicted[:, moved]
        near[open_[~moved]] = steps[open_[~moved]]
