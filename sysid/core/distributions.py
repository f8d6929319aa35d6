"""Tails of the χ², F and Student's t distributions, and the values with a given tail, by SciPy.

SciPy is loaded when one is computed first. Loading it takes longer than many a search.
`load_in_background` begins to load it while compiled code runs, which leaves Python to other
threads.
"""

from functools import lru_cache
from importlib import import_module
from threading import Thread

CHI_SQUARE_95 = 3.841458820694124
"""95 % quantile of χ² with one degree of freedom: the limit of a likelihood ratio (Wilks 1938)."""

_LIBRARY = "scipy.special"


def load_in_background() -> None:
    """Begin to load the library in a thread."""
    Thread(target=import_module, args=(_LIBRARY,), name="load-distributions").start()


def chi_square_tail(degrees: float, value: float) -> float:
    """Compute the probability that a χ² variable exceeds a value."""
    from scipy.special import chdtrc

    return float(chdtrc(degrees, value))


@lru_cache
def chi_square_limit(degrees: float, probability: float) -> float:
    """Compute the value that a χ² variable exceeds with a probability."""
    from scipy.special import chdtri

    return float(chdtri(degrees, probability))


def f_tail(numerator: float, denominator: float, value: float) -> float:
    """Compute the probability that an F variable exceeds a value."""
    from scipy.special import fdtrc

    return float(fdtrc(numerator, denominator, value))


def student_tail(degrees: float, value: float) -> float:
    """Compute the probability that a variable of Student's t exceeds a value."""
    from scipy.special import stdtr

    return float(stdtr(degrees, -value))


@lru_cache
def student_limit(degrees: float, probability: float) -> float:
    """Compute the value that a variable of Student's t exceeds with a probability."""
    from scipy.special import stdtrit

    return -float(stdtrit(degrees, probability))
