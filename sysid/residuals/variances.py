"""Variances of the noise of each output in each experiment."""

from collections.abc import Sequence

import numpy as np

from sysid.core.distributions import chi_square_tail
from sysid.core.types import RANK_TOLERANCE, FloatArray
from sysid.residuals.autocorrelation import MIN_SAMPLES

_SIGNIFICANCE = 1e-3  # level of the test for unequal variances


def have_unequal_variances(series: Sequence[FloatArray]) -> bool:
    """Return whether residual series clearly have unequal variances (Bartlett's test).

    The variance of n samples of a first-order noise of pole a is as uncertain as that of
    n(1 - a²)/(1 + a²) white ones.
    """
    long_series = [values for values in series if values.size >= MIN_SAMPLES]
    powers = [float(values @ values) for values in long_series]
    if len(long_series) < 2 or not min(powers) > 0:
        return False
    sizes = np.array([values.size for values in long_series])
    variances = np.array(powers) / sizes
    poles = [float(one[1:] @ one[:-1]) for one in long_series] / np.array(powers)
    counts = np.maximum(sizes * (1.0 - poles**2) / (1.0 + poles**2), 2.0)
    total = float(np.sum(counts))
    pooled = float(counts @ variances) / total
    statistic = total * np.log(pooled) - counts @ np.log(variances)
    degrees = len(long_series) - 1
    correction = 1.0 + (np.sum(1.0 / counts) - 1.0 / total) / (3.0 * degrees)
    return float(chi_square_tail(degrees, statistic / correction)) < _SIGNIFICANCE


def estimate_variances(series: Sequence[FloatArray], columns: Sequence[FloatArray]) -> FloatArray:
    """Estimate the variance of each residual series, which has slopes (n, D).

    The parameters take degrees of freedom from each series. A short series has the common variance.
    """
    sizes = np.array([values.size for values in series])
    powers = np.array([float(values @ values) for values in series])
    left = np.maximum(sizes - count_used_degrees(columns), 1.0)
    common = np.sum(powers) / np.sum(left)
    return np.where(sizes >= MIN_SAMPLES, powers / left, common)


def count_used_degrees(columns: Sequence[FloatArray]) -> FloatArray:
    """Compute the degrees of freedom that the D parameters take from each series."""
    products = [block.T @ block for block in columns]
    inverse = np.linalg.pinv(np.sum(products, axis=0), rcond=RANK_TOLERANCE**2, hermitian=True)
    used = np.array([np.sum(inverse * block) for block in products])
    total = float(np.sum(used))  # 0 where nothing has an effect
    return np.asarray(used * (len(inverse) / total if total > 0 else 0.0))
