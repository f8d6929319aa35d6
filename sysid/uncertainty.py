"""How sure an estimate is: covariance, intervals, correlation, identifiability.

All from the sensitivities S = ∂ŷ/∂p at the estimate, where p are the places in [0, 1] of the free
parameters, so that columns are comparable: a unit of p is the parameter's whole range (on a log
scale: of its logarithm).

With squares the covariance is s²(SᵀS)⁻¹, s² = Σe²/(n − D). With the soft-l1 loss it is that of an
M-estimator (sandwich): n/(n − D) · (SᵀKS)⁻¹ (SᵀΨ²S) (SᵀKS)⁻¹ with ψ = e/√(1 + (e/s)²) and
K = (1 + (e/s)²)^(−3/2), so outliers neither widen nor narrow the intervals unduly.

Where the output does not change on a plateau of width w (a lag that is rounded to whole samples),
nothing tells where in it the parameter lies: w²/12 is added to its variance.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from sysid.ga.chromosome import placed
from sysid.islands.archipelago import loss_scale
from sysid.parameters import Parameter
from sysid.problem import Problem
from sysid.result import Estimate, EstimateStatus, Uncertainty
from sysid.sensitivities import sensitivities
from sysid.types import FloatArray

_RANK = 1e-7  # of the largest singular value: below, the differences are rounding
_SAYS_NOTHING = 0.5  # of the range: a standard error as large as that
# Share of a direction (squared) from which a parameter belongs to it: of one the data tell little
# about, and of one that has no effect at all, which is known to many digits.
_WEAK_MEMBER, _NULL_MEMBER = 0.05, 1e-5
_AT_BOUND = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Analysis:
    """The local analysis at an estimate.

    Attributes
    ----------
    estimates : tuple of Estimate
        All parameters, fixed ones too.
    uncertainty : Uncertainty or None
        None when there are no more samples than parameters.
    possible_gain : float
        Part of the loss that one least-squares step promises to remove; near 0 at an optimum.
    evaluations : int
    """

    estimates: tuple[Estimate, ...]
    uncertainty: Uncertainty | None
    possible_gain: float
    evaluations: int


def analyse(problem: Problem, theta: FloatArray) -> Analysis:
    """Standard errors, correlations and identifiability at an estimate (D,)."""
    error, columns, plateau, one_sided, count = sensitivities(problem, theta)
    n, d = columns.shape
    if n <= d:
        reason = f"{n} samples are not more than {d} parameters"
        return Analysis(_without(problem, theta, reason), None, 0.0, count)
    singular, directions = np.linalg.svd(columns, full_matrices=False)[1:]
    known = singular > _RANK * max(singular[0], np.finfo(float).tiny)
    inverse = (directions[known].T / singular[known] ** 2) @ directions[known]
    covariance, noise = _covariance(error, columns, inverse, loss_scale(problem))
    place = placed(problem.evaluator, theta[None])[0]
    # No step of least squares gains from a parameter on a plateau: there the loss is flat.
    sloping = np.where(plateau > 0, 0.0, columns)
    gain = _possible_gain(_influence(error, loss_scale(problem)), sloping, place)
    statuses = _statuses(place, singular, directions, known, noise)
    scale = _physical(problem, theta)
    physical = (covariance + np.diag(plateau**2 / 12.0)) * np.outer(scale, scale)
    uncertainty = Uncertainty(
        names=tuple(p.name for p in problem.space),
        covariance=physical,
        correlation=_correlation(physical),
        condition=float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf"),
        singular_values=singular,
        noise_sd=noise,
    )
    jumps = {p.name for p, one in zip(problem.space, one_sided, strict=True) if one}
    blind = np.any(directions[~known] ** 2 > _NULL_MEMBER, axis=0) if not known.all() else None
    estimates = _estimates(problem, theta, statuses, np.sqrt(np.diag(physical)), blind, n - d)
    estimates = tuple(_on_one_side(e) if e.name in jumps else e for e in estimates)
    return Analysis(estimates, uncertainty, min(gain, 1.0), count)


def _on_one_side(estimate: Estimate) -> Estimate:
    """An estimate whose slope is not known because the output jumps on one side of it only."""
    reason = "the output changes with it in jumps, and here on one side only"
    return replace(estimate, stderr=None, interval95=None, reason=reason)


def _influence(error: FloatArray, scale: float) -> FloatArray:
    """ψ(e): the residuals as the loss sees them, with soft-l1 those of outliers bounded."""
    return error if scale == 0.0 else error / np.sqrt(1.0 + (error / scale) ** 2)


def _possible_gain(influence: FloatArray, columns: FloatArray, place: FloatArray) -> float:
    """Part of Σψ² in the span of those sensitivities along which the parameters may move.

    It is zero at a local optimum. A parameter at its bound whose slope leads out of the bounds
    may not move: there the bound is what holds it, and the estimate is optimal inside it.
    """
    total = float(influence @ influence)
    downhill = -(columns.T @ influence)
    held = ((place < _AT_BOUND) & (downhill < 0)) | ((place > 1.0 - _AT_BOUND) & (downhill > 0))
    if total == 0.0 or held.all():
        return 0.0
    left, singular, _ = np.linalg.svd(columns[:, ~held], full_matrices=False)
    span = left[:, singular > _RANK * max(singular[0], np.finfo(float).tiny)]
    return float(np.sum((span.T @ influence) ** 2)) / total


def _covariance(
    error: FloatArray, columns: FloatArray, inverse: FloatArray, scale: float
) -> tuple[FloatArray, float]:
    """Covariance of the places, and the standard deviation of the noise."""
    n, d = columns.shape
    if scale == 0.0:
        variance = float(error @ error) / (n - d)
        return variance * inverse, float(np.sqrt(variance))
    influence = _influence(error, scale)
    share = 1.0 / np.sqrt(1.0 + (error / scale) ** 2)
    bread = np.linalg.pinv((columns.T * share**3) @ columns, rcond=_RANK**2, hermitian=True)
    filling = (columns.T * influence**2) @ columns
    noise = float(1.4826 * np.median(np.abs(error)))  # of the bulk, not of the outliers
    return n / (n - d) * bread @ filling @ bread, noise


def _statuses(
    place: FloatArray, singular: FloatArray, directions: FloatArray,
    known: FloatArray, noise: float,
) -> tuple[EstimateStatus, ...]:  # fmt: skip
    """What the data say of each parameter: see `EstimateStatus`."""
    statuses: list[EstimateStatus] = ["identified"] * place.size
    for d in np.flatnonzero((place < _AT_BOUND) | (place > 1.0 - _AT_BOUND)):
        statuses[d] = "at bound"
    for value, direction, seen in zip(singular, directions, known, strict=True):
        if seen and noise < _SAYS_NOTHING * value:
            continue
        members = np.flatnonzero(direction**2 > (_WEAK_MEMBER if seen else _NULL_MEMBER))
        for d in members:
            if statuses[d] != "unidentifiable":
                statuses[d] = "unidentifiable" if members.size == 1 else "group"
    return tuple(statuses)


def _physical(problem: Problem, theta: FloatArray) -> FloatArray:
    """∂θ/∂p: the range, or on a log scale θ ln(upper/lower)."""
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    ratio = np.where(problem.evaluator.log > 0, upper / np.where(lower > 0, lower, 1.0), 1.0)
    return np.asarray(np.where(problem.evaluator.log > 0, theta * np.log(ratio), upper - lower))


def _correlation(covariance: FloatArray) -> FloatArray:
    deviation = np.sqrt(np.diag(covariance))
    safe = np.where(deviation > 0, deviation, 1.0)
    correlation = covariance / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(np.clip(correlation, -1.0, 1.0))


def _estimates(
    problem: Problem, theta: FloatArray, statuses: tuple[EstimateStatus, ...],
    errors: FloatArray, blind: FloatArray | None, freedom: int,
) -> tuple[Estimate, ...]:  # fmt: skip
    quantile = float(stdtrit(freedom, 0.975))
    free = {}
    for d, parameter in enumerate(problem.space):
        value, error = float(theta[d]), float(errors[d])
        reason = _reason(statuses[d], blind is not None and bool(blind[d]))
        if blind is not None and blind[d]:
            free[parameter.name] = _estimate(parameter, value, None, None, statuses[d], reason)
            continue
        interval = (value - quantile * error, value + quantile * error)
        free[parameter.name] = _estimate(parameter, value, error, interval, statuses[d], reason)
    return _all(problem, free)


def _reason(status: EstimateStatus, blind: bool) -> str:
    """Why there is no standard error, or what to think of it."""
    if blind and status == "group":
        return "only a combination with other parameters has an effect on the output"
    if blind:
        return "the output does not change with it"
    return {
        "group": "the data say little of it apart from a combination with other parameters",
        "unidentifiable": "the data say little of it: its standard error is as large as its range",
        "at bound": "it lies at its bound; the standard error is that of the linear model",
    }.get(status, "")


def _estimate(
    parameter: Parameter, value: float, stderr: float | None,
    interval: tuple[float, float] | None, status: EstimateStatus, reason: str,
) -> Estimate:  # fmt: skip
    return Estimate(
        parameter.name, parameter.unit, value, parameter.lower, parameter.upper, stderr, interval,
        status, reason,
    )  # fmt: skip


def _all(problem: Problem, free: dict[str, Estimate]) -> tuple[Estimate, ...]:
    """The free estimates and the fixed parameters, in the problem's order."""
    return tuple(
        free.get(p.name) or _estimate(p, p.fixed or 0.0, None, None, "fixed", "its value was given")
        for p in problem.all_parameters
    )


def _without(problem: Problem, theta: FloatArray, reason: str) -> tuple[Estimate, ...]:
    free = {
        p.name: _estimate(p, float(value), None, None, "unidentifiable", reason)
        for p, value in zip(problem.space, theta, strict=True)
    }
    return _all(problem, free)
