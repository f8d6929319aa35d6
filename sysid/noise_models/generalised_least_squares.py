"""Generalised least squares: estimates under first-order noise.

Least squares treats residuals as independent. If the noise changes slowly, neighbouring residuals
repeat the same information, and a slow disturbance outweighs the fast part of the record. So
parameters are estimated from residuals that a first-order noise model whitens
(`sysid.residuals.whitening`), and the noise from the new residuals, until both stay (feasible
generalised least squares; Cochrane and Orcutt, J. Am. Stat. Assoc. 44 (1949) 32).

The noise is described by its *correlation time* τ, at which the residuals' autocorrelation has
fallen to 1/e. For first-order noise τ is equivalent to the correlation of neighbours. Neighbours of
a smooth disturbance are equal to many digits. Their correlation would lead to a model of
differences, in which rounding and sensor noise outweigh all else. If the first-order noise is not
the true one, the estimates stay valid but lose some efficiency, and the covariance is a sandwich
(Liang and Zeger, Biometrika 73 (1986) 13; `sysid.residuals.sandwich`).

If switches make the loss rough, the minimum near that of least squares need not be the lowest. So
the lowest of points drawn along the covariance of least squares are starts as well.

Estimated parameters absorb a part of the noise. At the end the covariance of the fitted outputs,
S C Sᵀ, is added to the autocovariance of the residuals, once: repeated, noise with a white part
drifted away, and its offset with it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.fft import irfft, rfft

from sysid.core.linear_algebra import compute_truncated_svd
from sysid.core.settings import NoiseModel
from sysid.core.types import FloatArray
from sysid.residuals.autocorrelation import space_residuals
from sysid.residuals.series import ResidualPart, is_coloured, iterate_parts, make_whitening
from sysid.residuals.whitening import Whitening
from sysid.search.least_squares import (
    N_TRIED,
    ScoredSamples,
    fill_jacobian,
    solve_least_squares,
    steps_at_once,
)
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit
from sysid.uncertainty.linear_model import factor_covariance, make_move_generator

_MAX_ROUNDS = 12
_TIME_TOLERANCE = 1e-3  # relative: correlation times that differ by less
_MAX_STEPS = 40  # of least squares in a round
_START_DEVIATIONS = np.array([0.3, 1.0, 2.0])  # standard errors from the estimate to drawn points
_N_DRAWN, _MAX_STARTS = 96, 6
_MAX_WORK = 50_000_000  # steps of integration or recursion: no points are drawn on longer records
_DECAY_LEVEL = float(np.exp(-1.0))
_MIN_CORRELATION = 0.1  # correlation of neighbours: smaller ones need no model


class GeneralisedEstimate(NamedTuple):
    """Estimates under coloured noise.

    Attributes
    ----------
    theta : FloatArray, shape (D,)
    correlation_times : mapping of str to float
        Of each output's noise, s; 0 if its residuals are consistent with white noise.
    evaluations : int
    is_complete : bool
        False if the budget of simulations did not suffice.
    minima : FloatArray, shape (m, D)
        Ends of least squares from all starts, including the estimate.
    rms : FloatArray, shape (m,)
        RMS of the whitened residuals there.
    """

    theta: FloatArray
    correlation_times: Mapping[str, float]
    evaluations: int
    is_complete: bool = True
    minima: FloatArray = np.zeros((0, 0))
    rms: FloatArray = np.zeros(0)


def fit_generalised_least_squares(
    problem: Problem,
    theta: FloatArray,
    covariance: FloatArray,
    seed: int,
    max_simulations: int | None = None,
) -> GeneralisedEstimate:
    """Estimate under first-order noise, from the estimates of least squares (D,).

    At most `max_simulations` simulations are used. If all residuals are consistent with white
    noise, the estimates stay unchanged.

    Parameters
    ----------
    covariance : FloatArray, shape (D, D)
        Of the estimates of least squares.
    seed : int
        Seed of the points drawn along it.
    """
    search = WhitenedLeastSquares(problem, 2**62 if max_simulations is None else max_simulations)
    if search.simulations_left < 1:
        return GeneralisedEstimate(theta, {}, 0, False)
    point = to_unit(problem.evaluator, theta[None])[0]
    error = search.compute_residuals(point[None])[0]
    coloured = select_coloured_outputs(problem, error)
    times: Mapping[str, float] = {}
    random = make_move_generator(seed)
    for i in range(_MAX_ROUNDS if coloured else 0):
        new_times = estimate_correlation_times(problem, coloured, error, None)
        is_last = i == _MAX_ROUNDS - 1 or _have_converged(new_times, times)
        if search.simulations_left < search.round_simulations:
            search.is_cut = True
            break
        if is_last:
            spread = _factor_output_covariance(
                search.compute_slopes(point, error), error, make_whitening(problem, times)
            )
            new_times = estimate_correlation_times(problem, coloured, error, spread)
        times, whitening = new_times, make_whitening(problem, new_times)
        draws = i == 0 or is_last
        starts = _draw_starts(search, point, whitening, covariance, random) if draws else []
        point = search.find_lowest_minimum([point, *starts], whitening)
        error = search.compute_residuals(point[None])[0]
        if is_last:
            break
    if any(times.values()):
        theta = from_unit(problem.evaluator, point[None])[0]
    minima = from_unit(problem.evaluator, search.ends)
    complete = not search.is_cut
    return GeneralisedEstimate(theta, times, search.evaluations, complete, minima, search.rms)


def resolve_noise_model(problem: Problem, noise: GeneralisedEstimate) -> Problem:
    """Replace the noise model ``auto`` of a problem by the one that was selected."""
    if problem.loss.noise_model != "auto":
        return problem
    noise_model: NoiseModel = "ar1" if any(noise.correlation_times.values()) else "white"
    loss = replace(problem.loss, noise_model=noise_model)
    return replace(problem, settings=replace(problem.settings, loss=loss))


def select_coloured_outputs(problem: Problem, error: FloatArray) -> set[str]:
    """Select the outputs whose weighted residuals (n,) are clearly not white."""
    return {part.output for part in iterate_parts(problem) if is_coloured(part, error[part.rows])}


def _draw_starts(
    search: "WhitenedLeastSquares",
    point: FloatArray,
    whitening: Whitening,
    covariance: FloatArray,
    random: np.random.Generator,
) -> list[FloatArray]:
    """Draw points around one (D,) and return those of lowest loss."""
    count = _N_DRAWN + _MAX_STARTS * search.round_simulations
    if search.simulations_left < count or count * search.problem.n_steps > _MAX_WORK:
        return []
    evaluator = search.problem.evaluator
    moves = _START_DEVIATIONS[np.arange(_N_DRAWN) % _START_DEVIATIONS.size, None]
    moves = moves * random.standard_normal((_N_DRAWN, point.size)) @ factor_covariance(covariance).T
    theta = from_unit(evaluator, point[None]) + moves
    points = to_unit(evaluator, np.clip(theta, evaluator.lower, evaluator.upper))
    with np.errstate(all="ignore"):  # diverged simulations
        totals = np.sum(np.square(whitening.whiten(search.compute_residuals(points))), axis=1)
    totals = np.where(np.isfinite(totals), totals, np.inf)
    return [points[i] for i in np.argsort(totals, kind="stable")[:_MAX_STARTS]]


def _have_converged(times: Mapping[str, float], previous: Mapping[str, float]) -> bool:
    return bool(previous) and all(
        abs(times[name] - previous[name]) <= _TIME_TOLERANCE * previous[name] for name in times
    )


def _factor_output_covariance(
    columns: FloatArray, error: FloatArray, whitening: Whitening
) -> FloatArray:
    """Compute L (n, D) of the covariance LLᵀ of fitted outputs with slopes (n, D)."""
    whitened, residuals = whitening.whiten(columns.T).T, whitening.whiten(error)
    _, singular, rows, retained = compute_truncated_svd(whitened)
    deviation = np.sqrt(float(residuals @ residuals) / max(error.size - columns.shape[1], 1))
    return np.asarray(deviation * columns @ (rows[retained].T / singular[retained]))


def estimate_correlation_times(
    problem: Problem, coloured: set[str], error: FloatArray, spread: FloatArray | None
) -> dict[str, float]:
    """Estimate each output's correlation time in s: the mean over its series, by samples."""
    times: dict[str, list[tuple[float, int]]] = {}
    for part in iterate_parts(problem):
        if part.output in coloured:
            part_spread = None if spread is None else spread[part.rows]
            time = _estimate_correlation_time(part, error[part.rows], part_spread)
            times.setdefault(part.output, []).append((time, part.times.size))
    return {
        name: sum(time * n for time, n in estimates) / sum(n for _, n in estimates)
        for name, estimates in times.items()
    }


def _estimate_correlation_time(
    part: ResidualPart, error: FloatArray, spread: FloatArray | None
) -> float:
    """Time (s) at which the autocorrelation has fallen to 1/e; at most half of the series."""
    series = space_residuals(part.times, error)
    present = series.present.astype(np.float64)
    covariance = _autocorrelate(series.values)
    for column in () if spread is None else spread.T:
        values = np.zeros(series.values.size)
        values[series.present] = column
        covariance += _autocorrelate(values)
    n = series.values.size
    pairs = np.maximum(np.rint(_autocorrelate(present)), 1.0)
    covariance *= np.arange(n, n - pairs.size, -1.0) / pairs  # as if no sample were missing
    if not covariance.size or not covariance[0] > 0:
        return 0.0
    return series.period * _find_decay_lag(covariance / covariance[0])


def _autocorrelate(values: FloatArray) -> FloatArray:
    """Compute Σ v(t) v(t + k) for k from 0 up to half the number of values."""
    n = values.size
    length = 1 << (2 * n - 1).bit_length()
    return np.asarray(irfft(np.square(np.abs(rfft(values, length))), length)[: n // 2])


def _find_decay_lag(correlation: FloatArray) -> float:
    """Find the lag at which a correlation function has fallen to 1/e, by linear interpolation."""
    below = np.flatnonzero(correlation <= _DECAY_LEVEL)
    if not below.size:
        return float(correlation.size)
    k = int(below[0])
    if k == 1:  # faster than the samples: from the correlation after one sample
        return -1.0 / float(np.log(correlation[1])) if correlation[1] > _MIN_CORRELATION else 0.0
    before, after = correlation[k - 1], correlation[k]
    return k - 1 + float((before - _DECAY_LEVEL) / (before - after))


class WhitenedLeastSquares:
    """Least squares of whitened residuals over unit coordinates, counting simulations."""

    def __init__(self, problem: Problem, budget: int = 2**62) -> None:
        self.problem, self._budget, self.evaluations = problem, budget, 0
        self.is_cut = False  # whether a search ended early because the budget was spent
        # of the last round
        self.ends, self.rms = np.zeros((0, len(problem.free_parameters))), np.zeros(0)
        rows = problem.scored_rows
        self._scored = ScoredSamples(problem.evaluator, rows, problem.evaluator.weight[rows])
        self._step_simulations = len(problem.free_parameters) + N_TRIED
        # Least simulations of a round: the slopes, a step, residuals at both ends.
        self.round_simulations = len(problem.free_parameters) + self._step_simulations + 2

    @property
    def simulations_left(self) -> int:
        """Simulations that may still be run."""
        return self._budget - self.evaluations

    def compute_residuals(self, points: FloatArray) -> FloatArray:
        """Compute weighted residuals (P, n) at points (P, D)."""
        self.evaluations += points.shape[0]
        return self.problem.compute_residuals(from_unit(self.problem.evaluator, points))

    def compute_slopes(self, point: FloatArray, error: FloatArray) -> FloatArray:
        """Compute the slopes (n, D) of the residuals."""
        columns = np.empty((point.size, error.size))
        fill_jacobian(self._scored, point, error, columns)
        self.evaluations += point.size
        return columns.T

    def find_lowest_minimum(self, starts: Sequence[FloatArray], whitening: Whitening) -> FloatArray:
        """Find the lowest minimum from starts (D,); the first start is always searched."""
        scored = self._scored._replace(ar1_coefficient=whitening.ar1_coefficient)
        at_once = steps_at_once(starts[0].size, self.problem.n_steps)
        solutions = []
        for start in starts:
            steps = min(_MAX_STEPS, (self.simulations_left - 2) // self._step_simulations)
            if steps < 1:
                self.is_cut = True
                break
            solution = solve_least_squares(scored, start, 0.0, steps=steps, at_once=at_once)
            self.evaluations += solution.evaluations
            self.is_cut |= steps < _MAX_STEPS and not solution.is_converged
            solutions.append(solution)
        self.ends = np.array([solution.point for solution in solutions])
        self.rms = np.sqrt([solution.loss for solution in solutions])
        return solutions[int(np.argmin(self.rms))].point
