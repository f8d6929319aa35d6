"""Covariance of estimates where the residuals of neighbouring samples are alike.

s²(SᵀS)⁻¹ takes the residuals for white. Those of measured records seldom are, and then it is too
small by as much as they are alike over the time in which the sensitivities change. Where they are
clearly not white, the middle of the sandwich (SᵀS)⁻¹ Ω (SᵀS)⁻¹ becomes Ω = SᵀRS with the
autocovariance R of each series of residuals (output errors: Ljung 1999, sec. 9.3), from a Parzen
window as wide as their colour asks for after a first-order prewhitening (Andrews and Monahan 1992).
For free runs only: one step ahead the sensitivities are made of measured outputs and of the noise.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.fft import rfft

from sysid.distributions import chi_squared_tail
from sysid.lagged_sums import FEWEST, ROUNDING, Laid, colour_of, laid_out, whiteness
from sysid.problem import Problem
from sysid.types import FloatArray

_CHANCE = 1e-3
"""That white residuals look as little white: below, they are taken for coloured."""

_STEEPEST = 0.97
"""Of the recursion (Andrews and Monahan 1992): one nearer 1 would follow a single drift."""


class _Part(NamedTuple):
    """One output of one experiment: its scored samples among all of them, with their times."""

    rows: slice
    times: FloatArray
    size: float


def coloured_middle(problem: Problem, seen: FloatArray, columns: FloatArray) -> FloatArray | None:
    """Ω of the sandwich, (D, D); None where the residuals may as well be white.

    Parameters
    ----------
    seen : FloatArray, shape (n,)
        Weighted residuals of the scored samples as the loss sees them.
    columns : FloatArray, shape (n, D)
        Their sensitivities.
    """
    if problem.arguments[3] == "one-step":
        return None
    parts = [
        (columns[part.rows], seen[part.rows], part.times, _is_coloured(seen[part.rows], part.size))
        for part in _parts(problem)
    ]
    if not any(is_coloured for *_, is_coloured in parts):
        return None
    middle = np.zeros((columns.shape[1], columns.shape[1]))
    for own, values, times, is_coloured in parts:
        if is_coloured:
            middle += _with_colour(laid_out(times, values), own)
        else:
            middle += float(np.mean(np.square(values))) * (own.T @ own)
    return middle


def _parts(problem: Problem) -> Iterator[_Part]:
    measured = problem.split(problem.evaluator.weight * problem.evaluator.measured)
    weights = problem.split(problem.evaluator.weight)
    first = 0
    for record, weight, sizes in zip(problem.records, weights, measured, strict=True):
        times = {channel.name: channel.times for channel in record.outputs}
        for output, one in weight.items():
            scored = one > 0
            n = int(np.count_nonzero(scored))
            if n:
                size = float(np.max(np.abs(sizes[output][scored])))
                yield _Part(slice(first, first + n), times[output][scored], size)
            first += n


def _is_coloured(values: FloatArray, size: float) -> bool:
    """By the samples in their order, whatever gaps are between them: gaps only make them whiter."""
    if values.size < FEWEST or float(np.sqrt(np.mean(np.square(values)))) <= ROUNDING * size:
        return False
    one_by_one = Laid(values, values, np.ones(values.size, dtype=np.bool_), 1.0, is_regular=False)
    return chi_squared_tail(one_by_one.lags, whiteness(one_by_one).statistic) < _CHANCE


def _with_colour(laid: Laid, columns: FloatArray) -> FloatArray:
    """SᵀRS of one series; R of what a first-order recursion leaves, coloured again by it."""
    spread = np.zeros((columns.shape[1], laid.values.size))
    spread[:, laid.present] = columns.T
    both = laid.present[1:] & laid.present[:-1]
    before, after = laid.values[:-1][both], laid.values[1:][both]
    pole = float(np.clip(before @ after / (before @ before), -_STEEPEST, _STEEPEST))
    left = np.where(both, laid.values[1:] - pole * laid.values[:-1], 0.0)
    colour = colour_of(left, both)
    frequency = np.linspace(0.0, np.pi, colour.size)
    colour /= np.abs(1.0 - pole * np.exp(-1j * frequency))
    moved = rfft(spread, 2 * (colour.size - 1), axis=1) * colour
    return np.asarray((moved @ moved.conj().T).real)
