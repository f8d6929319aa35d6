"""The functions of statistics that every identification needs, by themselves.

They are a few lines; the package `scipy.special` that has two of them takes longer to import than
an identification of the paper's size, and NumPy's median imports its masked arrays.
"""

from math import erfc, exp, inf, lgamma, log, pi, sqrt

import numpy as np

from sysid.types import FloatArray

_ROUNDING = 1e-16
_TINY = 1e-300  # keeps a continued fraction from dividing by zero
_TERMS = 100_000
_MANY = 200.0  # degrees of freedom from which the expansion in their inverse is exact to rounding
_NORMAL = 1.959963984540054  # two-sided 95 % of the normal distribution
_OUTSIDE = 0.05
_NEAR = 1e-9  # relative: the step after such a one, squared, would be rounding
_STEPS = 200


def median(values: FloatArray) -> float:
    """The middle of the values (n ≥ 1), or the mean of the two in the middle; nan if one is."""
    ordered = np.sort(values, axis=None)  # nan last
    if ordered[-1] != ordered[-1]:
        return float("nan")
    middle = ordered.size // 2
    return float(np.mean(ordered[middle - 1 + ordered.size % 2 : middle + 1]))


def chi_squared_tail(degrees: float, statistic: float) -> float:
    """Probability that χ² with so many degrees of freedom (> 0) is larger.

    Q(k/2, x/2) by its series below its bulk, by Lentz's continued fraction above; relative error
    about 1e-13, 1e-10 at 1e5 degrees [1]_.

    .. [1] W. H. Press et al., Numerical Recipes, 3rd ed., Cambridge 2007, §6.2.
    """
    a, x = 0.5 * degrees, 0.5 * statistic
    if not x > 0.0:
        return 1.0 if x <= 0.0 else x  # nan stays nan
    if x == inf:
        return 0.0
    if degrees == 1.0:
        return erfc(sqrt(x))
    share = exp(a * log(x) - x - lgamma(a))
    return 1.0 - share * _gamma_series(a, x) if x < a + 1.0 else share * _gamma_fraction(a, x)


def _gamma_series(a: float, x: float) -> float:
    """Σ xⁿ / (a (a+1) … (a+n))."""
    term = total = 1.0 / a
    for n in range(1, _TERMS):
        term *= x / (a + n)
        total += term
        if term <= _ROUNDING * total:
            break
    return total


def _gamma_fraction(a: float, x: float) -> float:
    """1/(x+1-a- 1(1-a)/(x+3-a- 2(2-a)/(x+5-a- …)))."""
    b = x + 1.0 - a
    c, d = 1.0 / _TINY, 1.0 / b
    total = d
    for n in range(1, _TERMS):
        b += 2.0
        step = n * (a - n)
        d = 1.0 / _nonzero(step * d + b)
        c = _nonzero(b + step / c)
        total *= c * d
        if abs(c * d - 1.0) <= _ROUNDING:
            break
    return total


def student_95(degrees: float) -> float:
    """Half-width of the two-sided 95 % interval of Student's t with so many degrees of freedom.

    From many degrees on by the expansion in their inverse [1]_; else by Newton's method from
    below, which is monotone since the tail is convex.

    .. [1] M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions, 26.7.5.
    """
    if degrees >= _MANY:
        return _expanded(degrees)
    t = _NORMAL
    scale = exp(lgamma(0.5 * degrees + 0.5) - lgamma(0.5 * degrees))
    for _ in range(_STEPS):
        density = scale / sqrt(degrees * pi) * _power(t, degrees, degrees + 1.0)
        step = (_outside(t, degrees, scale) - _OUTSIDE) / (2.0 * density)
        t += step
        if abs(step) <= _NEAR * t:
            break
    return t


def student_tail(degrees: float, t: float) -> float:
    """Probability that |T| of Student's t with so many degrees of freedom (> 0) is larger than |t|.

    By Lentz's continued fraction of the incomplete beta function [1]_.

    .. [1] W. H. Press et al., Numerical Recipes, 3rd ed., Cambridge 2007, §6.4 and §6.14.
    """
    if t != t or t in (inf, -inf):
        return t if t != t else 0.0
    if t == 0.0:
        return 1.0
    scale = exp(lgamma(0.5 * degrees + 0.5) - lgamma(0.5 * degrees))
    return min(1.0, max(0.0, _outside(abs(t), degrees, scale)))


def _expanded(degrees: float) -> float:
    z, inverse = _NORMAL, 1.0 / degrees
    square = z * z
    first = (square + 1.0) / 4.0
    second = ((5.0 * square + 16.0) * square + 3.0) / 96.0
    third = (((3.0 * square + 19.0) * square + 17.0) * square - 15.0) / 384.0
    fourth = (
        (((79.0 * square + 776.0) * square + 1482.0) * square - 1920.0) * square - 945.0
    ) / 92160.0
    return z * (1.0 + inverse * (first + inverse * (second + inverse * (third + inverse * fourth))))


def _power(t: float, degrees: float, exponent: float) -> float:
    """(ν/(ν + t²))^(exponent/2)."""
    return float((degrees / (degrees + t * t)) ** (0.5 * exponent))


def _outside(t: float, degrees: float, scale: float) -> float:
    """Probability that |T| > t: the incomplete beta function I_x(ν/2, 1/2) at x = ν/(ν + t²)."""
    a, b, x = 0.5 * degrees, 0.5, degrees / (degrees + t * t)
    share = scale / sqrt(pi) * _power(t, degrees, degrees) * sqrt(1.0 - x)
    if x < (a + 1.0) / (a + b + 2.0):
        return share * _beta_fraction(a, b, x) / a
    return 1.0 - share * _beta_fraction(b, a, 1.0 - x) / b


def _beta_fraction(a: float, b: float, x: float) -> float:
    c, d = 1.0, 1.0 / _nonzero(1.0 - (a + b) * x / (a + 1.0))
    total = d
    for n in range(1, _TERMS):
        even = n * (b - n) * x / ((a + 2 * n - 1.0) * (a + 2 * n))
        odd = -(a + n) * (a + b + n) * x / ((a + 2 * n) * (a + 2 * n + 1.0))
        for step in (even, odd):
            d = 1.0 / _nonzero(1.0 + step * d)
            c = _nonzero(1.0 + step / c)
            total *= c * d
        if abs(c * d - 1.0) <= _ROUNDING:
            break
    return total


def _nonzero(value: float) -> float:
    return value if abs(value) >= _TINY else _TINY
