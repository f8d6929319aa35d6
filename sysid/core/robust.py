"""Statistics that outliers hardly change."""

import numpy as np

from sysid.core.types import FloatArray

_NORMAL = 1.4826  # deviation of normal values, over the median of their sizes


def estimate_deviation(values: FloatArray) -> float:
    """Estimate the deviation of values (n,) around 0, as if their bulk were normal.

    By the median of their sizes (Hampel, J. Am. Stat. Assoc. 69 (1974) 383).

    Examples
    --------
    >>> round(estimate_deviation(np.array([-1.0, 0.5, 1.0, -0.2, 900.0])), 4)
    1.4826
    """
    return _NORMAL * float(np.median(np.abs(values)))
