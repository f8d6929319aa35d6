"""Estimates of free, fixed and tied parameters from the local analysis."""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from sysid.core.findings import EstimateStatus
from sysid.core.types import BoolArray, FloatArray
from sysid.identifiability.combinations import IdentifiableCombination
from sysid.language.evaluation import evaluate_expression
from sysid.language.tree import Expression
from sysid.models.parameters import Parameter
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import AT_LIMIT, Estimate
from sysid.uncertainty.intervals import LocalInterval, compose_interval

_TIE_STEP = 1e-6  # of the range: slopes of ties
_NULL_SHARE = 1e-4  # share of a tie's slope along directions that have no effect
_MAX_NAMED_GROUPS = 4  # groups that a reason names


@dataclass(frozen=True, slots=True, eq=False)
class LocalStatistics:
    """Result of the local analysis.

    Attributes
    ----------
    theta : FloatArray, shape (D,)
    statuses : tuple of EstimateStatus
    covariance : FloatArray, shape (D, D)
        In the parameters' units.
    t_quantile : FloatArray, shape (D,)
        Of the t distribution, for 95 %.
    lacks_stderr : BoolArray, shape (D,)
        Parameters without a standard error.
    groups : tuple of IdentifiableCombination
    null_directions : FloatArray, shape (m, D)
        Directions without effect, in unit coordinates p.
    scale : FloatArray, shape (D,)
        ∂θ/∂p.
    is_limited : BoolArray, shape (D,)
        Parameters at a physical limit.
    reason : str
        Why no parameter has a standard error; empty if some have one.
    """

    theta: FloatArray
    statuses: tuple[EstimateStatus, ...]
    covariance: FloatArray
    t_quantile: FloatArray
    lacks_stderr: BoolArray
    groups: tuple[IdentifiableCombination, ...]
    null_directions: FloatArray
    scale: FloatArray
    is_limited: BoolArray
    reason: str = ""


def make_estimates(problem: Problem, statistics: LocalStatistics) -> tuple[Estimate, ...]:
    """Make the estimates of all parameters in the problem's order."""
    free = {
        p.name: _make_free_estimate(p, statistics, d) for d, p in enumerate(problem.free_parameters)
    }
    return tuple(
        free.get(p.name) or _make_fixed_or_tied_estimate(problem, statistics, p)
        for p in problem.all_parameters
    )


def _make_free_estimate(parameter: Parameter, statistics: LocalStatistics, d: int) -> Estimate:
    value, status = float(statistics.theta[d]), statistics.statuses[d]
    lacks_stderr = bool(statistics.lacks_stderr[d])
    reason = statistics.reason or _explain_status(
        parameter.name,
        status,
        lacks_stderr,
        statistics.groups,
        is_limited=bool(statistics.is_limited[d]),
    )
    error = None if lacks_stderr else sqrt(max(float(statistics.covariance[d, d]), 0.0))
    quantile = float(statistics.t_quantile[d])
    return _make_estimate(parameter, value, error, quantile, status, reason)


def _make_fixed_or_tied_estimate(
    problem: Problem, statistics: LocalStatistics, parameter: Parameter
) -> Estimate:
    if parameter.name not in problem.ties:
        value = parameter.fixed or 0.0
        return _make_estimate(parameter, value, None, 0.0, "fixed", "its value was given")
    tree, reason = problem.ties[parameter.name], f"tied to {parameter.tied}"
    value, slope = _linearise_tie(problem, tree, statistics.theta, statistics.scale)
    null_part = statistics.null_directions @ (slope * statistics.scale)
    if np.linalg.norm(null_part) > _NULL_SHARE * np.linalg.norm(slope * statistics.scale):
        why = statistics.reason or "the data do not determine what it is tied to"
        return _make_estimate(parameter, value, None, 0.0, "tied", f"{reason}; {why}")
    error = sqrt(max(float(slope @ statistics.covariance @ slope), 0.0))
    quantile = float(np.max(statistics.t_quantile[slope != 0.0], initial=0.0))
    return _make_estimate(parameter, value, error, quantile, "tied", reason)


def _linearise_tie(
    problem: Problem, tree: Expression, theta: FloatArray, scale: FloatArray
) -> tuple[float, FloatArray]:
    """Compute a tied parameter and its slopes in the free ones, by central differences."""
    fixed_values = {p.name: p.fixed for p in problem.all_parameters if p.fixed is not None}

    def evaluate_at(values: FloatArray) -> float:
        return evaluate_expression(
            tree, {**fixed_values, **dict(zip(problem.free_names, values.tolist(), strict=True))}
        )

    steps = np.diag(_TIE_STEP * scale)
    slope = [
        (evaluate_at(theta + step) - evaluate_at(theta - step)) / (2.0 * step.sum())
        for step in steps
    ]
    return evaluate_at(theta), np.array(slope)


def _explain_status(
    name: str,
    status: EstimateStatus,
    lacks_stderr: bool,
    groups: tuple[IdentifiableCombination, ...],
    *,
    is_limited: bool,
) -> str:
    """Explain why there is no standard error, or its limits; or that the value is one."""
    if status == "group":
        expressions = [group.text for group in groups if name in group.members]
        more = ", …" if len(expressions) > _MAX_NAMED_GROUPS else ""
        others = f": {', '.join(expressions[:_MAX_NAMED_GROUPS])}{more}" if expressions else ""
        if lacks_stderr:
            return f"only a combination with other parameters has an effect on the output{others}"
        return (
            "these data determine it poorly, apart from a combination with other "
            f"parameters{others}"
        )
    if lacks_stderr:
        return "the output does not change with it"
    return {
        "unidentifiable": "these data determine it poorly: its standard error is as large as "
        "its range",
        "identified": AT_LIMIT if is_limited else "",
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
    bare = Estimate(
        parameter.name,
        parameter.unit,
        value,
        parameter.lower,
        parameter.upper,
        stderr,
        None,
        status,
        reason,
    )
    return bare if stderr is None else compose_interval(bare, LocalInterval(quantile))
