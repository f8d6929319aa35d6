"""Bounds that keep a search from settling."""

from sysid.core.types import FloatArray
from sysid.identifiability.active_bounds import ActiveBound, find_holding_bounds
from sysid.identifiability.bound_limits import list_widest_bounds
from sysid.simulation.loss import compute_influence
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import to_unit
from sysid.uncertainty.analysis import Analysis


def find_cause_in_bounds(
    problem: Problem, theta: FloatArray, analysis: Analysis
) -> tuple[ActiveBound, ...]:
    """Find the bounds that are the cause if a search did not settle at an estimate (D,).

    The costliest comes first. Empty if no bound is the cause, or without sensitivities.
    """
    if analysis.residuals_and_sensitivities is None:
        return ()
    point = to_unit(problem.evaluator, theta[None])[0]
    residuals, columns = analysis.residuals_and_sensitivities
    limits = list_widest_bounds(problem, point)
    influence = compute_influence(residuals, problem.loss_scale)
    return find_holding_bounds(problem.free_parameters, limits, influence, columns, point)
