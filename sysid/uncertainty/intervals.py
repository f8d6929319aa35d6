"""From the local analysis to what is told of each parameter: free, fixed and tied ones."""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from sysid.core.types import BoolArray, FloatArray
from sysid.identifiability.combinations import IdentifiableCombination
from sysid.language.evaluation import evaluate_expression as worth
from sysid.language.tree import Expression
from sysid.models.parameters import Parameter
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import Estimate, EstimateStatus

_TIE_STEP = 1e-6  # of the range: slopes of ties
_NULL_SHARE = 1e-4  # share of a tie's slope along directions that have no effect
_MAX_NAMED_GROUPS = 4  # groups that a reason names


@dataclass(frozen=True, slots=True, eq=False)
class LocalStatistics:
    """What the analysis found.

    Attributes
    ----------
    theta : FloatArray, shape (D,)
    statuses : tuple of EstimateStatus
    covariance : FloatArray, shape (D, D)
        In the parameters' units.
    quantile : FloatArray, shape (D,)
        Of the t distribution, for 95 %.
    blind : BoolArray, shape (D,)
        Parameters without a standard error.
    groups : tuple of Group
    null : FloatArray, shape (m, D)
        Directions without effect, over the places.
    scale : FloatArray, shape (D,)
        ∂θ/∂p of the places p.
    reason : str
        Why there is no standard error of any; empty where there is.
    """

    theta: FloatArray
    statuses: tuple[EstimateStatus, ...]
    covariance: FloatArray
    t_quantile: FloatArray
    lacks_stderr: BoolArray
    groups: tuple[IdentifiableCombination, ...]
    null_directions: FloatArray
    scale: FloatArray
    reason: str = ""


def make_estimates(problem: Problem, known: LocalStatistics) -> tuple[Estimate, ...]:
    """All parameters in the problem's order."""
    free = {p.name: _make_free_estimate(p, known, d) for d, p in enumerate(problem.free_parameters)}
    return tuple(
        free.get(p.name) or _make_fixed_or_tied_estimate(problem, known, p)
        for p in problem.all_parameters
    )


def _make_free_estimate(parameter: Parameter, known: LocalStatistics, d: int) -> Estimate:
    value, status = float(known.theta[d]), known.statuses[d]
    blind = bool(known.lacks_stderr[d])
    reason = known.reason or _explain_status(parameter.name, status, blind, known.groups)
    error = None if blind else sqrt(max(float(known.covariance[d, d]), 0.0))
    return _make_estimate(parameter, value, error, float(known.t_quantile[d]), status, reason)


def _make_fixed_or_tied_estimate(
    problem: Problem, known: LocalStatistics, parameter: Parameter
) -> Estimate:
    if parameter.name not in problem.ties:
        value = parameter.fixed or 0.0
        return _make_estimate(parameter, value, None, 0.0, "fixed", "its value was given")
    tree, reason = problem.ties[parameter.name], f"tied to {parameter.tied}"
    value, slope = _linearise_tie(problem, tree, known.theta, known.scale)
    blind = known.null_directions @ (slope * known.scale)
    if np.linalg.norm(blind) > _NULL_SHARE * np.linalg.norm(slope * known.scale):
        why = known.reason or "the data do not determine what it is tied to"
        return _make_estimate(parameter, value, None, 0.0, "tied", f"{reason}; {why}")
    error = sqrt(max(float(slope @ known.covariance @ slope), 0.0))
    quantile = float(np.max(known.t_quantile[slope != 0.0], initial=0.0))
    return _make_estimate(parameter, value, error, quantile, "tied", reason)


def _linearise_tie(
    problem: Problem, tree: Expression, theta: FloatArray, scale: FloatArray
) -> tuple[float, FloatArray]:
    """Value of a tied parameter, and its slopes in the free ones by central differences."""
    given = {p.name: p.fixed for p in problem.all_parameters if p.fixed is not None}

    def at(place: FloatArray) -> float:
        return worth(tree, {**given, **dict(zip(problem.free_names, place.tolist(), strict=True))})

    steps = np.diag(_TIE_STEP * scale)
    slope = [(at(theta + one) - at(theta - one)) / (2.0 * one.sum()) for one in steps]
    return at(theta), np.array(slope)


def _explain_status(
    name: str, status: EstimateStatus, blind: bool, groups: tuple[IdentifiableCombination, ...]
) -> str:
    """Why there is no standard error, or what to think of it."""
    if status == "group":
        told = [group.expression for group in groups if name in group.members]
        others = (
            f": {', '.join(told[:_MAX_NAMED_GROUPS])}{', …' if len(told) > _MAX_NAMED_GROUPS else ''}"
            if told
            else ""
        )
        if blind:
            return f"only a combination with other parameters has an effect on the output{others}"
        return (
            f"the data say little about it apart from a combination with other parameters{others}"
        )
    if blind:
        return "the output does not change with it"
    return {
        "unidentifiable": "the data say little about it: its standard error is as large as its range",
        "at bound": "it lies at its bound; the standard error is that of the linear model",
    }.get(status, "")


def _make_estimate(
    parameter: Parameter,
    value: float,
    stderr: float | None,
    quantile: float,
    status: EstimateStatus,
    reason: str,
) -> Estimate:
    half = None if stderr is None else quantile * stderr
    interval = None if half is None else (value - half, value + half)
    return Estimate(
        parameter.name,
        parameter.unit,
        value,
        parameter.lower,
        parameter.upper,
        stderr,
        interval,
        status,
        reason,
    )
