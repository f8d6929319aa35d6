"""Colour of residuals by restricted maximum likelihood (REML), for short records.

Residuals are noise without the part that D parameters absorbed, mostly its slow part. So with 50 to
100 samples the autocovariances, and all results from them, are too small. The restricted likelihood
(Patterson and Thompson 1971) uses combinations of samples on which the parameters have no effect.
Nothing was absorbed from these (Cheang and Reinsel 2000). The noise is first-order noise plus white
noise with the share w:

    r(k) = (1 - w) aᵏ for k > 0,  r(0) = 1

The differences y(i) - aᵏ y(i - 1), with k periods between two samples, are then correlated with
their neighbours only. So the computing time is proportional to the samples. The accuracy of a and w
sets the degrees of freedom of each variance (Satterthwaite 1946, by the curvature of the
likelihood; Kenward and Roger 1997). If the innovations are not white, the model does not fit.
"""

from typing import NamedTuple

import numpy as np

from sysid.core.distributions import chi_square_tail
from sysid.core.jit import jit_compile
from sysid.core.linear_algebra import compute_truncated_svd
from sysid.core.types import FloatArray, IntArray
from sysid.residuals.autocorrelation import SpacedResiduals, compute_whiteness, keep_in_order

MAX_POLE = 0.97
"""Limit on an autoregressive pole: beyond, it follows a single drift (Andrews and Monahan 1992)."""

_SEARCH_STARTS = ((0.6, -1.5), (1.5, 0.0))
_SEARCH_OPTIONS = {"maxfev": 80, "xatol": 0.02, "fatol": 0.02}  # evaluations; tolerances
_DIFFERENCE_STEP = 0.1  # of the two arguments, for finite differences
_MIN_CURVATURE = 0.05  # a flatter likelihood counts as having this curvature
_MIN_CHANCE = 0.05  # least p-value of the innovations for whiteness


class NoiseColourModel(NamedTuple):
    """SᵀRS of one series, and its accuracy.

    Attributes
    ----------
    middle : FloatArray, shape (D, D)
    slopes : FloatArray, shape (2, D, D)
        Slopes of the middle over the two numbers that determine a and w.
    covariance : FloatArray, shape (2, 2)
        Covariance of these numbers.
    degrees : float
        Degrees of freedom of the noise variance for known colour.
    sample_share : float
        Equivalent white samples for a mean, for each sample.
    """

    middle: FloatArray
    slopes: FloatArray
    covariance: FloatArray
    degrees: float
    sample_share: float

    def compute_variation(self, direction: FloatArray) -> float:
        """Compute the variance of the log variance of a combination (D,) of Sᵀe."""
        size = float(direction @ self.middle @ direction)
        slope = np.einsum("d,kde,e->k", direction, self.slopes, direction)
        relative_variance = float(slope @ self.covariance @ slope) / size**2 if size > 0 else 0.0
        return relative_variance + 2.0 / self.degrees


class _ObservedSeries(NamedTuple):
    """Values (n,), a basis of the parameters' effects (n, r), and the gaps in periods (n-1,)."""

    values: FloatArray
    basis: FloatArray
    gaps: IntArray


def fit_noise_colour(spaced: SpacedResiduals, columns: FloatArray) -> NoiseColourModel | None:
    """Fit the noise model to residuals; None if it does not fit.

    Parameters
    ----------
    columns : FloatArray, shape (n, D)
        Sensitivities of the present samples.
    """
    from scipy.optimize import minimize  # imported late, as below: slow to load, rarely needed

    values = spaced.values[spaced.present]
    left_vectors, _, _, is_independent = compute_truncated_svd(columns)
    basis = left_vectors[:, is_independent]
    series = _ObservedSeries(values, basis, np.diff(np.flatnonzero(spaced.present)))
    if values.size <= basis.shape[1] + 2:
        return None
    solutions = [
        minimize(_compute_deviance, start, (series,), method="Nelder-Mead", options=_SEARCH_OPTIONS)
        for start in _SEARCH_STARTS
    ]
    best = min(solutions, key=lambda solution: float(solution.fun)).x
    innovations, power, _ = _compute_innovations(best, series)
    if not power > 0 or not _are_white(innovations):
        return None
    steps = _DIFFERENCE_STEP * np.eye(2)
    middles = [_compute_middle(best + step, spaced, columns, series) for step in (*steps, *-steps)]
    slopes = np.array([(middles[i] - middles[i + 2]) / (2.0 * _DIFFERENCE_STEP) for i in range(2)])
    degrees = float(values.size - basis.shape[1])
    a, w = _to_pole_and_share(best)
    share = 1.0 / (1.0 + (1.0 - w) * 2.0 * a / (1.0 - a))
    middle = _compute_middle(best, spaced, columns, series)
    return NoiseColourModel(
        middle, slopes, _estimate_covariance(best, series), degrees, min(share, 1.0)
    )


def _to_pole_and_share(place: FloatArray) -> tuple[float, float]:
    """Convert the two arguments to the pole and the share of white noise."""
    from scipy.special import expit

    return MAX_POLE * float(np.tanh(place[0])), float(expit(place[1]))


def _whiten_series(place: FloatArray, series: _ObservedSeries) -> tuple[FloatArray, float]:
    """Whiten basis and values, (n, r + 1), and compute ln det R."""
    a, w = _to_pole_and_share(place)
    columns = np.column_stack([series.basis, series.values])
    carried = np.asarray(a**series.gaps, dtype=np.float64)
    return columns, _whiten_in_place(carried, w, columns)


@jit_compile
def _whiten_in_place(carried: FloatArray, w: float, columns: FloatArray) -> float:
    """Whiten columns (n, c) by the Cholesky factor of the differences; return ln det R.

    `carried` (n - 1,) is the share of a sample's noise that the next one has, w that of white
    noise. Not finite if R is not positive definite.
    """
    n, count = columns.shape
    deviation, log_determinant = 1.0, 0.0  # of the first sample
    for i in range(n - 1, 0, -1):
        for c in range(count):
            columns[i, c] -= carried[i - 1] * columns[i - 1, c]
    for i in range(1, n):
        share = carried[i - 1]
        below = -w * share / deviation
        variance = (1.0 - w) * (1.0 - share**2) + w * (1.0 + share**2) - below**2
        deviation = np.sqrt(variance)
        log_determinant += np.log(deviation)
        for c in range(count):
            columns[i, c] = (columns[i, c] - below * columns[i - 1, c]) / deviation
    return 2.0 * log_determinant


def _compute_innovations(
    place: FloatArray, series: _ObservedSeries
) -> tuple[FloatArray, float, float]:
    """Compute the innovations (n,), their sum of squares, and ln of both determinants."""
    whitened, log_determinant = _whiten_series(place, series)
    basis, values = whitened[:, :-1], whitened[:, -1]
    gram = basis.T @ basis
    innovations = values - basis @ np.linalg.solve(gram, basis.T @ values)
    return (
        innovations,
        float(innovations @ innovations),
        log_determinant + float(np.linalg.slogdet(gram)[1]),
    )


def _compute_deviance(place: FloatArray, series: _ObservedSeries) -> float:
    """Compute -2 ln of the restricted likelihood, without a constant."""
    _, power, determinants = _compute_innovations(place, series)
    n, r = series.basis.shape
    return float((n - r) * np.log(max(power, float(np.finfo(float).tiny))) + determinants)


def _are_white(values: FloatArray) -> bool:
    spaced = keep_in_order(values)
    return chi_square_tail(spaced.n_lags, compute_whiteness(spaced).statistic) >= _MIN_CHANCE


def _compute_middle(
    place: FloatArray, spaced: SpacedResiduals, columns: FloatArray, series: _ObservedSeries
) -> FloatArray:
    """Compute SᵀRS (D, D)."""
    from scipy.linalg import solve_banded

    a, w = _to_pole_and_share(place)
    n, r = series.basis.shape
    variance = _compute_innovations(place, series)[1] / (n - r)
    spaced_columns = np.zeros((spaced.values.size, columns.shape[1]))
    spaced_columns[spaced.present] = columns
    recursion = np.array([[1.0], [-a]]) * np.ones(spaced.values.size)
    forward = solve_banded((1, 0), recursion, spaced_columns)
    backward = solve_banded((1, 0), recursion, spaced_columns[::-1])[::-1]
    first_order = spaced_columns.T @ (forward + backward - spaced_columns)
    middle = variance * ((1.0 - w) * first_order + w * (columns.T @ columns))
    return np.asarray(0.5 * (middle + middle.T))


def _estimate_covariance(place: FloatArray, series: _ObservedSeries) -> FloatArray:
    """Estimate the covariance (2, 2) of the two arguments by the curvature of the likelihood."""
    first, second = _DIFFERENCE_STEP * np.eye(2)

    def evaluate(move: FloatArray) -> float:
        return 0.5 * _compute_deviance(place + move, series)

    centre = evaluate(np.zeros(2))
    mixed = (
        evaluate(first + second)
        - evaluate(first - second)
        - evaluate(second - first)
        + evaluate(-first - second)
    ) / 4.0
    straight = [evaluate(step) - 2.0 * centre + evaluate(-step) for step in (first, second)]
    curvature = np.array([[straight[0], mixed], [mixed, straight[1]]]) / _DIFFERENCE_STEP**2
    size, rows = np.linalg.eigh(curvature)
    return np.asarray((rows / np.maximum(size, _MIN_CURVATURE)) @ rows.T)
