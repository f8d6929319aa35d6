"""First-order noise taken out of residuals, by what each sample owes to the one before.

Noise with the autocorrelation exp(-Δ/τ) over a time Δ, in continuous time an Ornstein-Uhlenbeck
process, at even samples an AR(1): given the sample before, no earlier one says more. So with
a = exp(-Δ/τ) the values (e(k) - a e(k-1))/√(1 - a²), and the first one as it is, are white and have
the variance of the noise. Samples that are missing or uneven only make some Δ longer.
"""

from dataclasses import dataclass

import numpy as np

from sysid.core.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """What each of n samples owes to the one before it, series after series.

    Attributes
    ----------
    owed : FloatArray, shape (n,)
        a; 0 where a series begins.
    n_times : int
        Correlation times that were estimated for it.
    """

    ar1_coefficient: FloatArray
    n_correlation_times: int = 0

    def whiten(self, values: FloatArray) -> FloatArray:
        """Values (..., n) of samples without what they owe."""
        white = np.array(values)
        white[..., 1:] -= self.ar1_coefficient[1:] * values[..., :-1]
        return white / self._innovation_deviation

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the correlation matrix."""
        return float(2.0 * np.sum(np.log(self._innovation_deviation)))

    @property
    def equivalent_samples(self) -> float:
        """How many white samples would say as much of a mean (Bayley and Hammersley 1946)."""
        return float(np.sum((1.0 - self.ar1_coefficient) / (1.0 + self.ar1_coefficient)))

    @property
    def _innovation_deviation(self) -> FloatArray:
        """Standard deviation of what is not owed, of that of the noise."""
        return np.sqrt(1.0 - np.square(self.ar1_coefficient))


def compute_ar1_coefficient(times: FloatArray, correlation_time: float) -> FloatArray:
    """What samples (n,) at some times (s) owe to the one before, 0 for a `correlation_time` of 0.

    Samples at one time owe no more than those a thousandth of the mean step apart.
    """
    found = np.zeros(times.size)
    if correlation_time > 0 and times.size > 1:
        steps = np.diff(times)
        least = 1e-3 * float(times[-1] - times[0]) / steps.size
        found[1:] = np.exp(-np.maximum(steps, least) / correlation_time)
    return found
