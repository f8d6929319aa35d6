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

All of that follows from products of the columns at a few lags, as in the covariance method of
linear prediction (Makhoul, Proc. IEEE 63 (1975) 561). So a record is read once for all
explanations. The rest is linear algebra of small matrices, of many explanations at a time.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

import numpy as np

from sysid.core.types import FloatArray
from sysid.judgement.lagged_products import Autoregressions, LaggedProducts, OutputNoise
from sysid.residuals.series import ResidualPart

_MOST_ORDER = 6
"""Of the autoregression of an output's noise. Measured with `benchmarks.judgement`, a record of
each of 102 kinds: 4 is too few, and changes the first word of four verdicts. 10 does so of one."""
_SAMPLES_PER_ORDER = 20
"""At least, of an output: 10 to 40 give the same verdicts of the same 102 records."""
_LENGTH_PER_ORDER = 2  # samples at least, of a series that tells of the noise
_ROUNDS = 2  # of generalised least squares and noise model, in turn
_RIDGE = 1e-10  # of columns of length 1: only a column that others hold is kept from dividing by 0
_LEAST_VARIANCE = 1e-20  # of the residuals: less is rounding
_ROUNDING = 1e-15  # of the squares of what is added up: what sums of products leave is that exact
_MOST_NUMBERS = 1 << 20  # of columns, and of products, of explanations that are fitted at a time

_Fitted = tuple[float, FloatArray, FloatArray, tuple[OutputNoise, ...]]
"""What a fit finds: Schwarz's criterion without its penalty, coefficients, errors, noise."""


@dataclass(frozen=True, eq=False)
class ColumnFit:
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
    model : ResidualModel
    added : tuple of FloatArray, shapes (n, q)
        Columns beside those of the parameters.
    """

    criterion: float
    coefficients: FloatArray
    errors: FloatArray
    noise: tuple[OutputNoise, ...]
    model: "ResidualModel"
    added: tuple[FloatArray, ...]

    @property
    def is_coloured(self) -> bool:
        """Whether some output's noise is coloured."""
        return any(one.weights.size for one in self.noise)

    @cached_property
    def innovations(self) -> FloatArray:
        """Innovations (n,) of the noise, in its deviations."""
        design = np.hstack([self.model.columns, *self.added])
        return self.model.whiten(self.model.residuals - design @ self.coefficients, self.noise)


class ResidualModel:
    """Residuals (n,) with the columns (n, D) that the parameters explain.

    Residuals are measured minus simulated values, weighted, and columns are weighted too. So
    coefficients of the first D columns are moves of the parameters.

    No variance is smaller than `least`, that of errors which the residuals contain anyway.
    """

    def __init__(
        self,
        residuals: FloatArray,
        columns: FloatArray,
        parts: Sequence[ResidualPart],
        least: float = 0.0,
    ) -> None:
        self.residuals, self.columns = residuals, columns
        outputs = dict.fromkeys(part.output for part in parts)
        self._series = [[p.rows for p in parts if p.output == name] for name in outputs]
        self.least = max(least, _LEAST_VARIANCE * float(np.mean(np.square(residuals))), 1e-320)

    @cached_property
    def without(self) -> ColumnFit:
        """The fit without any explanation."""
        return self.fit(np.zeros((self.residuals.size, 0)))

    def fit(self, columns: FloatArray, counted: int = 0) -> ColumnFit:
        """Fit columns (n, q) beside those of the parameters; `counted` more count as parameters."""
        [found] = self.fit_each([columns], [counted])
        return found

    def fit_each(
        self,
        explanations: Sequence[FloatArray],
        counted: Sequence[int],
        taken: Sequence[FloatArray] = (),
    ) -> list[ColumnFit]:
        """Fit the columns (n, q) of each explanation by itself, beside those that are `taken`.

        Parameters
        ----------
        explanations : sequence of FloatArray, shapes (n, q)
        counted : sequence of int
            Parameters of each beside its columns; those of what is taken are among them.
        taken : sequence of FloatArray, shapes (n, t)
        """
        own = np.column_stack([self.columns, *taken]).T
        fits = dict[int, ColumnFit]()
        by_width = sorted(range(len(explanations)), key=lambda i: explanations[i].shape[1])
        for q, numbers in groupby(by_width, key=lambda i: explanations[i].shape[1]):
            alike = list(numbers)
            pairs = ((_MOST_ORDER + 1) * (1 + len(own) + q)) ** 2
            most = max(_MOST_NUMBERS // max(q * self.residuals.size, pairs), 1)
            for chosen in (alike[i : i + most] for i in range(0, len(alike), most)):
                found = self._fit_alike(own, np.stack([explanations[i].T for i in chosen]))
                for i, (twice, coefficients, errors, noise) in zip(chosen, found, strict=True):
                    added = (*taken, explanations[i])
                    used = sum(one.shape[1] for one in added) + counted[i]
                    used += sum(one.weights.size for one in noise)
                    criterion = float(twice + used * np.log(max(self.residuals.size, 2)))
                    fits[i] = ColumnFit(criterion, coefficients, errors, noise, self, added)
        return [fits[i] for i in range(len(explanations))]

    def _fit_alike(self, own: FloatArray, added: FloatArray) -> Iterable[_Fitted]:
        """Fit `added` columns (B, q, n) beside `own` ones (s, n), for each of B explanations."""
        b, n = added.shape[0], self.residuals.size
        own_lengths, lengths = _measure_lengths(own), _measure_lengths(added)
        shared = np.vstack([self.residuals, own / own_lengths[:, None]])
        added = added / lengths[:, :, None]
        scale = np.hstack([np.tile(own_lengths, (b, 1)), lengths])
        outputs = []
        for rows in self._series:
            most = _find_most_order([one.stop - one.start for one in rows])
            outputs.append(LaggedProducts(shared, added, rows, most, _LENGTH_PER_ORDER * most))
        white = [one.whiten(Autoregressions.make_white(b, one.most)) for one in outputs]
        weights = _solve(np.sum(white, axis=0))
        for _ in range(_ROUNDS):
            noise = [self._fit_noise(one, weights) for one in outputs]
            whitened = [one.whiten(its) for one, its in zip(outputs, noise, strict=True)]
            products = np.sum(whitened, axis=0)
            weights = _solve(products)
        twice, total = np.zeros(b), np.zeros(b)
        for one, its, part in zip(outputs, noise, whitened, strict=True):
            squares = np.einsum("bi,bij,bj->b", weights, part, weights)
            size, first = int(np.sum(one.sizes)), one.count_first(its.orders)
            least = np.maximum(_LEAST_VARIANCE, self.least / its.power)
            twice += size * np.log(np.maximum(squares / size, least))
            twice += (size - first) * np.log(its.power) + first * np.log(its.variance)
            total += squares
        spread = np.maximum(total, 0.0) / max(n - scale.shape[1], 1)
        inverse = np.maximum(_invert_diagonal(products[:, 1:, 1:]), 0.0)
        errors = np.sqrt(inverse * spread[:, None]) / scale
        of_each = zip(*(one.split() for one in noise), strict=True)
        return zip(twice.tolist(), -weights[:, 1:] / scale, errors, of_each, strict=True)

    def whiten(self, values: FloatArray, noise: Sequence[OutputNoise]) -> FloatArray:
        """Whiten values (n,) or (n, k) by the noise of each output."""
        whitened = np.empty(values.shape)
        for rows, one in zip(self._series, noise, strict=True):
            for r in rows:
                whitened[r] = one.whiten(values[r])
        return whitened

    def _fit_noise(self, products: LaggedProducts, weights: FloatArray) -> Autoregressions:
        """Fit autoregressions to what is left, by weights (B, K) of the columns.

        By least squares, their orders by Schwarz's criterion. Series that are too short for the
        largest order tell nothing of it, and do not limit it.
        """
        n, b = products.told, weights.shape[0]
        lagged = products.correlate(weights) / n
        added_up = np.linalg.norm(self.residuals) + np.sum(np.abs(weights[:, 1:]), axis=1)
        lowest = np.maximum(self.least, _ROUNDING * np.square(added_up) / n)
        variance = np.maximum(lagged[:, 0, 0], lowest)
        ridge = np.maximum(_RIDGE * variance, lowest)[:, None, None]
        found = np.zeros((b, products.most))
        orders, power = np.zeros(b, dtype=np.int64), variance
        best = n * np.log(variance)
        for order in range(1, products.most + 1):
            past = lagged[:, 1 : order + 1, 1 : order + 1] + ridge * np.eye(order)
            right = lagged[:, 1 : order + 1, :1]
            solved = np.linalg.solve(past, right)
            least = lagged[:, 0, 0] - np.sum(right * solved, axis=(1, 2))
            least = np.maximum(least, lowest)
            criterion = n * np.log(least) + order * np.log(n)
            is_better = criterion < best
            best, power = np.where(is_better, criterion, best), np.where(is_better, least, power)
            orders = np.where(is_better, order, orders)
            found[is_better, :order] = solved[is_better, :, 0]
        return Autoregressions(found, orders, variance, power)


def _measure_lengths(columns: FloatArray) -> FloatArray:
    """Measure the lengths of columns (…, n); 1 of a column of zeros."""
    lengths = np.sqrt(np.einsum("...n,...n->...", columns, columns))
    return np.where(lengths > 0, lengths, 1.0)


def _find_most_order(sizes: Sequence[int]) -> int:
    """Find the largest order of the noise that series of such sizes tell."""
    for order in range(_MOST_ORDER, 0, -1):
        told = sum(size for size in sizes if size >= _LENGTH_PER_ORDER * order)
        if told >= _SAMPLES_PER_ORDER * order:
            return order
    return 0


def _solve(products: FloatArray) -> FloatArray:
    """Solve normal equations (B, K, K) whose first column is the right-hand side.

    Returns the weights (B, K) of the columns in what is left: 1 of the first one.
    """
    scale = _compute_lengths(products[:, 1:, 1:])
    matrix = _add_ridge(products[:, 1:, 1:], scale)
    right = products[:, 1:, :1] / scale[:, :, None]
    try:
        solved = np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:  # columns that rounding makes equal
        solved = np.linalg.pinv(matrix, hermitian=True) @ right
    return np.hstack([np.ones((scale.shape[0], 1)), -solved[:, :, 0] / scale])


def _invert_diagonal(products: FloatArray) -> FloatArray:
    """Compute the diagonals (B, k) of the inverses of normal equations (B, k, k)."""
    scale = _compute_lengths(products)
    matrices = _add_ridge(products, scale)
    try:
        inverse = np.linalg.inv(matrices)
    except np.linalg.LinAlgError:  # columns that rounding makes equal
        inverse = np.linalg.pinv(matrices, hermitian=True)
    return np.asarray(np.diagonal(inverse, axis1=1, axis2=2) / scale**2)


def _add_ridge(products: FloatArray, scale: FloatArray) -> FloatArray:
    """Scale products (B, k, k) to columns of length 1, and add the ridge."""
    scaled = products / (scale[:, :, None] * scale[:, None, :])
    return np.asarray(scaled + _RIDGE * np.eye(scale.shape[1]))


def _compute_lengths(products: FloatArray) -> FloatArray:
    """Compute the lengths (B, k) of columns from their products; 1 of a column of zeros."""
    powers = np.diagonal(products, axis1=1, axis2=2)
    return np.sqrt(np.where(powers > 0, powers, 1.0))
