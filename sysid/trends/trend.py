"""The trend of an estimate over a label, such as a lag over the length of a tube.

From points (x, estimate ± standard error) to a law (`sysid.trends.laws`), its confidence band,
predictions where nothing was measured, and flags: points that do not fit the law, and estimates
that have drifted from a reference.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, inf, isfinite, nan, sqrt
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, stdtr, stdtrit

from sysid.core.types import FloatArray
from sysid.trends.laws import TrendLaw, compute_rounding_floor, fit_line, fit_power

MIN_DISTINCT_X = 3
"""Different values of x from which a law has errors."""

_OUTLIER_PROBABILITY = 0.05  # of all batches without an outlier, the part that are told of one
_DRIFT_PROBABILITY = 2.0 * (1.0 - NormalDist().cdf(3.0))  # outside three standard deviations
_SCATTER_PROBABILITY = (
    0.05  # of batches whose errors are right, the part whose scatter these do not explain
)
_NORMAL_95 = NormalDist().inv_cdf(0.975)
_BAND_POINTS = 101
_MAX_LEVERAGE = 1.0 - 1e-9


class TrendEstimate(NamedTuple):
    """A value and its standard error."""

    value: float
    stderr: float


class TrendPoint(NamedTuple):
    """A law at one x: value, 95 % interval, and whether x lies outside the measured range."""

    x: float
    value: float
    stderr: float
    lower: float
    upper: float
    is_outside: bool


class Influence(NamedTuple):
    """How one point fits the law that the others give.

    `studentised` is the deleted residual over its standard deviation, that of the others, which
    follows Student's t with ν - 1 degrees of freedom [1]_; None where too few others are left.
    `p_value` is multiplied by the number of points (Bonferroni). An outlier is one that neither
    the scatter of the others nor the stated errors explain.

    .. [1] R. D. Cook, S. Weisberg, Residuals and Influence in Regression, Chapman and Hall 1982,
       §2.2.
    """

    residual: float
    studentised: float | None
    p_value: float | None
    is_outlier: bool


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """Laws through the points and what follows from the one that was chosen.

    Attributes
    ----------
    laws : tuple of Law
        Those that could be fitted; empty with a `reason`.
    chosen : Law or None
        The one of the smaller AIC.
    influences : tuple of Influence
        Of each point.
    band : tuple of Place
        Confidence band of the law over the measured range.
    predictions : tuple of Place
        With intervals for a new estimate: what the law is unsure of and the scatter about it.
    """

    laws: tuple[TrendLaw, ...] = ()
    best_law: TrendLaw | None = None
    influences: tuple[Influence, ...] = ()
    band: tuple[TrendPoint, ...] = ()
    predictions: tuple[TrendPoint, ...] = ()
    reason: str = ""


def fit_trend(
    x: Sequence[float], y: Sequence[float], stderr: Sequence[float], predict: Sequence[float] = ()
) -> Trend:
    """Choose a law for points and look at them with it.

    Parameters
    ----------
    x, y : sequence of float, shape (n,)
        Places and estimates.
    stderr : sequence of float, shape (n,)
        Standard errors of these, positive.
    predict : sequence of float
        Places for which an interval is wanted.
    """
    places, values, errors = (np.asarray(one, dtype=np.float64) for one in (x, y, stderr))
    different = np.unique(places).size
    if different < MIN_DISTINCT_X:
        return Trend(
            reason=f"found {different} different {'value' if different == 1 else 'values'} of x "
            f"with a standard error; a law with errors needs {MIN_DISTINCT_X} or more"
        )
    with np.errstate(all="ignore"):  # what does not fit into doubles gives no law
        fitted = fit_line(places, values, errors), fit_power(places, values, errors)
        laws = tuple(law for law in fitted if law is not None)
        if not laws:
            return Trend(
                reason=f"the {different} values of x, {np.min(places):g} to {np.max(places):g}, "
                "or the estimates there, are too far apart in size for doubles. No law is "
                "determined. Give x in a unit that makes them similar in size."
            )
        chosen = min(laws, key=lambda law: law.aic)  # of equals the line, which comes first
        return Trend(
            laws=laws,
            best_law=chosen,
            influences=_compute_influences(chosen, places, values, errors),
            band=_compute_band(chosen, places),
            predictions=predict_estimates(
                chosen, places, errors, np.asarray(predict, dtype=np.float64)
            ),
        )


def compute_half_width(law: TrendLaw) -> float:
    """Half of a 95 % interval in standard errors.

    That of the normal distribution where the stated errors hold; that of Student's t where the
    size of the errors is taken from the scatter of few points.
    """
    return _NORMAL_95 if law.birge_ratio <= 1.0 else float(stdtrit(law.degrees, 0.975))


def _compute_band(law: TrendLaw, x: FloatArray) -> tuple[TrendPoint, ...]:
    at = np.linspace(float(np.min(x)), float(np.max(x)), _BAND_POINTS)
    errors = law.error_factor * law.evaluate_stderr(at)
    reach = compute_half_width(law) * errors
    found = zip(at, law.evaluate_law(at), errors, reach, strict=True)
    return tuple(
        TrendPoint(float(p), float(v), float(e), float(v - r), float(v + r), False)
        for p, v, e, r in found
    )


def predict_estimates(
    law: TrendLaw, x: FloatArray, stderr: FloatArray, at: FloatArray
) -> tuple[TrendPoint, ...]:
    """What estimates at new places would be, with their 95 % intervals.

    Their own stated error is interpolated (geometrically) between those of the points; outside
    the measured range that of the nearest is taken. All is widened by the Birge ratio. A power
    law knows nothing of x ≤ 0: there the interval is not finite.

    Parameters
    ----------
    x, stderr : FloatArray, shape (n,)
        The points of the law and their stated standard errors.
    at : FloatArray, shape (m,)
        The new places.
    """
    reach, low, high = compute_half_width(law), float(np.min(x)), float(np.max(x))
    known = np.ones(at.shape, dtype=bool) if law.kind == "line" else at > 0
    inside = np.where(known, at, law.centre)
    values = law.evaluate_law(inside)
    errors = law.error_factor * np.hypot(
        law.evaluate_stderr(inside), _interpolate_stderr(x, stderr, inside)
    )
    return tuple(
        TrendPoint(p, v, e, v - reach * e, v + reach * e, not low <= p <= high)
        if is_known
        else TrendPoint(p, nan, inf, -inf, inf, True)
        for p, v, e, is_known in zip(
            at.tolist(), values.tolist(), errors.tolist(), known.tolist(), strict=True
        )
    )


def _interpolate_stderr(x: FloatArray, stderr: FloatArray, at: FloatArray) -> FloatArray:
    """The stated errors that estimates at some places would have."""
    places, which = np.unique(x, return_inverse=True)
    logs = np.bincount(which, np.log(stderr)) / np.bincount(which)
    return np.asarray(np.exp(np.interp(at, places, logs)))


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
    """The deleted residual follows from the whole fit: t = e/(s₍ᵢ₎ √(1 - h))."""
    degrees = law.degrees - 1
    if degrees < 1 or not leverage <= _MAX_LEVERAGE:
        return Influence(residual, None, None, False)
    square = residual**2 / (1.0 - leverage)
    others = max(law.chi_squared - square, 0.0) / degrees
    if others <= floor:  # the others lie on the law exactly
        t = float(np.copysign(inf, residual)) if square > 2.0 * floor else 0.0
    else:
        t = residual / sqrt(others * (1.0 - leverage))
    p_value = min(1.0, n * 2.0 * float(stdtr(degrees, -abs(t))))
    is_explained = sqrt(square) <= -NormalDist().inv_cdf(_OUTLIER_PROBABILITY / (2.0 * n))
    return Influence(residual, t, p_value, p_value < _OUTLIER_PROBABILITY and not is_explained)


def pool_estimates(
    groups: Sequence[Sequence[TrendEstimate]],
) -> tuple[tuple[TrendEstimate, ...], float]:
    """One estimate for each group of runs of one label, and how much these scatter.

    Within a group the weighted mean. How much runs of one label differ beyond their stated
    errors is taken from all groups together, since each has few: the Birge ratio of all of them
    multiplies every error where it is above 1, those of single runs as well.

    Returns
    -------
    tuple of Estimate, float
        The means, and the ratio; 1 where no group has two runs.
    """
    with np.errstate(over="ignore"):  # a ratio beyond doubles is infinite
        return _pool_groups(groups)


def _pool_groups(
    groups: Sequence[Sequence[TrendEstimate]],
) -> tuple[tuple[TrendEstimate, ...], float]:
    means, square, degrees = [], 0.0, 0
    for group in groups:
        errors = np.array([one.stderr for one in group])
        values = np.array([one.value for one in group])
        least = float(np.min(errors))
        weights = (least / errors) ** 2  # at most 1: no overflow where errors are tiny
        mean = float(weights @ values / np.sum(weights))
        means.append(TrendEstimate(mean, least * float(np.sum(weights)) ** -0.5))
        square += float(np.sum(((values - mean) / errors) ** 2))
        degrees += len(group) - 1
    ratio = sqrt(square / degrees) if degrees else 1.0
    return tuple(TrendEstimate(v, max(1.0, ratio) * s) for v, s in means), ratio


class Drift(NamedTuple):
    """How far an estimate is from what a reference says, in standard errors of the difference.

    It has drifted where |z| is above `limit`.
    """

    difference: float
    z: float
    has_drifted: bool
    limit: float


def compute_drift_limit(law: TrendLaw | None = None, comparisons: int = 1) -> float:
    """From how many standard errors on an estimate has drifted.

    Three; of many comparisons more, so that a batch that has not changed is flagged as seldom as
    one comparison would be (Bonferroni). Where the stated errors do not explain how the points
    scatter about a law (χ², 5 %), their size is known from few points only: the limit is then
    wider by as much as Student's 95 % interval is. Student's own tail that far out comes from
    batches that happen to scatter little, and these have their stated errors.
    """
    limit = -NormalDist().inv_cdf(_DRIFT_PROBABILITY / (2.0 * comparisons))
    if law is None or chdtrc(law.degrees, law.chi_squared) >= _SCATTER_PROBABILITY:
        return limit
    return limit * float(stdtrit(law.degrees, 0.975)) / _NORMAL_95


def compute_drift(new: TrendEstimate, old: TrendEstimate, comparisons: int = 1) -> Drift:
    """An estimate against that of a reference run."""
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
    """Estimates against what the trend of a reference batch predicts at their places.

    Parameters
    ----------
    new : sequence of Estimate, length m
        The estimates.
    x, stderr : FloatArray, shape (n,)
        The points of the reference batch and their stated standard errors.
    at : FloatArray, shape (m,)
        The places of the estimates. Where the law says nothing, no number is told.
    """
    with np.errstate(all="ignore"):
        told = predict_estimates(law, x, stderr, at)
        known = (law.error_factor * law.evaluate_stderr(at)).tolist()
    limit = compute_drift_limit(law, comparisons)
    return tuple(
        _compute_point_drift(one, place, error, limit)
        for one, place, error in zip(new, told, known, strict=True)
    )


def _compute_point_drift(new: TrendEstimate, told: TrendPoint, known: float, limit: float) -> Drift:
    if not (isfinite(told.value) and isfinite(told.stderr)):
        return Drift(nan, nan, False, limit)
    # Its own error is the larger of what it says and what points of that batch scatter.
    scatter = sqrt(max(told.stderr**2 - known**2, 0.0))
    error = hypot(known, max(scatter, new.stderr))
    difference = new.value - told.value
    z = _standardise_difference(difference, error)
    return Drift(difference, z, abs(z) > limit, limit)


def _standardise_difference(difference: float, error: float) -> float:
    if error > 0:
        return difference / error
    return float(np.copysign(inf, difference)) if difference else 0.0
