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

from sysid.core.types import RANK_TOLERANCE, FloatArray
from sysid.residuals.autocorrelation import (
    FEWEST_SAMPLES,
    ROUNDING_SHARE,
    SpacedResiduals,
    compute_whiteness,
    pad_length,
    smooth_spectrum_root,
    space_residuals,
)
from sysid.residuals.past_outputs import reads_outputs
from sysid.residuals.restricted_likelihood import LARGEST_POLE, NoiseColourModel, fit_noise_colour
from sysid.simulation.problem import Problem

_SIGNIFICANCE = 1e-3
"""That white residuals look as little white: below, they are taken for coloured.

And that those of one variance look as uneven. It is that of χ²: of 25 lags of a short record the
statistic varies more, and white ones are taken for coloured in 1 % of those of 50 to 100 samples
(decision 19)."""

CHI_SQUARE_95 = 3.841458820694124
"""95 % of χ² with one degree of freedom."""

_SHORT_RECORD = 400
"""Samples: fewer tell their colour by a model of it, where one holds, and more by its window."""

_LONGEST_RECURSION = 25  # of the recursion: past values

_LEAST_WIDENING = 1e-3  # of the variance under white residuals: below is rounding

_EVEN_TOLERANCE = 1e-3  # of a period: steps that differ by less are equal


class ColouredCovariance(NamedTuple):
    """Ω (D, D) of the sandwich, and how many white samples would say as much.

    `drifts` where that number is not known: the residuals wander over the whole record. `is_white`
    where they are of unequal size only. `series` has of each series its part of Ω and the degrees
    of freedom that it tells that by; empty: all are of one. `models` has for each what tells the
    degrees of freedom of one whose colour is modelled, else None.
    """

    middle: FloatArray
    equivalent_samples: float
    is_drifting: bool
    is_white: bool = False
    series: tuple[tuple[FloatArray, float], ...] = ()
    models: tuple[NoiseColourModel | None, ...] = ()

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the t distribution: those of white samples, one at least."""
        return max(self.equivalent_samples - len(self.middle), 1.0)

    def compute_degrees(self, direction: FloatArray) -> float:
        """Those of the variance of one combination (D,) of Sᵀe (Satterthwaite 1946)."""
        each = np.array([direction @ middle @ direction for middle, _ in self.series])
        if not np.sum(each) > 0:
            return self.degrees
        degrees = np.array([one for _, one in self.series])
        for i, known in enumerate(self.models):
            if known is not None:
                degrees[i] = 2.0 / known.compute_variation(direction)
        return max(float(np.sum(each) ** 2 / np.sum(each**2 / degrees)), 1.0)

    def compute_widening(self, direction: FloatArray, power: float, norm: float) -> float:
        """Square of how much wider than of white residuals an interval of one parameter is.

        Parameters
        ----------
        direction : FloatArray, shape (D,)
            Combination of the sensitivities that the other parameters cannot make up for.
        power, norm : float
            Mean square of the residuals; sum of squares of that combination.
        """
        told = max(float(direction @ self.middle @ direction) / (power * norm), _LEAST_WIDENING)
        reach = float(stdtrit(self.compute_degrees(direction), 0.975)) ** 2 / CHI_SQUARE_95
        return float(told * reach * self.equivalent_samples / self.degrees)


class ResidualPart(NamedTuple):
    """One output of one experiment: its scored samples among all of them, with their times."""

    output: str
    rows: slice
    times: FloatArray
    largest_value: float


def estimate_coloured_covariance(
    problem: Problem, seen: FloatArray, columns: FloatArray, *, by_model: bool = True
) -> ColouredCovariance | None:
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
    found = [(part, _order_residuals(part, seen[part.rows])) for part in iterate_parts(problem)]
    is_free = problem.prediction == "simulation" or not reads_outputs(problem.model)
    told = [is_free and _are_spaced_coloured(laid, part.largest_value) for part, laid in found]
    if not any(told) and not _have_unequal_variances([seen[part.rows] for part, _ in found]):
        return None
    each = []
    for (part, _), has_colour in zip(found, told, strict=True):
        own, values = columns[part.rows], seen[part.rows]
        if has_colour:
            each.append(
                _estimate_series_covariance(space_residuals(part.times, values), own, by_model)
            )
        else:
            mean = float(np.mean(np.square(values)))
            each.append(
                ColouredCovariance(mean * (own.T @ own), float(values.size), is_drifting=False)
            )
    used = _count_used_degrees([columns[part.rows] for part, _ in found])
    return _combine_series(each, used)._replace(is_white=not any(told))


def _count_used_degrees(columns: Sequence[FloatArray]) -> FloatArray:
    """How many of the degrees of freedom estimates of the parameters (D) take from each series."""
    own = [one.T @ one for one in columns]
    inverse = np.linalg.pinv(np.sum(own, axis=0), rcond=RANK_TOLERANCE**2, hermitian=True)
    used = np.array([np.sum(inverse * one) for one in own])
    total = float(np.sum(used))  # 0 where nothing has an effect
    return np.asarray(used * (len(inverse) / total if total > 0 else 0.0))


def _combine_series(each: Sequence[ColouredCovariance], used: FloatArray) -> ColouredCovariance:
    """Ω of several series.

    Residuals of a series are smaller than its noise by the degrees of freedom that were taken from
    it; a model allows for that. What all have lost on average is not allowed for here.
    """
    size, samples = len(each[0].middle), np.array([one.equivalent_samples for one in each])
    degrees = np.maximum(samples - used, 1.0)
    total = float(np.sum(samples))
    models = tuple(model for one in each for model in one.models or (None,))
    lost = np.where([one is None for one in models], samples / degrees, 1.0)
    grown = lost * (max(total - size, 1.0) / total)
    middles = [by * one.middle for one, by in zip(each, grown.tolist(), strict=True)]
    return ColouredCovariance(
        np.sum(middles, axis=0),
        total,
        any(one.is_drifting for one in each),
        series=tuple(zip(middles, degrees.tolist(), strict=True)),
        models=models,
    )


def _have_unequal_variances(series: Sequence[FloatArray]) -> bool:
    """Whether residuals are clearly of unequal variance, by the test of Bartlett."""
    long = [one for one in series if one.size >= FEWEST_SAMPLES]
    variances = np.array([np.mean(np.square(one)) for one in long])
    if len(long) < 2 or not np.min(variances) > 0:
        return False
    counts = np.array([one.size for one in long])
    total = float(np.sum(counts))
    pooled = float(counts @ variances) / total
    statistic = total * np.log(pooled) - counts @ np.log(variances)
    others = len(long) - 1
    correction = 1.0 + (np.sum(1.0 / counts) - 1.0 / total) / (3.0 * others)
    return float(chdtrc(others, statistic / correction)) < _SIGNIFICANCE


def is_coloured(part: ResidualPart, values: FloatArray) -> bool:
    """Whether the residuals (n,) of a part are clearly not white."""
    return _are_spaced_coloured(_order_residuals(part, values), part.largest_value)


def iterate_parts(problem: Problem) -> Iterator[ResidualPart]:
    """The series of a problem's scored samples, in their order."""
    measured = problem.split_by_output(problem.evaluator.weight * problem.evaluator.measured)
    weights = problem.split_by_output(problem.evaluator.weight)
    first = 0
    for record, weight, sizes in zip(problem.records, weights, measured, strict=True):
        times = {channel.name: channel.times for channel in record.outputs}
        for output, one in weight.items():
            scored = one > 0
            n = int(np.count_nonzero(scored))
            if n:
                size = float(np.max(np.abs(sizes[output][scored])))
                yield ResidualPart(output, slice(first, first + n), times[output][scored], size)
            first += n


def _order_residuals(part: ResidualPart, values: FloatArray) -> SpacedResiduals:
    """The residuals one after the other; laid out anew only where samples are missing."""
    steps = np.diff(part.times)
    if steps.size and np.ptp(steps) > _EVEN_TOLERANCE * steps[0]:
        return space_residuals(part.times, values)
    return SpacedResiduals(
        part.times, values, np.ones(values.size, dtype=np.bool_), 1.0, is_regular=True
    )


def _are_spaced_coloured(laid: SpacedResiduals, size: float) -> bool:
    n = np.count_nonzero(laid.present)
    if n < FEWEST_SAMPLES or float(np.sqrt(laid.values @ laid.values / n)) <= ROUNDING_SHARE * size:
        return False
    found = compute_whiteness(laid)
    chance = float(chdtrc(laid.n_lags, found.statistic))
    if n < _SHORT_RECORD and found.values[0] > 0:  # there many lags hide what the first one says
        chance = min(chance, float(chdtrc(1, (found.values[0] / found.deviation[0]) ** 2)))
    return chance < _SIGNIFICANCE


def _estimate_series_covariance(
    laid: SpacedResiduals, columns: FloatArray, by_model: bool
) -> ColouredCovariance:
    """Of one series SᵀRS."""
    root, pole = estimate_spectrum_root(laid)
    is_short = np.count_nonzero(laid.present) < _SHORT_RECORD
    known = (
        fit_noise_colour(laid, columns) if by_model and is_short and pole <= LARGEST_POLE else None
    )
    if known is not None:
        samples = laid.present.sum() * known.sample_share
        return ColouredCovariance(known.middle, float(samples), is_drifting=False, models=(known,))
    moved = transform_sensitivities(laid, columns, root)
    slow = min(max(pole, 0.0), LARGEST_POLE)
    share = (1.0 - slow) / (1.0 + slow)
    n = np.count_nonzero(laid.present)
    # The same of any colour: the mean of its spectrum over what it is at frequency 0.
    lowest = float(root[0] ** 2) * 2 * (root.size - 1)
    if lowest > 0:
        share = min(share, float(laid.values @ laid.values) / n / lowest)
    return ColouredCovariance(
        np.asarray((moved @ moved.conj().T).real), n * share, pole > LARGEST_POLE
    )


def estimate_spectrum_root(laid: SpacedResiduals) -> tuple[FloatArray, float]:
    """Root (F,) of the spectrum of a series as `smooth_spectrum_root` has it, and the pole of first order.

    Of what a recursion leaves, coloured again by it.
    """
    both = laid.present[1:] & laid.present[:-1]
    before, after = laid.values[:-1][both], laid.values[1:][both]
    found = float(before @ after / (before @ before))
    weights = np.array([min(max(found, -LARGEST_POLE), LARGEST_POLE)])
    if laid.present.all() and found <= LARGEST_POLE:  # a longer one takes a drift for oscillations
        longer = _fit_recursion(laid.values)
        weights = weights if longer.size < 2 else longer
    kernel = np.concatenate([[1.0], -weights])
    filtered = np.convolve(laid.values, kernel)
    left = np.where(both, filtered[1 : laid.values.size], 0.0)
    root = smooth_spectrum_root(left, both, room=2 * left.size)  # the recursion rings on
    root /= np.abs(rfft(kernel, 2 * (root.size - 1)))
    return root, found


def _fit_recursion(values: FloatArray) -> FloatArray:
    """Weights (p,) of the past values in a recursion, by Burg; p by Akaike's criterion."""
    ahead, behind, weights = values[1:], values[:-1], np.zeros(0)
    power, best = float(np.mean(np.square(values))), np.zeros(0)
    least = values.size * np.log(power)
    for order in range(1, min(_LONGEST_RECURSION, round(values.size ** (1 / 3))) + 1):
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
    return best * min(1.0, LARGEST_POLE / max(steepest, LARGEST_POLE)) ** np.arange(
        1, best.size + 1
    )


def make_white_root(laid: SpacedResiduals) -> FloatArray:
    """The same of a series taken for white: (F,), as many as `estimate_spectrum_root` has of its size."""
    size = pad_length(3 * (laid.values.size - 1)) // 2 + 1
    mean = float(laid.values @ laid.values) / np.count_nonzero(laid.present)
    both_signs = np.full(size, 2.0)  # each frequency stands for its negative too
    both_signs[[0, -1]] = 1.0
    return np.asarray(np.sqrt(mean * both_signs / (2 * (size - 1))))


def transform_sensitivities(
    laid: SpacedResiduals, columns: FloatArray, root: FloatArray
) -> NDArray[np.complex128]:
    """Transforms (D, F) of the sensitivities (n, D) of a series, times a root (F,)."""
    spread = np.zeros((columns.shape[1], laid.values.size))
    spread[:, laid.present] = columns.T
    return np.asarray(rfft(spread, 2 * (root.size - 1), axis=1) * root)
