"""The colour of residuals by restricted likelihood, as short records ask for.

Residuals are noise less what D parameters took of it, and that is mostly its slow part: of 50 to
100 samples autocovariances, and all that is made of them, come out too small. The restricted
likelihood (Patterson and Thompson 1971) is that of the combinations of samples in which the
parameters have no part, so nothing was taken from them (Cheang and Reinsel 2000). The noise is one
of first order beside white noise, with the share w of the white one:

    r(k) = (1 - w) aᵏ for k > 0,  r(0) = 1

The differences y(i) - aᵏ y(i - 1), over the k periods between two samples, are then correlated with
their neighbours only, so that all takes a time in proportion to the samples. How exact a and w are
tells the degrees of freedom of each variance (Satterthwaite 1946, by the curvature of the
likelihood; Kenward and Roger 1997). Where what it leaves is not white it is no model of the noise.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, expit

from sysid.core.linear_algebra import truncated_svd
from sysid.core.types import FloatArray, IntArray
from sysid.residuals.autocorrelation import SpacedResiduals, compute_whiteness

LARGEST_POLE = 0.97
"""Pole of a recursion: one nearer 1 would follow a single drift (Andrews and Monahan 1992)."""

_SEARCH_STARTS = ((0.6, -1.5), (1.5, 0.0))
_MOST_EVALUATIONS = 80  # of each of them
_SEARCH_TOLERANCE = 0.02  # of the likelihood, and of the two numbers that it is searched over
_DIFFERENCE_STEP = 0.1  # of their differences
_LEAST_CURVATURE = 0.05  # curvature: a likelihood that is flatter knows no more
_LEAST_CHANCE = 0.05  # chance of what is left of the residuals, if it is white


class NoiseColourModel(NamedTuple):
    """SᵀRS of one series, and how exact it is.

    Attributes
    ----------
    middle : FloatArray, shape (D, D)
    slopes : FloatArray, shape (2, D, D)
        Of the middle, over two numbers that stand for a and w.
    covariance : FloatArray, shape (2, 2)
        Of those.
    degrees : float
        Of the variance of the noise, were its colour known.
    share : float
        How much of a white sample one says of a mean.
    """

    middle: FloatArray
    slopes: FloatArray
    covariance: FloatArray
    degrees: float
    sample_share: float

    def compute_variation(self, direction: FloatArray) -> float:
        """Variance of the logarithm of the variance of a combination (D,) of Sᵀe."""
        size = float(direction @ self.middle @ direction)
        slope = np.einsum("d,kde,e->k", direction, self.slopes, direction)
        known = float(slope @ self.covariance @ slope) / size**2 if size > 0 else 0.0
        return known + 2.0 / self.degrees


class _ObservedSeries(NamedTuple):
    """Values (n,) beside what the parameters can take of them (n, r), and periods between (n-1)."""

    values: FloatArray
    basis: FloatArray
    gaps: IntArray


def fit_noise_colour(laid: SpacedResiduals, columns: FloatArray) -> NoiseColourModel | None:
    """The model's colour; None where it is none of these residuals.

    Parameters
    ----------
    columns : FloatArray, shape (n, D)
        Sensitivities of the samples that are present.
    """
    from scipy.optimize import minimize  # late, as below: few runs need what takes long to load

    values = laid.values[laid.present]
    left, _, _, kept = truncated_svd(columns)
    basis = left[:, kept]
    series = _ObservedSeries(values, basis, np.diff(np.flatnonzero(laid.present)))
    if values.size <= basis.shape[1] + 2:
        return None
    found = [
        minimize(
            _compute_deviance,
            start,
            (series,),
            method="Nelder-Mead",
            options={
                "maxfev": _MOST_EVALUATIONS,
                "xatol": _SEARCH_TOLERANCE,
                "fatol": _SEARCH_TOLERANCE,
            },
        )
        for start in _SEARCH_STARTS
    ]
    best = min(found, key=lambda one: float(one.fun)).x
    innovations, power, _ = _compute_innovations(best, series)
    if not power > 0 or not _are_white(innovations):
        return None
    steps = _DIFFERENCE_STEP * np.eye(2)
    middles = [_compute_middle(best + step, laid, columns, series) for step in (*steps, *-steps)]
    slopes = np.array([(middles[i] - middles[i + 2]) / (2.0 * _DIFFERENCE_STEP) for i in range(2)])
    degrees = float(values.size - basis.shape[1])
    a, w = _to_pole_and_share(best)
    share = 1.0 / (1.0 + (1.0 - w) * 2.0 * a / (1.0 - a))
    middle = _compute_middle(best, laid, columns, series)
    return NoiseColourModel(
        middle, slopes, _estimate_covariance(best, series), degrees, min(share, 1.0)
    )


def _to_pole_and_share(place: FloatArray) -> tuple[float, float]:
    """Pole and share of white noise."""
    return LARGEST_POLE * float(np.tanh(place[0])), float(expit(place[1]))


def _whiten_series(place: FloatArray, series: _ObservedSeries) -> tuple[FloatArray, float]:
    """Basis and values (n, r + 1) as of white noise, and ln of the determinant of R."""
    from scipy.linalg import cholesky_banded, solve_banded

    a, w = _to_pole_and_share(place)
    carried = a**series.gaps
    band = np.ones((2, series.values.size))
    band[0, 1:] = (1.0 - w) * (1.0 - carried**2) + w * (1.0 + carried**2)
    band[1, :-1] = -w * carried
    band[1, -1] = 0.0
    root = cholesky_banded(band, lower=True)
    both = np.column_stack([series.basis, series.values])
    both[1:] -= carried[:, None] * both[:-1]
    return solve_banded((1, 0), root, both), 2.0 * float(np.sum(np.log(root[0])))


def _compute_innovations(
    place: FloatArray, series: _ObservedSeries
) -> tuple[FloatArray, float, float]:
    """White residuals (n,), their squares' sum, and ln of both determinants."""
    both, size = _whiten_series(place, series)
    basis, values = both[:, :-1], both[:, -1]
    gram = basis.T @ basis
    left = values - basis @ np.linalg.solve(gram, basis.T @ values)
    return left, float(left @ left), size + float(np.linalg.slogdet(gram)[1])


def _compute_deviance(place: FloatArray, series: _ObservedSeries) -> float:
    """Minus twice the logarithm of the restricted likelihood, but for a constant."""
    _, power, determinants = _compute_innovations(place, series)
    n, r = series.basis.shape
    return float((n - r) * np.log(max(power, float(np.finfo(float).tiny))) + determinants)


def _are_white(values: FloatArray) -> bool:
    ones = np.ones(values.size, dtype=np.bool_)
    laid = SpacedResiduals(np.arange(float(values.size)), values, ones, 1.0, is_regular=True)
    return float(chdtrc(laid.n_lags, compute_whiteness(laid).statistic)) >= _LEAST_CHANCE


def _compute_middle(
    place: FloatArray, laid: SpacedResiduals, columns: FloatArray, series: _ObservedSeries
) -> FloatArray:
    """SᵀRS (D, D)."""
    from scipy.linalg import solve_banded

    a, w = _to_pole_and_share(place)
    n, r = series.basis.shape
    variance = _compute_innovations(place, series)[1] / (n - r)
    spread = np.zeros((laid.values.size, columns.shape[1]))
    spread[laid.present] = columns
    recursion = np.array([[1.0], [-a]]) * np.ones(laid.values.size)
    ahead = solve_banded((1, 0), recursion, spread)
    behind = solve_banded((1, 0), recursion, spread[::-1])[::-1]
    slow = spread.T @ (ahead + behind - spread)
    middle = variance * ((1.0 - w) * slow + w * (columns.T @ columns))
    return np.asarray(0.5 * (middle + middle.T))


def _estimate_covariance(place: FloatArray, series: _ObservedSeries) -> FloatArray:
    """Of the two numbers (2, 2), by the curvature of the likelihood."""
    one, other = _DIFFERENCE_STEP * np.eye(2)

    def at(move: FloatArray) -> float:
        return 0.5 * _compute_deviance(place + move, series)

    here = at(np.zeros(2))
    mixed = (at(one + other) - at(one - other) - at(other - one) + at(-one - other)) / 4.0
    straight = [at(step) - 2.0 * here + at(-step) for step in (one, other)]
    curvature = np.array([[straight[0], mixed], [mixed, straight[1]]]) / _DIFFERENCE_STEP**2
    size, rows = np.linalg.eigh(curvature)
    return np.asarray((rows / np.maximum(size, _LEAST_CURVATURE)) @ rows.T)
