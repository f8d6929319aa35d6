"""Least squares under first-order noise whose correlation time has the largest likelihood.

Models that are compared by their likelihoods have each a noise of their own. The two are fitted in
turn: the parameters under a noise, and the noise to the residuals (Cochrane and Orcutt 1949).
"""

from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray
from sysid.noise_models.generalised_least_squares import WhitenedLeastSquares
from sysid.residuals.series import iterate_parts, make_whitening
from sysid.residuals.whitening import Whitening
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit
from sysid.uncertainty.analysis import compute_criteria

_ROUNDS = 2  # of least squares and correlation time, in turn
_SHORTEST_TIME, _LONGEST_TIME = 0.1, 0.5  # correlation time, of a sampling period and the record


class FirstOrderFit(NamedTuple):
    """An estimate (D,) under first-order noise, its whitening, and the simulations spent."""

    theta: FloatArray
    whitening: Whitening
    evaluations: int


def fit_first_order_noise(
    problem: Problem, theta: FloatArray, max_simulations: int = 2**62
) -> FirstOrderFit:
    """Estimate under first-order noise, from an estimate (D,) of least squares on."""
    search = WhitenedLeastSquares(problem, max_simulations)
    whitening = fit_correlation_times(problem, problem.compute_residuals(theta[None])[0])
    for _ in range(_ROUNDS):
        if search.simulations_left < search.round_simulations:
            break
        point = search.find_lowest_minimum([to_unit(problem.evaluator, theta[None])[0]], whitening)
        theta = from_unit(problem.evaluator, point[None])[0]
        whitening = fit_correlation_times(problem, problem.compute_residuals(theta[None])[0])
    return FirstOrderFit(theta, whitening, search.evaluations + _ROUNDS + 1)


def fit_correlation_times(problem: Problem, residuals: FloatArray) -> Whitening:
    """Find the whitening of largest likelihood for weighted residuals (n,).

    Each output has a correlation time of its own; they are found one after the other.
    """
    from scipy.optimize import minimize_scalar  # imported late: slow to load, rarely needed

    times: dict[str, float] = {}
    for output in problem.model.outputs:
        # Pooled repeats have several samples at a time.
        parts = (part for part in iterate_parts(problem) if part.output == output.name)
        spans = [one for part in parts if (one := np.unique(part.times)).size > 1]
        if not spans:
            continue
        shortest = min(float(np.median(np.diff(one))) for one in spans)
        longest = max(float(np.ptp(one)) for one in spans)

        def compute_bic(logarithm: float, name: str = output.name) -> float:
            whitening = make_whitening(problem, {**times, name: float(np.exp(logarithm))})
            return compute_criteria(problem, whitening.whiten(residuals), whitening).bic

        bounds = (np.log(_SHORTEST_TIME * shortest), np.log(_LONGEST_TIME * longest))
        best = minimize_scalar(
            compute_bic, bounds=bounds, method="bounded", options={"xatol": 0.01}
        )
        times[output.name] = float(np.exp(best.x))
    return make_whitening(problem, times)
