"""The yardstick: linear black boxes against closed forms, and against the user's model."""

from typing import Any

import numpy as np
import pytest

from sysid.data.records import Channel, Record
from sysid.judgement import yardstick
from sysid.judgement.yardstick import Yardstick, fit_yardstick
from sysid.models.catalogue.load import load_model
from sysid.simulation.problem import Problem

TWO_INPUTS = {
    "name": "two",
    "form": "differential",
    "inputs": {"u": "1", "v": "1"},
    "states": {"x": "1", "z": "1"},
    "equations": {"x": "(u + v - x)/T", "z": "u - z"},
    "outputs": {"y": {"expression": "x"}, "w": {"expression": "z"}},
    "parameters": {"T": {"lower": 1, "upper": 2}},
}


def switch(rng: np.random.Generator, samples: int, hold: int) -> Any:
    return np.repeat(rng.integers(0, 2, samples // hold + 1) * 2.0 - 1.0, hold)[:samples]


def answer(u: Any, gain: float, time_constant: float, delay: int) -> Any:
    """First order after a time lag of whole samples, exact for a held input: period 1 s."""
    pole, x, values = np.exp(-1.0 / time_constant), gain * u[0], []
    for k in range(u.size):
        values.append(x)
        x = pole * x + (1.0 - pole) * gain * u[max(k - delay, 0)]
    return np.array(values)


def build(u: Any, y: Any, times: Any = None, **changes: Any) -> Problem:
    t = np.arange(u.size, dtype=float)
    record = Record(Channel("u", t, u, hold="zero"), Channel("y", t if times is None else times, y))
    return Problem.build(load_model("fopdt"), [record], **changes)


def compare(problem: Problem, simulated: Any) -> Yardstick:
    found = fit_yardstick(problem, simulated)
    assert found is not None
    return found


def record_first_order(seed: int, samples: int = 600, noise: float = 0.05) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(seed)
    u = switch(rng, samples, 20)
    clean = answer(u, 2.0, 12.0, 7)
    return u, clean, clean + noise * rng.standard_normal(samples)


def test_a_first_order_with_a_time_lag_is_found_against_a_model_without_one() -> None:
    u, _, y = record_first_order(1)
    found = compare(build(u, y), answer(u, 2.0, 18.0, 0))
    assert found.order == 1
    assert found.rms == pytest.approx(0.05, rel=0.1)
    assert found.is_clearly_better


def test_the_true_model_is_not_beaten() -> None:
    for seed in range(5):
        u, clean, y = record_first_order(seed)
        found = compare(build(u, y), clean)
        assert not found.is_clearly_better
        assert found.rms == pytest.approx(found.own_rms, rel=0.05)


def test_slow_noise_and_an_idle_input_make_no_better_model() -> None:
    model = {**TWO_INPUTS, "outputs": {"y": {"expression": "x"}}}
    for seed in range(5):
        rng = np.random.default_rng(100 + seed)
        u, clean, y = record_first_order(seed, 800, noise=0.0)
        for k in range(1, 800):
            y[k] += 0.98 * (y[k - 1] - clean[k - 1]) + 0.1 * rng.standard_normal()
        t = np.arange(800.0)
        inputs = [Channel("u", t, u), Channel("v", t, switch(rng, 800, 30))]
        problem = Problem.build(load_model(model), [Record(inputs, Channel("y", t, y))])
        assert not compare(problem, clean).is_clearly_better


def test_fit_and_rms_are_of_the_same_samples() -> None:
    u, clean, y = record_first_order(2)
    problem = build(u, y)
    found = compare(problem, clean + 1.0)
    later = slice(60, None)
    error = (y - clean - 1.0)[later]
    assert found.samples == 540
    assert found.own_rms == pytest.approx(np.sqrt(np.mean(error**2)))
    spread = np.linalg.norm(y[later] - np.mean(y[later]))
    assert found.own_fit_percent == pytest.approx(100 * (1 - np.linalg.norm(error) / spread))


def test_unit_and_offset_of_the_output_do_not_matter() -> None:
    u, _, y = record_first_order(3)
    one = compare(build(u, y), np.zeros(y.size))
    other = compare(build(u, 1e4 + 50.0 * y), np.full(y.size, 1e4))
    assert other.fit_percent == pytest.approx(one.fit_percent, abs=0.1)
    assert other.rms == pytest.approx(50.0 * one.rms, rel=1e-2)


def test_irregular_times_and_missing_samples_are_compared_where_they_are() -> None:
    rng = np.random.default_rng(4)
    u = switch(rng, 800, 20)
    clean = answer(u, 2.0, 12.0, 7)
    times = np.sort(rng.uniform(0.0, 799.0, 700))
    y = np.interp(times, np.arange(800.0), clean) + 0.05 * rng.standard_normal(700)
    y[::7] = np.nan
    found = compare(build(u, y, times), np.zeros(700))
    assert found.samples == pytest.approx(0.9 * 600, abs=2)
    assert found.rms == pytest.approx(0.05, rel=0.3)


def test_a_resonance_takes_two_poles() -> None:
    rng = np.random.default_rng(5)
    u = switch(rng, 1000, 40)
    rate, damping = 0.3, 0.2
    t = np.arange(1000.0)
    damped = rate * np.sqrt(1 - damping**2)
    step = 1 - np.exp(-damping * rate * t) * (
        np.cos(damped * t) + damping / np.sqrt(1 - damping**2) * np.sin(damped * t)
    )
    jumps = np.concatenate([[0.0], np.diff(u)])
    clean = u[0] + np.convolve(jumps, np.concatenate([np.zeros(4), step]))[:1000]
    y = clean + 0.03 * rng.standard_normal(1000)
    found = compare(build(u, y), answer(u, 1.0, 5.0, 4))
    assert found.order >= 2
    assert found.rms == pytest.approx(0.03, rel=0.25)
    assert found.is_clearly_better


def test_an_integrating_plant_is_followed() -> None:
    rng = np.random.default_rng(6)
    u = switch(rng, 500, 25)
    clean = np.cumsum(np.concatenate([np.zeros(6), 0.1 * (u - 0.3)]))[:500]
    y = clean + 0.05 * rng.standard_normal(500)
    found = compare(build(u, y), answer(u, 1.0, 20.0, 5) + np.mean(y))
    assert found.fit_percent > 90.0
    assert found.is_clearly_better


def test_each_output_is_explained_by_all_inputs() -> None:
    rng = np.random.default_rng(7)
    t = np.arange(600.0)
    u, v = switch(rng, 600, 15), switch(rng, 600, 22)
    y = answer(u, 1.0, 8.0, 3) + answer(v, -1.5, 8.0, 11) + 0.05 * rng.standard_normal(600)
    w = answer(u, 1.0, 5.0, 0) + 0.05 * rng.standard_normal(600)
    record = Record(
        [Channel("u", t, u, hold="zero"), Channel("v", t, v, hold="zero")],
        [Channel("y", t, y), Channel("w", t, w)],
    )
    problem = Problem.build(load_model(TWO_INPUTS), [record])
    simulated = np.concatenate([answer(u, 1.0, 8.0, 3), answer(u, 1.0, 5.0, 0)])
    found = compare(problem, simulated)
    assert found.output == "y"
    assert found.rms == pytest.approx(0.05, rel=0.2)


def test_several_experiments_have_starts_of_their_own() -> None:
    rng, records, models = np.random.default_rng(8), [], []
    for start, samples in [(2.0, 240), (-3.0, 300), (0.0, 260)]:
        u = switch(rng, samples, 20)
        clean = answer(u, 2.0, 12.0, 7) + start * np.exp(-np.arange(samples) / 12.0)
        t = np.arange(float(samples))
        y = clean + 0.05 * rng.standard_normal(samples)
        records.append(Record(Channel("u", t, u, hold="zero"), Channel("y", t, y)))
        models.append(answer(u, 2.0, 12.0, 0))
    found = compare(Problem.build(load_model("fopdt"), records), np.concatenate(models))
    assert found.rms == pytest.approx(0.05, rel=0.2)
    assert found.is_clearly_better


def test_input_recorded_before_the_output_is_used() -> None:
    u, _, _ = record_first_order(9)
    clean = answer(u, 2.0, 12.0, 30)
    y = clean + 0.02 * np.random.default_rng(9).standard_normal(600)
    t = np.arange(600.0)
    before = Channel("u", t, u, hold="zero").slice_with_history(100.0, 600.0)
    record = Record(before, Channel("y", t[100:], y[100:]))
    found = compare(Problem.build(load_model("fopdt"), [record]), np.zeros(500))
    assert found.rms == pytest.approx(0.02, rel=0.15)


def test_a_long_slow_record_is_averaged() -> None:
    rng = np.random.default_rng(10)
    u = switch(rng, 6000, 300)
    y = answer(u, 2.0, 200.0, 90) + 0.1 * rng.standard_normal(6000)
    found = compare(build(u, y), np.zeros(6000))
    assert found.samples == 5400
    assert found.rms == pytest.approx(0.1, rel=0.05)


def test_nothing_is_said_where_nothing_can_be() -> None:
    u, clean, y = record_first_order(11)
    assert fit_yardstick(build(np.full(600, 3.0), y), clean) is None  # no input moves
    assert fit_yardstick(build(u[:39], y[:39]), clean[:39]) is None  # few samples
    assert fit_yardstick(build(u, y), y + 1e-7 * clean) is None  # errors of a solver
    assert fit_yardstick(build(u, y), np.full(600, np.inf)) is None  # diverged
    assert fit_yardstick(build(u, np.full(600, 2.0)), clean) is None  # nothing moves


def test_one_step_alone_tells_nothing_of_the_block_that_holds_it() -> None:
    u = np.where(np.arange(600) < 300, 0.0, 1.0)
    y = answer(u, 2.0, 3.0, 2) + 0.02 * np.random.default_rng(12).standard_normal(600)
    found = compare(build(u, y), answer(u, 2.0, 9.0, 0))
    assert found.samples < 540
    assert not found.is_clearly_better


def test_coloured_residuals_count_as_fewer_samples() -> None:
    rng = np.random.default_rng(14)
    white, pole = rng.standard_normal(20_000), 0.8
    coloured = white.copy()
    for k in range(1, white.size):
        coloured[k] += pole * coloured[k - 1]
    zeros, t = np.zeros(white.size, dtype=np.int64), np.arange(float(white.size))
    plain = yardstick._compute_gain(zeros, t, white, 0.5 * white)
    assert plain == pytest.approx(0.5 * white.size * np.log(4.0), rel=0.05)
    gain = yardstick._compute_gain(zeros, t, coloured, 0.5 * coloured)
    assert gain / plain == pytest.approx((1 - pole**2) / (1 + pole**2), rel=0.1)
