"""Derivations: what each step keeps and changes, and that each bad setting is told."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.data.derivations import apply_steps, derive_recording
from sysid.data.noise import Noise, add_output_noise
from sysid.data.records import Channel, Hold, Recording, Segment
from sysid.models.catalogue.load import load_model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate


def make_recording(samples: int = 100) -> Recording:
    times = np.arange(samples) * 0.1
    rng = np.random.default_rng(1)
    return Recording(
        (
            Channel("u", times, rng.normal(size=samples), "V"),
            Channel("y", times, 3 + 0.5 * times, "m"),
        )
    )


def repeats() -> Recording:
    """Three repeats of a ramp u = y = t, sampled each at another phase, labelled n = 1, 2, 3."""
    own = [np.array([0.0, 0.4, 0.8]), np.array([0.1, 0.5, 0.9]), np.array([0.2, 0.6])]
    times = np.concatenate([i + one - one[0] for i, one in enumerate(own)])
    values = np.concatenate(own)
    segments = tuple(
        Segment(
            float(i),
            float(i + one[-1] - one[0]),
            float(one[0]),
            {"n": i + 1.0, "side": "ab"[i % 2]},
        )
        for i, one in enumerate(own)
    )
    return Recording((Channel("u", times, values), Channel("y", times, values)), segments)


def read_values(made: Recording, name: str) -> Any:
    return made.channel(name).values


def test_steps_are_taken_one_after_the_other() -> None:
    made = derive_recording(make_recording(), [{"trim": {"rows": [10, 20]}}, {"offset": {"y": 3}}])
    np.testing.assert_allclose(read_values(made, "y"), 0.5 * made.channel("y").times)


def test_trimming_by_rows_and_by_time_agree() -> None:
    by_rows = derive_recording(make_recording(), [{"trim": {"rows": [10, 21]}}])
    by_time = derive_recording(make_recording(), [{"trim": {"start": 0.95, "stop": 2.05}}])
    for name in ("u", "y"):
        np.testing.assert_array_equal(read_values(by_rows, name), read_values(by_time, name))
        np.testing.assert_array_equal(
            by_rows.channel(name).times, make_recording().channel("u").times[10:21]
        )


def test_noise_has_its_deviation_is_drawn_by_the_seed_and_leaves_others_alone() -> None:
    start = make_recording(20_000)
    step = {"noise": {"sigma": 0.2, "seed": 7, "channels": ["y"]}}
    first, again = derive_recording(start, [step]), derive_recording(start, [step])
    added = read_values(first, "y") - read_values(start, "y")
    np.testing.assert_array_equal(read_values(first, "y"), read_values(again, "y"))
    np.testing.assert_array_equal(read_values(first, "u"), read_values(start, "u"))
    assert np.std(added) == pytest.approx(0.2, rel=0.05)
    assert abs(np.mean(added)) < 0.01
    other = derive_recording(start, [{"noise": {"sigma": 0.2, "seed": 8, "channels": ["y"]}}])
    assert not np.array_equal(read_values(first, "y"), read_values(other, "y"))


def test_noise_is_the_same_as_that_of_a_job() -> None:
    start = make_recording()
    derived = derive_recording(start, [{"noise": {"sigma": 0.2, "seed": 7, "channels": ["y"]}}])
    record = add_output_noise(start.to_record({"u": "u"}, {"y": "y"}), Noise(0.2, 7))
    np.testing.assert_array_equal(read_values(derived, "y"), record.outputs[0].values)


def test_noise_of_two_channels_is_independent() -> None:
    start = make_recording(5000)
    made = derive_recording(start, [{"noise": {"sigma": 1, "seed": 1, "channels": ["u", "y"]}}])
    a, b = (read_values(made, name) - read_values(start, name) for name in ("u", "y"))
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.1


def test_detrending_takes_away_what_it_says() -> None:
    line = derive_recording(make_recording(), [{"detrend": {"kind": "linear", "channels": ["y"]}}])
    np.testing.assert_allclose(read_values(line, "y"), 0, atol=1e-12)
    mean = derive_recording(make_recording(), [{"detrend": {}}])
    assert np.mean(read_values(mean, "u")) == pytest.approx(0, abs=1e-14)


def test_what_detrending_subtracted_gives_the_recording_back() -> None:
    before = [{"trim": {"start": 2}}, {"unit": {"y": "mm"}}]
    steps = [{"detrend": {"channels": ["y"]}}, {"detrend": {"kind": "linear"}}]
    derived, subtracted = apply_steps(make_recording(), [*before, *steps])
    assert [(one.channel, one.unit) for one in subtracted] == [("y", "mm"), ("u", "V"), ("y", "mm")]
    assert [one.slope == 0 for one in subtracted] == [True, False, False]
    whole = derive_recording(make_recording(), before)
    for name in ("u", "y"):
        trends = [one for one in subtracted if one.channel == name]
        times = derived.channel(name).times
        back = read_values(derived, name) + sum(
            t.value + t.slope * (times - t.time) for t in trends
        )
        np.testing.assert_allclose(back, read_values(whole, name), atol=1e-9)


def test_a_line_survives_resampling() -> None:
    made = derive_recording(make_recording(), [{"resample": {"sample_time": 0.03}}])
    y = made.channel("y")
    assert y.sampling.is_regular
    assert y.sampling.period == pytest.approx(0.03)
    np.testing.assert_allclose(y.values, 3 + 0.5 * y.times)
    np.testing.assert_array_equal(made.channel("u").times, y.times)


def test_resampling_a_held_input_never_invents_a_value() -> None:
    made = derive_recording(
        make_recording(), [{"hold": {"u": "zero"}}, {"resample": {"sample_time": 0.03}}]
    )
    assert set(read_values(made, "u")) <= set(read_values(make_recording(), "u"))


def test_the_mean_of_each_period_is_taken() -> None:
    start = make_recording(101)
    made = derive_recording(start, [{"resample": {"sample_time": 0.5, "method": "mean"}}])
    assert read_values(made, "u")[2] == pytest.approx(np.mean(read_values(start, "u")[8:13]))


def test_a_sample_between_two_periods_counts_half_in_each() -> None:
    start = make_recording(101)
    made = derive_recording(start, [{"resample": {"sample_time": 0.2, "method": "mean"}}])
    u = read_values(start, "u")
    np.testing.assert_allclose(
        read_values(made, "u")[1:50], (u[1:98:2] + 2 * u[2:99:2] + u[3:100:2]) / 4
    )


def test_a_common_grid_has_no_time_that_a_channel_lacks() -> None:
    late = Channel("y", 0.5 + np.arange(20) * 0.1, np.arange(20.0))
    early = Channel("u", np.arange(15) * 0.1, np.arange(15.0))
    made = derive_recording(Recording((early, late)), [{"resample": {"sample_time": 0.1}}])
    np.testing.assert_allclose(made.channel("u").times, 0.5 + np.arange(10) * 0.1)
    np.testing.assert_allclose(read_values(made, "u"), np.arange(5.0, 15.0))
    np.testing.assert_allclose(read_values(made, "y"), np.arange(10.0))


def test_a_held_input_is_averaged_over_the_period_for_which_it_is_then_held() -> None:
    # Jumps between the points of the new grid must not move, or every lag behind them would.
    held = Channel(
        "u", np.array([0.0, 0.26, 0.75, 1.7]), np.array([1.0, 3.0, -1.0, 2.0]), "V", "zero"
    )
    made = derive_recording(
        Recording((held,)), [{"resample": {"sample_time": 0.5, "method": "mean"}}]
    )
    expected = [
        (0.26 * 1 + 0.24 * 3) / 0.5,
        (0.25 * 3 - 0.25 * 1) / 0.5,
        -1,
        (-0.2 + 0.3 * 2) / 0.5,
    ]
    np.testing.assert_allclose(read_values(made, "u"), expected, rtol=1e-12)


def test_a_gap_of_a_held_input_stays_one() -> None:
    times = 0.1 * np.arange(20)
    held = Channel("u", times, np.where(np.arange(20) == 6, np.nan, 0.1 * 3), "V", "zero")
    made = derive_recording(
        Recording((held,)), [{"resample": {"sample_time": 0.5, "method": "mean"}}]
    )
    np.testing.assert_array_equal(read_values(made, "u"), [0.1 * 3, np.nan, 0.1 * 3, 0.1 * 3])


@pytest.mark.parametrize("hold", ["zero", "first"])
def test_a_lag_survives_resampling_by_means(hold: Hold) -> None:
    times = 0.01 * np.arange(4000)
    draw = np.random.default_rng(1)
    levels = draw.uniform(-1, 1, 41)[np.searchsorted(np.cumsum(draw.uniform(0.7, 1.5, 40)), times)]
    if hold == "first":
        levels = np.convolve(np.pad(levels, (60, 0), mode="edge"), np.full(61, 1 / 61), "valid")
    model, truth = load_model("fopdt"), {"K": 2.0, "T": 1.0, "L": 0.53, "y0": 0.7, "x(0)": 0.0}
    measured = simulate(model, [Channel("u", times, levels, "V", hold)], truth, times=times)
    whole = Recording((Channel("u", times, levels, "V", hold), measured.channel("y")))
    made = derive_recording(whole, [{"resample": {"sample_time": 0.2, "method": "mean"}}])
    problem = Problem.build(model, [made.to_record({"u": "u"}, {"y": "y"})])
    start = np.array([truth[p.name] for p in problem.free_parameters])
    (end,) = refine_candidates(problem, [start])
    assert end is not None
    found = dict(zip((p.name for p in problem.free_parameters), end.theta, strict=True))
    assert found["L"] == pytest.approx(0.53, abs=0.01)


def test_the_two_parts_of_a_split_are_the_whole() -> None:
    parts = [
        derive_recording(make_recording(), [{"split": {"fraction": 0.3, "part": part}}])
        for part in ("estimation", "validation")
    ]
    assert [part.samples for part in parts] == [70, 30]
    joined = np.concatenate([read_values(part, "u") for part in parts])
    np.testing.assert_array_equal(joined, read_values(make_recording(), "u"))


def test_hold_and_names_are_set() -> None:
    made = derive_recording(
        make_recording(), [{"hold": {"u": "band-limited"}}, {"rename": {"u": "q"}}]
    )
    assert made.names == ("q", "y")
    assert made.channel("q").hold == "band-limited"


@pytest.mark.parametrize(
    ("condition", "kept"),
    [
        ({"n": 2}, [2]),
        ({"n": [1, 3]}, [1, 3]),
        ({"n": {"modulus": 2, "remainder": 1}}, [1, 3]),
        ({"n": {"min": 2}}, [2, 3]),
        ({"side": "a", "n": {"max": 2}}, [1]),
    ],
)
def test_segments_are_selected_by_their_labels(condition: dict[str, Any], kept: list[int]) -> None:
    made = derive_recording(repeats(), [{"select": condition}])
    assert [one.labels["n"] for one in made.segments] == kept
    for piece, number in zip(made.split_segments(), kept, strict=True):
        whole = repeats().split_segments()[number - 1]
        np.testing.assert_array_equal(piece.channel("u").times, whole.channel("u").times)
        np.testing.assert_array_equal(read_values(piece, "u"), read_values(whole, "u"))


def test_clipping_limits_samples_history_and_no_other_channel_and_keeps_gaps() -> None:
    made = make_recording()
    y = made.channel("y")
    gap = np.where(np.arange(y.values.size) == 70, np.nan, y.values)
    made = replace(made, channels=(made.channel("u"), replace(y, values=gap)))
    part = derive_recording(made, [{"trim": {"rows": [50, 100]}}])
    low, high = np.nanquantile(read_values(part, "y"), [0.2, 0.6])
    clipped = derive_recording(part, [{"clip": {"y": {"min": low, "max": high}}}])
    expected = np.minimum(np.maximum(read_values(part, "y"), low), high)
    np.testing.assert_array_equal(read_values(clipped, "y"), expected)
    assert np.isnan(expected).sum() == 1
    before, after = (one.channel("y").history for one in (part, clipped))
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after.values, np.clip(before.values, low, high))
    assert clipped.channel("u") is part.channel("u")
    above = derive_recording(part, [{"clip": {"y": {"min": low}}}])
    assert np.nanmax(read_values(above, "y")) == np.nanmax(read_values(part, "y"))


def test_pooling_puts_every_output_sample_at_its_own_time() -> None:
    made = derive_recording(repeats(), [{"pool": {"input": "u", "outputs": ["y"], "bin": 0.1}}])
    assert made.segments == ()
    y = made.channel("y")
    np.testing.assert_array_equal(y.times, y.values)  # y = t in every repeat
    np.testing.assert_array_equal(y.times, [0, 0.1, 0.2, 0.4, 0.5, 0.6, 0.8, 0.9])


def test_a_pooled_input_is_the_median_of_each_bin() -> None:
    made = derive_recording(
        repeats(), [{"pool": {"input": "u", "outputs": ["y"], "bin": 0.3, "start": 0, "stop": 0.7}}]
    )
    u = made.channel("u")
    np.testing.assert_allclose(u.values, [0.1, 0.45, 0.6])  # bins 0-0.3, 0.3-0.6, from 0.6
    np.testing.assert_allclose(u.times, u.values)
    assert made.channel("y").times[-1] == 0.6


def test_one_wrong_repeat_does_not_move_a_pooled_input() -> None:
    times = np.concatenate([i + np.array([0.0, 0.1, 0.2]) for i in range(5)])
    u = np.tile([1.0, 2.0, 3.0], 5)
    u[6:9] = 50.0  # the third repeat
    segments = tuple(Segment(float(i), i + 0.2, 0.0, {"n": i}) for i in range(5))
    repeated = Recording((Channel("u", times, u), Channel("y", times, u)), segments)
    made = derive_recording(repeated, [{"pool": {"input": "u", "outputs": ["y"], "bin": 0.1}}])
    np.testing.assert_array_equal(read_values(made, "u"), [1.0, 2.0, 3.0])


def test_a_pooled_input_is_that_of_all_repeats_where_outputs_are_those_of_some() -> None:
    pooling = {"input": "u", "outputs": ["y"], "bin": 0.3, "start": 0}
    some = {"n": {"modulus": 2, "remainder": 0}}
    whole = derive_recording(repeats(), [{"pool": pooling}])
    made = derive_recording(repeats(), [{"pool": pooling | {"outputs_from": some}}])
    alone = derive_recording(repeats(), [{"select": some}, {"pool": pooling}])
    for name, same in (("u", whole), ("y", alone)):
        np.testing.assert_array_equal(made.channel(name).times, same.channel(name).times)
        np.testing.assert_array_equal(read_values(made, name), read_values(same, name))
    assert alone.channel("u").times.size < made.channel("u").times.size
    assert made.channel("y").times.size < whole.channel("y").times.size


def test_pooled_outputs_are_of_segments_that_exist() -> None:
    pooling = {"input": "u", "outputs": ["y"], "bin": 0.3}
    for wrong, pointer in (
        ({"m": 1}, "/steps/0/pool/outputs_from/m"),
        (3, "/steps/0/pool/outputs_from"),
        ({"n": 99}, "/steps/0/pool/outputs_from"),
        ({}, "/steps/0/pool/outputs_from"),
    ):
        with pytest.raises(InvalidSettings) as caught:
            derive_recording(repeats(), [{"pool": pooling | {"outputs_from": wrong}}])
        assert caught.value.pointer == pointer


@pytest.mark.parametrize(
    ("steps", "pointer"),
    [
        ([], "/steps"),
        ({"trim": {}}, "/steps"),
        ([{}], "/steps/0"),
        ([{"trim": {"start": 0}, "detrend": {}}], "/steps/0"),
        ([{"detrend": {}}, {"trimm": {}}], "/steps/1/trimm"),
        ([{"trim": 3}], "/steps/0/trim"),
        ([{"trim": {}}], "/steps/0/trim"),
        ([{"trim": {"begin": 0}}], "/steps/0/trim/begin"),
        ([{"trim": {"start": "0"}}], "/steps/0/trim/start"),
        ([{"trim": {"start": 4, "stop": 2}}], "/steps/0/trim/stop"),
        ([{"trim": {"start": 1.01, "stop": 1.02}}], "/steps/0/trim"),
        ([{"trim": {"rows": [3]}}], "/steps/0/trim/rows"),
        ([{"trim": {"rows": [0, 5], "start": 0}}], "/steps/0/trim/rows"),
        ([{"trim": {"rows": [0, 101]}}], "/steps/0/trim/rows"),
        ([{"noise": {"sigma": 1}}], "/steps/0/noise/channels"),
        ([{"noise": {"sigma": -1, "channels": ["y"]}}], "/steps/0/noise/sigma"),
        ([{"noise": {"sigma": 1, "seed": 0.5, "channels": ["y"]}}], "/steps/0/noise/seed"),
        ([{"noise": {"sigma": 1, "channels": ["z"]}}], "/steps/0/noise"),
        ([{"noise": {"sigma": 1, "seed": 2**64, "channels": ["y"]}}], "/steps/0/noise/seed"),
        ([{"noise": {"sigma": 1, "terms": 2, "channels": ["y"]}}], "/steps/0/noise/terms"),
        ([{"resample": {"sample_time": 0}}], "/steps/0/resample/sample_time"),
        ([{"resample": {"sample_time": 1e-9}}], "/steps/0/resample/sample_time"),
        ([{"resample": {"sample_time": 1, "method": "cubic"}}], "/steps/0/resample/method"),
        ([{"detrend": {"channels": []}}], "/steps/0/detrend/channels"),
        ([{"offset": {}}], "/steps/0/offset"),
        ([{"offset": {"y": True}}], "/steps/0/offset/y"),
        ([{"clip": {}}], "/steps/0/clip"),
        ([{"clip": {"y": {}}}], "/steps/0/clip/y"),
        ([{"clip": {"y": [0, 1]}}], "/steps/0/clip/y"),
        ([{"clip": {"y": {"low": 0}}}], "/steps/0/clip/y/low"),
        ([{"clip": {"y": {"min": 2, "max": 1}}}], "/steps/0/clip/y/max"),
        ([{"clip": {"z": {"min": 0}}}], "/steps/0/clip"),
        ([{"split": {"fraction": 1.5, "part": "validation"}}], "/steps/0/split/fraction"),
        ([{"split": {"fraction": 0.5, "part": "test"}}], "/steps/0/split/part"),
        ([{"hold": {"u": "second"}}], "/steps/0/hold/u"),
        ([{"rename": {"u": "y"}}], "/steps/0/rename"),
        ([{"select": {"n": 1}}], "/steps/0/select"),
        ([{"pool": {"outputs": ["y"], "bin": 1}}], "/steps/0/pool/input"),
        ([{"pool": {"input": "u", "outputs": ["y"], "bin": -1}}], "/steps/0/pool/bin"),
        ([{"pool": {"input": "u", "outputs": ["y"], "bin": 1, "stop": 0}}], "/steps/0/pool/stop"),
        ([{"pool": {"input": "u", "outputs": ["y"], "bin": 1, "start": 50}}], "/steps/0/pool/stop"),
    ],
)
def test_a_bad_step_is_told_with_its_pointer(steps: Any, pointer: str) -> None:
    with pytest.raises(InvalidSettings) as caught:
        derive_recording(make_recording(), steps)
    assert caught.value.pointer == pointer
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("condition", "pointer"),
    [
        ({"m": 1}, "/steps/0/select/m"),
        ({"n": 9}, "/steps/0/select"),
        ({"n": None}, "/steps/0/select/n"),
        ({"n": {"modulus": 0, "remainder": 1}}, "/steps/0/select/n/modulus"),
    ],
)
def test_a_bad_condition_is_told_with_its_pointer(condition: dict[str, Any], pointer: str) -> None:
    with pytest.raises(InvalidSettings) as caught:
        derive_recording(repeats(), [{"select": condition}])
    assert caught.value.pointer == pointer


@pytest.mark.parametrize("number", [10**400, -(10**400), float("inf"), float("nan"), True])
def test_a_number_is_finite(number: float) -> None:
    with pytest.raises(InvalidSettings, match="need a finite number") as caught:
        derive_recording(make_recording(), [{"trim": {"start": 0, "stop": number}}])
    assert caught.value.pointer == "/steps/0/trim/stop"
