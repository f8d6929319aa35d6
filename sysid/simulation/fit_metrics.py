"""Agreement of a simulation with a measurement: RMS and fit in percent."""

from dataclasses import dataclass

import numpy as np

from sysid.core.types import FloatArray

EXPLAINED_PERCENT = 99.999
"""Fit (%) from which on what is left are errors of the solver."""


def compute_mean(values: FloatArray) -> float:
    """Compute the mean, with the bits of NumPy's. That takes longer for so few values."""
    total: np.float64 = np.add.reduce(values, axis=None)
    return float(total / values.size)


def rms(residual: FloatArray) -> float:
    """Compute √mean e² (Eq. 10) in the residual's unit."""
    return float(np.sqrt(compute_mean(np.square(residual))))


def compute_fit_percent(measured: FloatArray, simulated: FloatArray) -> float:
    """Compute 100 (1 - ‖y - ŷ‖ / ‖y - mean y‖): 100 is perfect, 0 as good as the mean.

    ``nan`` for a constant measurement, for which the ratio is undefined.
    """
    if np.ptp(measured) == 0.0:  # equal values may differ from their mean by a rounding
        return float("nan")
    spread = float(np.linalg.norm(measured - compute_mean(measured)))
    return 100.0 * (1.0 - float(np.linalg.norm(measured - simulated)) / spread)


def compute_line_rms(x: FloatArray, y: FloatArray) -> float:
    """Compute the RMS of the best straight line; ``nan`` for less than three samples."""
    if y.size < 3:
        return float("nan")
    centred = x - compute_mean(x)
    spread = float(centred @ centred)
    slope = float(centred @ (y - compute_mean(y))) / spread if spread > 0 else 0.0
    return rms(y - (compute_mean(y) + slope * centred))


@dataclass(frozen=True, slots=True)
class ChannelMetrics:
    """Agreement of one output of one experiment, over its scored samples.

    Attributes
    ----------
    experiment : int
        Record, from 0.
    output : str
        Output of the model.
    unit : str
        Unit of the RMS.
    samples : int
        Scored samples.
    rms : float
        RMS error, in `unit`.
    fit_percent : float
        Fit, %; not a number if the output does not vary.
    span : tuple of float
        Least and largest measured value, in `unit`. The estimate holds for such amplitudes.
    line_rms : float
        RMS error of a straight line through the samples, in `unit`; not a number for less than
        three.
    """

    experiment: int
    output: str
    unit: str
    samples: int
    rms: float
    fit_percent: float
    span: tuple[float, float] = (float("nan"), float("nan"))
    line_rms: float = float("nan")

    @property
    def is_worse_than_line(self) -> bool:
        """Whether a straight line fits better than the model, by more than errors of the solver."""
        return self.rms > self.line_rms and not self.fit_percent >= EXPLAINED_PERCENT


@dataclass(frozen=True, slots=True)
class Metrics:
    """Agreement over all experiments and outputs.

    Attributes
    ----------
    rms : float
        J of Eq. 10: unweighted, in the output's unit, for one output; weighted for several.
    unit : str
    fit_percent : float
        Over all scored samples, each output of each experiment about its own mean, weighted.
    channels : tuple of ChannelMetrics
    """

    rms: float
    unit: str
    fit_percent: float
    channels: tuple[ChannelMetrics, ...]


@dataclass(frozen=True, slots=True)
class PredictionError:
    """Error of predictions so many samples ahead.

    Attributes
    ----------
    samples : int
        Samples ahead.
    time : float
        Mean time ahead, s.
    rms : float or None
        RMS error, in the unit of the result's `rms`; none if a prediction diverged.
    """

    samples: int
    time: float
    rms: float | None
