"""Laws of a trend: a straight line and a power law, by weighted least squares.

The weights are 1/s² with the stated standard errors s. C = (JᵀWJ)⁻¹ is the covariance of the
coefficients if the stated errors are right. If the points scatter more, the Birge ratio
R = √(χ²/ν) [1]_ is above 1, and every error is multiplied by it.

.. [1] R. T. Birge, The calculation of errors by the method of least squares, Phys. Rev. 40 (1932)
   207-227.
"""

from dataclasses import dataclass
from math import exp, inf, log, sqrt
from typing import Literal

import numpy as np

from sysid.core.types import FloatArray

LawKind = Literal["line", "power"]
FORMULAS: dict[LawKind, str] = {"line": "a + b·x", "power": "a·x^b"}

_N_FITTED = 3  # two coefficients and the scale of the errors
_EXPONENTS = np.linspace(-8.0, 8.0, 161)
_MAX_STEPS, _MAX_HALVINGS = 60, 30
_MAX_LOG = 300.0  # exponents of e beyond which doubles overflow, squared still in range
_ROUNDING = 4.0 * float(np.finfo(np.float64).eps)
_MIN_DETERMINANT = 1e-14


@dataclass(frozen=True, slots=True, eq=False)
class TrendLaw:
    """A fitted law: y = c + b (x - x₀), or y = c (x/x₀)^b.

    The centre x₀ keeps c and b nearly uncorrelated.

    Attributes
    ----------
    theta : FloatArray, shape (2,)
        c and b.
    covariance : FloatArray, shape (2, 2)
        Covariance of c and b from the stated errors.
    chi_squared : float
        Weighted sum of the squared residuals.
    degrees : int
        Degrees of freedom ν: number of points minus two.
    aic : float
        n ln(χ²/n) + 2k with k = 3: two coefficients and the scale of the errors [1]_.
    aicc : float
        AIC corrected for few points by 2k(k + 1)/(n - k - 1); ``inf`` if n ≤ k + 1.

    .. [1] K. P. Burnham, D. R. Anderson, Model Selection and Multimodel Inference, 2nd ed.,
       Springer 2002, §2.2 and §2.4.
    """

    kind: LawKind
    centre: float
    theta: FloatArray
    covariance: FloatArray
    chi_squared: float
    degrees: int
    aic: float
    aicc: float

    @property
    def birge_ratio(self) -> float:
        """√(χ²/ν); 1 if the points scatter according to their errors."""
        return sqrt(self.chi_squared / self.degrees)

    @property
    def error_factor(self) -> float:
        """Factor of the stated errors: the Birge ratio, at least 1."""
        return max(1.0, self.birge_ratio)

    def evaluate_law(self, x: FloatArray) -> FloatArray:
        """Evaluate the law at x."""
        return _evaluate_kind(self.kind, x, self.centre, self.theta)

    def evaluate_stderr(self, x: FloatArray) -> FloatArray:
        """Compute the standard errors of the law at x from the stated errors."""
        slopes = _differentiate_kind(self.kind, x, self.centre, self.theta)
        variance = np.einsum("ni,ij,nj->n", slopes, self.covariance, slopes)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    @property
    def coefficients(self) -> tuple[tuple[str, float, float], ...]:
        """Names, values and standard errors (widened) of a and b of `FORMULAS`."""
        c, b = (float(value) for value in self.theta)
        if self.kind == "line":
            a, share, slopes = c - b * self.centre, 1.0, np.array([1.0, -self.centre])
        else:
            share = float(np.exp(-b * log(self.centre)))  # may be large, so it is never squared
            a, slopes = c * share, np.array([1.0, -c * log(self.centre)])
        variance = max(float(slopes @ self.covariance @ slopes), 0.0)
        error = self.error_factor * sqrt(variance) * share
        return ("a", a, error), ("b", b, self.error_factor * sqrt(float(self.covariance[1, 1])))


def fit_line(x: FloatArray, y: FloatArray, stderr: FloatArray) -> TrendLaw | None:
    """Fit a straight line to points (n ≥ 3, with at least three different x).

    The result is None if doubles cannot determine it, for example if squares of x overflow.
    """
    weight = (np.min(stderr) / stderr) ** 2  # at most 1: no overflow where errors are tiny
    centre = float(weight @ x / np.sum(weight))
    slopes = _differentiate_kind("line", x, centre, np.zeros(2))
    mean = float(weight @ y / np.sum(weight))
    # y minus its mean: otherwise that mean multiplies the rounding of the centre of x
    product = weight @ (slopes[:, 1] * (y - mean))
    theta = np.array([mean, float(product / (weight @ slopes[:, 1] ** 2))])
    return _build_law("line", x, y, stderr, centre, theta)


def fit_power(x: FloatArray, y: FloatArray, stderr: FloatArray) -> TrendLaw | None:
    """Fit a power law to points with x > 0; None if it does not exist or is not determined.

    The exponent is first scanned, since c follows from it linearly. Then the Gauss-Newton method
    finds the minimum.
    """
    if not np.all(x > 0):
        return None
    centre = exp(float(np.mean(np.log(x))))
    weight = np.min(stderr) / stderr
    theta = _scan_exponents(x, y, weight, centre)
    for _ in range(_MAX_STEPS):
        following = _take_step(x, y, weight, centre, theta)
        if following is None:
            break
        theta = following
    return _build_law("power", x, y, stderr, centre, theta)


def _scan_exponents(x: FloatArray, y: FloatArray, weight: FloatArray, centre: float) -> FloatArray:
    """Find the best of many exponents, each with its best c."""
    powers = np.clip(np.outer(_EXPONENTS, np.log(x / centre)), -_MAX_LOG, _MAX_LOG)
    shapes = weight * np.exp(powers)
    factors = shapes @ (weight * y) / np.sum(shapes**2, axis=1)
    losses = np.sum((weight * y - factors[:, None] * shapes) ** 2, axis=1)
    best = int(np.argmin(losses))
    return np.array([factors[best], _EXPONENTS[best]])


def _take_step(
    x: FloatArray, y: FloatArray, weight: FloatArray, centre: float, theta: FloatArray
) -> FloatArray | None:
    """Take a step, halved until it lowers the loss; None at the minimum."""
    slopes = weight[:, None] * _differentiate_kind("power", x, centre, theta)
    residual = weight * (y - _evaluate_kind("power", x, centre, theta))
    if not (np.all(np.isfinite(slopes)) and np.all(np.isfinite(residual))):
        return None
    step = np.linalg.lstsq(slopes, residual, rcond=None)[0]
    before = float(residual @ residual)
    for _ in range(_MAX_HALVINGS):
        if _compute_loss(x, y, weight, centre, theta + step) < before:
            return np.asarray(theta + step)
        step = 0.5 * step
    return None


def _compute_loss(
    x: FloatArray, y: FloatArray, weight: FloatArray, centre: float, theta: FloatArray
) -> float:
    residual = weight * (y - _evaluate_kind("power", x, centre, theta))
    return float(residual @ residual)


def _evaluate_kind(kind: LawKind, x: FloatArray, centre: float, theta: FloatArray) -> FloatArray:
    if kind == "line":
        return np.asarray(theta[0] + theta[1] * (x - centre))
    return np.asarray(
        theta[0] * np.exp(np.clip(theta[1] * np.log(x / centre), -_MAX_LOG, _MAX_LOG))
    )


def _differentiate_kind(
    kind: LawKind, x: FloatArray, centre: float, theta: FloatArray
) -> FloatArray:
    """Differentiate a law by c and b; the result has shape (n, 2)."""
    if kind == "line":
        return np.column_stack([np.ones_like(x), x - centre])
    share = _evaluate_kind(kind, x, centre, np.array([1.0, float(theta[1])]))
    return np.column_stack([share, theta[0] * share * np.log(x / centre)])


def _build_law(
    kind: LawKind,
    x: FloatArray,
    y: FloatArray,
    stderr: FloatArray,
    centre: float,
    theta: FloatArray,
) -> TrendLaw | None:
    least = float(np.min(stderr))
    slopes = _differentiate_kind(kind, x, centre, theta) * (least / stderr)[:, None]
    size = np.sqrt(np.sum(slopes**2, axis=0))
    if not np.all(size > 0):
        return None  # a curve of zero has no exponent
    normal = (slopes / size).T @ (slopes / size)
    if not np.linalg.det(normal) > _MIN_DETERMINANT:
        return None
    covariance = np.linalg.inv(normal) / np.outer(size / least, size / least)
    residual = (y - _evaluate_kind(kind, x, centre, theta)) / stderr
    # The rounding residual of an exact law is no evidence for it.
    chi_squared = max(float(residual @ residual), compute_rounding_floor(y, stderr))
    if not (np.isfinite(chi_squared) and np.all(np.isfinite(covariance))):
        return None
    aic, aicc = _compute_criteria(chi_squared, x.size)
    law = TrendLaw(kind, centre, theta, covariance, chi_squared, x.size - 2, aic, aicc)
    return law if np.all(np.isfinite([entry[1:] for entry in law.coefficients])) else None


def compute_rounding_floor(y: FloatArray, stderr: FloatArray) -> float:
    """Compute the χ² that rounding of the values alone may give."""
    return float(np.sum((_ROUNDING * np.max(np.abs(y)) / stderr) ** 2)) + 1e-300


def _compute_criteria(chi_squared: float, n: int) -> tuple[float, float]:
    aic = n * log(chi_squared / n) + 2 * _N_FITTED
    remaining = n - _N_FITTED - 1
    return aic, aic + 2 * _N_FITTED * (_N_FITTED + 1) / remaining if remaining > 0 else inf
