"""Profile likelihood: how far a parameter may move while all others follow it.

For each value v of the parameter the others are estimated again. With Gaussian noise of unknown
variance the likelihood ratio against the estimate is n ln(S(v)/S₀), where S is the sum of squares.
The interval is where the ratio stays below the 95 % quantile of χ² with one degree of freedom
(Venzon and Moolgavkar 1988; Raue et al. 2009). For a model that is linear in its parameters this is
the interval of the t distribution, except for a part of order 1/n. For other models the profile
shows what the covariance cannot: open ends, more than one valley, a bound.

With the soft-l1 loss, its sum R replaces S. The ratio is scaled by R₀ ΣK / (n Σψ²) to follow χ²
again (the ratio test of an M-estimator, Hampel et al. 1986, ch. 7). ψ and K are those of
`sysid.uncertainty.analysis`. The scale is 1 if no residual is an outlier.

If the residuals are coloured, the ratio is divided by the factor by which this widens the square of
the interval (`sysid.residuals.sandwich`). So profile and standard error assume the same noise.

The others are estimated by least squares from a neighbouring value. A time lag that is rounded to
samples changes the output in jumps only, so it is held while another parameter is profiled.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sysid.core.distributions import CHI_SQUARE_95
from sysid.core.errors import InvalidRecord, InvalidSettings, suggest_name
from sysid.core.types import FloatArray
from sysid.identifiability.exchange import (
    ExchangeGroups,
    find_exchanges,
    find_ordered_partners,
    order_exchangeable,
)
from sysid.residuals.sandwich import estimate_sandwich
from sysid.search.refine import RefinedCandidate, refine_candidates
from sysid.simulation.loss import compute_influence
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit
from sysid.uncertainty.sensitivities import compute_sensitivities
from sysid.uncertainty.unequal_noise import fit_unequal_noise

_SPAN_FACTOR = 1.5  # of the half width by the covariance: position of the outermost value
_STEP_GROWTH = 1.3  # growth of a step that does not reach the threshold
_MAX_STEPS, _MIN_POINTS = 40, 3
_ROUNDING_RMS = 1e-9  # of the outputs' size: residuals that are rounding
_OWN_SLOPE_TOLERANCE = 1e-14  # of the square of a slope: a smaller rest is rounding
_MIN_RANGE = 1e-6  # of the range: least range of a parameter that another one limits
_MAX_BISECTIONS = 6  # halvings of the gap in which the ratio crosses the threshold


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """The profile of one parameter.

    Attributes
    ----------
    name, unit : str
    values : FloatArray, shape (V,)
        In rising order, including the estimate.
    likelihood_ratio : FloatArray, shape (V,)
        n ln(S(v)/S₀), scaled; S₀ is the least sum of all. 0 at the best value; ``inf``: diverged.
    rms : FloatArray, shape (V,)
    others : FloatArray, shape (V, D - 1)
        The other free parameters, in the problem's order.
    interval : tuple of (float or None)
        Ends of the 95 % interval. None if the ratio stays below the threshold up to the bound, or
        up to the last value.
    estimate : float
        The best value.
    evaluations : int
    is_complete : bool
        False if `should_stop` ended the profile.
    """

    name: str
    unit: str
    values: FloatArray
    likelihood_ratio: FloatArray
    rms: FloatArray
    others: FloatArray
    interval: tuple[float | None, float | None]
    estimate: float
    evaluations: int
    is_complete: bool


def compute_profile(
    problem: Problem,
    theta: FloatArray,
    name: str,
    points: int = 21,
    should_stop: Callable[[], bool] | None = None,
) -> Profile:
    """Compute the profile of a free parameter from an estimate (D,), which is refined first.

    Parameters
    ----------
    points : int
        Approximate number of values, 3 or more; each takes a least-squares search.
    should_stop : callable
        Called before each of them.

    Raises
    ------
    InvalidSettings
        If there is no such free parameter, or there are fewer than 3 points.
    InvalidRecord
        If there are not more samples than parameters, if the simulation diverges, or if it equals
        the records up to rounding.
    """
    names = problem.free_names
    if name not in names:
        raise InvalidSettings(
            "/parameters", f"no free parameter {name!r}{suggest_name(name, names)}"
        )
    if problem.loss.noise_model == "ar1":
        raise InvalidSettings(
            "/loss/noise_model",
            f"profiles are of plain squares, not of the noise model {problem.loss.noise_model}. "
            "Fit with the noise model 'white', or use the standard errors.",
        )
    if points < _MIN_POINTS:
        raise InvalidSettings("/points", f"found {points}; need {_MIN_POINTS} or more")
    best = _refine_estimate(problem, np.array(theta, dtype=np.float64))
    reweighted = fit_unequal_noise(problem, best.theta)
    if reweighted is not None:
        problem = reweighted.problem
        best = replace(
            best,
            theta=reweighted.theta,
            rms=reweighted.rms,
            evaluations=best.evaluations + reweighted.evaluations,
        )
    groups, spent = find_exchanges(problem, best.theta)
    start = order_exchangeable(problem, best.theta, groups)
    search = _ProfileSearch(problem, start, names.index(name), groups, should_stop)
    search.evaluations += best.evaluations + spent
    step = _SPAN_FACTOR * search.half_width / (points // 2)
    search.extend_side(-step, points // 2)
    search.extend_side(step, points // 2)
    low, high = search.find_interval_end(-1.0), search.find_interval_end(1.0)
    return search.to_profile(low, high)


def _refine_estimate(problem: Problem, theta: FloatArray) -> RefinedCandidate:
    """Refine an estimate to the optimum, and check that intervals can be computed there."""
    samples, free = problem.n_scored, len(problem.free_parameters)
    if samples <= free:
        raise InvalidRecord(f"{samples} samples are not more than {free} parameters; need more")
    refined = refine_candidates(problem, [theta])[0]
    if refined is None:
        raise InvalidRecord("the simulation diverges at the estimate, so it has no profile")
    if refined.rms <= _ROUNDING_RMS * problem.output_scale:
        raise InvalidRecord(
            "the simulation equals the records up to rounding; a profile needs residuals"
        )
    return refined


class _ProfileSearch:
    """Values of one parameter in unit coordinates, with the others estimated again at each."""

    def __init__(
        self,
        problem: Problem,
        theta: FloatArray,
        d: int,
        groups: ExchangeGroups,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        self._problem, self._d, self._should_stop = problem, d, should_stop
        self._larger, self._smaller = find_ordered_partners(groups, theta, d)
        self.is_stopped, self.evaluations = False, 1
        self._position = float(to_unit(problem.evaluator, theta[None])[0, d])
        rms = float(problem.evaluate_fitness(theta[None])[0])
        self._fits = {self._position: (theta, rms)}
        self.half_width = self._predict_half_width(theta)

    def extend_side(self, step: float, count: int) -> None:
        """Extend the profile to one side, until the threshold is passed or a bound is reached."""
        position, taken = self._position, 0
        while taken < _MAX_STEPS and not self._is_side_complete(position, taken, count):
            nearer, position = position, min(max(position + step, 0.0), 1.0)
            if position == nearer:
                return  # at the bound
            self._fit_others(position, nearer)
            taken += 1
            step *= _STEP_GROWTH if taken >= count else 1.0

    def find_interval_end(self, side: float) -> float | None:
        """Find the coordinate at which the ratio crosses the threshold; None if it does not."""
        inside = min(self._fits, key=lambda position: self._fits[position][1])
        positions = sorted(
            (p for p in self._fits if side * (p - inside) > 0), key=lambda p: side * p
        )
        for outside in positions:
            if self._compute_ratio(outside) >= CHI_SQUARE_95:
                return self._find_crossing(inside, outside)
            inside = outside
        return None

    def to_profile(self, low: float | None, high: float | None) -> Profile:
        """Return the profile in the parameter's unit."""
        parameter = self._problem.free_parameters[self._d]
        order = sorted(self._fits)
        thetas = np.array([self._fits[position][0] for position in order])
        best = min(self._fits, key=lambda position: self._fits[position][1])
        low_, high_ = (
            None if end is None else self._to_parameter_value(end) for end in (low, high)
        )
        return Profile(
            name=parameter.name,
            unit=parameter.unit,
            values=thetas[:, self._d],
            likelihood_ratio=np.array([self._compute_ratio(position) for position in order]),
            rms=np.array([self._fits[position][1] for position in order]),
            others=np.delete(thetas, self._d, axis=1),
            interval=(low_, high_),
            estimate=self._to_parameter_value(best),
            evaluations=self.evaluations,
            is_complete=not self.is_stopped,
        )

    def _predict_half_width(self, theta: FloatArray) -> float:
        """Predict the half width by the covariance: at most the range, at least resolvable."""
        columns, error = (
            (sensed := compute_sensitivities(self._problem, theta)).columns,
            sensed.residuals,
        )
        self.evaluations += sensed.evaluations
        direction = np.zeros(columns.shape[1])
        direction[self._d] = 1.0
        others = np.delete(columns, self._d, axis=1)
        if others.shape[1]:
            made_up = np.linalg.lstsq(others, columns[:, self._d], rcond=1e-7)[0]
            direction[np.arange(direction.size) != self._d] = -made_up
        own_slope = columns @ direction
        # A slope that the others compensate up to rounding has no direction of its own.
        norm = float(own_slope @ own_slope)
        if norm <= _OWN_SLOPE_TOLERANCE * float(columns[:, self._d] @ columns[:, self._d]):
            norm = 0.0
        self._factor = self._compute_ratio_scale(error, columns, direction, norm)
        spread = float(np.linalg.norm(error)) / np.sqrt(max(error.size - columns.shape[1], 1))
        wide = np.sqrt(CHI_SQUARE_95 / (norm * self._factor)) * spread if norm > 0 else 1.0
        return float(min(max(wide, 1e-9), 1.0))

    def _compute_ratio_scale(
        self, error: FloatArray, columns: FloatArray, direction: FloatArray, norm: float
    ) -> float:
        """Compute the factor that makes n ln(R/R₀) follow χ², also for coloured residuals."""
        scale = self._problem.loss_scale
        influence = compute_influence(error, scale)
        colour = estimate_sandwich(self._problem, influence, columns)
        factor = _compute_robust_factor(error, scale)
        if colour is None or not norm > 0:
            return factor
        return factor / colour.compute_widening(
            direction, float(np.mean(np.square(influence))), norm
        )

    def _is_side_complete(self, position: float, taken: int, count: int) -> bool:
        self.is_stopped = self.is_stopped or bool(self._should_stop and self._should_stop())
        return self.is_stopped or (taken >= count and self._compute_ratio(position) > CHI_SQUARE_95)

    def _fit_others(self, position: float, nearer: float) -> None:
        """Estimate the others at a coordinate, starting from their values at a nearer one."""
        d, start = self._d, self._fits[nearer][0].copy()
        start[d] = self._to_parameter_value(position)
        fixed = _fix_parameter(self._restrict_exchanges(float(start[d])), d, float(start[d]))
        others = np.clip(np.delete(start, d), fixed.evaluator.lower, fixed.evaluator.upper)
        rms = float(fixed.evaluate_fitness(others[None])[0])
        self.evaluations += 1
        if others.size:
            end = refine_candidates(fixed, [others])[0]
            if end is not None:
                others, rms = end.theta, end.rms
                self.evaluations += end.evaluations
        self._fits[position] = (np.insert(others, d, start[d]), rms)

    def _restrict_exchanges(self, value: float) -> Problem:
        """Restrict exchangeable parameters to their side of a value.

        Otherwise the profile would continue into the other copy of the estimate.
        """
        if not self._larger and not self._smaller:
            return self._problem
        evaluator = self._problem.evaluator
        lower, upper = evaluator.lower.copy(), evaluator.upper.copy()
        least = _MIN_RANGE * (upper - lower)
        for i in self._larger:
            lower[i] = min(max(lower[i], value), upper[i] - least[i])
        for i in self._smaller:
            upper[i] = max(min(upper[i], value), lower[i] + least[i])
        return replace(self._problem, evaluator=evaluator._replace(lower=lower, upper=upper))

    def _find_crossing(self, inside: float, outside: float) -> float:
        """Find where the ratio, nearly a parabola, reaches the threshold."""
        for _ in range(_MAX_BISECTIONS):
            if self.is_stopped or abs(outside - inside) < 1e-3 * self.half_width:
                break
            middle = self._interpolate_crossing(inside, outside)
            nearer = min(self._fits, key=lambda p: abs(p - middle))
            if middle in self._fits:
                break
            self._fit_others(middle, nearer)
            if self._compute_ratio(middle) >= CHI_SQUARE_95:
                outside = middle
            else:
                inside = middle
        return self._interpolate_crossing(inside, outside)

    def _interpolate_crossing(self, inside: float, outside: float) -> float:
        a, b = (np.sqrt(min(self._compute_ratio(p), 1e12)) for p in (inside, outside))
        share = (np.sqrt(CHI_SQUARE_95) - a) / (b - a) if b > a else 0.5
        return float(inside + min(max(share, 0.02), 0.98) * (outside - inside))

    def _compute_ratio(self, position: float) -> float:
        best = min(rms for _, rms in self._fits.values())
        rms = self._fits[position][1]
        if rms == best:
            return 0.0
        return 2.0 * self._factor * self._problem.n_scored * float(np.log(rms / best))

    def _to_parameter_value(self, position: float) -> float:
        if position in self._fits:
            return float(self._fits[position][0][self._d])
        every = np.full((1, len(self._problem.free_parameters)), position)
        return float(from_unit(self._problem.evaluator, every)[0, self._d])


def _compute_robust_factor(error: FloatArray, scale: float) -> float:
    """Compute the factor that makes n ln(R/R₀) follow χ²: 1 for squares."""
    if scale == 0.0:
        return 1.0
    root = 1.0 + (error / scale) ** 2
    least = 2.0 * scale**2 * float(np.mean(np.sqrt(root) - 1.0))
    return least * float(np.mean(root**-1.5)) / float(np.mean(error**2 / root))


def _fix_parameter(problem: Problem, d: int, value: float) -> Problem:
    """Make the same problem with one free parameter fixed at a value."""
    old = problem.evaluator
    template = old.template.copy()
    template[old.free_rows[d]] = value
    evaluator = old._replace(
        template=template,
        free_rows=np.delete(old.free_rows, d),
        lower=np.delete(old.lower, d),
        upper=np.delete(old.upper, d),
        is_log=np.delete(old.is_log, d),
    )
    space = (*problem.free_parameters[:d], *problem.free_parameters[d + 1 :])
    return replace(problem, free_parameters=space, evaluator=evaluator, _shared={})
