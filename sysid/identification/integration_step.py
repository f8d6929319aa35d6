"""Test whether the integration step is short enough for the estimate.

A time constant shorter than about one step compensates for the integration error, and the
residuals do not show it. So the estimate of a differential model is simulated again with half the
step. A change d of the outputs moves no parameter by more than |d|/s of its standard errors. If
that may be one standard error, the model is fitted again. If d is small compared to the output,
the estimates move by -(SᵀS)⁻¹Sᵀd.

A small relative move is reported too if it is large compared to the standard error. It is not
reported if the record fits far better with the original step, as data simulated with it do.
"""

from collections.abc import Callable
from dataclasses import replace
from math import ceil, log10
from typing import NamedTuple

import numpy as np

from sysid.core.types import RANK_TOLERANCE, FloatArray
from sysid.core.units import format_unit
from sysid.kernels.reads import is_difference
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import compute_physical_scale
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.sensitivities import compute_sensitivities

_SUBSTEP_FACTOR = 2
_NOTABLE_ERROR = 1e-3  # of the output's size: smaller integration errors are accepted
_NOTABLE_SHARE = 0.01  # of a value: smaller moves are accepted if the original step fits far better
_TINY = float(np.finfo(float).tiny)
_LIKELIHOOD_GAIN = 10.0  # twice the logarithm of the ratio of likelihoods
_MAX_STEPS = 2_000_000
"""Most steps of the finer simulation; a longer one is not tested."""


def warn_integration_step(
    problem: Problem,
    theta: FloatArray,
    estimates: tuple[Estimate, ...],
    simulated: FloatArray,
    is_late: Callable[[], bool] | None = None,
) -> list[str]:
    """Warn about estimates (D,) that change with half the integration step; simulated (M,)."""
    plain = problem.loss.noise_model != "ar1"
    if is_difference(problem.model) or not plain or _SUBSTEP_FACTOR * problem.n_steps > _MAX_STEPS:
        return []
    fine = _halve_step(problem)
    weight = problem.evaluator.weight
    with np.errstate(all="ignore"):  # what diverges with one of the steps
        move = weight * (fine.predict(theta[None])[0] - simulated)
        error = weight * (simulated - problem.evaluator.measured)
        n, squares = max(problem.n_scored, 1), float(move @ move)
        is_near = np.sqrt(squares / n) <= _NOTABLE_ERROR * problem.output_scale
    if squares <= float(error @ error) / n:
        return []
    if is_late is not None and is_late():
        return [
            "half the integration step changes the output enough to move an estimate by its "
            "standard error. The time limit left no time for a new fit."
        ]
    error = error[weight > 0]
    end = (
        _predict_estimate(problem, theta, estimates, move[weight > 0], error)
        if is_near
        else _refit_estimate(fine, theta, is_late)
    )
    gain = n * np.log(max(end.squares, _TINY) / max(float(error @ error), _TINY))
    shifts = _describe_shifts(
        problem, theta, estimates, end.theta, _NOTABLE_SHARE if gain > _LIKELIHOOD_GAIN else 0.0
    )
    if not shifts:
        return []
    substeps = problem.model.solver.substeps
    return [
        "the integration step is too long for these estimates: with half of it "
        f"{', '.join(shifts)}. "
        f"Give the model solver: {{substeps: {2 * _SUBSTEP_FACTOR * substeps}}}"
    ]


class _FineEstimate(NamedTuple):
    """Estimates (D,) with the finer step, and the sum of their squared residuals."""

    theta: FloatArray
    squares: float


def _refit_estimate(
    fine: Problem, theta: FloatArray, is_late: Callable[[], bool] | None
) -> _FineEstimate:
    """Fit the model by least squares with the finer step."""
    (end,) = refine_candidates(fine, [theta], None, is_late)
    return (
        _FineEstimate(theta, 0.0)
        if end is None
        else _FineEstimate(end.theta, fine.n_scored * end.rms**2)
    )


def _predict_estimate(
    problem: Problem,
    theta: FloatArray,
    estimates: tuple[Estimate, ...],
    move: FloatArray,
    error: FloatArray,
) -> _FineEstimate:
    """Predict that fit from the change (n,) of the outputs, if they are linear."""
    at_bound = {estimate.name for estimate in estimates if estimate.status == "at bound"}
    sensitivities = compute_sensitivities(problem, theta)
    sloping = (sensitivities.plateau_width == 0.0) & ~sensitivities.one_sided
    sloping &= [name not in at_bound for name in problem.free_names]
    columns = sensitivities.columns * sloping
    shift = -np.linalg.lstsq(columns, move, rcond=RANK_TOLERANCE)[0]
    left = error + move + columns @ shift
    return _FineEstimate(theta + shift * compute_physical_scale(problem, theta), float(left @ left))


def _describe_shifts(
    problem: Problem,
    theta: FloatArray,
    estimates: tuple[Estimate, ...],
    end: FloatArray,
    share: float,
) -> list[str]:
    """Describe estimates that move by more than a standard error and this share of their value."""
    shift_by_name = dict(zip(problem.free_names, (end - theta).tolist(), strict=True))
    messages = []
    for estimate in estimates:
        shift = shift_by_name.get(estimate.name, 0.0)
        if estimate.stderr and abs(shift) > max(estimate.stderr, share * abs(estimate.value)):
            digits = max(4, 2 + ceil(log10(abs(estimate.value / shift)))) if estimate.value else 4
            values = (
                f"{value:.{digits}g}{format_unit(estimate.unit)}"
                for value in (estimate.value + shift, estimate.value)
            )
            often = f"{abs(shift) / estimate.stderr:.2g} of its standard errors away"
            messages.append(f"{estimate.name} = {' instead of '.join(values)}, {often}")
    return messages


def _halve_step(problem: Problem) -> Problem:
    """Make the same problem with half the integration step."""
    model = problem.untied_model
    solver = replace(model.solver, substeps=_SUBSTEP_FACTOR * model.solver.substeps)
    return problem.rebuild(model=replace(model, solver=solver))
