"""Whether the step of the integration is short enough for the estimate that it has led to.

A time constant of less than about one step is estimated as what makes up for the error of the
integration, and residuals do not tell. So an estimate of a differential model is simulated once
more with half the step. Where that moves the output by as much as may move a parameter by its
standard error (a move d of the outputs moves none by more than |d|/s of those), it is fitted anew.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sysid.kernels.demand import is_difference
from sysid.problem import Problem
from sysid.refinement import refine
from sysid.result import Estimate
from sysid.types import FloatArray

_FINER = 2
_NOTABLE = 1e-3  # of the output's size: smaller errors of the integration are let pass
_SHARE = 0.01  # of a value: so is a smaller move of an estimate
_MOST_STEPS = 2_000_000
"""Steps that the finer simulation may take; of a longer one nothing is told."""


def step_notes(
    problem: Problem, theta: FloatArray, estimates: tuple[Estimate, ...], simulated: FloatArray,
    is_late: Callable[[], bool] | None = None,
) -> list[str]:  # fmt: skip
    """Estimates (D,) that would be others with half the integration step; simulated (M,)."""
    plain = problem.loss.noise_model == "white"
    if is_difference(problem.model) or not plain or _FINER * problem.n_steps > _MOST_STEPS:
        return []
    fine = _finer(problem)
    weight = problem.evaluator.weight
    with np.errstate(all="ignore"):  # what diverges with one of the steps
        move = weight * (fine.predictions(theta[None])[0] - simulated)
        error = weight * (problem.evaluator.measured - simulated)
        n, squares = max(problem.n_scored, 1), float(move @ move)
        is_near = np.sqrt(squares / n) <= _NOTABLE * problem.output_scale
    if squares <= float(error @ error) / n or is_near:
        return []
    if is_late is not None and is_late():
        return [
            "with half the integration step the output moves by more than the noise lets the "
            "estimates; the time was over, so what they would be was not looked for"
        ]
    (end,) = refine(fine, [theta], None, is_late)
    if end is None:
        return []
    names = [one.name for one in problem.space]
    found = dict(zip(names, zip(theta.tolist(), end.theta.tolist(), strict=True), strict=True))
    told = [
        f"{one.name} = {found[one.name][1]:.4g}{_unit(one)} instead of {one.value:.4g}{_unit(one)}"
        for one in estimates
        if one.name in found and one.stderr is not None
        and abs(np.subtract(*found[one.name])) > max(one.stderr, _SHARE * abs(one.value))
    ]  # fmt: skip
    if not told:
        return []
    substeps = problem.model.solver.substeps
    return [
        f"the integration step is too long for these estimates: with half of it {', '.join(told)}; "
        f"give the model solver: {{substeps: {2 * _FINER * substeps}}}"
    ]


def _finer(problem: Problem) -> Problem:
    """The problem with shorter steps of integration."""
    model, records, parameters, prediction, loss, weights, skip, since = problem.arguments
    solver = replace(model.solver, substeps=_FINER * model.solver.substeps)
    return Problem.build(
        replace(model, solver=solver), records, parameters=parameters, prediction=prediction,
        loss=loss, weights=weights, skip=skip, scored_from=since,
    )  # fmt: skip


def _unit(estimate: Estimate) -> str:
    return "" if estimate.unit == "1" else f" {estimate.unit}"
