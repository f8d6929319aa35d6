"""AR(1) prewhitening of residuals with the coefficient of each sample.

The noise has the autocorrelation exp(-Δ/τ) over a time Δ. In continuous time this is an
Ornstein–Uhlenbeck process, at even samples an AR(1). Given the previous sample, earlier ones add no
information. So with a = exp(-Δ/τ) the values (e(k) - a e(k-1))/√(1 - a²) are white, with the
variance of the noise. The first value stays. Missing or uneven samples only make some Δ longer.
"""

from dataclasses import dataclass

import numpy as np

from sysid.core.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """AR(1) coefficient of each of n samples, series after series.

    Attributes
    ----------
    ar1_coefficient : FloatArray, shape (n,)
        a; 0 where a series begins.
    n_correlation_times : int
        Number of correlation times that were estimated.
    """

    ar1_coefficient: FloatArray
    n_correlation_times: int = 0

    def whiten(self, values: FloatArray) -> FloatArray:
        """Whiten values (..., n) of the samples."""
        white = np.array(values)
        with np.errstate(invalid="ignore"):  # a simulation that diverged
            white[..., 1:] -= self.ar1_coefficient[1:] * values[..., :-1]
        return white / self._innovation_deviation

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the correlation matrix."""
        return float(2.0 * np.sum(np.log(self._innovation_deviation)))

    @property
    def equivalent_samples(self) -> float:
        """Equivalent number of white samples for a mean (Bayley and Hammersley 1946)."""
        return float(np.sum((1.0 - self.ar1_coefficient) / (1.0 + self.ar1_coefficient)))

    @property
    def _innovation_deviation(self) -> FloatArray:
        """Standard deviation of the innovations, relative to that of the noise."""
        return np.sqrt(1.0 - np.square(self.ar1_coefficient))


def compute_ar1_coefficient(times: FloatArray, correlation_time: float) -> FloatArray:
    """Compute the AR(1) coefficient of samples (n,) at some times (s); 0 without correlation time.

    Samples at the same time count as a thousandth of the mean step apart.
    """
    coefficient = np.zeros(times.size)
    if correlation_time > 0 and times.size > 1:
        steps = np.diff(times)
        least = 1e-3 * float(times[-1] - times[0]) / steps.size
        coefficient[1:] = np.exp(-np.maximum(steps, least) / correlation_time)
    return coefficient
