"""Sandwich covariance of estimates whose residuals are not one white noise.

s²(SᵀS)⁻¹ assumes white residuals of one variance. For others it is mostly too small. The sandwich
(SᵀS)⁻¹ Ω (SᵀS)⁻¹ replaces it, with Ω = SᵀRS and the covariance R of the residuals (Ljung 1999, sec.
9.3). R has a block for each series, and blocks between outputs that share their noise.

colour
    R of a coloured series comes from a Parzen window whose width follows the colour, after
    prewhitening by an autoregression (Andrews and Monahan 1992) of first order, or of the order of
    Akaike's criterion (Burg; den Haan and Levin 1997): for slow noise plus white noise, the
    correlation of neighbours says too little. Short records use a noise model
    (`sysid.residuals.restricted_likelihood`). This is for free runs only: one step ahead the
    sensitivities depend on the noise. With first-order noise of pole a > 0, n samples of a mean
    count as n(1 - a)/(1 + a) (Bayley and Hammersley 1946), which sets the degrees of freedom. If a
    is too near 1, the residuals drift over the record, and the errors are a lower bound.
unequal variances
    If those of series clearly differ, or were estimated (`sysid.uncertainty.unequal_noise`), an
    interval has the degrees of freedom of the series that determine it (Satterthwaite 1946).
correlated outputs
    If outputs of an experiment are clearly correlated at the same times, Ω gets their cross terms
    (Zellner 1962). The coherence is taken as equal at all frequencies, so the variance of a
    difference of outputs is never negative. Equal residuals count once: Σe² varies like that of
    n²/Σ r² of n independent ones, with the sum over all pairs.
repeats
    What samples pooled from repeats have in common belongs to their repeat, such as its supply
    pressure. So Ω sums the scores u = Sᵀe of whole repeats (Liang and Zeger 1986). The estimate
    follows each of few repeats. So a score is that of the residuals which the repeat would have if
    it had been left out: (I - MA)⁻¹u with its M = SᵀS and A = (SᵀS)⁻¹ of all, the jackknife (Bell
    and McCaffrey 2002, CR3). A record that was not pooled is one repeat. An interval has one degree
    of freedom less than the effective number of repeats (Carter, Schnepel, Steigerwald 2017).
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, groupby
from typing import NamedTuple

import numpy as np
from numpy.fft import rfft
from numpy.typing import NDArray

from sysid.core.distributions import CHI_SQUARE_95, chi_square_tail, student_limit
from sysid.core.types import RANK_TOLERANCE, FloatArray, IntArray
from sysid.residuals.autocorrelation import (
    MIN_SAMPLES,
    SpacedResiduals,
    pad_length,
    smooth_spectrum_root,
    space_residuals,
)
from sysid.residuals.past_outputs import reads_outputs
from sysid.residuals.restricted_likelihood import MAX_POLE, NoiseColourModel, fit_noise_colour
from sysid.residuals.series import (
    SHORT_RECORD,
    ResidualPart,
    count_used_degrees,
    have_unequal_variances,
    is_coloured,
    iterate_parts,
)
from sysid.simulation.problem import Problem

MIN_REPEATS = 5  # and two more than parameters: fewer say too little of their spread
_CORRELATION_LEVEL = 1e-3  # of the test for correlation between outputs
_MAX_RECURSION_ORDER = 25  # past values of the autoregression
_MIN_WIDENING = 1e-3  # of the variance with white residuals: less is rounding
_OTHER_SHARE = 1e-6  # of what is known of a parameter: less from the other repeats is nothing


class Sandwich(NamedTuple):
    """Ω (D, D) of the sandwich, and the equivalent number of white samples.

    `is_drifting`: the number is unknown, because the residuals wander over the whole record.
    `is_white`: no series is coloured. `is_clustered`: Ω is that of whole repeats. `series` has for
    each series its part of Ω and its degrees of freedom; empty: there is one series. `models` has
    the noise model of each series, or None.
    """

    middle: FloatArray
    equivalent_samples: float
    is_drifting: bool = False
    is_white: bool = False
    is_clustered: bool = False
    series: tuple[tuple[FloatArray, float], ...] = ()
    models: tuple[NoiseColourModel | None, ...] = ()

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the t distribution, at least one."""
        return max(self.equivalent_samples - len(self.middle), 1.0)

    def compute_degrees(self, direction: FloatArray) -> float:
        """Compute the degrees of freedom for one combination (D,) of Sᵀe (Satterthwaite 1946)."""
        variances = np.array([direction @ middle @ direction for middle, _ in self.series])
        if not np.sum(variances) > 0:
            return self.degrees
        degrees = np.array([degree for _, degree in self.series])
        for i, model in enumerate(self.models):
            if model is not None:
                degrees[i] = 2.0 / model.compute_variation(direction)
        return max(float(np.sum(variances) ** 2 / np.sum(variances**2 / degrees)), 1.0)

    def compute_widening(self, direction: FloatArray, power: float, norm: float) -> float:
        """Compute the squared factor by which an interval is wider than for white residuals.

        Parameters
        ----------
        direction : FloatArray, shape (D,)
            Combination of the sensitivities that other parameters cannot compensate.
        power, norm : float
            Mean square of the residuals; sum of squares of that combination.
        """
        variance = max(float(direction @ self.middle @ direction) / (power * norm), _MIN_WIDENING)
        quantile = student_limit(self.compute_degrees(direction), 0.025)
        ratio = variance * (quantile**2 / CHI_SQUARE_95)
        return float(ratio * self.equivalent_samples / self.degrees)


def estimate_sandwich(
    problem: Problem, influence: FloatArray, columns: FloatArray
) -> Sandwich | None:
    """Estimate the middle of the sandwich; None if the residuals are consistent with white noise.

    Parameters
    ----------
    influence : FloatArray, shape (n,)
        Influence of the weighted residuals of the scored samples on the loss.
    columns : FloatArray, shape (n, D)
        Sensitivities of these samples.
    """
    parts = list(iterate_parts(problem))
    clustered = _estimate_by_repeats(parts, influence, columns)
    if clustered is not None:
        return clustered
    pairs = list(_find_correlated_pairs(parts, influence))
    is_free = problem.is_free_run or not reads_outputs(problem.model)
    are_coloured = [is_free and is_coloured(part, influence[part.rows]) for part in parts]
    are_equal = problem.settings.deviations is None and not have_unequal_variances(
        [influence[part.rows] for part in parts]
    )
    if any(are_coloured) or not are_equal:
        whole = _combine_series(
            [
                # with cross terms, the same method for all series
                _estimate_series(part, influence, columns, has_colour, by_model=not pairs)
                for part, has_colour in zip(parts, are_coloured, strict=True)
            ],
            count_used_degrees([columns[part.rows] for part in parts]),
        )
    elif pairs:
        power = float(np.mean(np.square(influence)))
        whole = Sandwich(power * (columns.T @ columns), float(influence.size))
    else:
        return None
    whole = whole._replace(is_white=not any(are_coloured))
    return _add_cross_terms(whole, pairs, are_coloured, influence, columns) if pairs else whole


def count_repeats(problem: Problem) -> int:
    """Count the repeats that the scored samples were pooled from; 0 if none was pooled."""
    return len(_list_repeats(list(iterate_parts(problem))))


def _list_repeats(parts: Sequence[ResidualPart]) -> list[IntArray]:
    """List the scored samples of each repeat of each experiment; none if none was pooled."""
    if all(part.repeats is None for part in parts):
        return []
    clusters: dict[tuple[int, float], list[IntArray]] = {}
    for part in parts:
        numbers = np.zeros(part.times.size) if part.repeats is None else part.repeats
        for number in np.unique(numbers).tolist():
            rows = part.rows.start + np.flatnonzero(numbers == number)
            clusters.setdefault((part.experiment, number), []).append(rows)
    return [np.concatenate(rows) for rows in clusters.values()]


def _estimate_by_repeats(
    parts: Sequence[ResidualPart], influence: FloatArray, columns: FloatArray
) -> Sandwich | None:
    """Estimate Ω by repeats; None if there are too few, or if one alone tells of a parameter."""
    clusters, (n, d) = _list_repeats(parts), columns.shape
    g = len(clusters)
    if g < max(MIN_REPEATS, d + 2):
        return None
    squares = [columns[rows].T @ columns[rows] for rows in clusters]
    inverse = np.linalg.pinv(columns.T @ columns, rcond=RANK_TOLERANCE**2, hermitian=True)
    middle = np.zeros((d, d))
    for rows, square in zip(clusters, squares, strict=True):
        others = np.eye(d) - square @ inverse
        if np.min(np.linalg.eigvals(others).real) < _OTHER_SHARE:
            return None
        score = np.linalg.solve(others, columns[rows].T @ influence[rows])
        middle += np.outer(score, score)
    share = (g - 1.0) / g
    return Sandwich(
        middle * share * (n - d) / n,  # not corrected twice for the degrees of freedom
        float(n),
        is_clustered=True,
        series=tuple((square, share) for square in squares),
    )


def _estimate_series(
    part: ResidualPart,
    influence: FloatArray,
    columns: FloatArray,
    has_colour: bool,
    *,
    by_model: bool,
) -> Sandwich:
    """Estimate SᵀRS of one series; that of a short one by a noise model, if that is allowed."""
    values, slopes = influence[part.rows], columns[part.rows]
    if not has_colour:
        return Sandwich(float(np.mean(np.square(values))) * (slopes.T @ slopes), float(values.size))
    spaced = space_residuals(part.times, values)
    root, pole = estimate_spectrum_root(spaced)
    if by_model and values.size < SHORT_RECORD and pole <= MAX_POLE:
        colour = fit_noise_colour(spaced, slopes)
        if colour is not None:
            samples = float(values.size * colour.sample_share)
            return Sandwich(colour.middle, samples, models=(colour,))
    transformed = _transform_sensitivities(spaced, slopes, root)
    positive_pole = min(max(pole, 0.0), MAX_POLE)
    share = (1.0 - positive_pole) / (1.0 + positive_pole)
    # For any colour the share is the mean of the spectrum over its value at frequency 0.
    power_at_zero = float(root[0] ** 2) * 2 * (root.size - 1)
    if power_at_zero > 0:
        share = min(share, float(spaced.values @ spaced.values) / values.size / power_at_zero)
    return Sandwich(
        np.asarray((transformed @ transformed.conj().T).real), values.size * share, pole > MAX_POLE
    )


def _combine_series(series: Sequence[Sandwich], used: FloatArray) -> Sandwich:
    """Combine Ω of several series.

    The degrees of freedom taken from a series make its residuals smaller than its noise. A noise
    model allows for that. The average loss over all series is not corrected here.
    """
    size, samples = len(series[0].middle), np.array([one.equivalent_samples for one in series])
    degrees = np.maximum(samples - used, 1.0)
    total = float(np.sum(samples))
    models = tuple(model for one in series for model in one.models or (None,))
    corrections = np.where([model is None for model in models], samples / degrees, 1.0)
    factors = corrections * (max(total - size, 1.0) / total)
    middles = [factor * one.middle for one, factor in zip(series, factors.tolist(), strict=True)]
    return Sandwich(
        np.sum(middles, axis=0),
        total,
        any(one.is_drifting for one in series),
        series=tuple(zip(middles, degrees.tolist(), strict=True)),
        models=models,
    )


def estimate_spectrum_root(spaced: SpacedResiduals) -> tuple[FloatArray, float]:
    """Estimate the root (F,) of the spectrum of a series, and its first-order pole.

    The spectrum is that of the prewhitened series (`smooth_spectrum_root`), recoloured by the
    autoregression.
    """
    are_neighbours = spaced.present[1:] & spaced.present[:-1]
    before, after = spaced.values[:-1][are_neighbours], spaced.values[1:][are_neighbours]
    pole = float(before @ after / (before @ before))
    weights = np.array([min(max(pole, -MAX_POLE), MAX_POLE)])
    # a higher order would take a drift for oscillations
    if spaced.present.all() and pole <= MAX_POLE:
        higher_order = _fit_recursion(spaced.values)
        weights = weights if higher_order.size < 2 else higher_order
    kernel = np.concatenate([[1.0], -weights])
    filtered = np.convolve(spaced.values, kernel)
    innovations = np.where(are_neighbours, filtered[1 : spaced.values.size], 0.0)
    room = 2 * innovations.size  # the autoregression rings on
    root = smooth_spectrum_root(innovations, are_neighbours, room)
    root /= np.abs(rfft(kernel, 2 * (root.size - 1)))
    return root, pole


def _fit_recursion(values: FloatArray) -> FloatArray:
    """Fit an autoregression (p,) by Burg's method; the order p by Akaike's criterion."""
    forward, backward, weights = values[1:], values[:-1], np.zeros(0)
    power, best = float(np.mean(np.square(values))), np.zeros(0)
    least = values.size * np.log(power)
    for order in range(1, min(_MAX_RECURSION_ORDER, round(values.size ** (1 / 3))) + 1):
        power_sum = float(forward @ forward + backward @ backward)
        if not power_sum > 0:
            break
        reflected = 2.0 * float(forward @ backward) / power_sum
        weights = np.append(weights - reflected * weights[::-1], reflected)
        power *= 1.0 - reflected**2
        forward, backward = (
            (forward - reflected * backward)[1:],
            (backward - reflected * forward)[:-1],
        )
        if not power > 0:
            break
        criterion = values.size * np.log(power) + 2.0 * order
        if criterion < least:
            least, best = criterion, weights
    steepest = float(np.max(np.abs(np.roots(np.append(1.0, -best))), initial=0.0))
    return best * min(1.0, MAX_POLE / max(steepest, MAX_POLE)) ** np.arange(1, best.size + 1)


def _make_white_root(spaced: SpacedResiduals) -> FloatArray:
    """Make the spectrum root (F,) of a white series, as long as that of a coloured one."""
    size = pad_length(3 * (spaced.values.size - 1)) // 2 + 1
    mean = float(spaced.values @ spaced.values) / np.count_nonzero(spaced.present)
    both_signs = np.full(size, 2.0)  # each frequency stands for its negative too
    both_signs[[0, -1]] = 1.0
    return np.asarray(np.sqrt(mean * both_signs / (2 * (size - 1))))


def _transform_sensitivities(
    spaced: SpacedResiduals, columns: FloatArray, root: FloatArray
) -> NDArray[np.complex128]:
    """Transform the sensitivities (n, D) of a series and multiply by a root (F,): (D, F)."""
    spaced_columns = np.zeros((columns.shape[1], spaced.values.size))
    spaced_columns[:, spaced.present] = columns.T
    return np.asarray(rfft(spaced_columns, 2 * (root.size - 1), axis=1) * root)


class _CorrelatedPair(NamedTuple):
    """Two series at the times that they share, their rows, their correlation and its p-value."""

    series: tuple[int, int]
    times: FloatArray
    rows: tuple[IntArray, IntArray]
    correlation: float
    chance: float


def _find_correlated_pairs(
    parts: Sequence[ResidualPart], influence: FloatArray
) -> Iterator[_CorrelatedPair]:
    """Find the pairs of outputs in experiments with common noise.

    All pairs of such an experiment count: a part of them might form an impossible covariance.
    """
    for _, group in groupby(range(len(parts)), key=lambda i: parts[i].experiment):
        correlated = [_correlate_series(parts, pair, influence) for pair in combinations(group, 2)]
        pairs = [pair for pair in correlated if pair is not None]
        if any(pair.chance < _CORRELATION_LEVEL / len(pairs) for pair in pairs):
            yield from pairs


def _correlate_series(
    parts: Sequence[ResidualPart], series: tuple[int, int], influence: FloatArray
) -> _CorrelatedPair | None:
    """Correlate two series (n,) at their common times; None if these are few, or a series is 0.

    For series with poles p and q the variance of a correlation is (1 + pq)/(1 - pq)/n (Bartlett
    1935).
    """
    part_a, part_b = (parts[i] for i in series)
    times, i, j = np.intersect1d(part_a.times, part_b.times, return_indices=True)
    rows = part_a.rows.start + i, part_b.rows.start + j
    a, b = influence[rows[0]], influence[rows[1]]
    size = float(np.sqrt((a @ a) * (b @ b)))
    if times.size < MIN_SAMPLES or not size > 0:
        return None
    correlation = float(a @ b) / size
    poles = max(float((a[1:] @ a[:-1]) * (b[1:] @ b[:-1]) / size**2), 0.0)
    widening = (1.0 + poles) / (1.0 - poles)
    chance = chi_square_tail(1, correlation**2 * a.size / widening)
    return _CorrelatedPair(series, times, rows, correlation, chance)


def _add_cross_terms(
    whole: Sandwich,
    pairs: Sequence[_CorrelatedPair],
    are_coloured: Sequence[bool],
    influence: FloatArray,
    columns: FloatArray,
) -> Sandwich:
    """Add SᵢᵀE[eᵢeⱼᵀ]Sⱼ of correlated outputs; equal residuals count once."""
    middle, double_counted = whole.middle, 0.0
    for pair in pairs:
        errors, slopes = ([values[rows] for rows in pair.rows] for values in (influence, columns))
        colours = [are_coloured[i] for i in pair.series]
        term = float(errors[0] @ errors[1]) / pair.times.size * (slopes[0].T @ slopes[1])
        if any(colours):
            transformed = []
            for error, slope, has_colour in zip(errors, slopes, colours, strict=True):
                spaced = space_residuals(pair.times, error)
                root = estimate_spectrum_root(spaced)[0] if has_colour else _make_white_root(spaced)
                transformed.append(_transform_sensitivities(spaced, slope, root))
            term = pair.correlation * (transformed[0] @ transformed[1].conj().T).real
        middle = middle + term + term.T
        double_counted += 2.0 * pair.times.size * pair.correlation**2
    size, vectors = np.linalg.eigh(middle)
    if size[0] < 0.0:  # if outputs with missing samples nearly cancel
        middle = (vectors * np.maximum(size, 0.0)) @ vectors.T
    share = 1.0 / (1.0 + double_counted / influence.size)
    return whole._replace(
        middle=middle,
        equivalent_samples=whole.equivalent_samples * share,
        series=tuple((one, max(share * degrees, 1.0)) for one, degrees in whole.series),
    )
