"""Full fits: the model fitted again after a change, or to the parts of a record.

An explanation by columns moves the parameters by a linear step. Where that may be far, the model is
fitted again: to other records, from another start, or with another experiment from a moment on. So
are both sides of a change, by themselves.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sysid.core.errors import SysidError
from sysid.core.findings import Move
from sysid.core.types import FloatArray
from sysid.data.records import Record, keep_outputs
from sysid.judgement.residual_context import ResidualContext, find_held, hold_noise
from sysid.judgement.residual_model import ResidualModel
from sysid.judgement.unrecorded_input import compute_reach
from sysid.residuals.series import iterate_parts
from sysid.results.findings import list_moves, order_moves
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.start_values import convert_point
from sysid.uncertainty.analysis import compute_physical_scale
from sysid.uncertainty.sensitivities import compute_sensitivities

_REFIT_STEPS = 12  # of least squares, from the estimate
_FULL_FIT = 20  # simulations of a full fit and its slopes, for each parameter and one
_LONGER = 2.0  # times the time lags: they may be longer with another experiment
_PART_SAMPLES = 4  # of a part of a record, for each parameter
_BACK_SHARE = 0.5  # of the size of an outlier: so much of it may be left a sample later
"""Measured with `benchmarks.judgement`, a record of each of 102 kinds, all values changed at once,
and those of `residual_context.py` too. With a `_LONGER` of 1, `_PART_SAMPLES` 2 and a `_BACK_SHARE`
of 0.25, all statuses stay. With 4, 8 and 0.75, three records have other statuses. In both, each
verdict keeps its first word."""


class _FittedPart(NamedTuple):
    """A point (D,) of a part of a record, its residuals (n,) and slopes (n, D); 0 elsewhere."""

    theta: FloatArray
    residuals: FloatArray
    columns: FloatArray


class Refitted(NamedTuple):
    """A model fitted again in full: Schwarz's criterion, and the moves of its parameters."""

    criterion: float
    moves: tuple[Move, ...]


class Parted(NamedTuple):
    """A model fitted to both parts of a record: criterion, moves, changes from part to part.

    Changes are by size: in errors of the difference, the parameter, its values before and after.
    """

    criterion: float
    moves: tuple[Move, ...]
    changes: tuple[tuple[float, str, float, float], ...]


def refit(context: ResidualContext, change: Mapping[str, Any]) -> Refitted | None:
    """Fit the model again after a change of the problem; None if that fails."""
    if not context.simulations.allow(_FULL_FIT * (context.theta.size + 1)):
        return None
    problem = context.problem.rebuild(**{"weights": context.problem.output_weights, **change})
    return _fit_again(context, problem, convert_point(context.problem, problem, context.theta))


def refit_experiments(context: ResidualContext, moment: float) -> Refitted | None:
    """Fit the model again if another experiment begins at a moment (s); None if that fails.

    Its parameters are the same. Its states start as the model's do, and after a gap anywhere:
    then what reads the input of the gap is not fitted. Each such sample counts as a parameter,
    and so does an estimated start.
    """
    if (
        len(context.parts) > 1
        or not _has_two_parts(context, moment)
        or _is_outlier(context, moment)
    ):
        return None
    weights = context.problem.output_weights
    known = dict(zip(context.problem.free_names, context.theta.tolist(), strict=True))
    found = list[Refitted | None]()
    with suppress(SysidError):  # a part has no inputs, or the model no such start
        records = [part for one in context.problem.records for part in _divide(one, moment)]
        divided = context.problem.rebuild(records=records, weights=weights)
        values = [known.get(name, known.get(name.split("[")[0])) for name in divided.free_names]
        theta = np.array(values, dtype=np.float64)
        found.append(_fit_again(context, divided, theta))
        if moment in context.gap_ends:
            free = divided.rebuild(initial="free", weights=weights)
            until = moment + _LONGER * compute_reach(context.problem, context.analysis)
            start = convert_point(divided, free, theta)
            found.append(_fit_again(context, free, start, (moment, until)))
    return min(filter(None, found), key=lambda one: one.criterion, default=None)


def _fit_again(
    context: ResidualContext,
    problem: Problem,
    start: FloatArray,
    left_out: tuple[float, float] | None = None,
) -> Refitted | None:
    """Fit a problem from a point (D',); None if that fails, or if it has other samples.

    Those from a time up to another one (s) are left out, each by a column of its own.
    """
    if problem.n_scored != context.times.size:
        return None
    if not context.simulations.allow(_FULL_FIT * (start.size + 1)):
        return None
    fitted, dummies = problem, np.zeros((context.times.size, 0))
    if left_out is not None:
        first, last = left_out
        records = keep_outputs(
            problem.records, lambda one: (one.times < first) | (one.times >= last)
        )
        fitted = problem.rebuild(records=records, weights=problem.output_weights)
        dummies = np.eye(context.times.size)[:, (context.times >= first) & (context.times < last)]
    (end,) = refine_candidates(fitted, [start], _REFIT_STEPS * (start.size + 1))
    if end is None:
        return None
    context.simulations.spent += end.evaluations
    return _assess(context, problem, end.theta, dummies)


def _assess(
    context: ResidualContext, problem: Problem, theta: FloatArray, dummies: FloatArray
) -> Refitted:
    """Assess the fit of a problem at a point (D',), beside columns (n, q) of samples left out."""
    sensitivities = compute_sensitivities(problem, theta)
    context.simulations.spent += sensitivities.evaluations
    residuals, columns = -sensitivities.residuals, hold_noise(problem, sensitivities.columns)
    is_held = find_held(problem, theta, residuals, columns)
    parts, d = list(iterate_parts(problem)), theta.size
    fit = ResidualModel(residuals, np.where(is_held, 0.0, columns), parts).fit(dummies)
    errors_of_all = fit.errors[:d]
    if is_held.any():  # at a bound, the error is that of the linear model
        beyond = ResidualModel(residuals, columns, parts).fit(dummies)
        errors_of_all = np.where(is_held, beyond.errors[:d], errors_of_all)
    scale = compute_physical_scale(problem, theta)
    values = (theta + fit.coefficients[:d] * scale).tolist()
    errors = (errors_of_all * scale).tolist()
    moves = list_moves(
        context.declared_estimates,
        dict(zip(problem.free_names, values, strict=True)),
        dict(zip(problem.free_names, errors, strict=True)),
    )
    more = (d - context.theta.size) * np.log(max(context.times.size, 2))
    return Refitted(float(fit.criterion + more), moves)


def _has_two_parts(context: ResidualContext, moment: float) -> bool:
    """Whether both sides of a moment (s) have enough samples for all parameters."""
    late = int(np.count_nonzero(context.times >= moment))
    return min(late, context.times.size - late) >= _PART_SAMPLES * context.theta.size


def _is_outlier(context: ResidualContext, moment: float) -> bool:
    """Whether the residuals are back where they were after the sample at a moment (s).

    Then it is an outlier of the sensor, and the plant has no shock (additive outlier: Chen and
    Liu, J. Am. Stat. Assoc. 88 (1993) 284).
    """
    first = int(np.argmax(context.times >= moment))
    before, there, after = context.residual_model.residuals[first - 1 : first + 2].tolist()
    away = there - 0.5 * (before + after)
    return bool(abs(after - before) < _BACK_SHARE * abs(away))


def refit_parts(context: ResidualContext, moment: float) -> Parted | None:
    """Fit the model to both parts of a record by themselves; None if that fails.

    Both have parameters of their own, and the states may jump between them (Chow, Econometrica
    28 (1960) 591). Moves are those to the value that is further away.
    """
    is_late = context.times >= moment
    d, n = context.theta.size, context.times.size
    if len(context.problem.records) > 1 or not _has_two_parts(context, moment):
        return None
    if not context.simulations.allow(2 * _FULL_FIT * (d + 1)):
        return None
    before = _fit_span(context, -np.inf, moment)
    after = None if before is None else _fit_span(context, moment, np.inf)
    if before is None or after is None:
        return None
    jumps = [context.shift_start(one, int(np.argmax(is_late))) for one in context.start_slopes]
    design = np.column_stack([before.columns, after.columns, *jumps])
    fit = ResidualModel(before.residuals + after.residuals, design, context.parts).without
    used = design.shape[1] - d + 1
    values, errors = [], []
    for number, part in enumerate((before, after)):
        own = slice(number * d, (number + 1) * d)
        scale = compute_physical_scale(context.problem, part.theta)
        values.append(part.theta + fit.coefficients[own] * scale)
        errors.append(fit.errors[own] * scale)
    criterion = float(fit.criterion + used * np.log(max(n, 2)))
    return _compare_parts(context, criterion, values, errors)


def _fit_span(context: ResidualContext, begin: float, end: float) -> _FittedPart | None:
    """Fit the model from a time up to another one (s), without it; None if that fails."""
    problem = _select_span(context, begin, end)
    evaluator = problem.evaluator
    start = np.clip(context.theta, evaluator.lower, evaluator.upper)
    (found,) = refine_candidates(problem, [start], _REFIT_STEPS * (start.size + 1))
    if found is None:
        return None
    slopes = compute_sensitivities(context.problem, found.theta)
    context.simulations.spent += found.evaluations + slopes.evaluations
    is_part = (context.times >= begin) & (context.times < end)
    residuals = np.where(is_part, -slopes.residuals, 0.0)
    columns = hold_noise(context.problem, slopes.columns)
    return _FittedPart(found.theta, residuals, np.where(is_part[:, None], columns, 0.0))


def _compare_parts(
    context: ResidualContext,
    criterion: float,
    values: Sequence[FloatArray],
    errors: Sequence[FloatArray],
) -> Parted:
    """Compare the parameters (D,) of two parts of a record, and their errors."""
    known = {one.name: one for one in context.declared_estimates}
    moves, changes = [], []
    for number, name in context.parameter_numbers:
        stderr = known[name].stderr
        if not stderr:
            continue
        away = [float(value[number] - context.theta[number]) / stderr for value in values]
        far = int(np.argmax(np.abs(away)))
        value, error = float(values[far][number]), float(errors[far][number])
        moves.append(Move(name, value, error, away[far]))
        change = float(values[1][number] - values[0][number])
        size = abs(change) / max(float(np.hypot(*(e[number] for e in errors))), 1e-300)
        changes.append((size, name, float(values[0][number]), float(values[1][number])))
    return Parted(criterion, order_moves(moves), tuple(sorted(changes, reverse=True)))


def _select_span(context: ResidualContext, begin: float, end: float) -> Problem:
    """Compare no outputs but those from a time up to another one (s), without it."""
    records = keep_outputs(
        context.problem.records, lambda one: (one.times >= begin) & (one.times < end)
    )
    return context.problem.rebuild(records=records, weights=context.problem.output_weights)


def _divide(record: Record, moment: float) -> list[Record]:
    """Divide a record into two experiments at a moment (s).

    Raises
    ------
    InvalidRecord
        If a channel has no samples on one side.
    """
    spans = ((-np.inf, float(np.nextafter(moment, -np.inf))), (moment, np.inf))
    return [
        replace(
            record,
            inputs=tuple(
                replace(one.slice_time(*span), hold=one.effective_hold) for one in record.inputs
            ),
            outputs=tuple(one.slice_time(*span) for one in record.outputs),
        )
        for span in spans
    ]
