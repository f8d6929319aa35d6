"""Covariance of estimates where residuals are not those of one white noise.

s²(SᵀS)⁻¹ takes the residuals for white. Those of measured records seldom are, and then it is too
small by as much as they are alike over the time in which the sensitivities change. Where they are
clearly not white, the middle of the sandwich (SᵀS)⁻¹ Ω (SᵀS)⁻¹ becomes Ω = SᵀRS with the
autocovariance R of each series of residuals (output errors: Ljung 1999, sec. 9.3), from a Parzen
window as wide as their colour asks for, or in short records from a model of it
(`sysid.residuals.restricted_likelihood`), after they are prewhitened by a recursion (Andrews and
Monahan 1992). It is of first order, or of as many as Akaike's criterion takes (Burg's method; den
Haan and Levin 1997): slow noise beside white has a correlation of neighbours that says too little.
For free runs only: one step ahead the sensitivities are made of measured outputs and of the noise.

Coloured samples say less than as many white ones: of first-order noise with pole a > 0 those of a
mean count for n(1 - a)/(1 + a) (Bayley and Hammersley 1946). So many are taken for the degrees of
freedom. Where a is too near 1 the record is short beside its drift, and the errors are a lower
bound. Different outputs are taken for independent here; see `sysid.residuals.correlated_outputs`.

Nor is s² that of every output of every experiment. Where they are clearly noisy by unequal amounts
in the weighted residuals (Bartlett 1937), Ω has of each its own variance, and an interval has the
degrees of freedom of those series that tell it.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.fft import rfft
from numpy.typing import NDArray
from scipy.special import chdtrc, stdtrit

from sysid.core.types import RANK, FloatArray
from sysid.residuals.autocorrelation import (
    FEWEST,
    ROUNDING,
    Laid,
    colour_of,
    laid_out,
    padded,
    whiteness,
)
from sysid.residuals.past_outputs import reads_outputs
from sysid.residuals.restricted_likelihood import STEEPEST, Modelled, modelled
from sysid.simulation.problem import Problem

_CHANCE = 1e-3
"""That white residuals look as little white: below, they are taken for coloured.

And that those of one variance look as uneven. It is that of χ²: of 25 lags of a short record the
statistic varies more, and white ones are taken for coloured in 1 % of those of 50 to 100 samples
(decision 19)."""

QUANTILE = 3.841458820694124
"""95 % of χ² with one degree of freedom."""

_SHORT = 400
"""Samples: fewer tell their colour by a model of it, where one holds, and more by its window."""

_LONGEST = 25  # of the recursion: past values

_NARROWEST = 1e-3  # of the variance under white residuals: below is rounding

_EVEN = 1e-3  # of a period: steps that differ by less are equal


class Coloured(NamedTuple):
    """Ω (D, D) of the sandwich, and how many white samples would say as much.

    `drifts` where that number is not known: the residuals wander over the whole record. `is_white`
    where they are of unequal size only. `series` has of each series its part of Ω and the degrees
    of freedom that it tells that by; empty: all are of one. `models` has for each what tells the
    degrees of freedom of one whose colour is modelled, else None.
    """

    middle: FloatArray
    samples: float
    drifts: bool
    is_white: bool = False
    series: tuple[tuple[FloatArray, float], ...] = ()
    models: tuple[Modelled | None, ...] = ()

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the t distribution: those of white samples, one at least."""
        return max(self.samples - len(self.middle), 1.0)

    def degrees_along(self, direction: FloatArray) -> float:
        """Those of the variance of one combination (D,) of Sᵀe (Satterthwaite 1946)."""
        each = np.array([direction @ middle @ direction for middle, _ in self.series])
        if not np.sum(each) > 0:
            return self.degrees
        degrees = np.array([one for _, one in self.series])
        for i, known in enumerate(self.models):
            if known is not None:
                degrees[i] = 2.0 / known.variation(direction)
        return max(float(np.sum(each) ** 2 / np.sum(each**2 / degrees)), 1.0)

    def widening(self, direction: FloatArray, power: float, norm: float) -> float:
        """Square of how much wider than of white residuals an interval of one parameter is.

        Parameters
        ----------
        direction : FloatArray, shape (D,)
            Combination of the sensitivities that the other parameters cannot make up for.
        power, norm : float
            Mean square of the residuals; sum of squares of that combination.
        """
        told = max(float(direction @ self.middle @ direction) / (power * norm), _NARROWEST)
        reach = float(stdtrit(self.degrees_along(direction), 0.975)) ** 2 / QUANTILE
        return float(told * reach * self.samples / self.degrees)


class Part(NamedTuple):
    """One output of one experiment: its scored samples among all of them, with their times."""

    output: str
    rows: slice
    times: FloatArray
    size: float


def coloured(
    problem: Problem, seen: FloatArray, columns: FloatArray, *, by_model: bool = True
) -> Coloured | None:
    """The middle of the sandwich; None where the residuals may as well be one white noise.

    Parameters
    ----------
    seen : FloatArray, shape (n,)
        Weighted residuals of the scored samples as the loss sees them.
    columns : FloatArray, shape (n, D)
        Their sensitivities.
    by_model : bool
        Whether short series may tell their colour by a model of it.
    """
    found = [(part, _in_order(part, seen[part.rows])) for part in parts(problem)]
    is_free = problem.prediction == "simulation" or not reads_outputs(problem.model)
    told = [is_free and _is_coloured(laid, part.size) for part, laid in found]
    if not any(told) and not _are_uneven([seen[part.rows] for part, _ in found]):
        return None
    each = []
    for (part, _), has_colour in zip(found, told, strict=True):
        own, values = columns[part.rows], seen[part.rows]
        if has_colour:
            each.append(_with_colour(laid_out(part.times, values), own, by_model))
        else:
            mean = float(np.mean(np.square(values)))
            each.append(Coloured(mean * (own.T @ own), float(values.size), drifts=False))
    used = _used([columns[part.rows] for part, _ in found])
    return _together(each, used)._replace(is_white=not any(told))


def _used(columns: Sequence[FloatArray]) -> FloatArray:
    """How many of the degrees of freedom estimates of the parameters (D) take from each series."""
    own = [one.T @ one for one in columns]
    inverse = np.linalg.pinv(np.sum(own, axis=0), rcond=RANK**2, hermitian=True)
    used = np.array([np.sum(inverse * one) for one in own])
    total = float(np.sum(used))  # 0 where nothing has an effect
    return np.asarray(used * (len(inverse) / total if total > 0 else 0.0))


def _together(each: Sequence[Coloured], used: FloatArray) -> Coloured:
    """Ω of several series.

    Residuals of a series are smaller than its noise by the degrees of freedom that were taken from
    it; a model allows for that. What all have lost on average is not allowed for here.
    """
    size, samples = len(each[0].middle), np.array([one.samples for one in each])
    degrees = np.maximum(samples - used, 1.0)
    total = float(np.sum(samples))
    models = tuple(model for one in each for model in one.models or (None,))
    lost = np.where([one is None for one in models], samples / degrees, 1.0)
    grown = lost * (max(total - size, 1.0) / total)
    middles = [by * one.middle for one, by in zip(each, grown.tolist(), strict=True)]
    return Coloured(
        np.sum(middles, axis=0), total, any(one.drifts for one in each),
        series=tuple(zip(middles, degrees.tolist(), strict=True)), models=models,
    )  # fmt: skip


def _are_uneven(series: Sequence[FloatArray]) -> bool:
    """Whether residuals are clearly of unequal variance, by the test of Bartlett."""
    long = [one for one in series if one.size >= FEWEST]
    variances = np.array([np.mean(np.square(one)) for one in long])
    if len(long) < 2 or not np.min(variances) > 0:
        return False
    counts = np.array([one.size for one in long])
    total = float(np.sum(counts))
    pooled = float(counts @ variances) / total
    statistic = total * np.log(pooled) - counts @ np.log(variances)
    others = len(long) - 1
    correction = 1.0 + (np.sum(1.0 / counts) - 1.0 / total) / (3.0 * others)
    return float(chdtrc(others, statistic / correction)) < _CHANCE


def is_coloured(part: Part, values: FloatArray) -> bool:
    """Whether the residuals (n,) of a part are clearly not white."""
    return _is_coloured(_in_order(part, values), part.size)


def parts(problem: Problem) -> Iterator[Part]:
    """The series of a problem's scored samples, in their order."""
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
                yield Part(output, slice(first, first + n), times[output][scored], size)
            first += n


def _in_order(part: Part, values: FloatArray) -> Laid:
    """The residuals one after the other; laid out anew only where samples are missing."""
    steps = np.diff(part.times)
    if steps.size and np.ptp(steps) > _EVEN * steps[0]:
        return laid_out(part.times, values)
    return Laid(part.times, values, np.ones(values.size, dtype=np.bool_), 1.0, is_regular=True)


def _is_coloured(laid: Laid, size: float) -> bool:
    n = np.count_nonzero(laid.present)
    if n < FEWEST or float(np.sqrt(laid.values @ laid.values / n)) <= ROUNDING * size:
        return False
    found = whiteness(laid)
    chance = float(chdtrc(laid.lags, found.statistic))
    if n < _SHORT and found.values[0] > 0:  # there many lags hide what the first one says
        chance = min(chance, float(chdtrc(1, (found.values[0] / found.deviation[0]) ** 2)))
    return chance < _CHANCE


def _with_colour(laid: Laid, columns: FloatArray, by_model: bool) -> Coloured:
    """Of one series SᵀRS."""
    root, pole = spectrum_root(laid)
    is_short = np.count_nonzero(laid.present) < _SHORT
    known = modelled(laid, columns) if by_model and is_short and pole <= STEEPEST else None
    if known is not None:
        samples = laid.present.sum() * known.share
        return Coloured(known.middle, float(samples), drifts=False, models=(known,))
    moved = transformed(laid, columns, root)
    slow = min(max(pole, 0.0), STEEPEST)
    share = (1.0 - slow) / (1.0 + slow)
    n = np.count_nonzero(laid.present)
    # The same of any colour: the mean of its spectrum over what it is at frequency 0.
    lowest = float(root[0] ** 2) * 2 * (root.size - 1)
    if lowest > 0:
        share = min(share, float(laid.values @ laid.values) / n / lowest)
    return Coloured(np.asarray((moved @ moved.conj().T).real), n * share, pole > STEEPEST)


def spectrum_root(laid: Laid) -> tuple[FloatArray, float]:
    """Root (F,) of the spectrum of a series as `colour_of` has it, and the pole of first order.

    Of what a recursion leaves, coloured again by it.
    """
    both = laid.present[1:] & laid.present[:-1]
    before, after = laid.values[:-1][both], laid.values[1:][both]
    found = float(before @ after / (before @ before))
    weights = np.array([min(max(found, -STEEPEST), STEEPEST)])
    if laid.present.all() and found <= STEEPEST:  # a longer one takes a drift for oscillations
        longer = _recursion(laid.values)
        weights = weights if longer.size < 2 else longer
    kernel = np.concatenate([[1.0], -weights])
    filtered = np.convolve(laid.values, kernel)
    left = np.where(both, filtered[1 : laid.values.size], 0.0)
    root = colour_of(left, both, room=2 * left.size)  # the recursion rings on
    root /= np.abs(rfft(kernel, 2 * (root.size - 1)))
    return root, found


def _recursion(values: FloatArray) -> FloatArray:
    """Weights (p,) of the past values in a recursion, by Burg; p by Akaike's criterion."""
    ahead, behind, weights = values[1:], values[:-1], np.zeros(0)
    power, best = float(np.mean(np.square(values))), np.zeros(0)
    least = values.size * np.log(power)
    for order in range(1, min(_LONGEST, round(values.size ** (1 / 3))) + 1):
        both = float(ahead @ ahead + behind @ behind)
        if not both > 0:
            break
        reflected = 2.0 * float(ahead @ behind) / both
        weights = np.append(weights - reflected * weights[::-1], reflected)
        power *= 1.0 - reflected**2
        ahead, behind = (ahead - reflected * behind)[1:], (behind - reflected * ahead)[:-1]
        if not power > 0:
            break
        told = values.size * np.log(power) + 2.0 * order
        if told < least:
            least, best = told, weights
    steepest = float(np.max(np.abs(np.roots(np.append(1.0, -best))), initial=0.0))
    return best * min(1.0, STEEPEST / max(steepest, STEEPEST)) ** np.arange(1, best.size + 1)


def white_root(laid: Laid) -> FloatArray:
    """The same of a series taken for white: (F,), as many as `spectrum_root` has of its size."""
    size = padded(3 * (laid.values.size - 1)) // 2 + 1
    mean = float(laid.values @ laid.values) / np.count_nonzero(laid.present)
    both_signs = np.full(size, 2.0)  # each frequency stands for its negative too
    both_signs[[0, -1]] = 1.0
    return np.asarray(np.sqrt(mean * both_signs / (2 * (size - 1))))


def transformed(laid: Laid, columns: FloatArray, root: FloatArray) -> NDArray[np.complex128]:
    """Transforms (D, F) of the sensitivities (n, D) of a series, times a root (F,)."""
    spread = np.zeros((columns.shape[1], laid.values.size))
    spread[:, laid.present] = columns.T
    return np.asarray(rfft(spread, 2 * (root.size - 1), axis=1) * root)
