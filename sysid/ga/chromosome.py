"""The code of an individual: one unsigned word per free parameter (Eq. 8, 9).

Reading of Eq. 9: θ = lower + (upper − lower)·int/(2^bits − 1); on a logarithmic scale the same
rule holds for ln θ. The *place* of a parameter is int/(2^bits − 1), a number in [0, 1].
"""

import numpy as np

from sysid.kernels.caching import compiled
from sysid.kernels.evaluator import Evaluator
from sysid.types import FloatArray, WordArray


@compiled
def located(evaluator: Evaluator, places: FloatArray) -> FloatArray:
    """Physical values of places in [0, 1]: (P, D) → (P, D)."""
    theta = np.empty(places.shape)
    for d in range(places.shape[1]):
        lower, upper = evaluator.lower[d], evaluator.upper[d]
        for p in range(places.shape[0]):
            if evaluator.log[d]:
                value = lower * np.exp(places[p, d] * np.log(upper / lower))
            else:
                value = lower + (upper - lower) * places[p, d]
            theta[p, d] = min(max(value, lower), upper)
    return theta


@compiled
def placed(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Places of physical values, the inverse of `located`; values out of bounds go to the bound."""
    places = np.empty(theta.shape)
    for d in range(theta.shape[1]):
        lower, upper = evaluator.lower[d], evaluator.upper[d]
        for p in range(theta.shape[0]):
            value = min(max(theta[p, d], lower), upper)
            if evaluator.log[d]:
                places[p, d] = np.log(value / lower) / np.log(upper / lower)
            else:
                places[p, d] = (value - lower) / (upper - lower)
    return places


@compiled
def coded(places: FloatArray, bits: int) -> WordArray:
    """Nearest chromosomes of places in [0, 1]."""
    largest = float((1 << bits) - 1)
    words = np.empty(places.shape, np.uint32)
    for p in range(places.shape[0]):
        for d in range(places.shape[1]):
            words[p, d] = np.uint32(round(min(max(places[p, d], 0.0), 1.0) * largest))
    return words


@compiled
def decoded(words: WordArray, bits: int) -> FloatArray:
    """Places of chromosomes; the inverse of `coded`."""
    largest = float((1 << bits) - 1)
    places = np.empty(words.shape)
    for p in range(words.shape[0]):
        for d in range(words.shape[1]):
            places[p, d] = words[p, d] / largest
    return places
