"""Autoregressive noise of a free run, which whitens a linear regression: generalised least squares.

Noise in a polynomial's equation passes its recursion, so the error of the free run is coloured.
Only white errors have the likelihood that compares selections of terms.
"""

from collections.abc import Iterator, Sequence
from math import log, log10
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray

_PART_SHARE = 4  # an order is at most one such share of a series

_MIN_SAMPLES = 20


class Autoregression(NamedTuple):
    """Coefficients φ (p,) of e(k) = Σ φⱼ e(k - j) + white noise; none: the noise is white."""

    coefficients: FloatArray

    @property
    def order(self) -> int:
        """Number of coefficients."""
        return self.coefficients.size

    def whiten(self, values: FloatArray, rows: int) -> Iterator[FloatArray]:
        """Whiten a series (n, ...) in blocks of `rows`; the first p values have no innovation."""
        for first in range(self.order, values.shape[0], rows):
            last = min(first + rows, values.shape[0])
            block = np.array(values[first:last])
            for lag, coefficient in enumerate(self.coefficients, 1):
                block -= coefficient * values[first - lag : last - lag]
            yield block


def fit_autoregression(parts: Sequence[FloatArray]) -> Autoregression:
    """Fit the order and coefficients to residuals of several series, by least squares.

    The order has the least criterion of Schwarz, among orders up to 10 log₁₀ n.
    """
    white = Autoregression(np.zeros(0))
    samples = sum(part.size for part in parts)
    if samples < _MIN_SAMPLES:
        return white
    typical = int(np.median([part.size for part in parts]))
    most = min(int(10.0 * log10(samples)), typical // _PART_SHARE)
    rows = [
        np.lib.stride_tricks.sliding_window_view(part, most + 1)[:, ::-1]
        for part in parts
        if part.size > most
    ]
    if most < 1 or not rows:
        return white
    lagged = np.concatenate(rows)
    triangle = np.asarray(np.linalg.qr(np.column_stack([lagged[:, 1:], lagged[:, 0]]), mode="r"))
    left = np.cumsum(np.square(triangle[::-1, -1]))[::-1]  # with 0, 1, … coefficients
    if left[-1] <= 0.0:
        return white
    count = lagged.shape[0]
    criteria = [count * log(left[p] / count) + p * log(count) for p in range(most + 1)]
    order = int(np.argmin(criteria))
    return Autoregression(np.linalg.solve(triangle[:order, :order], triangle[:order, -1]))
