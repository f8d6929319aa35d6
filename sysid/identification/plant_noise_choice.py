"""Fit filters beside a free run: whether the noise acts inside the plant.

Residuals of a free run may be coloured because a sensor's noise is, or because a load moves the
plant. Both have a likelihood of the same samples. That of coloured noise is an autoregression
beside a linear step (`sysid.judgement.residual_model`), or first-order noise in full. That of a
load, and of a drift beside white noise, is the Kalman filter's. They are compared by Schwarz's
criterion (Ann. Statist. 6 (1978) 461), in which the sizes of noise count as parameters.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.findings import Finding
from sysid.core.types import FloatArray
from sysid.judgement.unstable_run import MIN_GROWTH, compute_growth
from sysid.minima.minima import is_same_point
from sysid.models.kalman_filter import is_noise_parameter, list_plant_noise
from sysid.noise_models.first_order_fit import fit_first_order_noise
from sysid.residuals.series import iterate_parts
from sysid.search.refine import refine_candidates
from sysid.simulation.free_run import convert_to_free_run
from sysid.simulation.noise_levels import add_noise_levels
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import compute_criteria

_MOST_STARTS = 4  # that are refined: those of lowest J
_MOST_SIMULATIONS = 4000


class ReplacedRun(NamedTuple):
    """A free run by squares that a filter took the place of.

    Attributes
    ----------
    values : mapping
        Its estimates.
    gain : float
        By how much the filter lowers Schwarz's criterion.
    feedback : tuple of Finding
        The loop that its residuals show. A filter that fits leaves no trace of it.
    """

    values: Mapping[str, float]
    gain: float
    feedback: tuple[Finding, ...]


class FilteredFits(NamedTuple):
    """The fits of all filters, the likeliest first, and the simulations spent."""

    fits: tuple["FilteredFit", ...]
    evaluations: int


class FilteredFit(NamedTuple):
    """A filter's estimate (D,), and its criterion as `ResidualModel` has that of a free run.

    The criterion counts the parameters that the free run has not.
    """

    problem: Problem
    theta: FloatArray
    criterion: float

    @property
    def sizes(self) -> dict[str, float]:
        """Values of the parameters of the noise."""
        return {name: value for name, value in self.values.items() if is_noise_parameter(name)}

    @property
    def values(self) -> dict[str, float]:
        """Values of all parameters."""
        return dict(zip(self.problem.free_names, self.theta.tolist(), strict=True))


def fit_filters(
    problem: Problem,
    points: Sequence[FloatArray],
    max_simulations: int | None,
    is_late: Callable[[], bool],
) -> FilteredFits:
    """Fit the filters of a free run's model from its minima (D,).

    There are none if the document names no place of noise, if no filter can be built on the
    samples, or if budget or time do not suffice.
    """
    most = _MOST_SIMULATIONS if max_simulations is None else max_simulations
    distinct: list[FloatArray] = []
    for point in points:
        if not any(is_same_point(problem, point, other) for other in distinct):
            distinct.append(point)
    found, spent = list[FilteredFit](), 0
    for noise in list_plant_noise(problem.model):
        with suppress(InvalidSettings):  # no derivative, or samples off the grid
            filtered = problem.rebuild(loss=replace(problem.loss, noise_model=noise))
            if not is_late():
                fits = _fit_filter(problem, filtered, distinct, most, is_late)
                found, spent = [*found, *fits.fits], spent + fits.evaluations
    return FilteredFits(tuple(sorted(found, key=lambda one: one.criterion)), spent)


def _fit_filter(
    problem: Problem,
    filtered: Problem,
    points: Sequence[FloatArray],
    most: int,
    is_late: Callable[[], bool],
) -> FilteredFits:
    """Fit one filter; no fit if nothing is finite, or if the budget does not suffice."""
    starts, spent = list[tuple[float, FloatArray]](), 0
    for point in points:
        theta = add_noise_levels(
            filtered, dict(zip(problem.free_names, point.tolist(), strict=True))
        )
        if spent + len(theta) > most:
            break
        fitness = filtered.evaluate_fitness(theta)
        spent += len(theta)
        starts.append((float(np.min(fitness)), theta[np.argmin(fitness)]))
    starts.sort(key=lambda one: one[0])
    chosen = [theta for _, theta in starts[:_MOST_STARTS]]
    ends = refine_candidates(filtered, chosen, most - spent, is_late) if chosen else ()
    known = [one for one in ends if one is not None]
    if not known:
        return FilteredFits((), spent)
    best = min(known, key=lambda one: one.rms)
    spent += sum(one.evaluations for one in known)
    if _is_unstable_drift(filtered, best.theta):
        return FilteredFits((), spent)
    criterion = _compute_criterion(filtered, best.theta, len(problem.free_parameters))
    return FilteredFits((FilteredFit(filtered, best.theta, criterion),), spent)


def _is_unstable_drift(filtered: Problem, theta: FloatArray) -> bool:
    """Whether a sensor drifts beside an unstable run, whose last digits fit anything."""
    if filtered.loss.noise_model != "drift":
        return False
    return compute_growth(*convert_to_free_run(filtered, theta)) >= MIN_GROWTH


def fit_first_order_criterion(problem: Problem, theta: FloatArray) -> tuple[float, int]:
    """Compute the criterion of a free run under first-order noise; count the simulations."""
    found = fit_first_order_noise(problem, theta)
    plain, error = problem.compute_residuals(np.array([theta, found.theta]))
    white, coloured = (
        compute_criteria(problem, values, whitening).bic
        for values, whitening in (
            (plain, None),
            (found.whitening.whiten(error), found.whitening),
        )
    )
    own = _compute_criterion(problem, theta, theta.size)
    return own + coloured - white, found.evaluations + 2


def _compute_criterion(problem: Problem, theta: FloatArray, counted: int) -> float:
    """Compute Schwarz's criterion, in which `counted` parameters do not count."""
    error = problem.compute_residuals(theta[None])[0]
    squares, sizes = dict[str, float](), dict[str, int]()
    for part in iterate_parts(problem):
        own = error[part.rows]
        squares[part.output] = squares.get(part.output, 0.0) + float(own @ own)
        sizes[part.output] = sizes.get(part.output, 0) + own.size
    twice = sum(sizes[name] * np.log(squares[name] / sizes[name]) for name in sizes)
    more = theta.size - counted
    return float(twice + more * np.log(error.size))
