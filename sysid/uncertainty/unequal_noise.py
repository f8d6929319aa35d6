"""Estimates under noise of unequal variance: one for each output of each experiment.

A joint fit by plain squares is led by the noisiest record. Under Gaussian noise of unknown
variances the likelihood weighs each residual by the variance of its series. Variances and
parameters are estimated in turn, until both stay (iteratively reweighted least squares; Aitken
1936). A variance has the degrees of freedom that the parameters leave to its series, as by
restricted likelihood (Patterson and Thompson 1971).

The variances are found once. They are part of the problem, as relative deviations that divide its
weights. So all that follows weighs residuals alike: minima, errors, tests, posterior, profiles. The
deviations are scaled so that J at the estimate is the plain RMS error.
"""

from collections.abc import Callable, Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np

from sysid.core.types import BoolArray, FloatArray
from sysid.core.units import format_unit
from sysid.residuals.autocorrelation import MIN_SAMPLES
from sysid.residuals.series import (
    ResidualPart,
    count_used_degrees,
    have_unequal_variances,
    iterate_parts,
)
from sysid.search.refine import refine_candidates
from sysid.simulation.fit_metrics import ChannelMetrics
from sysid.simulation.problem import Problem
from sysid.uncertainty.sensitivities import BudgetSpentError, compute_sensitivities

_MAX_ROUNDS = 12
_TOLERANCE = 0.01  # relative: deviations that differ by less
_LEAST_DEVIATION = 1e-3  # of the largest: no series counts more than so many times another
_NO_NOISE = 1e-4  # of the output: smaller residuals are of the solver
_MOST_TOLD = 4  # series whose noise a note lists


class ReweightedFit(NamedTuple):
    """A fit (D,) whose problem weighs residuals by the estimated noise, with its RMS there."""

    problem: Problem
    theta: FloatArray
    rms: float
    evaluations: int


def fit_unequal_noise(
    problem: Problem,
    theta: FloatArray,
    max_simulations: int | None = None,
    is_late: Callable[[], bool] | None = None,
) -> ReweightedFit | None:
    """Fit parameters and variances together, from the estimate (D,) by plain squares.

    None: the noise is equal, or the weights were given, or the loss is not that of squares.
    """
    parts = list(iterate_parts(problem))
    if len(parts) < 2 or problem.loss_scale or problem.settings.weights is not None:
        return None
    left = 2**62 if max_simulations is None else max_simulations
    most, fit, rows = left, None, problem.scored_rows
    measured = problem.evaluator.measured[rows]
    varies = np.array([np.ptp(measured[part.rows]) > 0 for part in parts])
    for _ in range(_MAX_ROUNDS):
        try:
            error, columns, *_, count = compute_sensitivities(problem, theta, left)
        except BudgetSpentError:
            break
        left -= count
        series = [error[part.rows] for part in parts]
        rms = sqrt(float(error @ error) / error.size)
        shows_noise = varies | [values @ values > rms**2 * values.size for values in series]
        if fit is None and (
            rms <= _NO_NOISE * problem.output_scale
            or not have_unequal_variances([series[i] for i in np.flatnonzero(shows_noise)])
        ):
            return None
        used = count_used_degrees([columns[part.rows] for part in parts])
        plain = error * problem.plain_weight[rows] / problem.evaluator.weight[rows]
        ratios = _estimate_ratios(series, used, shows_noise, float(plain @ plain))
        if np.ptp(np.log(ratios)) <= _TOLERANCE or (is_late is not None and is_late()):
            break
        problem = _divide_weights(problem, parts, ratios)
        (end,) = refine_candidates(problem, [theta], left, is_late)
        if end is not None:
            left, theta, rms = left - end.evaluations, end.theta, end.rms
        fit = ReweightedFit(problem, theta, rms, most - left)
    return fit


def _estimate_ratios(
    series: Sequence[FloatArray], used: FloatArray, shows_noise: BoolArray, total: float
) -> FloatArray:
    """Estimate the deviation of each series relative to its present one; Σe² becomes `total`.

    The parameters take the degrees of freedom `used` from each series. A short series has the
    common variance. So has one that shows no noise: a sensor at rest, which the model follows.
    """
    sizes = np.array([values.size for values in series])
    powers = np.array([float(values @ values) for values in series])
    left = np.maximum(sizes - used, 1.0)
    own = shows_noise & (sizes >= MIN_SAMPLES)
    deviations = np.sqrt(np.where(own, powers / left, np.sum(powers) / np.sum(left)))
    deviations = np.maximum(deviations, _LEAST_DEVIATION * np.max(deviations))
    return np.asarray(deviations * np.sqrt(np.sum(powers / deviations**2) / total))


def _divide_weights(problem: Problem, parts: Sequence[ResidualPart], ratios: FloatArray) -> Problem:
    names = [output.name for output in problem.model.outputs]
    given = problem.settings.deviations
    deviations = np.ones((len(problem.records), len(names))) if given is None else np.array(given)
    for part, ratio in zip(parts, ratios.tolist(), strict=True):
        deviations[part.experiment, names.index(part.output)] *= ratio
    return problem.rebuild(deviations=tuple(map(tuple, deviations.tolist())))


def describe_unequal_noise(problem: Problem, channels: Sequence[ChannelMetrics]) -> list[str]:
    """Describe the noise by which residuals were weighed, if it was estimated."""
    if problem.settings.deviations is None or problem.settings.weights is not None:
        return []
    ordered = sorted(channels, key=lambda channel: channel.rms)
    if len(ordered) > _MOST_TOLD:
        ordered = [ordered[0], ordered[-1]]
    noise = ", ".join(
        f"{one.rms:.3g}{format_unit(one.unit)} in {one.output}"
        + (f" of experiment {one.experiment + 1}" if len(problem.records) > 1 else "")
        for one in ordered
    )
    return [
        f"the noise is unequal (RMS {noise}), so residuals count by its variance in each output of "
        "each experiment. To choose otherwise, set weights."
    ]
