"""Intervals that do not take the estimated sizes of noise as known.

A slow load acts like a few independent values in a record. The most likely size of it is too small
then, and so are the errors of all other parameters. Two remedies are joined here:

* The restricted likelihood of the sizes ψ counts the p other parameters β that were fitted
  (Patterson and Thompson, Biometrika 58 (1971) 545). With standardised innovations e(β, ψ) and
  their slopes J by β, up to a constant, it is ``-((n - p) ln min e² + ln det JᵀJ) / 2``.
* The others are averaged over the sizes, as integrated nested Laplace approximations do (Rue,
  Martino and Chopin, J. R. Stat. Soc. B 71 (2009) 319, sec. 3.1). The sizes lie on a lattice of
  steps of one standard error along the axes of their covariance. It ends where the restricted
  likelihood has fallen by 4.5, three standard errors from its maximum.

All sizes are taken as equally probable, on their own scale: deviations as in Gelman (Bayesian
Analysis 1 (2006) 515), and correlation times. A few effective values do not rule out a large one.
On a logarithmic scale small ones would have most of the probability, and intervals were too narrow:
for a step beside a load they held K in 87 % of 120 records. With more than two sizes, one varies at
a time.
"""

from collections.abc import Iterator, Sequence
from math import exp
from typing import NamedTuple

import numpy as np

from sysid.core.types import RANK_TOLERANCE, FloatArray
from sysid.models.kalman_filter import is_noise_parameter
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit
from sysid.uncertainty.intervals import Alternative, AverageOverNoise

_FALL = 4.5  # of the logarithm of the restricted likelihood: 3² / 2
_SMALLEST, _LARGEST = 0.01, 0.15  # steps of the lattice, of the range of a size
_MOST_POINTS = 200
"""Against a likelihood without an end. Measured with `benchmarks.disturbance`, 60 records with a
load: about 52 points lie within the fall, and all were found. With 60 that are tried, some ends of
intervals were off by 0.45 of their width."""
_ITERATIONS = 2  # of Gauss and Newton at each point, from the estimate
_DIFFERENCE = 1e-5  # of a range

_Place = tuple[int, ...]


class NoisePoint(NamedTuple):
    """The other parameters at one choice of the sizes of noise.

    Attributes
    ----------
    sizes : FloatArray, shape (m,)
        In their units.
    log_likelihood : float
        Logarithm of the restricted likelihood, up to a constant of all points. The probability of a
        step of the lattice is in it: that of the range of sizes that it covers.
    values, stderrs : FloatArray, shape (p,)
        Most likely values of the other parameters, and their standard errors, in their units.
    """

    sizes: FloatArray
    log_likelihood: float
    values: FloatArray
    stderrs: FloatArray


class NoisePoints(NamedTuple):
    """Points of the lattice, the names of the other parameters (p,), and simulations spent."""

    points: tuple[NoisePoint, ...]
    names: tuple[str, ...]
    evaluations: int

    def average(self) -> dict[str, AverageOverNoise]:
        """Average each parameter over the points."""
        if len(self.points) < 2:
            return {}
        best = max(point.log_likelihood for point in self.points)
        weights = [exp(point.log_likelihood - best) for point in self.points]
        return {
            name: AverageOverNoise(
                tuple(
                    Alternative(weight, float(point.values[i]), float(point.stderrs[i]))
                    for weight, point in zip(weights, self.points, strict=True)
                )
            )
            for i, name in enumerate(self.names)
        }


def explore_noise_sizes(
    problem: Problem, theta: FloatArray, covariance: FloatArray, most: int | None = None
) -> NoisePoints:
    """Explore the sizes of noise around an estimate (D,), in at most so many simulations.

    There is no point if no size is free, if the others cannot be told apart, or if `most` is too
    few.

    Parameters
    ----------
    covariance : FloatArray, shape (D, D)
        Of the estimate, in the units of the parameters.
    """
    lattice = _Lattice(problem, theta, covariance)
    if not lattice.sizes.size or not lattice.others.size:
        return NoisePoints((), (), 0)
    found: dict[_Place, NoisePoint] = {}
    front: list[_Place] = [(0,) * lattice.sizes.size]
    spent, best = 0, -np.inf
    while front and len(found) < _MOST_POINTS:
        cost = len(front) * lattice.simulations
        if most is not None and spent + cost > most:
            break
        points = lattice.fit_others(front)
        spent += cost
        found |= {place: point for place, point in zip(front, points, strict=True) if point}
        best = max((point.log_likelihood for point in found.values()), default=best)
        open_places = [place for place in front if place in found]
        near = [p for p in open_places if found[p].log_likelihood > best - _FALL]
        neighbours = dict.fromkeys(other for place in near for other in lattice.list_next(place))
        front = [place for place in neighbours if place not in found]
    kept = tuple(point for point in found.values() if point.log_likelihood > best - _FALL)
    return NoisePoints(kept, tuple(problem.free_names[i] for i in lattice.others), spent)


class _Lattice:
    """Choices of the sizes of noise, and the fit of the other parameters at each."""

    def __init__(self, problem: Problem, theta: FloatArray, covariance: FloatArray) -> None:
        self._problem, self._centre = problem, to_unit(problem.evaluator, theta[None])[0]
        is_size = np.array([is_noise_parameter(name) for name in problem.free_names], dtype=bool)
        self.sizes, self.others = np.flatnonzero(is_size), np.flatnonzero(~is_size)
        self.simulations = _ITERATIONS * (self.others.size + 1)
        if self.sizes.size:
            self._axes = self._find_axes(covariance)

    def _find_axes(self, covariance: FloatArray) -> FloatArray:
        """Find the axes (m, m) of the sizes' covariance, one standard error long."""
        rows = self.sizes
        slopes = self._measure_slopes(self._centre)[rows]
        block = covariance[np.ix_(rows, rows)] / np.outer(slopes, slopes)
        block = np.where(np.isfinite(block), block, 0.0)
        squares, vectors = np.linalg.eigh(0.5 * (block + block.T))
        lengths = np.clip(np.sqrt(np.maximum(squares, 0.0)), _SMALLEST, _LARGEST)
        return np.asarray((vectors * lengths).T)

    def _measure_slopes(self, point: FloatArray) -> FloatArray:
        """Measure the change (D,) of each parameter by its share of the range."""
        steps = np.where(point < 0.5, _DIFFERENCE, -_DIFFERENCE)
        moved = np.vstack([point, point + steps])
        values = from_unit(self._problem.evaluator, moved)
        return np.asarray((values[1] - values[0]) / steps)

    def list_next(self, place: _Place) -> Iterator[_Place]:
        """List the next places along each axis; of many axes, one is left at a time."""
        for i in range(len(place)):
            if len(place) > 2 and any(place[:i] + place[i + 1 :]):
                continue
            for side in (-1, 1):
                yield (*place[:i], place[i] + side, *place[i + 1 :])

    def fit_others(self, places: Sequence[_Place]) -> list[NoisePoint | None]:
        """Fit the other parameters at each place; None outside the bounds, or without a fit."""
        points = np.repeat(self._centre[None], len(places), axis=0)
        points[:, self.sizes] += np.array(places, dtype=np.float64) @ self._axes
        inside = np.all((points >= 0.0) & (points <= 1.0), axis=1)
        points = np.clip(points, 0.0, 1.0)
        fits: list[_LinearFit | None] = [None] * len(places)
        for _ in range(_ITERATIONS):
            for i, fit in enumerate(self._linearise(points)):
                old = fits[i]
                if fit is None or (old is not None and old.squares <= fit.squares):
                    continue
                fits[i] = fit
                points[i, self.others] = np.clip(fit.others, 0.0, 1.0)
        return [
            self._make_point(points[i], fit) if fit is not None and inside[i] else None
            for i, fit in enumerate(fits)
        ]

    def _linearise(self, points: FloatArray) -> list["_LinearFit | None"]:
        """Fit the linear model of the residuals at points (Q, D), in their others."""
        count, p = len(points), self.others.size
        steps = np.where(points[:, self.others] < 0.5, _DIFFERENCE, -_DIFFERENCE)
        moved = np.repeat(points[:, None], p + 1, axis=1)
        moved[:, np.arange(1, p + 1), self.others] += steps
        individuals = from_unit(self._problem.evaluator, moved.reshape(-1, points.shape[1]))
        residuals = self._problem.compute_residuals(individuals).reshape(count, p + 1, -1)
        return [
            _fit_linear(residuals[q, 0], (residuals[q, 1:] - residuals[q, 0]).T / steps[q], start)
            for q, start in enumerate(points[:, self.others])
        ]

    def _make_point(self, point: FloatArray, fit: "_LinearFit") -> NoisePoint:
        values = from_unit(self._problem.evaluator, point[None])[0]
        slopes = np.abs(self._measure_slopes(point))
        covered = float(np.sum(np.log(slopes[self.sizes])))
        return NoisePoint(
            values[self.sizes],
            fit.log_likelihood + covered,
            values[self.others],
            slopes[self.others] * fit.stderrs,
        )


class _LinearFit(NamedTuple):
    """Linear fit: least squares, most likely others (p,) with their errors, and the likelihood."""

    squares: float
    others: FloatArray
    stderrs: FloatArray
    log_likelihood: float


def _fit_linear(error: FloatArray, columns: FloatArray, start: FloatArray) -> _LinearFit | None:
    """Fit residuals (n,) by columns (n, p); None if they are not finite or of less than full rank.

    `squares` are those at the start itself, before the step.
    """
    if not (np.isfinite(error).all() and np.isfinite(columns).all()):
        return None
    left, singular, right = np.linalg.svd(columns, full_matrices=False)
    if singular[-1] <= RANK_TOLERANCE * singular[0]:
        return None
    step = right.T @ ((left.T @ -error) / singular)
    least = float(np.sum(np.square(error + columns @ step)))
    degrees = error.size - start.size
    if not least > 0.0 or degrees < 1:
        return None
    inverse = right.T / singular
    stderrs = np.sqrt(least / degrees * np.sum(np.square(inverse), axis=1))
    log_likelihood = -0.5 * degrees * np.log(least) - float(np.sum(np.log(singular)))
    return _LinearFit(float(error @ error), start + step, stderrs, float(log_likelihood))
