"""Whether the step of the integration is short enough for the estimate that it has led to.

A time constant of less than about one step is estimated as what makes up for the error of the
integration, and residuals do not tell. So an estimate of a differential model is simulated once
more with half the step. A move d of the outputs moves no parameter by more than |d|/s of its
standard errors. Where that may be one it is fitted anew; where d is small beside the
output, the estimates move by -(SᵀS)⁻¹Sᵀd. A move of little of a value is told, too, where it is
much of the standard error; but not where the record fits far better with the step as it is, as one
that was simulated with it does.
"""

from collections.abc import Callable
from dataclasses import replace
from math import ceil, log10
from typing import NamedTuple

import numpy as np

from sysid.core.types import RANK, FloatArray
from sysid.core.units import format_unit
from sysid.kernels.reads import is_difference
from sysid.search.refine import refine
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import physical_scale
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.sensitivities import sensitivities

_FINER = 2
_NOTABLE = 1e-3  # of the output's size: smaller errors of the integration are let pass
_SHARE = 0.01  # of a value: so is a smaller move where the record fits better with the step
_TINY = float(np.finfo(float).tiny)
_FAR_BETTER = 10.0  # twice the logarithm of the ratio of likelihoods
_MOST_STEPS = 2_000_000
"""Steps that the finer simulation may take; of a longer one nothing is told."""


def step_notes(
    problem: Problem, theta: FloatArray, estimates: tuple[Estimate, ...], simulated: FloatArray,
    is_late: Callable[[], bool] | None = None,
) -> list[str]:  # fmt: skip
    """Estimates (D,) that would be others with half the integration step; simulated (M,)."""
    plain = problem.loss.noise_model != "ar1"
    if is_difference(problem.model) or not plain or _FINER * problem.n_steps > _MOST_STEPS:
        return []
    fine = _finer(problem)
    weight = problem.evaluator.weight
    with np.errstate(all="ignore"):  # what diverges with one of the steps
        move = weight * (fine.predictions(theta[None])[0] - simulated)
        error = weight * (simulated - problem.evaluator.measured)
        n, squares = max(problem.n_scored, 1), float(move @ move)
        is_near = np.sqrt(squares / n) <= _NOTABLE * problem.output_scale
    if squares <= float(error @ error) / n:
        return []
    if is_late is not None and is_late():
        return [
            "with half the integration step the output moves by enough to move an estimate by its "
            "standard error; the time was over, so what they would be was not looked for"
        ]
    error = error[weight > 0]
    end = (
        _beside(problem, theta, estimates, move[weight > 0], error)
        if is_near
        else _anew(fine, theta, is_late)
    )
    gain = n * np.log(max(end.squares, _TINY) / max(float(error @ error), _TINY))
    told = _told(problem, theta, estimates, end.theta, _SHARE if gain > _FAR_BETTER else 0.0)
    if not told:
        return []
    substeps = problem.model.solver.substeps
    return [
        f"the integration step is too long for these estimates: with half of it {', '.join(told)}; "
        f"give the model solver: {{substeps: {2 * _FINER * substeps}}}"
    ]


class _End(NamedTuple):
    """Estimates (D,) with the finer step, and the sum of their squared residuals."""

    theta: FloatArray
    squares: float


def _anew(fine: Problem, theta: FloatArray, is_late: Callable[[], bool] | None) -> _End:
    """Where least squares ends with the finer step."""
    (end,) = refine(fine, [theta], None, is_late)
    return _End(theta, 0.0) if end is None else _End(end.theta, fine.n_scored * end.rms**2)


def _beside(
    problem: Problem, theta: FloatArray, estimates: tuple[Estimate, ...], move: FloatArray,
    error: FloatArray,
) -> _End:  # fmt: skip
    """Where it would end if outputs that move by so little (n,) are linear."""
    held = {one.name for one in estimates if one.status == "at bound"}
    found = sensitivities(problem, theta)
    sloping = (found.plateau == 0.0) & ~found.one_sided
    sloping &= [name not in held for name in problem.free_names]
    columns = found.columns * sloping
    shift = -np.linalg.lstsq(columns, move, rcond=RANK)[0]
    left = error + move + columns @ shift
    return _End(theta + shift * physical_scale(problem, theta), float(left @ left))


def _told(
    problem: Problem, theta: FloatArray, estimates: tuple[Estimate, ...], end: FloatArray,
    share: float,
) -> list[str]:  # fmt: skip
    """Estimates that move by much of their standard error, and by that share of themselves."""
    by = dict(zip(problem.free_names, (end - theta).tolist(), strict=True))
    told = []
    for one in estimates:
        shift = by.get(one.name, 0.0)
        if one.stderr and abs(shift) > max(one.stderr, share * abs(one.value)):
            digits = max(4, 2 + ceil(log10(abs(one.value / shift)))) if one.value else 4
            values = (
                f"{value:.{digits}g}{format_unit(one.unit)}"
                for value in (one.value + shift, one.value)
            )
            often = f"{abs(shift) / one.stderr:.2g} of its standard errors away"
            told.append(f"{one.name} = {' instead of '.join(values)}, {often}")
    return told


def _finer(problem: Problem) -> Problem:
    """The problem with shorter steps of integration."""
    model = problem.untied_model
    solver = replace(model.solver, substeps=_FINER * model.solver.substeps)
    return problem.rebuild(model=replace(model, solver=solver))
