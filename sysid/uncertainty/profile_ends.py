"""Ends of intervals by the profile likelihood, where the local interval does not hold.

The local interval is that of a linear model of the outputs. It fails where a step of two standard
errors changes their slopes (Bates and Watts, J. R. Stat. Soc. B 42 (1980) 1). A time constant that
is longer than the record does so. So the likelihood ratio Q is computed at both ends of each local
interval, where the others follow by the linear model. If that holds, Q is the square of the
quantile there. A parameter whose √Q differs by more than 20 % is profiled. So is one of a pair
whose correlation is above 0.95, since the valley of such a pair may bend.

An end is where Q of the profile reaches the square of the quantile (Venzon and Moolgavkar, Appl.
Statist. 37 (1988) 87). Each step takes the slopes at a point, and solves both conditions there: the
others are at their best, and the parameter is at the end. Q is that of
`sysid.uncertainty.likelihood`. So the profile assumes the same noise as the standard errors, of any
colour, and of a linear model both intervals are the same.

Near a parameter on a plateau the output moves in jumps, if at all. The likelihood ratio at the true
place of a jump follows the larger of two exponential variables then, not χ²: its 95 % quantile is
-2 ln(1 - √0.95) = 7.35 (Hansen, Econometrica 68 (2000) 575).

Where Q stays below the limit up to the bound, the end is *open*: the data say nothing there. It is
open as well if another parameter meets its bound before: without that, the valley would go on. A
bound that is a physical limit closes it. No value lies beyond, and the set that the likelihood
ratio does not rule out ends there (Self and Liang, J. Am. Stat. Assoc. 82 (1987) 605).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, get_args

import numpy as np

from sysid.core.distributions import CHI_SQUARE_95
from sysid.core.types import RANK_TOLERANCE, BoolArray, FloatArray
from sysid.identifiability.exchange import find_ordered_partners
from sysid.search.least_squares import ScoredSamples, fill_jacobian
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import find_physical_bounds, from_unit, is_at_bounds, to_unit
from sysid.uncertainty.analysis import Analysis
from sysid.uncertainty.estimates import Estimate, IntervalEnd
from sysid.uncertainty.intervals import ProfileEnds
from sysid.uncertainty.likelihood import Likelihood, LikelihoodModel, LinearRatio

_NOTABLE_CURVATURE = 0.2  # of √Q of the linear model: a larger change asks for a profile
_HIGH_CORRELATION = 0.95  # of two parameters: their valley may bend
_ROUNDING_RMS = 1e-9  # of the outputs' size: residuals that are rounding
_TOLERANCE = 0.02  # of √Q at an end
_SMALL_GAIN = 0.1  # of the limit of Q: what the others may still gain at an end
_LARGE_GAIN = 0.5  # of that limit: more gain, and the others move alone
_MAX_STEPS = 16  # points on the way to an end
_MAX_GROWTH = 1.5  # of the distance from the estimate: the longest step
_SHARES = np.array([1.0, 0.5, 0.25, 0.125])  # of a step: those that are tried at once
_SCALES = (1.0, 1 / 16, 1 / 256)  # of those shares, one after the other
_RESOLUTION = 5e-4  # of the width of a local interval: nearer points are one
_JUMP_LIMIT = 7.352 / CHI_SQUARE_95  # times the limit of Q, where the output moves in jumps
_SIDES = np.array([-1.0, 1.0])  # of an interval


class FoundEnds(NamedTuple):
    """Ends of intervals by the profile, by parameter, and the simulations that they took."""

    by_name: Mapping[str, ProfileEnds]
    evaluations: int


def find_profile_ends(
    problem: Problem,
    theta: FloatArray,
    analysis: Analysis,
    max_simulations: int,
    names: Collection[str] | None = None,
) -> FoundEnds:
    """Find the ends of intervals around an estimate (D,) that those of the linear model miss.

    When `max_simulations` are spent, the other intervals stay as they are. So do those of
    parameters that are not among the `names`, if these are given.
    """
    model, uncertainty = analysis.likelihood, analysis.uncertainty
    by_name = {one.name: one for one in analysis.estimates}
    estimates = [by_name[name] for name in problem.free_names]
    has_none = not any(one.stderr and one.status != "at bound" for one in estimates)
    if model is None or uncertainty is None or has_none or max_simulations < 3 * theta.size + 2:
        return FoundEnds({}, 0)
    if float(problem.evaluate_fitness(theta[None])[0]) <= _ROUNDING_RMS * problem.output_scale:
        return FoundEnds({}, 1)
    search = _EndSearch(problem, theta, analysis, model, max_simulations - 1)
    ends = {}
    with np.errstate(over="ignore", invalid="ignore"):  # far away a simulation may diverge
        for d in search.select_doubtful(estimates, uncertainty.correlation):
            name = problem.free_names[d]
            found = search.find_ends(d) if names is None or name in names else None
            if found is not None:
                ends[name] = found
    return FoundEnds(ends, 1 + search.evaluations)


def extrapolate_ends(coarse: ProfileEnds, fine: ProfileEnds) -> ProfileEnds:
    """Extrapolate the ends of a set from those with a step of the integration and with half of it.

    A held input jumps, and the jump is spread over a step. So the set is too small by a part of the
    step at either end (Richardson's extrapolation). A rounded lag has a set that shrinks with the
    step, and keeps its own.
    """
    (low, high), (lower, upper) = coarse.interval, fine.interval
    ends = min(low, 2.0 * lower - low), max(high, 2.0 * upper - high)
    return replace(coarse, interval=ends)


class _StoppedError(Exception):
    """No simulations are left, or none is finite."""


class _End(NamedTuple):
    """An end of an interval in unit coordinates.

    It is open if only a bound of the search stops it. `limit` is the parameter with that bound. If
    the steps did not suffice, it `is_rough`: a point inside. `meets_limit`: a parameter is at a
    physical limit there.
    """

    position: float
    limit: str = ""
    is_rough: bool = False
    meets_limit: bool = False


class _Valley(NamedTuple):
    """Q along one parameter, where the others are at their best: ratio + 2 slope δ + curvature δ².

    `gain` is what the others gain at δ = 0. They move by `fixed` (D,), and by `turning` · δ.
    """

    ratio: float
    gain: float
    slope: float
    curvature: float
    fixed: FloatArray
    turning: FloatArray

    def find_step(self, side: float, limit: float, longest: float) -> float:
        """Find the step to where Q reaches the limit, on that side of the valley's bottom."""
        root = self.slope**2 + self.curvature * (limit - self.ratio)
        if root < 0.0 or not self.curvature > 0.0:
            return side * longest
        step = (side * np.sqrt(root) - self.slope) / self.curvature
        return float(np.clip(step, -longest, longest))

    def predict_ratios(self, steps: FloatArray) -> FloatArray:
        """Predict Q (P,) after steps (P,)."""
        return self.ratio + 2.0 * self.slope * steps + self.curvature * steps**2


class _EndSearch:
    """Search for the ends of intervals in unit coordinates, counting simulations."""

    def __init__(
        self,
        problem: Problem,
        theta: FloatArray,
        analysis: Analysis,
        model: LikelihoodModel,
        most: int,
    ) -> None:
        self._groups = () if analysis.uncertainty is None else analysis.uncertainty.groups
        self._problem, self._exchanges, self._most = problem, analysis.exchanges, most
        self._likelihood, self._quantiles = Likelihood(problem, model), model.quantiles
        self.evaluations = 0
        rows = problem.scored_rows
        self._scored = ScoredSamples(problem.evaluator, rows, problem.evaluator.weight[rows])
        self._theta, self._point = theta, to_unit(problem.evaluator, theta[None])[0]
        self._start = self._linearise(self._point)
        # The output does not change near a lag on a plateau, which stays where it is.
        self._moves: BoolArray = np.any(self._start.columns != 0.0, axis=0)
        self._is_physical = find_physical_bounds(problem.free_parameters)
        self._local_ends, self._resolution = np.zeros((theta.size, 2)), np.zeros(theta.size)

    def select_doubtful(self, estimates: Sequence[Estimate], correlation: FloatArray) -> list[int]:
        """Select the parameters whose local interval may not hold."""
        evaluator = self._problem.evaluator
        widths = evaluator.upper - evaluator.lower
        is_mirrored = self._find_mirrored(estimates)
        errors = np.array([one.stderr or 0.0 for one in estimates])
        errors = np.where(is_mirrored, widths / self._quantiles, errors)
        at_bound = np.array([one.status == "at bound" for one in estimates])
        chosen = np.flatnonzero((errors > 0.0) & ~at_bound)
        reach = self._quantiles * errors
        points, shares = [], []
        for d in chosen.tolist():
            valley = self._find_valley(self._start, self._point, d)
            ends = np.repeat(self._theta[None], 2, axis=0)
            ends[:, d] = np.clip(
                ends[:, d] + reach[d] * _SIDES, evaluator.lower[d], evaluator.upper[d]
            )
            shares.append(np.abs(ends[:, d] - self._theta[d]) / reach[d])
            self._local_ends[d] = to_unit(evaluator, ends)[:, d]
            if not is_mirrored[d]:  # the range that its steps begin with resolves nothing
                self._resolution[d] = _RESOLUTION * np.ptp(self._local_ends[d])
            steps = self._local_ends[d] - self._point[d]
            points.append(np.clip(self._point + steps[:, None] * valley.turning, 0.0, 1.0))
        ratios = self._compute_ratios(np.concatenate(points)).reshape(-1, 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            roots = np.sqrt(np.maximum(ratios, 0.0)) / self._quantiles[chosen, None]
            is_curved = np.any(np.abs(roots / np.array(shares) - 1.0) > _NOTABLE_CURVATURE, axis=1)
        related = np.abs(correlation[np.ix_(chosen, chosen)]) - np.eye(chosen.size)
        is_related = np.any(related > _HIGH_CORRELATION, axis=1)
        is_doubtful = is_curved | is_related | ~self._moves[chosen] | is_mirrored[chosen]
        return [int(d) for d in chosen[is_doubtful]]

    def _find_mirrored(self, estimates: Sequence[Estimate]) -> BoolArray:
        """Find parameters (D,) without an error, in a combination that has a physical limit."""
        bounded = np.any(self._is_physical, axis=0)
        limited = {one.name for one, has_limit in zip(estimates, bounded, strict=True) if has_limit}
        members = {
            name for group in self._groups if limited & set(group.members) for name in group.members
        }
        return np.array(
            [
                one.stderr is None and one.status == "group" and one.name in members
                for one in estimates
            ]
        )

    def find_ends(self, d: int) -> ProfileEnds | None:
        """Find both ends of a parameter; None if the search stopped before."""
        try:
            ends = [self._find_end(d, i) for i in range(2)]
        except _StoppedError:
            return None
        values = np.repeat(self._point[None], 2, axis=0)
        values[:, d] = [end.position for end in ends]
        lower, upper = from_unit(self._problem.evaluator, values)[:, d].tolist()
        limits = dict[IntervalEnd, str]()
        for name, end in zip(get_args(IntervalEnd), ends, strict=True):
            if end.limit:
                limits[name] = end.limit
        is_closed = not (limits or any(end.is_rough for end in ends))
        meets_limit = any(end.meets_limit for end in ends)
        is_set = not self._moves[d]
        return ProfileEnds((lower, upper), limits, is_closed, is_set, meets_limit)

    def _find_end(self, d: int, number: int) -> _End:
        """Find the lower end (0) or the upper one (1).

        If the steps do not suffice, it is the furthest point inside, or the local end.
        """
        side, limit = float(_SIDES[number]), self._compute_limit(d)
        point, linear = self._point, self._start
        inside, outside = float(point[d]), side * np.inf
        for _ in range(_MAX_STEPS):
            valley = self._find_valley(linear, point, d)
            root = np.sqrt(max(valley.ratio, 0.0) / limit)
            is_near_end = abs(root - 1.0) <= _TOLERANCE or point[d] == max(side, 0.0)
            if valley.gain > (_SMALL_GAIN if is_near_end else _LARGE_GAIN) * limit:
                point = self._move_others(point, valley, d)
                linear = self._linearise(point)
                continue
            if valley.ratio < limit:
                inside = float(point[d])
                if inside == max(side, 0.0):
                    is_closed = bool(self._is_physical[number, d])
                    name = "" if is_closed else self._problem.free_names[d]
                    return _End(inside, name, meets_limit=self._meets_limit(point))
            else:
                outside = float(point[d])
            if abs(outside - inside) <= self._resolution[d]:
                return _End(inside, meets_limit=self._meets_limit(point))
            step = valley.find_step(side, limit, self._find_longest_step(point, d))
            target = float(np.clip(point[d] + step, 0.0, 1.0))
            if abs(root - 1.0) <= _TOLERANCE:
                name = self._name_limit(linear, point, d, limit)
                return _End(target, name, meets_limit=self._meets_limit(point))
            if not side * inside < side * target < side * outside:
                target = 0.5 * (inside + outside) if np.isfinite(outside) else target
            point = self._follow(point, valley, d, target - float(point[d]), limit)
            linear = self._linearise(point)
        return _End(side * max(side * inside, side * self._local_ends[d, number]), is_rough=True)

    def _compute_limit(self, d: int) -> float:
        """Compute the value of Q at an end."""
        return float(self._quantiles[d]) ** 2 * (1.0 if self._moves[d] else _JUMP_LIMIT)

    def _meets_limit(self, point: FloatArray) -> bool:
        """Whether a parameter is at a physical limit at a point."""
        return bool(np.any(np.array(is_at_bounds(point)) & self._is_physical))

    def _name_limit(self, linear: LinearRatio, point: FloatArray, d: int, limit: float) -> str:
        """Name another parameter whose bound ends the valley at a point: without it Q is smaller.

        It has met that bound on the way from the estimate. Empty: no bound of the search matters.
        """
        is_held = np.any(np.array(is_at_bounds(point)) & ~self._is_physical, axis=0)
        is_held &= ~np.logical_or(*is_at_bounds(self._point))
        is_held &= self._moves & (np.arange(point.size) != d)
        if not is_held.any():
            return ""
        gain = self._find_valley(linear, np.where(is_held, 0.5, point), d).gain
        name = self._problem.free_names[int(np.argmax(is_held))]
        return name if gain > _LARGE_GAIN * limit else ""

    def _find_longest_step(self, point: FloatArray, d: int) -> float:
        """Find the longest next step: from the estimate, a little beyond its local interval."""
        distance = abs(float(point[d] - self._point[d]))
        local = float(np.max(np.abs(self._local_ends[d] - self._point[d])))
        return _MAX_GROWTH * (distance or local)

    def _find_valley(self, linear: LinearRatio, point: FloatArray, d: int) -> _Valley:
        """Find Q along a parameter, where the others follow it inside their bounds."""
        residuals, columns = linear.residuals, linear.columns
        free = self._moves & (np.arange(point.size) != d)
        fixed, turning = np.zeros(point.size), np.zeros(point.size)
        while True:
            rest = np.column_stack([residuals, columns[:, d]])
            fixed[:], turning[:] = 0.0, 0.0
            if free.any():
                made_up = np.linalg.lstsq(columns[:, free], rest, rcond=RANK_TOLERANCE)[0]
                rest -= columns[:, free] @ made_up
                fixed[free], turning[free] = -made_up.T
            leads_out = ((point <= 0.0) & (fixed < 0.0)) | ((point >= 1.0) & (fixed > 0.0))
            if not leads_out.any():
                break
            free &= ~leads_out
        gain = float(residuals @ residuals - rest[:, 0] @ rest[:, 0])
        turning[d] = 1.0
        slope, curvature = float(rest[:, 0] @ rest[:, 1]), float(rest[:, 1] @ rest[:, 1])
        return _Valley(linear.ratio - gain, gain, slope, curvature, fixed, turning)

    def _follow(
        self, point: FloatArray, valley: _Valley, d: int, step: float, limit: float
    ) -> FloatArray:
        """Follow the valley by a step, or by the largest share of it where Q is as predicted."""
        move = valley.fixed + step * valley.turning
        for scale in _SCALES:
            shares = scale * _SHARES
            points = self._keep_inside(point + shares[:, None] * move, d)
            ratios = self._compute_ratios(points)
            is_near = ratios - valley.predict_ratios(shares * step) <= limit
            if is_near.any():
                return np.asarray(points[int(np.argmax(is_near))])
        if not np.isfinite(ratios[-1]):
            raise _StoppedError
        return np.asarray(points[-1])

    def _move_others(self, point: FloatArray, valley: _Valley, d: int) -> FloatArray:
        """Move the others towards their best values, by the share of the step that gains most.

        The whole step ends where the first of them meets its bound.
        """
        room = np.where(valley.fixed > 0.0, 1.0 - point, point)
        meets = np.abs(valley.fixed) > room
        share = float(np.min(room[meets] / np.abs(valley.fixed[meets]), initial=1.0))
        points = self._keep_inside(point + share * _SHARES[:, None] * valley.fixed, d)
        return np.asarray(points[int(np.argmin(self._compute_ratios(points)))])

    def _keep_inside(self, points: FloatArray, d: int) -> FloatArray:
        """Keep points (P, D) inside the bounds, and exchangeable parameters on their side of one.

        Otherwise the profile would continue into the other copy of the estimate.
        """
        inside = np.clip(points, 0.0, 1.0)
        larger, smaller = find_ordered_partners(self._exchanges, self._theta, d)
        if larger or smaller:
            evaluator = self._problem.evaluator
            value = from_unit(evaluator, inside)[:, d]
            same = to_unit(evaluator, np.repeat(value[:, None], inside.shape[1], axis=1))
            inside[:, larger] = np.maximum(inside[:, larger], same[:, larger])
            inside[:, smaller] = np.minimum(inside[:, smaller], same[:, smaller])
        return np.asarray(inside)

    def _linearise(self, point: FloatArray) -> LinearRatio:
        """Linearise Q at a point."""
        self._spend(1 + point.size)
        error = self._problem.compute_residuals(from_unit(self._problem.evaluator, point[None]))[0]
        columns = np.empty((point.size, error.size))
        fill_jacobian(self._scored, point, error, columns)
        return self._likelihood.linearise_ratio(error, columns.T)

    def _compute_ratios(self, points: FloatArray) -> FloatArray:
        self._spend(len(points))
        return self._likelihood.compute_ratios(from_unit(self._problem.evaluator, points))

    def _spend(self, simulations: int) -> None:
        if self.evaluations + simulations > self._most:
            raise _StoppedError
        self.evaluations += simulations
