"""Sandwich (HAC) covariance of estimates with coloured residuals or unequal noise variances.

s²(SᵀS)⁻¹ assumes white residuals. Residuals of measured records are seldom white, and then it is
too small. If they are clearly coloured, the sandwich (SᵀS)⁻¹ Ω (SᵀS)⁻¹ replaces it. Its middle is
Ω = SᵀRS with the autocovariance R of each residual series (output errors: Ljung 1999, sec. 9.3).

R comes from a Parzen window whose width follows the colour, after prewhitening by an autoregression
(Andrews and Monahan 1992). Short records use a noise model instead
(`sysid.residuals.restricted_likelihood`). The autoregression is of first order, or of the order of
Akaike's criterion (Burg's method; den Haan and Levin 1997). A higher order is needed because for
slow noise plus white noise, the correlation of neighbours says too little. All this applies to free
runs only. One step ahead the sensitivities depend on measured outputs, and so on the noise.

Coloured samples carry less information than white ones. With first-order noise of pole a > 0, n
samples of a mean count as n(1 - a)/(1 + a) (Bayley and Hammersley 1946). This number sets the
degrees of freedom. If a is too near 1, the record is short compared with its drift, and the errors
are a lower bound. Different outputs are assumed independent here; see
`sysid.residuals.correlated_outputs`.

The noise variance can also differ between outputs and experiments. If it clearly does, or if the
weights were estimated from the residuals (`sysid.residuals.variances`), Ω has one variance for each
series. An interval then has the degrees of freedom of the series that determine it.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.fft import rfft
from numpy.typing import NDArray

from sysid.core.distributions import chi_square_tail, student_quantile
from sysid.core.types import FloatArray
from sysid.residuals.autocorrelation import (
    MIN_SAMPLES,
    ROUNDING_SHARE,
    SpacedResiduals,
    compute_whiteness,
    pad_length,
    smooth_spectrum_root,
    space_residuals,
)
from sysid.residuals.past_outputs import reads_outputs
from sysid.residuals.restricted_likelihood import MAX_POLE, NoiseColourModel, fit_noise_colour
from sysid.residuals.variances import count_used_degrees, have_unequal_variances
from sysid.simulation.problem import Problem

_SIGNIFICANCE = 1e-3
"""Level of the test for coloured residuals.

It is that of χ². With 25 lags of a short record the statistic varies more. So white residuals of 50
to 100 samples are taken for coloured in 1 % of the cases (decision 19)."""

CHI_SQUARE_95 = 3.841458820694124
"""95 % quantile of χ² with one degree of freedom."""

_SHORT_RECORD = 400
"""Samples: shorter records use a noise model if it fits, longer ones the window."""

_MAX_RECURSION_ORDER = 25  # past values of the autoregression

_MIN_WIDENING = 1e-3  # of the variance with white residuals: less is rounding

_EVEN_TOLERANCE = 1e-3  # of a period: steps that differ by less are equal


class ColouredCovariance(NamedTuple):
    """Ω (D, D) of the sandwich, and the equivalent number of white samples.

    `is_drifting`: the number is unknown, because the residuals wander over the whole record.
    `is_white`: the residuals are white, but of unequal variances. `is_clustered`: Ω is that of
    whole repeats. `series` has for each series its part of Ω and its degrees of freedom; empty:
    there is one series. `models` has the noise model of each series, or None.
    """

    middle: FloatArray
    equivalent_samples: float
    is_drifting: bool
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
        variance_ratio = max(
            float(direction @ self.middle @ direction) / (power * norm), _MIN_WIDENING
        )
        quantile_ratio = (
            float(student_quantile(self.compute_degrees(direction), 0.975)) ** 2 / CHI_SQUARE_95
        )
        return float(variance_ratio * quantile_ratio * self.equivalent_samples / self.degrees)


class ResidualPart(NamedTuple):
    """Scored samples of one output of one experiment: their rows among all, times, repeats."""

    experiment: int
    output: str
    rows: slice
    times: FloatArray
    largest_value: float
    repeats: FloatArray | None = None


def estimate_coloured_covariance(
    problem: Problem, influence: FloatArray, columns: FloatArray, *, by_model: bool = True
) -> ColouredCovariance | None:
    """Estimate the middle of the sandwich; None if the residuals are consistent with white noise.

    Parameters
    ----------
    influence : FloatArray, shape (n,)
        Influence of the weighted residuals of the scored samples on the loss.
    columns : FloatArray, shape (n, D)
        Sensitivities of these samples.
    by_model : bool
        Whether short series may use a noise model.
    """
    parts = [
        (part, _order_residuals(part, influence[part.rows])) for part in iterate_parts(problem)
    ]
    is_free = problem.prediction == "simulation" or not reads_outputs(problem.model)
    are_coloured = [
        is_free and _are_spaced_coloured(spaced, part.largest_value) for part, spaced in parts
    ]
    are_equal = problem.settings.deviations is None and not have_unequal_variances(
        [influence[part.rows] for part, _ in parts]
    )
    if not any(are_coloured) and are_equal:
        return None
    series = []
    for (part, _), has_colour in zip(parts, are_coloured, strict=True):
        part_columns, values = columns[part.rows], influence[part.rows]
        if has_colour:
            series.append(
                _estimate_series_covariance(
                    space_residuals(part.times, values), part_columns, by_model
                )
            )
        else:
            mean = float(np.mean(np.square(values)))
            series.append(
                ColouredCovariance(
                    mean * (part_columns.T @ part_columns), float(values.size), is_drifting=False
                )
            )
    used = count_used_degrees([columns[part.rows] for part, _ in parts])
    return _combine_series(series, used)._replace(is_white=not any(are_coloured))


def _combine_series(series: Sequence[ColouredCovariance], used: FloatArray) -> ColouredCovariance:
    """Combine Ω of several series.

    The degrees of freedom taken from a series make its residuals smaller than its noise. A noise
    model allows for that. The average loss over all series is not corrected here.
    """
    size, samples = len(series[0].middle), np.array([part.equivalent_samples for part in series])
    degrees = np.maximum(samples - used, 1.0)
    total = float(np.sum(samples))
    models = tuple(model for part in series for model in part.models or (None,))
    corrections = np.where([part is None for part in models], samples / degrees, 1.0)
    factors = corrections * (max(total - size, 1.0) / total)
    middles = [factor * part.middle for part, factor in zip(series, factors.tolist(), strict=True)]
    return ColouredCovariance(
        np.sum(middles, axis=0),
        total,
        any(part.is_drifting for part in series),
        series=tuple(zip(middles, degrees.tolist(), strict=True)),
        models=models,
    )


def is_coloured(part: ResidualPart, values: FloatArray) -> bool:
    """Return whether the residuals (n,) of a part are clearly not white."""
    return _are_spaced_coloured(_order_residuals(part, values), part.largest_value)


def iterate_parts(problem: Problem) -> Iterator[ResidualPart]:
    """Iterate over the series of a problem's scored samples, in their order."""
    measured = problem.split_by_output(problem.evaluator.weight * problem.evaluator.measured)
    weights = problem.split_by_output(problem.evaluator.weight)
    first = 0
    parts = zip(problem.records, weights, measured, strict=True)
    for experiment, (record, weight, sizes) in enumerate(parts):
        channels = {channel.name: channel for channel in record.outputs}
        for output, output_weight in weight.items():
            scored, channel = output_weight > 0, channels[output]
            n = int(np.count_nonzero(scored))
            if n:
                size = float(np.max(np.abs(sizes[output][scored])))
                rows = slice(first, first + n)
                repeats = None if channel.repeats is None else channel.repeats[scored]
                yield ResidualPart(experiment, output, rows, channel.times[scored], size, repeats)
            first += n


def _order_residuals(part: ResidualPart, values: FloatArray) -> SpacedResiduals:
    """Put residuals in order; space them on a grid only if samples are missing."""
    steps = np.diff(part.times)
    if steps.size and np.ptp(steps) > _EVEN_TOLERANCE * steps[0]:
        return space_residuals(part.times, values)
    return SpacedResiduals(
        part.times, values, np.ones(values.size, dtype=np.bool_), 1.0, is_regular=True
    )


def _are_spaced_coloured(spaced: SpacedResiduals, size: float) -> bool:
    n = np.count_nonzero(spaced.present)
    if (
        n < MIN_SAMPLES
        or float(np.sqrt(spaced.values @ spaced.values / n)) <= ROUNDING_SHARE * size
    ):
        return False
    whiteness = compute_whiteness(spaced)
    chance = float(chi_square_tail(spaced.n_lags, whiteness.statistic))
    if (
        n < _SHORT_RECORD and whiteness.values[0] > 0
    ):  # in short records many lags hide the first one
        chance = min(
            chance, float(chi_square_tail(1, (whiteness.values[0] / whiteness.deviation[0]) ** 2))
        )
    return chance < _SIGNIFICANCE


def _estimate_series_covariance(
    spaced: SpacedResiduals, columns: FloatArray, by_model: bool
) -> ColouredCovariance:
    """Estimate SᵀRS of one series."""
    root, pole = estimate_spectrum_root(spaced)
    is_short = np.count_nonzero(spaced.present) < _SHORT_RECORD
    colour = (
        fit_noise_colour(spaced, columns) if by_model and is_short and pole <= MAX_POLE else None
    )
    if colour is not None:
        samples = spaced.present.sum() * colour.sample_share
        return ColouredCovariance(
            colour.middle, float(samples), is_drifting=False, models=(colour,)
        )
    transformed = transform_sensitivities(spaced, columns, root)
    positive_pole = min(max(pole, 0.0), MAX_POLE)
    share = (1.0 - positive_pole) / (1.0 + positive_pole)
    n = np.count_nonzero(spaced.present)
    # For any colour the share is the mean of the spectrum over its value at frequency 0.
    power_at_zero = float(root[0] ** 2) * 2 * (root.size - 1)
    if power_at_zero > 0:
        share = min(share, float(spaced.values @ spaced.values) / n / power_at_zero)
    return ColouredCovariance(
        np.asarray((transformed @ transformed.conj().T).real), n * share, pole > MAX_POLE
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
    if (
        spaced.present.all() and pole <= MAX_POLE
    ):  # a higher order would take a drift for oscillations
        higher_order = _fit_recursion(spaced.values)
        weights = weights if higher_order.size < 2 else higher_order
    kernel = np.concatenate([[1.0], -weights])
    filtered = np.convolve(spaced.values, kernel)
    innovations = np.where(are_neighbours, filtered[1 : spaced.values.size], 0.0)
    root = smooth_spectrum_root(
        innovations, are_neighbours, room=2 * innovations.size
    )  # the autoregression rings on
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


def make_white_root(spaced: SpacedResiduals) -> FloatArray:
    """Make the spectrum root (F,) of a white series, as long as that of a coloured one."""
    size = pad_length(3 * (spaced.values.size - 1)) // 2 + 1
    mean = float(spaced.values @ spaced.values) / np.count_nonzero(spaced.present)
    both_signs = np.full(size, 2.0)  # each frequency stands for its negative too
    both_signs[[0, -1]] = 1.0
    return np.asarray(np.sqrt(mean * both_signs / (2 * (size - 1))))


def transform_sensitivities(
    spaced: SpacedResiduals, columns: FloatArray, root: FloatArray
) -> NDArray[np.complex128]:
    """Transform the sensitivities (n, D) of a series and multiply by a root (F,): (D, F)."""
    spaced_columns = np.zeros((columns.shape[1], spaced.values.size))
    spaced_columns[:, spaced.present] = columns.T
    return np.asarray(rfft(spaced_columns, 2 * (root.size - 1), axis=1) * root)
