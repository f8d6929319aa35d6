"""Uncertainty of an estimate: covariance, intervals, correlation, identifiability.

All follow from the sensitivities S = ∂ŷ/∂p at the estimate. The free parameters are in unit
coordinates p in [0, 1], so that columns are comparable. A unit of p is the parameter's whole range
(on a log scale: of its logarithm).

With squares the covariance is s²(SᵀS)⁻¹, s² = Σe²/(n − D). With the soft-l1 loss it is that of an
M-estimator (sandwich): n/(n − D) · (SᵀKS)⁻¹ (SᵀΨ²S) (SᵀKS)⁻¹. Here ψ = e/√(1 + (e/s)²) and
K = (1 + (e/s)²)^(−3/2), so outliers neither widen nor narrow the intervals unduly.

If the residuals are clearly not one white noise, the covariance is a sandwich
(`sysid.residuals.sandwich`): of coloured residuals of a free run, of unequal variances, of outputs
that share their noise, or of whole repeats. Under a noise model, e and S are whitened first
(`sysid.noise_models.generalised_least_squares`).

A time lag that is rounded to whole samples has plateaus of width w on which the output does not
change. The position on a plateau is undetermined. So w²/12 is added to the variance, and the
interval is centred on the plateau.

Directions that no data identify follow from the form of the equations
(`sysid.identifiability.scaling_symmetries`); they are removed from S exactly. Directions that these
data do not identify follow from the singular values of S. Both give groups
(`sysid.identifiability.combinations`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sysid.core.distributions import student_limit
from sysid.core.findings import EstimateStatus
from sysid.core.linear_algebra import TruncatedSvd, compute_truncated_svd
from sysid.core.robust import estimate_deviation
from sysid.core.types import RANK_TOLERANCE, BoolArray, FloatArray
from sysid.identifiability.active_bounds import ActiveBound, is_active, rank_active_bounds
from sysid.identifiability.bound_limits import list_widest_bounds
from sysid.identifiability.combinations import (
    ParameterBlock,
    classify_directions,
    express_combinations,
    find_unidentified,
)
from sysid.identifiability.exchange import ExchangeGroups
from sysid.identifiability.scaling_symmetries import find_scalings
from sysid.identifiability.translations import find_translations
from sysid.residuals.sandwich import Sandwich, estimate_sandwich
from sysid.residuals.series import iterate_parts
from sysid.residuals.whitening import Whitening
from sysid.simulation.loss import compute_influence, compute_loss_weight
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import is_at_bounds, is_at_limits, to_unit
from sysid.uncertainty.estimates import Criteria, Estimate, NoiseColour, Uncertainty
from sysid.uncertainty.intervals import CompatibleMinima, Plateau, compose_intervals
from sysid.uncertainty.likelihood import LikelihoodModel
from sysid.uncertainty.linear_model import LinearOutputModel, linearise_outputs
from sysid.uncertainty.local_algebra import (
    compute_correlation,
    compute_descent,
    compute_explained_share,
    invert_squared,
    scale_matrix,
)
from sysid.uncertainty.local_estimates import LocalStatistics, make_estimates
from sysid.uncertainty.sensitivities import BudgetSpentError, Sensitivities, compute_sensitivities


@dataclass(frozen=True, slots=True, eq=False)
class Analysis:
    """The local analysis at an estimate.

    Attributes
    ----------
    estimates : tuple of Estimate
        All parameters, fixed and tied ones too.
    uncertainty : Uncertainty or None
        None if there are no more samples than parameters.
    possible_gain : float
        Share of the loss that one least-squares step would remove; near 0 at an optimum.
    evaluations : int
    criteria : Criteria
    """

    estimates: tuple[Estimate, ...]
    uncertainty: Uncertainty | None
    possible_gain: float
    evaluations: int
    criteria: Criteria
    active_bounds: tuple[ActiveBound, ...] = ()
    """Bounds to widen together, the costliest first."""
    limits: frozenset[str] = frozenset()
    """Parameters at a bound that is a physical limit."""
    linear_model: LinearOutputModel | None = None
    """None if there is no uncertainty, or if the loss is not that of squares."""
    exchanges: ExchangeGroups = ()
    """Parameters that can exchange their values."""
    is_cut_short: bool = False
    """Whether the time limit prevented the search for minima near the estimate."""
    residuals_and_sensitivities: tuple[FloatArray, FloatArray] | None = None
    """Residuals (n,) and sensitivities (n, D), not whitened."""
    is_whitened: bool = False
    """Whether all else is of whitened residuals and sensitivities, under a noise model."""
    decomposition: TruncatedSvd | None = None
    """Of the sensitivities, whitened or not. None: no uncertainty."""
    likelihood: LikelihoodModel | None = None
    """None if there is no uncertainty."""
    minima: Mapping[str, CompatibleMinima] = field(default_factory=dict)
    """Minima near the estimate that widen the intervals, by parameter."""


def analyse_estimate(
    problem: Problem,
    theta: FloatArray,
    max_simulations: int | None = None,
    whitening: Whitening | None = None,
) -> Analysis:
    """Compute standard errors, correlations and identifiability at an estimate (D,).

    At most `max_simulations` simulations are used. If they do not suffice, there are no standard
    errors. With a whitening, residuals and sensitivities are whitened first.
    """
    try:
        sensitivities = compute_sensitivities(problem, theta, max_simulations)
    except BudgetSpentError as spent:
        return _analyse_without_sensitivities(problem, theta, spent, whitening)
    plain = sensitivities.residuals, sensitivities.columns
    if whitening is not None:
        columns = np.ascontiguousarray(whitening.whiten(sensitivities.columns.T).T)
        sensitivities = sensitivities._replace(
            residuals=whitening.whiten(sensitivities.residuals), columns=columns
        )
    analysis = _analyse_sensitivities(problem, theta, sensitivities, max_simulations, whitening)
    return replace(analysis, residuals_and_sensitivities=plain, is_whitened=whitening is not None)


def _analyse_without_sensitivities(
    problem: Problem, theta: FloatArray, spent: BudgetSpentError, whitening: Whitening | None
) -> Analysis:
    """Analyse an estimate without sensitivities.

    If no simulation is left, one is run in addition: a result shows it, and no budget counts it.
    """
    error = spent.residuals
    if error is None:
        error = problem.compute_residuals(theta[None])[0]
    criteria = compute_criteria(
        problem, error if whitening is None else whitening.whiten(error), whitening
    )
    reason = "the budget of simulations left too few for standard errors"
    return Analysis(
        _make_estimates_without_stderr(problem, theta, reason),
        None,
        0.0,
        spent.evaluations,
        criteria,
    )


def _analyse_sensitivities(
    problem: Problem,
    theta: FloatArray,
    sensitivities: Sensitivities,
    max_simulations: int | None,
    whitening: Whitening | None = None,
) -> Analysis:
    error, columns, plateau, one_sided, plateau_offset, count = sensitivities
    n, d = columns.shape
    criteria = compute_criteria(problem, error, whitening)
    if n <= d:
        reason = f"{n} samples are not more than {d} parameters"
        return Analysis(
            _make_estimates_without_stderr(problem, theta, reason), None, 0.0, count, criteria
        )
    point = to_unit(problem.evaluator, theta[None])[0]
    decomposition = compute_truncated_svd(columns)
    # No step of least squares gains from a parameter on a plateau: there the loss is flat.
    has_plateau = bool((plateau > 0).any())
    sloping = np.where(plateau > 0, 0.0, columns) if has_plateau else columns
    influence = compute_influence(error, problem.loss_scale)
    gain = _compute_possible_gain(influence, sloping, point, None if has_plateau else decomposition)
    is_pulled = is_active(influence, sloping, point)
    scale = compute_physical_scale(problem, theta)
    powers = problem.share("scalings", lambda: find_scalings(problem.model, problem.all_parameters))
    left = None if max_simulations is None else max_simulations - count
    shifts, spent = find_translations(problem, theta, decomposition, scale, left)
    count += spent
    still = np.concatenate([powers * theta, shifts])  # (k, D) without effect on the output
    moving, n_symmetries = remove_symmetries(columns, still / scale)
    _, singular, rows, retained = (
        decomposition if moving is columns else compute_truncated_svd(moving)
    )
    columns, retained = moving, retained.copy()
    retained[d - n_symmetries :] = False
    inverse = invert_squared(singular, rows, retained)
    colour = estimate_sandwich(problem, influence, columns)
    covariance, noise, middle = _estimate_covariance(
        error, columns, inverse, problem.loss_scale, colour
    )
    # A scaling does not move a factor that is 0. It moves the others, without any effect.
    moved = np.any(still != 0.0, axis=0)
    directions = classify_directions(singular, rows, ~retained, moved, covariance, noise)
    on_plateaus = covariance + np.diag(plateau**2 / 12.0) if has_plateau else covariance
    physical = scale_matrix(on_plateaus, scale)
    blocks = find_unidentified(directions)
    names = problem.free_names
    degrees = _compute_degrees_of_freedom(n, inverse, colour, whitening)
    uncertainty = Uncertainty(
        names=names,
        covariance=physical,
        correlation=compute_correlation(physical),
        sensitivity_correlation=compute_correlation(scale_matrix(inverse, scale)),
        condition=float(singular[0] / singular[-1]) if retained.all() else float("inf"),
        singular_values=singular,
        noise_sd=noise,
        noise_colour=_classify_noise_colour(colour, whitening),
        groups=tuple(
            g
            for block in blocks
            for g in express_combinations(block, names, theta, scale, physical)
        ),
        degrees=float(np.min(degrees)),
    )
    combined = {name for group in uncertainty.groups for name in group.members}
    is_limited = is_at_limits(problem.free_parameters, point)
    statuses = _classify_parameters(
        point, blocks, is_pulled, np.array([name in combined for name in names]), is_limited
    )
    quantiles = np.array([student_limit(each, 0.025) for each in degrees.tolist()])
    statistics = LocalStatistics(
        theta,
        statuses,
        physical,
        quantiles,
        directions.is_null_member,
        uncertainty.groups,
        rows[~retained],
        scale,
        is_limited,
    )
    estimates = _correct_for_jumps(
        problem, make_estimates(problem, statistics), one_sided, plateau_offset * scale
    )
    linear = None
    if problem.loss_scale == 0.0:
        stated = np.diag(covariance)
        root = singular[:, None] * rows
        linear = linearise_outputs(error, columns, plateau > 0, point, stated, scale, inverse, root)
    active_bounds = (
        _find_active_bounds(problem, influence, sloping, point) if is_pulled.any() else ()
    )
    return Analysis(
        estimates,
        uncertainty,
        min(gain, 1.0),
        count,
        criteria,
        active_bounds,
        frozenset(name for name, is_it in zip(names, is_limited, strict=True) if is_it),
        linear,
        decomposition=decomposition,
        likelihood=LikelihoodModel(
            error, columns, middle, uncertainty.degrees, quantiles, whitening
        ),
    )


def _find_active_bounds(
    problem: Problem, influence: FloatArray, columns: FloatArray, point: FloatArray
) -> tuple[ActiveBound, ...]:
    limits = list_widest_bounds(problem, point)
    return rank_active_bounds(problem.free_parameters, limits, influence, columns, point)


def compute_criteria(
    problem: Problem, error: FloatArray, whitening: Whitening | None = None
) -> Criteria:
    """Compute information criteria from the weighted residuals (n,); formulas in `Criteria`.

    With whitened or reweighted residuals the likelihood is still that of the outputs. So criteria
    with and without a noise model can be compared. Correlation times and variances count as
    parameters.
    """
    n, parameters = error.size, len(problem.free_parameters)
    counted = parameters + 1
    if whitening is not None:
        counted += whitening.n_correlation_times
    if problem.settings.deviations is not None and problem.settings.weights is None:
        counted += len(list(iterate_parts(problem))) - 1
    mean = float(error @ error) / n
    twice = -n * (np.log(2.0 * np.pi * mean) + 1.0) if mean > 0 else np.inf  # 2 ln ℓ
    twice -= 0.0 if whitening is None else whitening.log_determinant
    if problem.settings.deviations is not None:
        rows = problem.scored_rows
        ratio = problem.evaluator.weight[rows] / problem.plain_weight[rows]
        twice += 2.0 * float(np.sum(np.log(ratio)))
    aic = 2.0 * counted - twice
    left = n - counted - 1
    aicc = aic + 2.0 * counted * (counted + 1) / left if left > 0 else None
    bic = counted * float(np.log(n)) - twice
    return Criteria(float(aic), None if aicc is None else float(aicc), float(bic), n, parameters)


def remove_symmetries(columns: FloatArray, directions: FloatArray) -> tuple[FloatArray, int]:
    """Remove the directions (k, D) without effect from the sensitivities; count them.

    By differences, the output would change slightly along them, and more where friction breaks
    away.
    """
    if not directions.size:
        return columns, 0
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    size, rows = np.linalg.svd(
        directions / np.where(lengths > 0, lengths, 1.0), full_matrices=False
    )[1:]
    rows = rows[size > RANK_TOLERANCE]
    return columns - (columns @ rows.T) @ rows, rows.shape[0]


def _correct_for_jumps(
    problem: Problem,
    estimates: tuple[Estimate, ...],
    one_sided: BoolArray,
    plateau_offset: FloatArray,
) -> tuple[Estimate, ...]:
    """Correct the estimates of parameters with which the output changes in jumps only."""
    names = problem.free_names
    blind = {name for name, jumps in zip(names, one_sided, strict=True) if jumps}
    plateaus = {
        name: Plateau(float(offset))
        for name, offset in zip(names, plateau_offset, strict=True)
        if offset
    }
    corrected = [
        _remove_stderr(estimate) if estimate.name in blind else estimate for estimate in estimates
    ]
    return compose_intervals(corrected, plateaus)


def _remove_stderr(estimate: Estimate) -> Estimate:
    """Remove the standard error if the output jumps on one side of the estimate only."""
    reason = "the output changes with it in jumps, and here on one side only"
    return replace(estimate, stderr=None, interval95=None, reason=reason)


def _compute_possible_gain(
    influence: FloatArray,
    columns: FloatArray,
    point: FloatArray,
    decomposition: TruncatedSvd | None = None,
) -> float:
    """Share of Σψ² in the span of the sensitivities along which the parameters may move.

    It is zero at a local optimum. A parameter at its bound whose slope leads out of the bounds may
    not move. Then the bound holds it, and the estimate is optimal inside its bounds. A known
    `decomposition` of the sensitivities is used where all parameters may move.
    """
    at_lower, at_upper = is_at_bounds(point)
    if not influence.any():
        return 0.0
    if np.any(at_lower | at_upper):
        downhill = compute_descent(columns, influence)
        is_held = (at_lower & (downhill < 0)) | (at_upper & (downhill > 0))
        if is_held.all():
            return 0.0
        if is_held.any():
            decomposition = compute_truncated_svd(columns[:, ~is_held])
    decomposition = decomposition or compute_truncated_svd(columns)
    return compute_explained_share(decomposition.left, decomposition.retained, influence)


def _estimate_covariance(
    error: FloatArray,
    columns: FloatArray,
    inverse: FloatArray,
    scale: float,
    colour: Sandwich | None,
) -> tuple[FloatArray, float, FloatArray | None]:
    """Estimate the covariance in unit coordinates, and the standard deviation of the noise.

    Also returned is the middle of a sandwich; None for white residuals of squares.
    """
    n, d = columns.shape
    widening = n / (n - d) if colour is None else colour.equivalent_samples / colour.degrees
    if scale == 0.0:
        variance = float(error @ error) / (n - d)
        if colour is not None:
            covariance = widening * inverse @ colour.middle @ inverse
            return covariance, float(np.sqrt(variance)), widening * colour.middle
        return variance * inverse, float(np.sqrt(variance)), None
    influence, share = compute_influence(error, scale), compute_loss_weight(error, scale)
    bread = np.linalg.pinv(
        (columns.T * share**3) @ columns, rcond=RANK_TOLERANCE**2, hermitian=True
    )
    filling = (columns.T * influence**2) @ columns if colour is None else colour.middle
    return widening * bread @ filling @ bread, estimate_deviation(error), widening * filling


def _compute_degrees_of_freedom(
    n: int, inverse: FloatArray, colour: Sandwich | None, whitening: Whitening | None
) -> FloatArray:
    """Compute the degrees of freedom (D,) of the intervals; `inverse` (D, D) is (SᵀS)⁻¹.

    Whitened samples have at most the degrees of freedom of a mean, because the correlation time is
    estimated from no more.
    """
    d = len(inverse)
    degrees = np.full(d, float(n - d))
    if colour is not None:
        degrees = np.array([colour.compute_degrees(row) for row in inverse])
    return (
        degrees
        if whitening is None
        else np.minimum(degrees, max(whitening.equivalent_samples - d, 1.0))
    )


def _classify_noise_colour(colour: Sandwich | None, whitening: Whitening | None) -> NoiseColour:
    if colour is None or colour.is_white:
        return "white" if whitening is None else "first-order"
    if colour.is_clustered:
        return "clustered"
    return "drifting" if colour.is_drifting else "coloured"


def _classify_parameters(
    point: FloatArray,
    blocks: tuple[ParameterBlock, ...],
    is_pulled: BoolArray,
    is_combined: BoolArray,
    is_limited: BoolArray,
) -> tuple[EstimateStatus, ...]:
    """Classify each parameter: see `EstimateStatus`.

    `is_combined` (D,) marks parameters in a combination. An unidentified parameter in none is
    unidentifiable by itself. If the data pull a parameter beyond its bound, they contain
    information about it, even if the bound leaves large residuals and standard errors.

    A physical limit (`is_limited`) is as good a value as those inside: no better one lies beyond.
    If the data pull a parameter over it, that value is theirs no more than at any other bound.
    """
    statuses: list[EstimateStatus] = ["identified"] * point.size
    for d in np.flatnonzero(np.logical_or(*is_at_bounds(point))):
        statuses[d] = "identified" if is_limited[d] and not is_pulled[d] else "at bound"
    for block in blocks:
        for d in block.members:
            if not is_pulled[d]:
                statuses[d] = "group" if is_combined[d] else "unidentifiable"
    return tuple(statuses)


def compute_physical_scale(problem: Problem, theta: FloatArray) -> FloatArray:
    """Compute ∂θ/∂p: the range, or on a log scale θ ln(upper/lower)."""
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    ratio = np.where(problem.evaluator.is_log > 0, upper / np.where(lower > 0, lower, 1.0), 1.0)
    return np.asarray(np.where(problem.evaluator.is_log > 0, theta * np.log(ratio), upper - lower))


def _make_estimates_without_stderr(
    problem: Problem, theta: FloatArray, reason: str
) -> tuple[Estimate, ...]:
    """Make estimates that have values only."""
    d = theta.size
    statuses: list[EstimateStatus] = ["unidentifiable"] * d
    lacks_stderr = np.ones(d, dtype=np.bool_)
    statistics = LocalStatistics(
        theta,
        tuple(statuses),
        np.zeros((d, d)),
        np.zeros(d),
        lacks_stderr,
        (),
        np.eye(d),
        np.ones(d),
        np.zeros(d, dtype=np.bool_),
        reason,
    )
    return make_estimates(problem, statistics)
