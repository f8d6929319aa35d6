"""Parts of a result: minima and how far the search is to be trusted, holds, orders of a process."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import log
from typing import Literal

import numpy as np

from sysid.core.distributions import chi_square_limit
from sysid.core.settings import FoundNoiseModel
from sysid.core.types import FloatArray
from sysid.data.holds import Hold
from sysid.simulation.fit_metrics import PredictionError

STRONG_EVIDENCE = 6.0
"""Difference of BIC: odds of 20 to 1 (Kass and Raftery 1995)."""
_CHANCE = 0.05  # of a gain of the likelihood by more parameters alone (Wilks 1938)


@dataclass(frozen=True, slots=True)
class Minimum:
    """A minimum of the loss.

    Attributes
    ----------
    parameters : mapping of str to float
        Values of the free parameters, in their units.
    rms : float
        RMS error, in the unit of the result's `rms`.
    count : int
        How many least-squares fits ended in it, in the search and after it.
    independent : int
        How many of them began at random points.
    likelihood_ratio : float
        n ln(Σe²/Σe²₀) to the best minimum, twice the logarithm of the ratio of likelihoods, made
        smaller for coloured residuals.
    is_compatible : bool
        Whether the data do not rule it out.
    recorded_from : float or None
        Compared from this time of each record on, s, where the input is recorded; none: all of it.
    """

    parameters: Mapping[str, float]
    rms: float
    count: int
    independent: int
    likelihood_ratio: float
    is_compatible: bool
    recorded_from: float | None = None

    @property
    def values(self) -> FloatArray:
        """Values of the free parameters (D,)."""
        return np.array([*self.parameters.values()])


@dataclass(frozen=True, slots=True)
class SearchEvidence:
    """What a result knows of the whole search.

    Attributes
    ----------
    settled : bool
        Whether the search settled.
    because : {"starts", "residuals"} or None
        What shows it; none if nothing does.
    independent_starts : int
        Local searches from random points.
    agreeing_starts : int
        How many of them ended in the best minimum.
    minima : tuple of Minimum
        Minima in which least squares ended after the search, the lowest first.
    """

    settled: bool
    because: Literal["starts", "residuals"] | None
    independent_starts: int
    agreeing_starts: int
    minima: tuple[Minimum, ...] = ()


@dataclass(frozen=True, slots=True)
class InputHold:
    """How an input is read between its samples.

    Attributes
    ----------
    input : str
        Input of the model.
    chosen : {"zero", "first", "band-limited", "mean", "mean-after"}
        How it was read.
    reason : str or None
        Reason of a choice by the values; none if the hold was given.
    other : {"zero", "first"} or None
        The reading that was not chosen; none if the hold was given or has no effect.
    estimates_other : mapping of str to float, or None
        Estimates of the free parameters with the other reading, from the estimates by least
        squares, in their units; none if they were not computed.
    rms_other : float or None
        RMS error with the other reading, in the unit of the result's `rms`.
    """

    input: str
    chosen: Hold
    reason: str | None
    other: Hold | None = None
    estimates_other: Mapping[str, float] | None = None
    rms_other: float | None = None


@dataclass(frozen=True, slots=True)
class OrderFit:
    """A process of one order, fitted to the samples of an identification.

    Attributes
    ----------
    model : str
        Its name in the catalogue.
    order : int
        Number of poles.
    delay : float
        Dead time, in the comparison's `unit`.
    delay_stderr : float or None
        Standard error of the dead time, in the same unit.
    values : mapping of str to float
        All parameters of that model, in their units.
    rms : float
        RMS error, in the unit of the result's `rms`.
    bic : float
        Criterion of Schwarz, smaller is better; with the noise model of the comparison.
    is_open : bool
        Whether its BIC is within 6 of the lowest: no strong evidence against it.
    leaves_noise : bool
        Whether it tells all its parameters and leaves nothing but noise. Only of the preferred
        order this is looked for.
    """

    model: str
    order: int
    delay: float
    delay_stderr: float | None
    values: Mapping[str, float]
    rms: float
    bic: float
    is_open: bool = True
    leaves_noise: bool = True


@dataclass(frozen=True, slots=True)
class OrderComparison:
    """The model's order, one order less and one more, fitted to the same samples.

    Attributes
    ----------
    model : str
        The catalogue's name of the model's own order.
    preferred_model : str or None
        The one order that is open; none if there are several.
    delay : str
        The model's parameter that is the dead time.
    unit : str
        Unit of the dead times.
    delay_range : tuple of float
        Smallest and largest dead time of the open orders, in `unit`.
    noise_model : {"white", "ar1", "load"}
        Noise model of the criteria.
    fits : tuple of OrderFit
        The orders, the lowest first.
    """

    model: str
    preferred_model: str | None
    delay: str
    unit: str
    delay_range: tuple[float, float]
    noise_model: FoundNoiseModel
    fits: tuple[OrderFit, ...]

    @property
    def own_fit(self) -> OrderFit:
        """The fit of the model's own order."""
        return next(fit for fit in self.fits if fit.model == self.model)

    @property
    def open_fits(self) -> tuple[OrderFit, ...]:
        """The orders without strong evidence against them."""
        return tuple(fit for fit in self.fits if fit.is_open)


@dataclass(frozen=True, slots=True)
class NoiseSource:
    """A source of noise, and its size.

    Attributes
    ----------
    place : str
        The output, input or state where it acts.
    kind : {"sensor", "plant", "load"}
        White noise of a sensor, diffusion of a state, or a slow load.
    deviation : float
        Standard deviation, in `unit`; of a diffusion that after one second.
    unit : str
        Its unit.
    correlation_time : float or None
        Correlation time of a load, s.
    """

    place: str
    kind: Literal["sensor", "plant", "load"]
    deviation: float
    unit: str
    correlation_time: float | None


@dataclass(frozen=True, slots=True)
class PlantNoise:
    """Noise inside the plant, and errors from one sample ahead to the free run.

    Attributes
    ----------
    sources : tuple of NoiseSource
        The sensors, then the noise inside the plant.
    rms_free : float or None
        RMS error of the free run with the same estimates, in the unit of the result's `rms`; none
        if it diverges.
    fit_free : float or None
        Its fit, %.
    prediction_errors : tuple of PredictionError
        RMS errors of predictions 1, 2, 5, 10, … samples ahead, up to a tenth of the shortest
        record.
    """

    sources: tuple[NoiseSource, ...]
    rms_free: float | None
    fit_free: float | None
    prediction_errors: tuple[PredictionError, ...] = ()


def find_sensor_weights(noise: PlantNoise, values: Mapping[str, float]) -> dict[str, float]:
    """Find the weight w of each output in a filter: 1/w is its sensor's relative deviation.

    Sizes of noise among the `values` of the parameters are relative to the same deviation.
    """
    relative_to = [
        one.deviation / values[f"{'load' if one.kind == 'load' else 'noise'}[{one.place}]"]
        for one in noise.sources
        if one.kind != "sensor"
    ]
    return {
        one.place: relative_to[0] / one.deviation if one.deviation > 0.0 else 1.0
        for one in noise.sources
        if one.kind == "sensor"
    }


def _is_open(fit: OrderFit, best: OrderFit, samples: int) -> bool:
    """Whether the data do not rule out an order, and speak for the parameters that it has more."""
    more = len(fit.values) - len(best.values)
    gain = best.bic - fit.bic + more * log(samples)
    if more > 0 and gain <= chi_square_limit(more, _CHANCE):
        return False
    return fit.bic <= best.bic + STRONG_EVIDENCE


def compare_fits(
    model: str,
    delay: str,
    unit: str,
    noise_model: FoundNoiseModel,
    fits: Sequence[OrderFit],
    samples: int,
) -> OrderComparison:
    """Compare orders fitted to so many samples by their BIC: which are open, which is preferred.

    One with more parameters than the best is open only if its likelihood gains more than by chance.

    Examples
    --------
    >>> first = OrderFit("fopdt", 1, 1.57, 0.01, {"L": 1.57}, 0.027, -1264.0)
    >>> second = OrderFit("sopdt", 2, 1.33, 0.01, {"L": 1.33}, 0.019, -1474.0)
    >>> comparison = compare_fits("fopdt", "L", "s", "white", (first, second), 300)
    >>> comparison.preferred_model, comparison.delay_range
    ('sopdt', (1.33, 1.33))
    """
    best = min(fits, key=lambda fit: fit.bic)
    judged = tuple(replace(fit, is_open=_is_open(fit, best, samples)) for fit in fits)
    open_fits = [fit for fit in judged if fit.is_open]
    delays = [fit.delay for fit in open_fits]
    preferred = open_fits[0].model if len(open_fits) == 1 else None
    ends = (min(delays), max(delays))
    return OrderComparison(model, preferred, delay, unit, ends, noise_model, judged)
