"""Least squares under first-order noise whose correlation time has the largest likelihood.

Models that are compared by their likelihoods have each a noise of their own. The two are fitted in
turn: the parameters under a noise, and the noise to the residuals (Cochrane and Orcutt 1949).
"""

from collections.abc import Callable
from math import exp, inf, isfinite, log
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
_GOLDEN_SHARE = 0.6180339887498949
_BRACKET = 0.05  # of a logarithm, within which the criterion is a parabola
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

        limits = log(_SHORTEST_TIME * shortest), log(_LONGEST_TIME * longest)
        times[output.name] = exp(find_minimum(compute_bic, *limits))
    return make_whitening(problem, times)


def find_minimum(function: Callable[[float], float], lower: float, upper: float) -> float:
    """Find a minimum in an interval by golden sections, and at last by a parabola.

    The method of Brent (Algorithms for Minimization without Derivatives, 1973, ch. 5) does both in
    turn. SciPy has it, but takes a tenth of a second to load.
    """
    points = [(lower, inf), (upper, inf)]
    inside = lower + _GOLDEN_SHARE * (upper - lower)
    while len(points) < 3 or points[-1][0] - points[0][0] > _BRACKET:
        points = sorted([*points, (inside, function(inside))])
        if len(points) > 3:
            points = points[:3] if points[1][1] <= points[2][1] else points[1:]
        inside = points[0][0] + points[2][0] - points[1][0]
    (before, _), (middle, least), (after, _) = points
    first, last = ((value - least) / (at - middle) for at, value in (points[0], points[2]))
    if not (isfinite(first) and isfinite(last) and last > first):
        return middle  # at an end, or where all is alike
    return middle - 0.5 * (first * (after - middle) - last * (before - middle)) / (last - first)
