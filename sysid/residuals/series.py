"""Residual series: the scored samples of one output in one experiment.

Noise is modelled by series. Each may be coloured, and each may have a variance of its own.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.distributions import chi_square_tail
from sysid.core.types import RANK_TOLERANCE, FloatArray
from sysid.residuals.autocorrelation import (
    MIN_SAMPLES,
    ROUNDING_SHARE,
    compute_whiteness,
    keep_in_order,
    space_residuals,
)
from sysid.residuals.whitening import Whitening, compute_ar1_coefficient
from sysid.simulation.problem import Problem

_SIGNIFICANCE = 1e-3
"""Level of the tests for coloured residuals and for unequal variances.

It is that of χ². With 25 lags of a short record the statistic varies more. So white residuals of 50
to 100 samples are taken for coloured in 1 % of the cases (decision 19)."""

SHORT_RECORD = 400  # samples: in shorter records many lags hide the first one
_EVEN_TOLERANCE = 1e-3  # of a period: steps that differ by less are equal


class ResidualPart(NamedTuple):
    """Scored samples of one output of one experiment: their rows among all, times, repeats."""

    experiment: int
    output: str
    rows: slice
    times: FloatArray
    largest_value: float
    repeats: FloatArray | None = None


def iterate_parts(problem: Problem) -> Iterator[ResidualPart]:
    """Iterate over the series of a problem's scored samples, in their order.

    The runs of a sweep share them, but not a problem from which samples are left out.
    """
    evaluator, rows = problem.evaluator, problem.scored_rows
    weight, parts = problem.share(
        "residual series", lambda: (evaluator.weight, _list_parts(problem))
    )
    sizes = np.abs(evaluator.weight[rows] * evaluator.measured[rows])
    for part in parts if weight is evaluator.weight else _list_parts(problem):
        yield part._replace(largest_value=float(np.max(sizes[part.rows])))


def _list_parts(problem: Problem) -> list[ResidualPart]:
    """List the series without their largest values."""
    listed, first = [], 0
    weights = problem.split_by_output(problem.evaluator.weight)
    for experiment, (record, weight) in enumerate(zip(problem.records, weights, strict=True)):
        channels = {channel.name: channel for channel in record.outputs}
        for output, output_weight in weight.items():
            scored, channel = output_weight > 0, channels[output]
            n = int(np.count_nonzero(scored))
            if n:
                rows = slice(first, first + n)
                repeats = None if channel.repeats is None else channel.repeats[scored]
                listed.append(
                    ResidualPart(experiment, output, rows, channel.times[scored], 0.0, repeats)
                )
            first += n
    return listed


def make_whitening(problem: Problem, correlation_times: Mapping[str, float]) -> Whitening:
    """Make the whitening of a problem's scored samples from correlation times (s) by output."""
    coefficients = [
        compute_ar1_coefficient(part.times, correlation_times.get(part.output, 0.0))
        for part in iterate_parts(problem)
    ]
    n_times = sum(time > 0 for time in correlation_times.values())
    return Whitening(np.concatenate([np.zeros(0), *coefficients]), n_times)


def is_coloured(part: ResidualPart, values: FloatArray) -> bool:
    """Return whether the residuals (n,) of a series are clearly not white."""
    n, steps = values.size, np.diff(part.times)
    is_rounding = float(np.sqrt(values @ values / n)) <= ROUNDING_SHARE * part.largest_value
    if n < MIN_SAMPLES or is_rounding:
        return False
    is_even = np.ptp(steps) <= _EVEN_TOLERANCE * steps[0]
    spaced = keep_in_order(values) if is_even else space_residuals(part.times, values)
    whiteness = compute_whiteness(spaced)
    chance = chi_square_tail(spaced.n_lags, whiteness.statistic)
    if n < SHORT_RECORD and whiteness.values[0] > 0:
        first = (whiteness.values[0] / whiteness.deviation[0]) ** 2
        chance = min(chance, chi_square_tail(1, first))
    return chance < _SIGNIFICANCE


def have_unequal_variances(series: Sequence[FloatArray]) -> bool:
    """Return whether residual series clearly have unequal variances (Bartlett's test).

    The variance of n samples of a first-order noise of pole a is as uncertain as that of
    n(1 - a²)/(1 + a²) white ones. A series without any residual says nothing of its noise.
    """
    long_series = [one for one in series if one.size >= MIN_SAMPLES and float(one @ one) > 0]
    if len(long_series) < 2:
        return False
    powers = np.array([float(values @ values) for values in long_series])
    sizes = np.array([values.size for values in long_series])
    variances = powers / sizes
    poles = [float(one[1:] @ one[:-1]) for one in long_series] / powers
    counts = np.maximum(sizes * (1.0 - poles**2) / (1.0 + poles**2), 2.0)
    total = float(np.sum(counts))
    pooled = float(counts @ variances) / total
    statistic = total * np.log(pooled) - counts @ np.log(variances)
    degrees = len(long_series) - 1
    correction = 1.0 + (np.sum(1.0 / counts) - 1.0 / total) / (3.0 * degrees)
    return chi_square_tail(degrees, statistic / correction) < _SIGNIFICANCE


def count_used_degrees(columns: Sequence[FloatArray]) -> FloatArray:
    """Compute the degrees of freedom that the D parameters take from each series, slopes (n, D)."""
    products = [block.T @ block for block in columns]
    inverse = np.linalg.pinv(np.sum(products, axis=0), rcond=RANK_TOLERANCE**2, hermitian=True)
    used = np.array([np.sum(inverse * block) for block in products])
    total = float(np.sum(used))  # 0 where nothing has an effect
    return np.asarray(used * (len(inverse) / total if total > 0 else 0.0))
