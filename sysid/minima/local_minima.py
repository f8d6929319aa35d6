"""Search for minima near an estimate: on a rough loss, least squares ends at one of many.

Switches such as dry friction make the loss jump. Minima then lie side by side inside the
statistical ellipsoid, with losses that the noise hardly distinguishes. Points are drawn along
s²(SᵀS)⁻¹, in which the likelihood ratio of squares is measured for residuals of any colour. If the
loss there agrees with the linear model, the search ends. Otherwise least squares continues from
the points that are lowest compared to the linear model. It is repeated around a better minimum
(basin hopping, Wales and Doye, J. Phys. Chem. A 101 (1997) 5111).

Such a minimum often lies on the edge of a jump, where no slope leads along the edge. So at last an
evolution strategy follows it, unless the search has probed the loss and met no jump. The best of a
batch of points around the best one replaces it. Their spread grows after a gain and shrinks
otherwise (Rechenberg, Evolutionsstrategie, 1973).

A minimum whose likelihood ratio n ln(Σe²/Σe²₀) is below the square of the interval's quantile is
inside the profile likelihood region (Venzon and Moolgavkar, Appl. Statist. 37 (1988) 87). With the
curvature of the best minimum, each one covers the values within √(q² − ratio) standard errors. The
interval extends from the least to the largest of all these. With coloured residuals the likelihood
ratio is inflated by the factor by which s²(SᵀS)⁻¹ underestimates the variance.

A time lag that is rounded to samples is not moved. Its standard error is from plateau to plateau,
and the position on a plateau where a search ends has no meaning.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.core.types import FloatArray
from sysid.search.refine import RefinedCandidate, refine_candidate
from sysid.simulation.problem import Problem
from sysid.uncertainty.intervals import CompatibleMinima
from sysid.uncertainty.linear_model import LinearOutputModel, factor_covariance, make_move_generator

_DRAW_DEVIATIONS = np.array([0.5, 1.0, 2.0, 3.0])  # standard errors
_ROUGHNESS_POINTS = 24  # points that show whether the loss is rough
_POINTS_PER_ROUND = 192  # points in a round
_STARTS_PER_ROUND = 8  # of these: the lowest compared to the linear model
_MAX_ROUNDS = 2
_MAX_STEPS = 12  # of least squares from each point
_ROUGHNESS_TOLERANCE = 0.5  # of the linear model's likelihood ratio: a larger deviation is rough
_BATCH_SIZE = 32  # points around the best one
_FIRST_SPREAD = 0.5  # standard errors: their spread at the beginning
_LAST_SPREAD = 1e-3  # standard errors: a smaller spread ends the search
_SPREAD_GROWTH = 1.1  # of the spread, after a gain
_SPREAD_DECAY = 0.7  # of the spread, after none
_MAX_SIMULATIONS = 1800  # simulations
_MAX_WORK = 50_000_000  # steps of integration or recursion: on long records simulations are fewer
_MAX_LATE_WORK = 5_000_000  # as many when the time of the run is over
_GAIN_TOLERANCE = 1e-9  # relative


@dataclass(frozen=True, slots=True, eq=False)
class LocalMinima:
    """Minima near an estimate.

    Attributes
    ----------
    best : RefinedCandidate or None
        A better minimum; None if the estimate is the best.
    values : FloatArray, shape (m, D)
        All minima, the estimate first; only the estimate if the loss agrees with the linear model.
    rms : FloatArray, shape (m,)
    evaluations : int
    """

    best: RefinedCandidate | None
    values: FloatArray
    rms: FloatArray
    evaluations: int


def count_affordable_simulations(
    problem: Problem, is_late: bool, most: int = _MAX_SIMULATIONS
) -> int:
    """Count the simulations affordable after a search: fewer, the longer one takes.

    The cost is measured in integration steps, not by the clock, so equal runs give equal results.
    """
    steps = sum(
        experiment.grid.points * experiment.grid.substeps for experiment in problem.experiments
    )
    limit = min(most, (_MAX_LATE_WORK if is_late else _MAX_WORK) // max(steps, 1))
    return limit if limit >= _ROUGHNESS_POINTS else 0


def find_local_minima(
    problem: Problem,
    theta: FloatArray,
    rms: float,
    linear: LinearOutputModel,
    seed: int,
    max_simulations: int | None = None,
    *,
    may_jump: bool,
) -> LocalMinima:
    """Search for minima around an estimate (D,) with at most `max_simulations` simulations.

    `may_jump`: whether jumps are possible. A rough loss may also just bend.
    """
    search = _LocalSearch(
        problem, linear, seed, 2**62 if max_simulations is None else max_simulations
    )
    first = best = RefinedCandidate(theta, rms, 0)
    minima = [first]
    if rms > 0 and search.root.any() and search.is_rough(best):
        for _ in range(_MAX_ROUNDS):
            ends = search.refine_starts(best)
            minima += ends
            reached = min((best, *ends), key=lambda candidate: candidate.rms)
            gains = reached.rms < best.rms * (1.0 - _GAIN_TOLERANCE)
            best = reached  # also if lower by rounding only: the last minimum is the lowest
            if not gains or best.rms == 0:
                break
        if may_jump and best.rms > 0:
            best = search.run_evolution_strategy(best)
            minima.append(best)
    better = best if best.rms < rms * (1.0 - _GAIN_TOLERANCE) else None
    return LocalMinima(
        better,
        np.array([candidate.theta for candidate in minima]),
        np.array([candidate.rms for candidate in minima]),
        search.evaluations,
    )


class _LocalSearch:
    """Search from points drawn around an estimate, counting simulations."""

    def __init__(self, problem: Problem, linear: LinearOutputModel, seed: int, budget: int) -> None:
        self._problem, self._budget, self.evaluations = problem, budget, 0
        self._linear = linear
        self._random = make_move_generator(seed)
        self.root = factor_covariance(linear.covariance)

    def is_rough(self, centre: RefinedCandidate) -> bool:
        """Whether losses around differ from the linear model; no, if the budget is spent."""
        if self._budget - self.evaluations < _ROUGHNESS_POINTS:
            return False
        _, _, expected, beyond = self._draw_points(centre, _ROUGHNESS_POINTS)
        return bool(np.any(~(np.abs(beyond) <= _ROUGHNESS_TOLERANCE * np.maximum(expected, 1.0))))

    def refine_starts(self, centre: RefinedCandidate) -> list[RefinedCandidate]:
        """Refine the most promising points around by least squares."""
        count = min(_POINTS_PER_ROUND, (self._budget - self.evaluations) // 2)
        if count < _ROUGHNESS_POINTS:
            return []
        starts, values, _, beyond = self._draw_points(centre, count)
        ends = []
        for i in np.argsort(beyond, kind="stable")[:_STARTS_PER_ROUND]:
            left = self._budget - self.evaluations
            end = refine_candidate(self._problem, starts[i], float(values[i]), left, _MAX_STEPS)
            if end is None or not np.isfinite(end.rms):
                break
            self.evaluations += end.evaluations
            ends.append(end)
        return ends

    def run_evolution_strategy(self, centre: RefinedCandidate) -> RefinedCandidate:
        """Follow the best point by batches of points around it."""
        theta, rms, size = centre.theta, centre.rms, _FIRST_SPREAD
        while size > _LAST_SPREAD and self._budget - self.evaluations >= _BATCH_SIZE:
            sizes = size * np.exp(self._random.uniform(-1.5, 0.5, _BATCH_SIZE))
            starts, values = self._simulate_moves(theta, sizes)
            best = int(np.argmin(values))
            gains = bool(values[best] < rms)
            if gains:
                theta, rms = starts[best], float(values[best])
            size *= _SPREAD_GROWTH if gains else _SPREAD_DECAY
        return RefinedCandidate(theta, rms, 0)

    def _draw_points(
        self, centre: RefinedCandidate, count: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Draw points; return them, their RMS, the expected likelihood ratio and its excess."""
        starts, values = self._simulate_moves(
            centre.theta, _DRAW_DEVIATIONS[np.arange(count) % _DRAW_DEVIATIONS.size]
        )
        n = self._problem.n_scored
        expected = n * np.log1p(self._linear.predict_relative_increase(starts - centre.theta))
        with np.errstate(divide="ignore"):
            ratio = 2.0 * n * np.log(values / centre.rms)
        return starts, values, expected, ratio - expected

    def _simulate_moves(
        self, theta: FloatArray, sizes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Simulate points that many standard errors away, inside the bounds; with their RMS."""
        moves = sizes[:, None] * self._random.standard_normal((sizes.size, theta.size))
        evaluator = self._problem.evaluator
        starts = np.maximum(theta + moves @ self.root.T, evaluator.lower)
        starts = np.minimum(starts, evaluator.upper)  # quicker than clip for so few
        self.evaluations += sizes.size
        return starts, self._problem.evaluate_fitness(starts)


def list_compatible_minima(
    names: Sequence[str],
    n: int,
    minima: LocalMinima,
    variance_ratio: FloatArray,
    quantiles: FloatArray,
) -> dict[str, CompatibleMinima]:
    """List the minima with their likelihood ratios, for each of the free parameters' `names`.

    `variance_ratio` (D,) is that of `LinearOutputModel`. `quantiles` (D,) are those of the t
    distribution. A parameter without a variance ratio is left out.
    """
    least = minima.rms.min()
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = 2.0 * n * np.log(np.where(minima.rms > least, minima.rms / least, 1.0))
    return {
        names[d]: CompatibleMinima(
            minima.values[:, d], ratio * variance_ratio[d], float(quantiles[d])
        )
        for d in np.flatnonzero(np.isfinite(variance_ratio)).tolist()
    }
