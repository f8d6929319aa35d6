"""Inputs between their samples, by their hold."""

import numpy as np
import pytest

from sysid.core.errors import InvalidRecord
from sysid.data.interpolation import interpolate_channel, interpolate_input
from sysid.data.records import Channel, Hold

TIMES = 0.1 * np.arange(400)


def make_channel(hold: Hold, values: np.ndarray | None = None) -> Channel:
    return Channel("u", TIMES, np.sin(3 * TIMES) if values is None else values, hold=hold)


def test_first_order_hold_is_a_straight_line() -> None:
    found = interpolate_channel(make_channel("first"), np.array([-1.0, 0.05, 0.1, 99.0]))
    expected = [0.0, np.sin(0.3) / 2, np.sin(0.3), np.sin(3 * TIMES[-1])]
    np.testing.assert_allclose(found, expected)


def test_zero_order_hold_keeps_the_last_sample_and_is_the_mean_at_a_jump() -> None:
    values = np.arange(400.0)
    found = interpolate_channel(
        make_channel("zero", values), np.array([-1.0, 0.04, 0.1, 0.19, 99.0])
    )
    np.testing.assert_allclose(found, [0.0, 0.0, 0.5, 1.0, 399.0])


def test_band_limited_input_passes_through_a_sine_and_through_every_sample() -> None:
    at = np.linspace(0.5, 39.0, 1001)
    for rate in (3.0, 12.0, 22.0):  # rad/s; the limit is 31.4
        sine = make_channel("band-limited", np.sin(rate * TIMES))
        # the ends are continued by reflection, which is exact only for slow signals
        inside = (at > 5) & (at < 35)
        found = interpolate_channel(sine, at)
        np.testing.assert_allclose(found[inside], np.sin(rate * at)[inside], atol=2e-4)
        np.testing.assert_allclose(
            interpolate_channel(sine, TIMES), np.sin(rate * TIMES), atol=1e-3
        )


def test_band_limited_input_rings_little_at_the_ends() -> None:
    ramp = make_channel("band-limited", 5.0 + TIMES)
    at = np.linspace(-0.5, 40.5, 997)
    expected = 5.0 + np.clip(at, 0.0, TIMES[-1])
    np.testing.assert_allclose(interpolate_channel(ramp, at), expected, atol=1e-3)


def test_band_limited_input_needs_regular_samples() -> None:
    rng = np.random.default_rng(0)
    times = np.sort(rng.random(50))
    with pytest.raises(InvalidRecord, match="'u' is to be band-limited"):
        interpolate_channel(Channel("u", times, times, hold="band-limited"), times)


def test_a_short_record_can_be_band_limited() -> None:
    short = Channel("u", TIMES[:3], np.array([1.0, 2.0, 3.0]), hold="band-limited")
    np.testing.assert_allclose(interpolate_channel(short, np.array([0.05])), [1.5], atol=1e-2)


@pytest.mark.parametrize("hold", ["first", "zero", "band-limited"])
def test_half_steps_and_samples_are_points_of_the_fine_grid(hold: Hold) -> None:
    fine = interpolate_input(make_channel(hold), 0.0, 0.1, 399, max_delay=7.0)
    assert fine.points_per_step % 2 == 0
    samples = fine.values[fine.start_index + fine.begin :: fine.points_per_step][:400]
    np.testing.assert_allclose(samples, np.sin(3 * TIMES), atol=1e-3)
    assert fine.start_index >= fine.max_delay >= 7 * fine.points_per_step
    np.testing.assert_array_equal(fine.values[: fine.start_index], fine.values[0])


def test_an_input_sampled_faster_than_the_grid_keeps_its_samples() -> None:
    fine = interpolate_input(make_channel("first"), 0.0, 0.3, 100, max_delay=0.0)
    assert fine.points_per_step == 6
    np.testing.assert_allclose(
        fine.values[fine.start_index :: 2][:300], np.sin(3 * TIMES)[:300], atol=1e-12
    )
