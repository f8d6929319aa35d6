"""Trend of an estimate over a label, such as a delay over the length of a tube.

A law (`sysid.trends.laws`) is fitted to points (x, estimate ± standard error). It has a confidence
band and predictions at new x. Outliers, and estimates that have drifted from a reference, are
flagged. An outlier leaves the law, so that it moves neither the law nor the size of its errors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, inf, isfinite, nan, sqrt
from statistics import NormalDist
from typing import Literal, NamedTuple

import numpy as np

from sysid.core.distributions import chi_square_tail, student_limit, student_tail
from sysid.core.types import BoolArray, FloatArray
from sysid.trends.laws import TrendLaw, compute_rounding_floor, fit_line, fit_power

MIN_DISTINCT_X = 3
"""Fewest different values of x for a law with standard errors."""

OutlierRule = Literal["exclude", "include"]
"""Whether the laws leave outliers out."""

_MAX_EXCLUDED_SHARE = 0.2  # of the points; what more of them say is no exception
_OUTLIER_PROBABILITY = 0.05  # share of batches without an outlier that get a false alarm
_DRIFT_PROBABILITY = 2.0 * (1.0 - NormalDist().cdf(3.0))  # outside three standard deviations
_SCATTER_PROBABILITY = 0.05  # share of batches with right errors that fail the χ² test
_TWO_SIDED_95 = NormalDist().inv_cdf(0.975)
_BAND_POINTS = 101
_MAX_LEVERAGE = 1.0 - 1e-9


class TrendEstimate(NamedTuple):
    """A value and its standard error."""

    value: float
    stderr: float


class TrendPoint(NamedTuple):
    """Value of a law at one x, with 95 % interval; `is_outside` the measured range of x."""

    x: float
    value: float
    stderr: float
    lower: float
    upper: float
    is_outside: bool


class Influence(NamedTuple):
    """Fit of one point to the law of the other points.

    `studentised` is the deleted residual over its standard deviation from the other points. It
    follows Student's t with ν - 1 degrees of freedom [1]_. It is None if too few other points are
    left. `p_value` is multiplied by the number of points (Bonferroni). Neither the scatter of the
    other points nor the stated errors explain an outlier.

    .. [1] R. D. Cook, S. Weisberg, Residuals and Influence in Regression, Chapman and Hall 1982,
       §2.2.
    """

    residual: float
    studentised: float | None
    p_value: float | None
    is_outlier: bool


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """Fitted laws of the points, and results of the best law.

    Attributes
    ----------
    laws : tuple of TrendLaw
        Laws that could be fitted; if empty, `reason` says why.
    best_law : TrendLaw or None
        Law with the smaller AIC.
    influences : tuple of Influence
        Influence of each point. That of an excluded point is the one that excluded it.
    excluded : tuple of int
        Indices of the points that the laws leave out.
    band : tuple of TrendPoint
        Confidence band of the law over the measured range.
    predictions : tuple of TrendPoint
        With intervals for a new estimate: uncertainty of the law and scatter about it.
    """

    laws: tuple[TrendLaw, ...] = ()
    best_law: TrendLaw | None = None
    influences: tuple[Influence, ...] = ()
    excluded: tuple[int, ...] = ()
    band: tuple[TrendPoint, ...] = ()
    predictions: tuple[TrendPoint, ...] = ()
    reason: str = ""


class _Fit(NamedTuple):
    """Laws of the used points, the best first, and the influence of every point."""

    laws: tuple[TrendLaw, ...]
    influences: tuple[Influence, ...]
    used: BoolArray


def fit_trend(
    x: Sequence[float],
    y: Sequence[float],
    stderr: Sequence[float],
    predict: Sequence[float] = (),
    outliers: OutlierRule = "exclude",
) -> Trend:
    """Fit the laws to points and choose the better one, with its band and predictions.

    An outlier is left out, and the laws are fitted again, until no other is flagged. At most a
    fifth of the points leave.

    Parameters
    ----------
    x, y : sequence of float, shape (n,)
        Labels and estimates.
    stderr : sequence of float, shape (n,)
        Standard errors of the estimates, positive.
    predict : sequence of float
        Labels for which an interval is wanted.
    outliers : {"exclude", "include"}
        Whether the laws leave outliers out.

    Examples
    --------
    >>> y = [1.0, 2.01, 2.99, 7.0, 5.0, 6.02]
    >>> fit_trend([1, 2, 3, 4, 5, 6], y, [0.01] * 6).excluded
    (3,)
    """
    labels, values, errors = (np.asarray(array, dtype=np.float64) for array in (x, y, stderr))
    distinct = np.unique(labels).size
    if distinct < MIN_DISTINCT_X:
        found = f"{distinct or 'no'} {'value' if distinct == 1 else 'values'} of x"
        return Trend(
            reason=f"there {'is' if distinct == 1 else 'are'} {found} with a standard error. "
            f"A law needs {MIN_DISTINCT_X} or more"
        )
    with np.errstate(all="ignore"):  # an overflow of doubles gives no law
        fit = _fit_laws(labels, values, errors, outliers)
        if not fit.laws:
            return Trend(
                reason=f"the {distinct} values of x, {np.min(labels):g} to {np.max(labels):g}, "
                "or the estimates there, are too far apart in size for doubles. No law is "
                "determined. Give x in a unit that makes them similar in size."
            )
        chosen = _choose_law(fit.laws)
        return Trend(
            laws=fit.laws,
            best_law=chosen,
            influences=fit.influences,
            excluded=tuple(np.flatnonzero(~fit.used).tolist()),
            band=_compute_band(chosen, labels[fit.used]),
            predictions=predict_estimates(
                chosen, labels[fit.used], errors[fit.used], np.asarray(predict, dtype=np.float64)
            ),
        )


def _fit_laws(x: FloatArray, y: FloatArray, stderr: FloatArray, outliers: OutlierRule) -> _Fit:
    """Fit the laws; leave the worst outlier out and fit again, until no other is flagged."""
    fit = _fit_used(x, y, stderr, np.ones(x.size, dtype=bool), ())
    while outliers == "exclude" and (used := _drop_outlier(x, fit)) is not None:
        rest = _fit_used(x, y, stderr, used, fit.influences)
        if not rest.laws:
            break
        fit = rest
    return fit


def _fit_used(
    x: FloatArray,
    y: FloatArray,
    stderr: FloatArray,
    used: BoolArray,
    before: Sequence[Influence],
) -> _Fit:
    """Fit the laws to the used points; the influences of others are those of `before`."""
    points = x[used], y[used], stderr[used]
    laws = tuple(law for law in (fit_line(*points), fit_power(*points)) if law is not None)
    if not laws:
        return _Fit((), (), used)
    influences = iter(_compute_influences(_choose_law(laws), *points))
    return _Fit(
        laws,
        tuple(next(influences) if is_used else before[i] for i, is_used in enumerate(used)),
        used,
    )


def _choose_law(laws: Sequence[TrendLaw]) -> TrendLaw:
    return min(laws, key=lambda law: law.aic)  # if equal the line, which comes first


def _drop_outlier(x: FloatArray, fit: _Fit) -> BoolArray | None:
    """Drop the worst outlier among the used points; None if none may leave."""
    flagged = [
        (abs(influence.studentised or 0.0), i)
        for i, influence in enumerate(fit.influences)
        if fit.used[i] and influence.is_outlier
    ]
    if not flagged or np.sum(~fit.used) + 1 > _MAX_EXCLUDED_SHARE * x.size:
        return None
    used = fit.used.copy()
    used[max(flagged)[1]] = False
    return used if np.unique(x[used]).size >= MIN_DISTINCT_X else None


def compute_half_width(law: TrendLaw) -> float:
    """Compute half of a 95 % interval, in standard errors.

    It is that of the normal distribution if the stated errors hold. It is that of Student's t if
    the size of the errors comes from the scatter of few points.
    """
    return _TWO_SIDED_95 if law.birge_ratio <= 1.0 else student_limit(law.degrees, 0.025)


def _compute_band(law: TrendLaw, x: FloatArray) -> tuple[TrendPoint, ...]:
    grid = np.linspace(float(np.min(x)), float(np.max(x)), _BAND_POINTS)
    errors = law.error_factor * law.evaluate_stderr(grid)
    half_widths = compute_half_width(law) * errors
    rows = zip(grid, law.evaluate_law(grid), errors, half_widths, strict=True)
    return tuple(
        TrendPoint(float(p), float(v), float(e), float(v - r), float(v + r), False)
        for p, v, e, r in rows
    )


def predict_estimates(
    law: TrendLaw, x: FloatArray, stderr: FloatArray, at: FloatArray
) -> tuple[TrendPoint, ...]:
    """Predict new estimates with their 95 % intervals.

    Their own stated error is interpolated geometrically between those of the points. Outside the
    measured range the nearest one is used. All errors are widened by the Birge ratio. A power law
    is not defined for x ≤ 0: there the interval is infinite.

    Parameters
    ----------
    x, stderr : FloatArray, shape (n,)
        The points of the law and their stated standard errors.
    at : FloatArray, shape (m,)
        Labels of the new estimates.
    """
    half_width, low, high = compute_half_width(law), float(np.min(x)), float(np.max(x))
    defined = np.ones(at.shape, dtype=bool) if law.kind == "line" else at > 0
    inside = np.where(defined, at, law.centre)
    values = law.evaluate_law(inside)
    errors = law.error_factor * np.hypot(
        law.evaluate_stderr(inside), _interpolate_stderr(x, stderr, inside)
    )
    return tuple(
        TrendPoint(p, v, e, v - half_width * e, v + half_width * e, not low <= p <= high)
        if is_defined
        else TrendPoint(p, nan, inf, -inf, inf, True)
        for p, v, e, is_defined in zip(
            at.tolist(), values.tolist(), errors.tolist(), defined.tolist(), strict=True
        )
    )


def _interpolate_stderr(x: FloatArray, stderr: FloatArray, at: FloatArray) -> FloatArray:
    """Interpolate the stated errors to new labels."""
    labels, which = np.unique(x, return_inverse=True)
    logs = np.bincount(which, np.log(stderr)) / np.bincount(which)
    return np.asarray(np.exp(np.interp(at, labels, logs)))


def _compute_influences(
    law: TrendLaw, x: FloatArray, y: FloatArray, stderr: FloatArray
) -> tuple[Influence, ...]:
    residuals = (y - law.evaluate_law(x)) / stderr
    leverages = (law.evaluate_stderr(x) / stderr) ** 2
    floor = compute_rounding_floor(y, stderr)
    return tuple(
        _compute_influence(law, float(e), min(float(h), 1.0), x.size, floor)
        for e, h in zip(residuals, leverages, strict=True)
    )


def _compute_influence(
    law: TrendLaw, residual: float, leverage: float, n: int, floor: float
) -> Influence:
    """Compute the deleted residual from the whole fit: t = e/(s₍ᵢ₎ √(1 - h))."""
    degrees = law.degrees - 1
    if degrees < 1 or not leverage <= _MAX_LEVERAGE:
        return Influence(residual, None, None, False)
    square = residual**2 / (1.0 - leverage)
    variance_of_others = max(law.chi_squared - square, 0.0) / degrees
    if variance_of_others <= floor:  # the other points lie exactly on the law
        t = float(np.copysign(inf, residual)) if square > 2.0 * floor else 0.0
    else:
        t = residual / sqrt(variance_of_others * (1.0 - leverage))
    p_value = min(1.0, n * 2.0 * student_tail(degrees, abs(t)))
    is_explained = sqrt(square) <= -NormalDist().inv_cdf(_OUTLIER_PROBABILITY / (2.0 * n))
    return Influence(residual, t, p_value, p_value < _OUTLIER_PROBABILITY and not is_explained)


def pool_estimates(
    groups: Sequence[Sequence[TrendEstimate]],
) -> tuple[tuple[TrendEstimate, ...], float]:
    """Pool the runs of each label to one estimate, and compute their scatter.

    Each group gives its weighted mean. The scatter beyond the stated errors is computed from all
    groups together, since each has few runs. If their common Birge ratio is above 1, it multiplies
    every error, also those of single runs.

    Returns
    -------
    tuple of TrendEstimate, float
        The means, and the ratio; 1 if no group has two runs.
    """
    with np.errstate(over="ignore"):  # a ratio beyond doubles is infinite
        return _pool_groups(groups)


def _pool_groups(
    groups: Sequence[Sequence[TrendEstimate]],
) -> tuple[tuple[TrendEstimate, ...], float]:
    means, square, degrees = [], 0.0, 0
    for group in groups:
        errors = np.array([estimate.stderr for estimate in group])
        values = np.array([estimate.value for estimate in group])
        least = float(np.min(errors))
        weights = (least / errors) ** 2  # at most 1: no overflow where errors are tiny
        mean = float(weights @ values / np.sum(weights))
        means.append(TrendEstimate(mean, least * float(np.sum(weights)) ** -0.5))
        square += float(np.sum(((values - mean) / errors) ** 2))
        degrees += len(group) - 1
    ratio = sqrt(square / degrees) if degrees else 1.0
    return tuple(TrendEstimate(v, max(1.0, ratio) * s) for v, s in means), ratio


class Drift(NamedTuple):
    """Distance of an estimate from a reference, in standard errors of the difference.

    The estimate has drifted if |z| is above `limit`.
    """

    difference: float
    z: float
    has_drifted: bool
    limit: float


def compute_drift_limit(law: TrendLaw | None = None, comparisons: int = 1) -> float:
    """Compute the number of standard errors from which an estimate has drifted.

    The limit is three. Many comparisons widen it, so that an unchanged batch is flagged as seldom
    as one comparison (Bonferroni). If the stated errors do not explain the scatter about a law
    (χ², 5 %), the size of the errors comes from few points. The limit is then widened like
    Student's 95 % interval. Student's own tail that far out comes from batches with little
    scatter by chance, and these keep their stated errors.
    """
    limit = -NormalDist().inv_cdf(_DRIFT_PROBABILITY / (2.0 * comparisons))
    if law is None or chi_square_tail(law.degrees, law.chi_squared) >= _SCATTER_PROBABILITY:
        return limit
    return limit * student_limit(law.degrees, 0.025) / _TWO_SIDED_95


def compute_drift(new: TrendEstimate, old: TrendEstimate, comparisons: int = 1) -> Drift:
    """Compare an estimate with that of a reference run."""
    difference, error = new.value - old.value, hypot(new.stderr, old.stderr)
    limit = compute_drift_limit(None, comparisons)
    z = _standardise_difference(difference, error)
    return Drift(difference, z, abs(z) > limit, limit)


def compute_law_drifts(
    new: Sequence[TrendEstimate],
    law: TrendLaw,
    x: FloatArray,
    stderr: FloatArray,
    at: FloatArray,
    comparisons: int = 1,
) -> tuple[Drift, ...]:
    """Compare estimates with the predictions of a reference batch's trend.

    Parameters
    ----------
    new : sequence of TrendEstimate, length m
        Estimates to compare.
    x, stderr : FloatArray, shape (n,)
        The points of the reference batch and their stated standard errors.
    at : FloatArray, shape (m,)
        Labels of the estimates. Where the law is not defined, the result is nan.
    """
    with np.errstate(all="ignore"):
        predictions = predict_estimates(law, x, stderr, at)
        law_errors = (law.error_factor * law.evaluate_stderr(at)).tolist()
    limit = compute_drift_limit(law, comparisons)
    return tuple(
        _compute_point_drift(estimate, predicted, error, limit)
        for estimate, predicted, error in zip(new, predictions, law_errors, strict=True)
    )


def _compute_point_drift(
    new: TrendEstimate, prediction: TrendPoint, law_error: float, limit: float
) -> Drift:
    if not (isfinite(prediction.value) and isfinite(prediction.stderr)):
        return Drift(nan, nan, False, limit)
    # Its own error is the larger of the stated error and the scatter of the batch.
    scatter = sqrt(max(prediction.stderr**2 - law_error**2, 0.0))
    error = hypot(law_error, max(scatter, new.stderr))
    difference = new.value - prediction.value
    z = _standardise_difference(difference, error)
    return Drift(difference, z, abs(z) > limit, limit)


def _standardise_difference(difference: float, error: float) -> float:
    if error > 0:
        return difference / error
    return float(np.copysign(inf, difference)) if difference else 0.0
