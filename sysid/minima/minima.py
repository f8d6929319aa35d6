"""The minima of the loss that a run has found: those its islands ended in, and those of a scan.

A search ends in one of several minima where the loss is a comb in a time lag, where the input is
periodic, or where the model has mirror images. From the best estimate each parameter alone is
moved over its whole range, time lags first, with all points in one batch. Least squares continues
from the lowest dips. If it ends lower, the scan is repeated from there.

All ends are kept, those of the search too (`sysid.search.archive`). The data do not rule out a
minimum whose likelihood ratio n ln(Σe²/Σe²₀) is below the quantile of χ² with one degree of
freedom: its value lies in the profile likelihood region (Venzon and Moolgavkar, Appl. Statist. 37
(1988) 87). A parameter that differs between such minima is ambiguous. Coloured residuals hold less
information than white ones. The ratio is multiplied by the least `variance_ratio` of all parameters
(`sysid.uncertainty.linear_model`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sysid.core.distributions import CHI_SQUARE_95
from sysid.core.types import BoolArray, FloatArray
from sysid.core.units import format_unit
from sysid.minima.projection import draw_projected_points
from sysid.results.parts import Minimum
from sysid.search.archive import SAME_POINT, ArchivedMinimum
from sysid.search.refine import RefinedCandidate, refine_candidate
from sysid.search.state import SAME_OPTIMUM
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.linear_model import LinearOutputModel

_DELAY_POINTS, _POINTS = 128, 16  # of a scan: over the range of a time lag, of another parameter
_STARTS, _STARTS_IN_DOUBT = 6, 12  # dips from which least squares continues, in a round
_ENOUGH_ENDS = 2  # of least squares in the best minimum of a filter: it is found then
_TRIAL_STEPS, _MAX_STEPS = 4, 60  # of least squares from each, and from a promising one
_PROMISING = 1.5  # times the RMS of the best: least squares continues below it
_MAX_ROUNDS = 4
_MOST_CONTINUED = 8  # minima of the search from which least squares continues
_SAME_VALLEY = 1e-2  # of the range: nearer ends of the same RMS are one minimum
_MOST_MINIMA = 10  # that a result lists


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Where least squares ended: the values (D,), their RMS, and how often it ended there.

    `independent` is the number of fits from random points.
    """

    theta: FloatArray
    rms: float
    count: int = 1
    independent: int = 0


class FoundMinima(NamedTuple):
    """All minima, the lowest first.

    `agreeing` fits from random points ended in the minimum of the estimate, or in one as low.
    `projected` fits after the search began at random points with the linear parameters solved for.
    `is_contradicted`: the data contradict the input that is assumed before the record.
    """

    minima: tuple[Minimum, ...]
    agreeing: int
    projected: int = 0
    is_contradicted: bool = False


class ScanResult(NamedTuple):
    """Best candidate after a scan, with all ends of least squares and the simulations spent.

    `starts`: the points from which least squares continued.
    """

    best: RefinedCandidate
    ends: tuple[RefinedCandidate, ...]
    evaluations: int
    starts: int = 0


def scan_parameters(
    problem: Problem,
    start: RefinedCandidate,
    delays: Sequence[int],
    budget: int,
    is_late: Callable[[], bool] | None = None,
    *,
    only_delays: bool = False,
    is_doubtful: bool = False,
) -> ScanResult:
    """Scan each parameter alone from a minimum, with at most `budget` simulations.

    Parameters
    ----------
    start : RefinedCandidate
        A minimum. It counts as one of the ends.
    delays : sequence of int
        Numbers of the free parameters that time lags depend on. They are scanned first.
    only_delays : bool
        Whether no other parameter is scanned.
    is_doubtful : bool
        Whether least squares continues from twice as many dips.
    """
    others = () if only_delays else [d for d in range(start.theta.size) if d not in delays]
    best, ends, spent = start, [start], 0
    for _ in range(_MAX_ROUNDS):
        scanned = _scan_around(problem, best, delays, others, budget - spent)
        spent += sum(series.values.size - 1 for series in scanned)
        dips = _find_dips(scanned, problem.output_scale)
        dips = dips[: _STARTS_IN_DOUBT if is_doubtful else _STARTS]
        refined = _refine_dips(problem, dips, best.rms, budget - spent, is_late, len(dips) + 1)
        spent += refined.evaluations
        ends += refined.ends
        reached = min((best, *refined.ends), key=lambda candidate: candidate.rms)
        gains = reached.rms < best.rms * (1.0 - SAME_OPTIMUM)
        best = reached
        if not gains:
            break
    return ScanResult(best, tuple(ends), spent)


def scan_by_projection(
    problem: Problem,
    start: RefinedCandidate,
    seed: int,
    budget: int,
    is_late: Callable[[], bool] | None = None,
) -> ScanResult:
    """Scan the whole range with the linear parameters solved for (`projection`).

    A filter has a minimum at many lags. So least squares continues from more points, until two
    have ended in the best.
    """
    points, fitness, spent = draw_projected_points(problem, start.theta, seed, budget)
    order = np.argsort(fitness, kind="stable")
    dips = [(points[i], float(fitness[i])) for i in order if fitness[i] < problem.output_scale]
    is_filter = bool(problem.model.corrections)
    dips = dips[: _STARTS_IN_DOUBT if is_filter else _STARTS]
    enough = _ENOUGH_ENDS if is_filter else len(dips) + 1
    refined = _refine_dips(problem, dips, start.rms, budget - spent, is_late, enough)
    best = min((start, *refined.ends), key=lambda candidate: candidate.rms)
    return ScanResult(best, (start, *refined.ends), spent + refined.evaluations, refined.starts)


class _RefinedDips(NamedTuple):
    """Ends of least squares, the simulations spent, and the dips from which it continued."""

    ends: tuple[RefinedCandidate, ...]
    evaluations: int
    starts: int


def _refine_dips(
    problem: Problem,
    dips: Sequence[tuple[FloatArray, float]],
    best: float,
    budget: int,
    is_late: Callable[[], bool] | None,
    enough: int,
) -> _RefinedDips:
    """Refine dips, and further only those that come near the best RMS.

    It ends early when so many (`enough`) have reached the best.
    """
    ends: list[RefinedCandidate] = []
    spent, starts, lowest = 0, 0, best
    for point, rms in dips:
        if is_late is not None and is_late():
            break
        trial = refine_candidate(problem, point, rms, budget - spent, _TRIAL_STEPS)
        if trial is None:
            break
        spent, starts = spent + trial.evaluations, starts + 1
        if not trial.rms < _PROMISING * best:
            continue
        end = refine_candidate(problem, trial.theta, trial.rms, budget - spent, _MAX_STEPS)
        if end is None:
            break
        spent += end.evaluations
        ends.append(end)
        lowest = min(lowest, end.rms)
        if sum(one.rms <= lowest * (1.0 + SAME_OPTIMUM) for one in ends) >= enough:
            break
    return _RefinedDips(tuple(ends), spent, starts)


def continue_from_archive(
    problem: Problem,
    archived: Sequence[ArchivedMinimum],
    ends: Sequence[Fit],
    budget: int,
    is_late: Callable[[], bool] | None = None,
) -> tuple[list[Fit], int]:
    """Continue least squares from the lowest minima of a search, with at most `budget` simulations.

    A minimum near one of the `ends` counts for it. The simulations spent are returned too.
    """
    if not archived or len(archived) > budget:
        return [], 0
    points = from_unit(problem.evaluator, np.array([one.point for one in archived]))
    fitness, spent = problem.evaluate_fitness(points), len(archived)
    best = min(end.rms for end in ends)
    units, known = to_unit(problem.evaluator, points), [*ends]
    known_units = [*to_unit(problem.evaluator, np.array([end.theta for end in ends]))]
    fits: list[Fit] = []
    continued = 0
    for i in np.argsort(fitness, kind="stable"):
        theta, rms, count = points[i], float(fitness[i]), archived[i].count
        if not rms < _PROMISING * best:
            break
        distances = _compute_distances(np.array(known_units), units[i])
        nearest = int(np.argmin(distances))
        same = _SAME_VALLEY if rms <= best * (1.0 + SAME_OPTIMUM) else SAME_POINT
        if distances[nearest] < same:
            fits.append(Fit(known[nearest].theta, known[nearest].rms, count, count))
            continue
        if continued == _MOST_CONTINUED or (is_late is not None and is_late()):
            break
        end = refine_candidate(problem, theta, rms, budget - spent, _MAX_STEPS)
        if end is None:
            break
        spent, continued = spent + end.evaluations, continued + 1
        fits.append(Fit(end.theta, end.rms, count, count))
        known.append(fits[-1])
        known_units.append(to_unit(problem.evaluator, end.theta[None])[0])
    return fits, spent


class _Series(NamedTuple):
    """Points with one parameter moved, in ascending order, and their fitness; the centre too."""

    points: FloatArray
    values: FloatArray
    centre: int


def _scan_around(
    problem: Problem,
    centre: RefinedCandidate,
    delays: Sequence[int],
    others: Sequence[int],
    budget: int,
) -> list[_Series]:
    """Simulate the range of each parameter, time lags first, as far as the budget goes."""
    middle = to_unit(problem.evaluator, centre.theta[None])[0]
    scanned, moved = [], []
    for d in (*delays, *others):
        count = _DELAY_POINTS if d in delays else _POINTS
        budget -= count
        if budget < 0:
            break
        series = np.repeat(middle[None], count, axis=0)
        series[:, d] = (np.arange(count) + 0.5) / count
        scanned.append(d)
        moved.append(series)
    if not moved:
        return []
    points = from_unit(problem.evaluator, np.concatenate(moved))
    ends = np.cumsum([len(series) for series in moved])[:-1]
    fitness = problem.evaluate_fitness(points)
    return [
        _insert_centre(theta, values, series[:, d], middle[d], centre)
        for theta, values, series, d in zip(
            np.split(points, ends), np.split(fitness, ends), moved, scanned, strict=True
        )
    ]


def _insert_centre(
    points: FloatArray,
    values: FloatArray,
    unit: FloatArray,
    middle: float,
    centre: RefinedCandidate,
) -> _Series:
    at = int(np.searchsorted(unit, middle))
    return _Series(
        np.concatenate([points[:at], centre.theta[None], points[at:]]),
        np.concatenate([values[:at], [centre.rms], values[at:]]),
        at,
    )


def _find_dips(scanned: Sequence[_Series], limit: float) -> list[tuple[FloatArray, float]]:
    """Find the lowest local minima of the series, without their centre: points and fitness.

    Above the limit, the RMS of the mean of the output, the model explains nothing.
    """
    dips = []
    for points, values, centre in scanned:
        framed = np.full(values.size + 2, np.inf)
        np.copyto(framed[1:-1], values, where=np.isfinite(values))
        is_dip = (framed[1:-1] < framed[:-2]) & (framed[1:-1] <= framed[2:]) & (values < limit)
        is_dip[centre] = False
        dips += [(points[i], float(values[i])) for i in np.flatnonzero(is_dip)]
    return sorted(dips, key=lambda dip: dip[1])


def collect_minima(
    problem: Problem,
    fits: Sequence[Fit],
    linear: LinearOutputModel | None = None,
    recorded_from: float | None = None,
) -> tuple[Minimum, ...]:
    """Group the ends of least squares by minimum; the lowest first.

    Least squares ends anywhere in a flat valley. So an end that the data do not rule out belongs to
    the lowest one if the linear model at the estimate says so too.
    """
    if not fits:
        return ()
    n = problem.n_scored * _get_variance_ratio(linear)
    ordered = sorted(fits, key=lambda fit: fit.rms)
    units = to_unit(problem.evaluator, np.array([fit.theta for fit in ordered]))
    are_close = (_compute_distances(units[:, None], units) < SAME_POINT).tolist()
    groups: list[list[int]] = []
    ratios: list[float] = []
    for i, fit in enumerate(ordered):
        best = ordered[0]
        if fit.rms <= best.rms:
            ratio = 0.0
        else:
            ratio = np.inf if best.rms == 0 else 2.0 * n * float(np.log(fit.rms / best.rms))
        near = next((group for group in groups if are_close[group[0]][i]), None)
        if near is None and groups and linear is not None and ratio <= CHI_SQUARE_95:
            is_inside = _is_in_valley(problem, linear, n, fit.theta, best.theta)
            near = groups[0] if is_inside else None
        if near is None:
            groups.append([i])
            ratios.append(ratio)
        else:
            near.append(i)
    return tuple(
        Minimum(
            dict(zip(problem.free_names, ordered[group[0]].theta.tolist(), strict=True)),
            ordered[group[0]].rms,
            sum(ordered[i].count for i in group),
            sum(ordered[i].independent for i in group),
            ratio,
            ratio <= CHI_SQUARE_95,
            recorded_from,
        )
        for group, ratio in zip(groups[:_MOST_MINIMA], ratios, strict=False)
    )


def _get_variance_ratio(linear: LinearOutputModel | None) -> float:
    """Get the least variance ratio of all parameters; 1 for white residuals."""
    ratios = np.ones(1) if linear is None else linear.variance_ratio
    return float(np.min(ratios[np.isfinite(ratios)], initial=1.0))


def _is_in_valley(
    problem: Problem, linear: LinearOutputModel, n: float, theta: FloatArray, best: FloatArray
) -> bool:
    """Whether the data do not rule out a point (D,), by the linear model at the best minimum.

    A parameter that is on a plateau or has no variance is not in the model. It must not move.
    """
    points = to_unit(problem.evaluator, np.array([theta, best]))
    is_left_out = ~np.isfinite(linear.variance_ratio)
    if np.any(np.abs(points[0] - points[1])[is_left_out] >= SAME_POINT):
        return False
    (increase,) = linear.predict_relative_increase((theta - best)[None])
    return bool(n * np.log1p(increase) <= CHI_SQUARE_95)


def is_same_point(problem: Problem, first: FloatArray, second: FloatArray) -> bool:
    """Whether two ends (D,) of least squares are one minimum."""
    return compute_distance(problem, first, second) < SAME_POINT


def compute_distance(problem: Problem, first: FloatArray, second: FloatArray) -> float:
    """Compute the largest distance of two points (D,) in one parameter, as a share of its range."""
    points = to_unit(problem.evaluator, np.array([first, second]))
    return float(_compute_distances(points[:1], points[1])[0])


def find_nearest(problem: Problem, minima: Sequence[Minimum], theta: FloatArray) -> Minimum:
    """Find the minimum nearest to a point (D,)."""
    points = to_unit(problem.evaluator, np.array([*(one.values for one in minima), theta]))
    return minima[int(np.argmin(_compute_distances(points[:-1], points[-1])))]


def _compute_distances(units: FloatArray, unit: FloatArray) -> FloatArray:
    """Compute the largest difference (…) of points (…, D) in [0, 1] from another one (D,)."""
    return np.asarray(np.abs(units - unit).max(axis=-1, initial=0.0))


def mark_ambiguous(
    problem: Problem, estimates: tuple[Estimate, ...], minima: FoundMinima
) -> tuple[Estimate, ...]:
    """Mark estimates that differ between the minima that the data do not rule out.

    The minimum nearest to the estimate is its own; under a noise model it is not quite the same.
    A value differs if the intervals of both, equally wide, do not overlap. An initial state is not
    compared where the start of the record is left out.
    """
    by_name = {estimate.name: estimate.value for estimate in estimates}
    theta = np.array([by_name[name] for name in problem.free_names])
    declared = {parameter.name for parameter in problem.model.parameters}
    is_declared = np.array([name in declared for name in problem.free_names])
    pairs = [
        pair
        for is_recorded, compared in ((False, np.ones_like(is_declared)), (True, is_declared))
        for pair in _pair_with_own(
            problem,
            theta,
            [m for m in minima.minima if (m.recorded_from is not None) == is_recorded],
            compared,
        )
    ]
    columns = {name: d for d, name in enumerate(problem.free_names)}
    return tuple(
        _mark_one(
            estimate,
            columns[estimate.name],
            [p for p in pairs if p[1].recorded_from is None or estimate.name in declared],
        )
        if estimate.name in columns
        else estimate
        for estimate in estimates
    )


def _pair_with_own(
    problem: Problem, theta: FloatArray, minima: Sequence[Minimum], compared: BoolArray
) -> list[tuple[Minimum, Minimum]]:
    """Pair the compatible minimum nearest to the estimate (D,) with each other one.

    The distance is that of the `compared` parameters (D,).
    """
    compatible = [minimum for minimum in minima if minimum.is_compatible]
    if not compatible:
        return []

    def find_distance(one: Minimum) -> float:
        return compute_distance(problem, np.where(compared, one.values, theta), theta)

    own = min(compatible, key=find_distance)
    return [(own, one) for one in compatible if one is not own]


def _find_own_outside(
    interval: tuple[float, float], column: int, pairs: Sequence[tuple[Minimum, Minimum]]
) -> list[Minimum]:
    """Find the own minimum of the recorded part if an assumed input has moved the estimate away."""
    own = next((own for own, _ in pairs if own.recorded_from is not None), None)
    if own is None or interval[0] <= own.values[column] <= interval[1]:
        return []
    return [own]


def _mark_one(
    estimate: Estimate, column: int, pairs: Sequence[tuple[Minimum, Minimum]]
) -> Estimate:
    if estimate.interval95 is None:
        return estimate
    lower, upper = estimate.interval95
    others = [
        other
        for own, other in pairs
        if abs(other.values[column] - own.values[column]) > upper - lower
    ]
    if not others:
        return estimate
    others += _find_own_outside(estimate.interval95, column, pairs)
    listed = ", ".join(f"{value:.4g}" for value in sorted(m.values[column] for m in others))
    verb = "fits" if len(others) == 1 else "fit"
    since = next((m.recorded_from for m in others if m.recorded_from is not None), None)
    where = "" if since is None else f" from t = {since:.3g} s on, where the input is recorded"
    reason = f"{listed}{format_unit(estimate.unit)} {verb} as well{where}"
    return replace(estimate, status="ambiguous", reason=reason)
