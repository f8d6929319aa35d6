"""Find an integration step that has no part in the estimates.

A time constant shorter than about one step compensates for the integration error, and the
residuals do not show it. Such an estimate may lie where the method is just stable. The sensitivity
there is that of the solver, and the standard error is far too small.

So the estimate of a differential model is compared with that of half the step. A change d of the
outputs moves no parameter by more than |d|/s of its standard errors. If that may be notable, the
estimates move by -(SᵀS)⁻¹Sᵀd while d is small compared to the output. Otherwise the model is fitted
again. The sensitivities are computed with half the step too, because errors matter as values do.

If an estimate or its error changes, the finer step replaces the longer one, until both stand still
or a limit is reached. A small relative move is accepted if the record fits far better with the
longer step, as data simulated with it do.

Without noise the standard errors are so small that no step is short enough. There a small relative
move at the limit is an error of the solver, and is added to the standard error.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, inf, log10, sqrt

import numpy as np

from sysid.core.findings import Finding, note
from sysid.core.linear_algebra import compute_truncated_svd
from sysid.core.types import RANK_TOLERANCE, FloatArray
from sysid.core.units import format_unit
from sysid.kernels.signals.past_reads import is_difference
from sysid.models.model import MAX_SUBSTEPS, replace_substeps
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import is_at_bounds, to_unit
from sysid.uncertainty.analysis import Analysis, compute_physical_scale
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.intervals import IntegrationError, compose_interval
from sysid.uncertainty.sensitivities import BudgetSpentError, compute_sensitivities

_FACTOR = 2  # times as many steps: they are halved
_NOTABLE_MOVE = 0.3  # of a standard error
_NOTABLE_GROWTH = 1.3  # of a standard error with half the step
_NOTABLE_ERROR = 1e-3  # of the output's size: smaller integration errors act linearly
_NOTABLE_SHARE = 0.01  # of a value: smaller moves are accepted if the original step fits far better
_RANGE_SHARE = 0.1  # of that share, of the range: so are these, such as those of values near 0
_SMALL_SHARE = 1e-3  # of a value: a smaller move is no doubt if there is no noise
_TINY = float(np.finfo(float).tiny)
_LIKELIHOOD_GAIN = 10.0  # twice the logarithm of the ratio of likelihoods
_MAX_STEPS = 2_000_000  # of one simulation
_MIN_WORK = 200_000_000  # integration steps of all finer fits together: a second or two
_WORK_SHARE = 2  # of the steps that the search has taken, where these are more
_MAX_STARTS = 32  # earlier champions of an island, from which a finer fit may begin
_MIN_FIT_STEPS = 4  # of least squares


@dataclass(frozen=True, slots=True, eq=False)
class HalfStep:
    """The change of estimates with half the integration step.

    Attributes
    ----------
    problem : Problem
        With half the step.
    theta : FloatArray, shape (D,)
        The estimate with half the step, as fitted or predicted.
    changes : mapping of str to str
        What changes notably, in words, by parameter; empty: all stand still.
    small_moves : mapping of str to float
        Of these, moves of less than a thousandth of a value, if the residuals are negligible.
    evaluations : int
    """

    problem: Problem
    theta: FloatArray
    changes: Mapping[str, str]
    small_moves: Mapping[str, float]
    evaluations: int


def compare_half_step(
    problem: Problem,
    theta: FloatArray,
    analysis: Analysis,
    max_simulations: int | None = None,
    is_late: Callable[[], bool] | None = None,
) -> HalfStep | None:
    """Compare estimates (D,) and their errors with those of half the step.

    None if there is no such comparison: a recursion, too long a simulation, no sensitivities. One
    simulation is always run. If the budget or the time is over, the change is predicted.
    """
    if not can_halve_step(problem) or analysis.residuals_and_sensitivities is None:
        return None
    fine = halve_step(problem)
    error, columns = analysis.residuals_and_sensitivities
    with np.errstate(all="ignore"):  # what diverges with one of the steps
        residual = fine.compute_residuals(theta[None])[0]
        move = residual - error
        squares, own = float(move @ move), float(error @ error)
        is_near = squares <= error.size * (_NOTABLE_ERROR * problem.output_scale) ** 2
    left = None if max_simulations is None else max_simulations - 1
    may_search = is_late is None or not is_late()
    end, end_squares, spent = theta, own, 1
    moves: dict[str, str] = {}
    if not squares <= _NOTABLE_MOVE**2 * own / error.size:
        if not is_near and may_search and _can_fit(problem, left):
            (fit,) = refine_candidates(fine, [theta], left, is_late)
            if fit is None:
                end, end_squares = theta, inf
            else:
                end, end_squares = fit.theta, error.size * fit.rms**2
                spent += fit.evaluations
                left = None if left is None else left - fit.evaluations
        elif np.isfinite(squares):
            shift = _predict_shift(problem, theta, move, columns)
            end = theta + shift * compute_physical_scale(problem, theta)
            left_over = residual + columns @ shift
            end_squares = float(left_over @ left_over)
        else:
            end_squares = inf
        gain = error.size * np.log(max(end_squares, _TINY) / max(own, _TINY))
        share = _NOTABLE_SHARE if gain > _LIKELIHOOD_GAIN else 0.0
        moves = _describe_moves(problem, theta, analysis.estimates, end, share, is_near=is_near)
        if end_squares == inf:
            moves = {e.name: f"no finite fit for {e.name}" for e in analysis.estimates if e.stderr}
    growths: dict[str, str] = {}
    if not moves and may_search:
        growths, count = _compare_errors(fine, theta, analysis, left)
        spent += count
    small = _find_small_moves(problem, sqrt(own / error.size), analysis.estimates, end, moves)
    return HalfStep(fine, end, moves | growths, small, spent)


def find_limit(
    half: HalfStep,
    work_left: int,
    max_simulations: int | None = None,
    is_late: Callable[[], bool] | None = None,
) -> str:
    """Name the limit that forbids a fit with half the step; empty if there is none."""
    fine = half.problem
    if not can_halve_step(fine):
        limit = f"{MAX_SUBSTEPS} substeps or {_MAX_STEPS:,} steps of a simulation"
    elif is_late is not None and is_late():
        limit = "the time limit"
    elif not _can_fit(fine, max_simulations):
        limit = "the budget of evaluations"
    elif not _can_fit(fine, work_left // fine.n_steps):
        limit = "the limit on the work of finer fits"
    else:
        return ""
    return f"a finer step is beyond {limit}"


def compute_work_limit(problem: Problem, evaluations: int) -> int:
    """Compute the integration steps of all finer fits after a search of so many evaluations."""
    return max(_MIN_WORK, _WORK_SHARE * evaluations * problem.n_steps)


def choose_starts(
    half: HalfStep, champions: Sequence[Sequence[FloatArray]]
) -> tuple[list[FloatArray], FloatArray, int]:
    """Choose the best of the champions (D,) of each island with half the step.

    A champion of the longer step may owe its fit to that step, and an earlier one may not. Returned
    are the starts, their RMS and the number of simulations.
    """
    chosen = [_spread(some) for some in champions]
    with np.errstate(all="ignore"):
        values = half.problem.evaluate_fitness(np.array([one for some in chosen for one in some]))
    starts, rms, first = [], [], 0
    for some in chosen:
        part = values[first : first + len(some)]
        best = int(np.argmin(part))
        starts.append(some[best])
        rms.append(float(part[best]))
        first += len(some)
    return starts, np.array(rms), values.size


def mark_changing(
    estimates: tuple[Estimate, ...], half: HalfStep | None, limit: str
) -> tuple[Estimate, ...]:
    """Mark estimates that change with half the step, beyond a limit, as not identified.

    The standard error of one that moves little instead includes the move.
    """
    if half is None:
        return estimates
    return tuple(_mark_estimate(estimate, half, limit) for estimate in estimates)


def _mark_estimate(estimate: Estimate, half: HalfStep, limit: str) -> Estimate:
    if estimate.name not in half.changes or estimate.status not in ("identified", "at bound"):
        return estimate
    move = half.small_moves.get(estimate.name)
    if move is None or estimate.stderr is None or estimate.interval95 is None:
        reason = f"half the integration step still changes it: {half.changes[estimate.name]}"
        return replace(estimate, status="unidentifiable", reason=f"{reason}; {limit}")
    return compose_interval(estimate, IntegrationError(move))


def find_finer_step(
    asked: Problem, used: Problem, first: tuple[Estimate, ...], estimates: tuple[Estimate, ...]
) -> Iterator[Finding]:
    """Find that a result is that of a finer step than the model's; `first`: estimates with it."""
    wanted, taken = asked.model.solver.substeps, used.model.solver.substeps
    if taken == wanted:
        return
    before = {estimate.name: estimate for estimate in first}
    changes = [
        f"{_format_estimate(estimate, before[estimate.name])} instead of "
        f"{_format_estimate(before[estimate.name], estimate)}"
        for estimate in estimates
        if estimate.name in before and _differs(estimate, before[estimate.name])
    ]
    yield note(
        "integration step",
        "numerics",
        f"the integration step of the model, substeps: {wanted}, is too long for these data. The "
        f"result is that of substeps: {taken}{': ' if changes else ''}{'; '.join(changes)}",
    )


def _differs(estimate: Estimate, before: Estimate) -> bool:
    """Whether value or error of an estimate differ notably."""
    if not estimate.stderr or not before.stderr:
        return estimate.value != before.value
    move, growth = abs(estimate.value - before.value), estimate.stderr / before.stderr
    is_same = 1.0 / _NOTABLE_GROWTH <= growth <= _NOTABLE_GROWTH
    return move > _NOTABLE_MOVE * before.stderr or not is_same


def _spread(champions: Sequence[FloatArray]) -> Sequence[FloatArray]:
    """Select at most `_MAX_STARTS` of the champions, the last one included."""
    step = ceil(len(champions) / _MAX_STARTS)
    return champions[::-1][::step]


def can_halve_step(problem: Problem) -> bool:
    """Whether half the integration step is possible, and a simulation with it is not too long."""
    return (
        not is_difference(problem.model)
        and _FACTOR * problem.n_steps <= _MAX_STEPS
        and _FACTOR * problem.model.solver.substeps <= MAX_SUBSTEPS
    )


def halve_step(problem: Problem) -> Problem:
    """Make the same problem with half the integration step."""
    model = problem.given_model
    return problem.rebuild(model=replace_substeps(model, _FACTOR * model.solver.substeps))


def _can_fit(problem: Problem, simulations: int | None) -> bool:
    """Whether so many simulations suffice for a few steps of least squares."""
    needed = _MIN_FIT_STEPS * (len(problem.free_parameters) + 1)
    return simulations is None or simulations >= needed


def _predict_shift(
    problem: Problem, theta: FloatArray, move: FloatArray, columns: FloatArray
) -> FloatArray:
    """Predict the shift (D,), in unit coordinates, after a change (n,) of linear outputs.

    What lies at a bound stays there.
    """
    held = np.logical_or(*is_at_bounds(to_unit(problem.evaluator, theta[None])[0]))
    return np.asarray(-np.linalg.lstsq(columns * ~held, move, rcond=RANK_TOLERANCE)[0])


def _describe_moves(
    problem: Problem,
    theta: FloatArray,
    estimates: tuple[Estimate, ...],
    end: FloatArray,
    share: float,
    *,
    is_near: bool,
) -> dict[str, str]:
    """Describe notable moves of estimates.

    An estimate without a standard error moves notably by a hundredth of its range, in a new fit.
    """
    points = to_unit(problem.evaluator, np.array([theta, end]))
    by_name = {
        name: (float(end[d]), float(abs(points[1, d] - points[0, d])))
        for d, name in enumerate(problem.free_names)
    }
    described = {}
    for estimate in estimates:
        value, distance = by_name.get(estimate.name, (estimate.value, 0.0))
        shift, error = abs(value - estimate.value), _get_error(estimate)
        if error is None:
            is_notable = not is_near and distance > _NOTABLE_SHARE
        else:
            is_small = shift <= share * abs(estimate.value) or distance <= share * _RANGE_SHARE
            is_notable = shift > _NOTABLE_MOVE * error and not is_small
        if is_notable:
            often = f", {shift / error:.2g} of its standard errors away" if error else ""
            unit = format_unit(estimate.unit)
            described[estimate.name] = (
                f"{estimate.name} = {_format(value, shift)}{unit} instead of "
                f"{_format(estimate.value, shift)}{unit}{often}"
            )
    return described


def _find_small_moves(
    problem: Problem,
    rms: float,
    estimates: tuple[Estimate, ...],
    end: FloatArray,
    moves: Mapping[str, str],
) -> dict[str, float]:
    """Find notable moves that are small compared to their values, if the residuals (RMS) are."""
    if rms > _NOTABLE_ERROR * problem.output_scale:
        return {}
    values = dict(zip(problem.free_names, end.tolist(), strict=True))
    shifts = {e.name: abs(values[e.name] - e.value) for e in estimates if e.name in moves}
    return {
        e.name: shifts[e.name]
        for e in estimates
        if e.name in shifts and shifts[e.name] <= _SMALL_SHARE * _get_size(e)
    }


def _get_size(estimate: Estimate) -> float:
    """Get the size of a value; of one near 0, that of a hundredth of its range."""
    return max(abs(estimate.value), 0.01 * (estimate.upper - estimate.lower))


def _get_error(estimate: Estimate) -> float | None:
    """Get the standard error, or half the half-width of a wider interval; None: there is none."""
    if not estimate.stderr or estimate.interval95 is None:
        return None
    lower, upper = estimate.interval95
    return max(estimate.stderr, 0.25 * (upper - lower))


def _compare_errors(
    fine: Problem, theta: FloatArray, analysis: Analysis, max_simulations: int | None
) -> tuple[dict[str, str], int]:
    """Describe standard errors that grow notably with half the step; count the simulations.

    Both are those of white noise of one size, so only the sensitivities count.
    """
    if analysis.residuals_and_sensitivities is None:
        return {}, 0
    try:
        by_half = compute_sensitivities(fine, theta, max_simulations)
    except BudgetSpentError as spent:
        return {}, spent.evaluations
    by_coarse = _compute_variances(analysis.residuals_and_sensitivities[1])
    by_fine = _compute_variances(by_half.columns)
    with np.errstate(all="ignore"):
        growth = dict(zip(fine.free_names, np.sqrt(by_fine / by_coarse).tolist(), strict=True))
    described = {
        e.name: f"the standard error of {e.name} is {growth[e.name]:.2g} times as large"
        for e in analysis.estimates
        if e.stderr and growth.get(e.name, 1.0) > _NOTABLE_GROWTH
    }
    return described, by_half.evaluations


def _compute_variances(columns: FloatArray) -> FloatArray:
    """Compute the diagonal of (SᵀS)⁻¹, (D,); inf for parameters that these rows leave open."""
    triangle = np.asarray(np.linalg.qr(columns, mode="r"))  # of a long record in half the time
    _, singular, rows, retained = compute_truncated_svd(triangle)
    variances: FloatArray = np.sum((rows[retained].T / singular[retained]) ** 2, axis=1)
    is_open = np.max(np.abs(rows[~retained]), axis=0, initial=0.0) > RANK_TOLERANCE
    return np.where(is_open, np.inf, variances)


def _format_estimate(estimate: Estimate, other: Estimate) -> str:
    error = f" ± {estimate.stderr:.2g}" if estimate.stderr else ""
    errors = [error for error in (estimate.stderr, other.stderr) if error]
    value = _format(estimate.value, min(errors, default=0.0))
    return f"{estimate.name} = {value}{error}{format_unit(estimate.unit)}"


def _format(value: float, resolution: float) -> str:
    """Format a value with the digits that show a difference of this size."""
    digits = max(4, 2 + ceil(log10(abs(value / resolution)))) if value and resolution else 4
    return f"{value:.{digits}g}"
