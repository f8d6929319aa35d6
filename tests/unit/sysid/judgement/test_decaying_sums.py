"""Sums with a decay are those of a loop."""

import numpy as np
import pytest

from sysid.judgement.decaying_sums import sum_with_decay


@pytest.mark.parametrize("decay", [0.7 + 0j, 1.0 + 0j, 0.6 + 0.7j])
def test_sums_are_those_of_a_loop(decay: complex) -> None:
    values = np.random.default_rng(1).normal(size=(40, 3))
    expected, total = [], np.zeros(3, dtype=np.complex128)
    for row in values:
        total = row + decay * total
        expected.append(total)
    sums = sum_with_decay(values, decay)
    np.testing.assert_allclose(sums[0], np.real(expected))
    assert len(sums) == (2 if decay.imag else 1)
    if decay.imag:
        np.testing.assert_allclose(sums[1], np.imag(expected))
    np.testing.assert_array_equal(sum_with_decay(values, decay, 7), sums[:, -7:])
