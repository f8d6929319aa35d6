"""Tails and quantiles of distributions, by SciPy, which is loaded when one is computed first.

Loading it takes longer than many a search. `load_in_background` begins to load it while compiled
code runs, which leaves Python to other threads.
"""

from importlib import import_module
from threading import Thread
from typing import Any

from numpy.typing import ArrayLike

_LIBRARY = "scipy.special"


def load_in_background() -> None:
    """Begin to load the library in a thread."""
    Thread(target=import_module, args=(_LIBRARY,), name="load-distributions").start()


def chi_square_tail(degrees: ArrayLike, value: ArrayLike) -> Any:
    """Compute the probability that a χ² variable is larger than a value."""
    from scipy.special import chdtrc

    return chdtrc(degrees, value)


def chi_square_limit(degrees: ArrayLike, probability: ArrayLike) -> Any:
    """Compute the value that a χ² variable exceeds with a probability."""
    from scipy.special import chdtri

    return chdtri(degrees, probability)


def student_quantile(degrees: ArrayLike, probability: ArrayLike) -> Any:
    """Compute the value below which a variable of Student's t lies with a probability."""
    from scipy.special import stdtrit

    return stdtrit(degrees, probability)


def f_tail(numerator: ArrayLike, denominator: ArrayLike, value: ArrayLike) -> Any:
    """Compute the probability that an F variable is larger than a value."""
    from scipy.special import fdtrc

    return fdtrc(numerator, denominator, value)
