"""The interval of a mixture of alternatives, against the quantiles of samples drawn from it."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf

import numpy as np
import pytest

from sysid.core.distributions import student_limit
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.intervals import (
    Alternative,
    Mixture,
    compose_interval,
    compute_mixture_interval,
)

ONE = Alternative(1.0, 3.0, 0.2, 7.0)
N_SAMPLES = 400_000


def draw(alternatives: Sequence[Alternative], seed: int) -> np.ndarray:
    """Draw samples of a mixture."""
    random = np.random.default_rng(seed)
    weights = np.array([one.weight for one in alternatives])
    counts = random.multinomial(N_SAMPLES, weights / weights.sum())
    return np.concatenate(
        [
            one.value
            + one.stderr
            * (
                random.standard_t(one.degrees, count)
                if one.degrees < inf
                else random.standard_normal(count)
            )
            for one, count in zip(alternatives, counts.tolist(), strict=True)
        ]
    )


@pytest.mark.parametrize(
    "alternatives",
    [
        [ONE],
        [ONE, Alternative(0.5, 4.0, 0.1, 12.0)],
        [Alternative(20.0, 3.3, 0.4), Alternative(1.0, 9.0, 3.0, 3.0), Alternative(4.0, 2.0, 0.7)],
        [Alternative(0.97, 1.0, 0.01), Alternative(0.03, -5.0, 2.0, 5.0)],
        [ONE, Alternative(1.0, 3.0, 0.2, 7.0)],
    ],
)
def test_the_ends_are_the_quantiles_of_samples(alternatives: Sequence[Alternative]) -> None:
    samples = draw(alternatives, seed=len(alternatives))
    interval = compute_mixture_interval(alternatives)
    for end, share in zip(interval, (0.025, 0.975), strict=True):
        # Four standard deviations of a count of samples.
        below = float(np.mean(samples < end))
        assert below == pytest.approx(share, abs=4 * (0.025 * 0.975 / N_SAMPLES) ** 0.5)


def test_one_alternative_has_the_interval_of_its_t_distribution() -> None:
    half = student_limit(7.0, 0.025) * 0.2
    assert compute_mixture_interval([ONE]) == pytest.approx((3.0 - half, 3.0 + half))


def test_only_relative_weights_count_and_one_of_weight_zero_does_not() -> None:
    other = Alternative(0.25, 4.0, 0.1)
    expected = compute_mixture_interval([ONE, other])
    scaled = [replace(one, weight=1e-9 * one.weight) for one in (ONE, other)]
    assert compute_mixture_interval(scaled) == pytest.approx(expected)
    assert compute_mixture_interval([ONE, other, Alternative(0.0, 99.0, 1.0)]) == expected


def test_an_alternative_below_the_tail_hardly_moves_the_end() -> None:
    alone = compute_mixture_interval([ONE])
    low, high = compute_mixture_interval([ONE, Alternative(0.02, 50.0, 0.1)])
    assert low == pytest.approx(alone[0], abs=0.02)
    assert alone[1] < high < 5.0
    assert compute_mixture_interval([ONE, Alternative(0.1, 50.0, 0.1)])[1] > 49.0


def test_an_alternative_without_error_is_a_single_value() -> None:
    low, high = compute_mixture_interval([Alternative(1.0, 2.0, 0.0), Alternative(1.0, 5.0, 0.0)])
    assert (low, high) == pytest.approx((2.0, 5.0))


@pytest.mark.parametrize(
    "alternatives",
    [
        [],
        [Alternative(0.0, 1.0, 1.0)],
        [Alternative(-1.0, 1.0, 1.0), Alternative(2.0, 1.0, 1.0)],
        [Alternative(inf, 1.0, 1.0)],
        [Alternative(1.0, 1.0, -1.0)],
    ],
)
def test_weights_and_errors_that_mean_nothing_are_refused(
    alternatives: Sequence[Alternative],
) -> None:
    with pytest.raises(ValueError, match="weights and errors"):
        compute_mixture_interval(alternatives)


def test_a_mixture_extends_the_interval_and_leaves_the_rest() -> None:
    estimate = Estimate("L", "s", 3.0, 0.0, 10.0, 0.2, (2.5, 3.5), "identified")
    mixed = compose_interval(estimate, Mixture((ONE, Alternative(1.0, 4.0, 0.1))))
    assert mixed == replace(estimate, interval95=mixed.interval95)
    lower, upper = compute_mixture_interval([ONE, Alternative(1.0, 4.0, 0.1)])
    assert lower > 2.5
    assert mixed.interval95 == (2.5, upper)
