"""Products of columns at a few lags: all that a fit under autoregressive noise needs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray, IntArray


class OutputNoise(NamedTuple):
    """Noise of an output: an autoregression (p,), its variance and that of its innovations."""

    weights: FloatArray
    variance: float
    innovation_variance: float

    def whiten(self, values: FloatArray) -> FloatArray:
        """Whiten values (n,) or (n, k) of one series, in deviations of the noise.

        The first p keep their correlation, and their variance is that of the noise.
        """
        first = min(self.weights.size, values.shape[0])
        filtered = values / np.sqrt(self.innovation_variance)
        if first:
            for lag, weight in enumerate(self.weights.tolist(), 1):
                filtered[first:] -= (weight / np.sqrt(self.innovation_variance)) * values[
                    first - lag : values.shape[0] - lag
                ]
            filtered[:first] = values[:first] / np.sqrt(self.variance)
        return np.asarray(filtered)


class Autoregressions(NamedTuple):
    """Autoregressions of the noise of an output, one for each of B explanations.

    Attributes
    ----------
    weights : FloatArray, shape (B, m)
        0 beyond the order.
    orders : IntArray, shape (B,)
    variance, power : FloatArray, shape (B,)
        Of the noise, and of its innovations.
    """

    weights: FloatArray
    orders: IntArray
    variance: FloatArray
    power: FloatArray

    @classmethod
    def make_white(cls, count: int, most: int) -> "Autoregressions":
        """Make white noise of variance 1."""
        ones = np.ones(count)
        return cls(np.zeros((count, most)), np.zeros(count, dtype=np.int64), ones, ones)

    def split(self) -> list[OutputNoise]:
        """Split them into one for each explanation."""
        orders, variance, power = (one.tolist() for one in self[1:])
        return [
            OutputNoise(weights[:order], *its)
            for weights, order, *its in zip(self.weights, orders, variance, power, strict=True)
        ]


class LaggedProducts:
    """Products of the columns of one output, for several explanations at a time.

    Each of B explanations has q columns beside the s that all share, K = s + q. The products are
    those at lags up to `most`, from the sample on at which all of them are known (covariance
    method). The samples before it are the head of a series.

    Parameters
    ----------
    shared : FloatArray, shape (s, n)
    added : FloatArray, shape (B, q, n)
    series : sequence of slice
        Samples of each series of the output.
    most : int
    least : int
        Samples of the shortest series that tells of the noise.
    """

    def __init__(
        self,
        shared: FloatArray,
        added: FloatArray,
        series: Sequence[slice],
        most: int,
        least: int,
    ) -> None:
        self.most, self.sizes = most, np.array([rows.stop - rows.start for rows in series])
        self.told = int(np.sum(self.sizes[self.sizes >= least] - most))
        b, k = added.shape[0], shared.shape[0] + added.shape[1]
        self._head = np.zeros((b, len(series), most, k))
        self._of_told = np.zeros((b, most + 1, most + 1, k, k))
        self._of_others = np.zeros_like(self._of_told) if np.any(self.sizes < least) else None
        for number, rows in enumerate(series):
            own, other = shared[:, rows], added[:, :, rows]
            head = _join(own[:, :most], other[:, :, :most])
            self._head[:, number, : head.shape[1]] = head
            size = rows.stop - rows.start
            if size > most:
                into = self._of_told if size >= least else self._of_others
                assert into is not None
                into += _multiply(own, other, most, head)

    def correlate(self, weights: FloatArray) -> FloatArray:
        """Correlate a sum of the columns, of weights (B, K), with itself at the lags.

        Returns the products (B, m + 1, m + 1) of the series that tell of the noise.
        """
        b, lags, _, k, _ = self._of_told.shape
        squares = (weights[:, :, None] * weights[:, None, :]).reshape(b, k * k, 1)
        return (self._of_told.reshape(b, lags * lags, k * k) @ squares).reshape(b, lags, lags)

    def whiten(self, noise: Autoregressions) -> FloatArray:
        """Return the products (B, K, K) of columns that are whitened.

        The first samples keep their correlation, and their variance is that of the noise.
        """
        weights, orders, variance, power = noise
        b, lags, _, k, _ = self._of_told.shape
        filters = np.hstack([np.ones((b, 1)), -weights])
        pairs = (filters[:, :, None] * filters[:, None, :]).reshape(b, 1, lags * lags)
        whole = self._of_told if self._of_others is None else self._of_told + self._of_others
        products = (pairs @ whole.reshape(b, lags * lags, k * k)).reshape(b, k, k)
        products /= power[:, None, None]
        if not self.most:
            return np.asarray(products)
        lag = np.arange(self.most)[:, None] - np.arange(self.most)
        filtered = np.where(lag >= 0, filters[:, np.maximum(lag, 0)], 0.0)
        is_first = np.arange(self.most) < orders[:, None]
        filtered = np.where(
            is_first[:, :, None],
            np.eye(self.most) / np.sqrt(variance)[:, None, None],
            filtered / np.sqrt(power)[:, None, None],
        )
        is_there = np.arange(self.most)[:, None] < self.sizes[:, None, None]
        rows = (filtered[:, None] @ self._head) * is_there
        rows = rows.reshape(b, -1, k)
        return np.asarray(products + rows.transpose(0, 2, 1) @ rows)

    def count_first(self, orders: IntArray) -> IntArray:
        """Count the samples (B,) that keep their correlation."""
        return np.asarray(np.sum(np.minimum(orders[:, None], self.sizes), axis=1))


def _join(shared: FloatArray, added: FloatArray) -> FloatArray:
    """Join columns (s, n) and (B, q, n) to samples (B, n, s + q)."""
    both = [np.broadcast_to(shared, (added.shape[0], *shared.shape)), added]
    return np.concatenate(both, axis=1).transpose(0, 2, 1)


def _multiply(shared: FloatArray, added: FloatArray, most: int, head: FloatArray) -> FloatArray:
    """Multiply the columns of a series at all pairs of lags, (B, m + 1, m + 1, K, K).

    Those of a pair follow from the pair before it, but for the samples at both ends.
    """
    (s, n), (b, q, _) = shared.shape, added.shape
    flat, k = added.reshape(b * q, n), s + q
    products = np.empty((b, most + 1, most + 1, k, k))
    for lag in range(most + 1):
        late, early = slice(most, n), slice(most - lag, n - lag)
        one = products[:, 0, lag]
        one[:, :s, :s] = shared[:, late] @ shared[:, early].T
        one[:, :s, s:] = (shared[:, late] @ flat[:, early].T).reshape(s, b, q).transpose(1, 0, 2)
        one[:, s:, :s] = (flat[:, late] @ shared[:, early].T).reshape(b, q, s)
        one[:, s:, s:] = added[:, :, late] @ added[:, :, early].transpose(0, 2, 1)
        products[:, lag, 0] = one.transpose(0, 2, 1)
    tail = _join(shared[:, n - most :], added[:, :, n - most :])
    entering, leaving = head[:, ::-1], tail[:, ::-1]
    for i in range(most):
        one = products[:, i + 1, 1:]
        np.multiply(entering[:, i, None, :, None], entering[:, :, None, :], out=one)
        one -= leaving[:, i, None, :, None] * leaving[:, :, None, :]
        one += products[:, i, :-1]
    return products
