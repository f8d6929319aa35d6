"""The black box: its sections against closed forms, and blocks that its fit did not see."""

from typing import Any

import numpy as np
import pytest

from sysid.data.records import Channel
from sysid.judgement import black_box
from sysid.judgement.black_box import Samples, average_input, simulate_left_out

N = 400
TIMES = np.arange(float(N))
BLOCKS = np.concatenate([np.full(40, -1), np.repeat(np.arange(20), 18)])


def make_input(seed: int = 0) -> Channel:
    values = np.repeat(np.random.default_rng(seed).integers(0, 2, N // 20) * 2.0 - 1.0, 20)
    return Channel("u", TIMES, values, hold="zero")


def make_samples(values: Any) -> Samples:
    return Samples(np.zeros(N, dtype=np.int64), TIMES, values, BLOCKS)


def respond(channel: Channel, step: Any, delay: int) -> Any:
    """Respond from rest at the first value, by a response (N,) to a unit step."""
    jumps = np.concatenate([[0.0], np.diff(channel.values)])
    return np.convolve(jumps, np.concatenate([np.zeros(delay), step]))[:N]


def respond_by_poles(rate: float, damping: float | None) -> Any:
    """Compute the response (N,) of gain 1 to a unit step."""
    if damping is None:
        return 1.0 - np.exp(-rate * TIMES)
    damped = rate * np.sqrt(1 - damping**2)
    wave = np.cos(damped * TIMES) + damping * rate / damped * np.sin(damped * TIMES)
    return 1.0 - np.exp(-damping * rate * TIMES) * wave


@pytest.mark.parametrize(("rate", "damping"), [(0.08, None), (0.2, 0.3), (0.3, 0.04)])
def test_responses_of_closed_form_are_simulated_in_blocks_that_were_left_out(
    rate: float, damping: float | None
) -> None:
    channel = make_input()
    y = 3.0 - 2.0 * respond(channel, respond_by_poles(rate, damping), 7)
    noise = 0.05 * np.random.default_rng(1).standard_normal(N)
    found = simulate_left_out([[channel]], make_samples(y + noise))
    assert found is not None
    np.testing.assert_array_equal(np.isnan(found.values), BLOCKS < 0)
    assert np.sqrt(np.mean((found.values - y)[40:] ** 2)) < 0.02


def fit_first_order(noise: float) -> tuple[Any, Any, Any]:
    """Fit a first-order answer with a time lag of 7.5 s; return the grid and the rows too."""
    channel, step = make_input(), respond_by_poles(0.08, None)
    y = 0.5 * (respond(channel, step, 7) + respond(channel, step, 8))
    y += noise * np.random.default_rng(3).standard_normal(N)
    grid, rows = black_box._place([[channel]], make_samples(y))
    section = black_box._Section(0, np.array([7.5, np.log(0.08)]))
    return grid, rows, black_box._refine(grid, rows, [section])


def list_blocks() -> list[tuple[Any, Any]]:
    """List the samples of each block, and those that a fit without it sees."""
    blocks = []
    for number in range(10):
        own = np.isin(BLOCKS, [2 * number, 2 * number + 1])
        near = np.arange(max(2 * number - 1, 0), 2 * number + 3)
        blocks.append((own, ~np.isin(BLOCKS, near)))
    return blocks


def test_a_block_is_simulated_by_what_is_more_than_half_a_block_away() -> None:
    grid, rows, fit = fit_first_order(0.1)
    values = black_box._leave_out(grid, fit, rows, rows)
    for own, seen in list_blocks():
        near = rows._replace(value=rows.value + 9.0 * ~seen)
        np.testing.assert_array_equal(black_box._leave_out(grid, fit, near, rows)[own], values[own])
        far = rows._replace(value=rows.value + 9.0 * seen)  # the offset follows it
        found = black_box._leave_out(grid, fit, far, rows)[own]
        np.testing.assert_allclose(found, values[own] + 9.0, rtol=1e-5)


def test_a_left_out_block_moves_all_parameters_as_a_fit_without_it_does() -> None:
    grid, rows, fit = fit_first_order(0.02)
    whole = black_box._read_columns(grid, fit.sections, rows) @ fit.linear
    left_out = black_box._leave_out(grid, fit, rows, rows)
    for own, seen in list_blocks():
        some = black_box._Rows(*(column[seen] for column in rows))
        without = black_box._refine(grid, some, fit.sections)
        simulated = black_box._read_columns(grid, without.sections, rows) @ without.linear
        move = np.max(np.abs(simulated - whole)[own])
        np.testing.assert_allclose(left_out[own], simulated[own], atol=0.1 * move)


def test_inputs_are_averaged_between_the_edges() -> None:
    edges = np.array([-1.0, 0.0, 1.0, 1.5, 4.0])
    held = Channel("u", [0.0, 1.0, 3.0], [2.0, 4.0, 0.0], hold="zero")
    np.testing.assert_allclose(average_input(held, edges), [2.0, 2.0, 4.0, (1.5 * 4.0) / 2.5])
    straight = Channel("u", [0.0, 1.0, 3.0], [2.0, 4.0, 0.0], hold="first")
    np.testing.assert_allclose(
        average_input(straight, edges), [2.0, 3.0, 3.5, 0.5 * 3.0 * 1.5 / 2.5]
    )
