"""Likelihood of residuals under linear columns and autoregressive noise: one scale for all.

What is left of the data by an estimate is e = Sδ + Zγ + v. S are the sensitivities of the outputs
to the parameters, Z the columns of an explanation, and v is noise. Each output has an
autoregression of its own, whose order Schwarz's criterion chooses. The noise is estimated *with*
the explanation and not before it. Otherwise an autoregression absorbs what the explanation explains
(model-error modelling: Ljung, Reinelt, Garulli; Automatica 38 (2002) 1445). Columns and noise are
estimated in turn, by generalised least squares (Cochrane and Orcutt 1949).

    gain = C(S) - C(S, Z),  C = Σ n ln σ² + (columns + orders of the noise) ln n

is the difference of Schwarz's criteria (Ann. Statist. 6 (1978) 461): twice the logarithm of the
odds (Kass and Raftery, J. Am. Stat. Assoc. 90 (1995) 773). No simulation is needed.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray
from sysid.residuals.series import ResidualPart

_MOST_ORDER = 6  # of the autoregression of an output's noise
_SAMPLES_PER_ORDER = 20  # at least, of an output
_LENGTH_PER_ORDER = 2  # samples at least, of a series that tells of the noise
_ROUNDS = 2  # of generalised least squares and noise model, in turn
_RIDGE = 1e-10  # of columns of length 1: only a column that others hold is kept from dividing by 0
_LEAST_VARIANCE = 1e-20  # of the residuals: less is rounding


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


class ColumnFit(NamedTuple):
    """Columns fitted to residuals.

    Attributes
    ----------
    criterion : float
        Schwarz's criterion.
    coefficients : FloatArray, shape (k,)
    errors : FloatArray, shape (k,)
        Their standard errors.
    noise : tuple of OutputNoise
        Of each output.
    innovations : FloatArray, shape (n,)
        Of the noise, in its deviations.
    """

    criterion: float
    coefficients: FloatArray
    errors: FloatArray
    noise: tuple[OutputNoise, ...]
    innovations: FloatArray

    @property
    def is_coloured(self) -> bool:
        """Whether some output's noise is coloured."""
        return any(one.weights.size for one in self.noise)


class ResidualModel:
    """Residuals (n,) with the columns (n, D) that the parameters explain.

    Residuals are measured minus simulated values, weighted, and columns are weighted too. So
    coefficients of the first D columns are moves of the parameters.
    """

    def __init__(
        self, residuals: FloatArray, columns: FloatArray, parts: Sequence[ResidualPart]
    ) -> None:
        self.residuals, self.columns = residuals, columns
        outputs = dict.fromkeys(part.output for part in parts)
        self._series = [[p.rows for p in parts if p.output == name] for name in outputs]
        self._least = _LEAST_VARIANCE * max(float(np.mean(np.square(residuals))), 1e-300)

    @cached_property
    def without(self) -> ColumnFit:
        """The fit without any explanation."""
        return self.fit(np.zeros((self.residuals.size, 0)))

    def fit(self, columns: FloatArray, counted: int = 0) -> ColumnFit:
        """Fit columns (n, q) beside those of the parameters; `counted` more count as parameters."""
        design = np.hstack([self.columns, columns])
        length = np.linalg.norm(design, axis=0)
        scale = np.where(length > 0, length, 1.0)
        joint = np.column_stack([design / scale, self.residuals])
        k = joint.shape[1] - 1
        coefficients = _solve(joint.T @ joint)
        for _ in range(_ROUNDS):
            left = self.residuals - joint[:, :k] @ coefficients
            noise = tuple(self._fit_noise([left[r] for r in rows]) for rows in self._series)
            whitened = self.whiten(joint, noise)
            products = whitened.T @ whitened
            coefficients = _solve(products)
        innovations = whitened[:, k] - whitened[:, :k] @ coefficients
        n, twice = innovations.size, 0.0
        for rows, one in zip(self._series, noise, strict=True):
            own = np.concatenate([innovations[r] for r in rows])
            first = sum(min(one.weights.size, r.stop - r.start) for r in rows)
            twice += own.size * np.log(max(float(np.mean(np.square(own))), _LEAST_VARIANCE))
            twice += (own.size - first) * np.log(one.innovation_variance)
            twice += first * np.log(one.variance)
        spread = float(innovations @ innovations) / max(n - k, 1)
        inverse = _invert_diagonal(products[:k, :k])
        used = columns.shape[1] + counted + sum(one.weights.size for one in noise)
        return ColumnFit(
            float(twice + used * np.log(max(n, 2))),
            coefficients / scale,
            np.sqrt(np.maximum(inverse, 0.0) * spread) / scale,
            noise,
            innovations,
        )

    def whiten(self, values: FloatArray, noise: Sequence[OutputNoise]) -> FloatArray:
        """Whiten values (n,) or (n, k) by the noise of each output."""
        whitened = np.empty(values.shape)
        for rows, one in zip(self._series, noise, strict=True):
            for r in rows:
                whitened[r] = one.whiten(values[r])
        return whitened

    def _fit_noise(self, series: Sequence[FloatArray]) -> OutputNoise:
        """Fit an autoregression by least squares, its order by Schwarz's criterion.

        Series that are too short for its largest order tell nothing of it, and do not limit it.
        """
        most = _find_most_order([values.size for values in series])
        stacked = np.concatenate(
            [
                np.column_stack([values[most - lag : values.size - lag] for lag in range(most + 1)])
                for values in series
                if values.size >= _LENGTH_PER_ORDER * most
            ]
        )
        n = stacked.shape[0]
        products = stacked.T @ stacked / n
        variance = max(float(products[0, 0]), self._least)
        best, weights, least = n * np.log(variance), np.zeros(0), variance
        for order in range(1, most + 1):
            past = products[1 : order + 1, 1 : order + 1]
            past = past + _RIDGE * variance * np.eye(order)
            found = np.linalg.solve(past, products[1 : order + 1, 0])
            power = max(
                float(products[0, 0] - products[1 : order + 1, 0] @ found),
                self._least,
            )
            criterion = n * np.log(power) + order * np.log(n)
            if criterion < best:
                best, weights, least = criterion, found, power
        return OutputNoise(weights, variance, least)


def _find_most_order(sizes: Sequence[int]) -> int:
    """Find the largest order of the noise that series of such sizes tell."""
    for order in range(_MOST_ORDER, 0, -1):
        told = sum(size for size in sizes if size >= _LENGTH_PER_ORDER * order)
        if told >= _SAMPLES_PER_ORDER * order:
            return order
    return 0


def _solve(products: FloatArray) -> FloatArray:
    """Solve normal equations (k + 1, k + 1) whose last column is the right-hand side."""
    k = products.shape[0] - 1
    scale = _compute_lengths(products[:k, :k])
    matrix = products[:k, :k] / np.outer(scale, scale) + _RIDGE * np.eye(k)
    right = products[:k, k] / scale
    try:
        return np.asarray(np.linalg.solve(matrix, right) / scale)
    except np.linalg.LinAlgError:  # columns that rounding makes equal
        return np.asarray(np.linalg.pinv(matrix, hermitian=True) @ right / scale)


def _invert_diagonal(products: FloatArray) -> FloatArray:
    """Compute the diagonal (k,) of the inverse of normal equations (k, k)."""
    scale = _compute_lengths(products)
    matrix = products / np.outer(scale, scale) + _RIDGE * np.eye(scale.size)
    return np.asarray(np.diag(np.linalg.pinv(matrix, hermitian=True)) / scale**2)


def _compute_lengths(products: FloatArray) -> FloatArray:
    """Compute the lengths (k,) of columns from their products (k, k); 1 of a column of zeros."""
    powers = np.diag(products)
    return np.sqrt(np.where(powers > 0, powers, 1.0))
