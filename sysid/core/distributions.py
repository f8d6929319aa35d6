"""Tails of the χ², F and Student's t distributions, and the values with a given tail.

They follow from the incomplete gamma and beta functions, by a series and continued fractions
(DLMF 8.7, 8.9, 8.17). SciPy's are the same to twelve digits. Loading these takes longer than many
a search.
"""

from collections.abc import Callable, Iterable
from functools import lru_cache
from itertools import count
from math import exp, inf, lgamma, log, log1p, nan, pi, sqrt
from statistics import NormalDist

_ROUNDING = 4e-16
_STIRLING_FROM = 16.0  # five terms of the series are exact from here on
_LAST_CHANGE = 1e-8  # of Newton's method: the next one would be the square of it

_Tail = tuple[float, float]
"""Probability that a variable exceeds a value, and how fast it falls with the value's logarithm."""


def chi_square_tail(degrees: float, value: float) -> float:
    """Compute the probability that a χ² variable exceeds a value."""
    return _compute_chi_square_tail(float(degrees), float(value))[0]


@lru_cache
def chi_square_limit(degrees: float, probability: float) -> float:
    """Compute the value that a χ² variable exceeds with a probability of at most 1/2."""
    normal, spread = -NormalDist().inv_cdf(probability), 2.0 / (9.0 * degrees)
    start = degrees * (1.0 - spread + normal * sqrt(spread)) ** 3  # Wilson and Hilferty 1931
    return _find_limit(lambda x: _compute_chi_square_tail(degrees, x), start, probability)


def f_tail(numerator: float, denominator: float, value: float) -> float:
    """Compute the probability that an F variable exceeds a value."""
    return _compute_f_tail(float(numerator), float(denominator), float(value))[0]


def student_tail(degrees: float, value: float) -> float:
    """Compute the probability that a variable of Student's t exceeds a value."""
    above = _compute_student_tail(float(degrees), abs(float(value)))[0]
    return 1.0 - above if value < 0.0 else above


@lru_cache
def student_limit(degrees: float, probability: float) -> float:
    """Compute the value that a variable of Student's t exceeds with a probability below 1/2."""
    normal = -NormalDist().inv_cdf(probability)
    if not 0.0 < degrees < inf:
        return normal if degrees == inf else nan
    start = normal + (normal**3 + normal) / (4.0 * degrees)  # Fisher and Cornish 1960
    return _find_limit(lambda t: _compute_student_tail(degrees, t), start, probability)


def _find_limit(compute_tail: Callable[[float], _Tail], start: float, probability: float) -> float:
    """Find the value that is exceeded with a probability.

    Newton's method for the logarithms of both. That curve is concave: every start converges.
    """
    value, change = start, inf
    while abs(change) > _LAST_CHANGE:
        tail, fall = compute_tail(value)
        change = log(tail / probability) * tail / fall
        value *= exp(change)
    return value


def _compute_chi_square_tail(degrees: float, value: float) -> _Tail:
    """Compute the upper incomplete gamma function Q(a, x), and x dQ/dx."""
    a, x = degrees / 2.0, value / 2.0
    if not (a > 0.0 and x > 0.0):
        return (1.0, 0.0) if a > 0.0 and x <= 0.0 else (nan, nan)
    if x == inf:
        return 0.0, 0.0
    power = a * _log_ratio(x, a, x - a) - (x - a) - _stirling_rest(a)
    weight = sqrt(a / (2.0 * pi)) * exp(power)  # x^a e^-x / Γ(a)
    if x > a + 1.0:
        terms = ((n * (a - n), x - a + 2 * n + 1) for n in count(1))
        return weight / _evaluate_fraction(x - a + 1.0, terms), weight
    term = total = 1.0 / a
    order = a
    while term > _ROUNDING * total:
        order += 1.0
        term *= x / order
        total += term
    return 1.0 - weight * total, weight


def _compute_student_tail(degrees: float, value: float) -> _Tail:
    tail, fall = _compute_f_tail(1.0, degrees, value * value)
    return tail / 2.0, fall


def _compute_f_tail(numerator: float, denominator: float, value: float) -> _Tail:
    """Compute the incomplete beta function I_x(a, b) of x = d/(d + n value)."""
    a, b = denominator / 2.0, numerator / 2.0
    if not (a > 0.0 and b > 0.0 and value > 0.0):
        return (1.0, 0.0) if a > 0.0 and b > 0.0 and value <= 0.0 else (nan, nan)
    odds = value * b / a
    if odds == inf:
        return 0.0, 0.0
    both, x, y = a + b, 1.0 / (1.0 + odds), odds / (1.0 + odds)
    ahead = (b - a * odds) / (1.0 + odds)  # (a + b) x - a without cancellation
    power = a * _log_ratio(both * x, a, ahead) + b * _log_ratio(both * y, b, -ahead)
    rest = _stirling_rest(both) - _stirling_rest(a) - _stirling_rest(b)
    weight = sqrt(a * b / (2.0 * pi * both)) * exp(power + rest)  # x^a y^b / B(a, b)
    if x * (both + 2.0) < a + 1.0:
        return weight / _evaluate_beta_fraction(a, b, x, -ahead), weight
    return 1.0 - weight / _evaluate_beta_fraction(b, a, y, ahead), weight


def _evaluate_beta_fraction(a: float, b: float, x: float, behind: float) -> float:
    """Evaluate x^a (1-x)^b / (B(a, b) I_x(a, b)); `behind` is a - (a + b) x."""
    terms = (
        (
            (a + n - 1) * (a + b + n - 1) * n * (b - n) * (x / (a + 2 * n - 1)) ** 2,
            n
            + n * (b - n) * x / (a + 2 * n - 1)
            + (a + n) * (behind + 1 + n * (2 - x)) / (a + 2 * n + 1),
        )
        for n in count(1)
    )
    return _evaluate_fraction(a * (behind + 1.0) / (a + 1.0), terms)


def _evaluate_fraction(first: float, terms: Iterable[tuple[float, float]]) -> float:
    """Evaluate first + a1/(b1 + a2/(b2 + ...)) by Lentz's method."""
    value = above = first
    below = 0.0
    for a, b in terms:
        below = 1.0 / (b + a * below)
        above = b + a / above
        value *= above * below
        if abs(above * below - 1.0) < _ROUNDING:
            break
    return value


def _log_ratio(value: float, reference: float, difference: float) -> float:
    """Compute ln(value/reference), precise where both are almost equal."""
    if 2.0 * value < reference:
        return log(value / reference) if value > 0.0 else -inf
    return log1p(difference / reference)


def _stirling_rest(z: float) -> float:
    """Compute what Stirling's formula lacks of ln Γ(z)."""
    if z < _STIRLING_FROM:
        return lgamma(z) - (z - 0.5) * log(z) + z - log(2.0 * pi) / 2.0
    u = 1.0 / (z * z)
    return (1 / 12 - u * (1 / 360 - u * (1 / 1260 - u * (1 / 1680 - u / 1188)))) / z
