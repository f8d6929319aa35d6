"""What was recorded before a record's first sample: kept by every step, read by lags alone."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.datasets.waveforms import interpolate_channel
from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.data.derivations import derive_recording
from sysid.data.history import INTERPOLATION_MARGIN
from sysid.data.outages import extract_records
from sysid.data.records import HOLDS, Channel, History, Hold, Record, Recording, Segment
from sysid.data.splitting import split_record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.simulation.simulate import simulate

H = 0.1
CUT = 120
TRUE = {"K": 2.0, "T": 0.6, "L": 0.73, "y0": 0.5}
SHORT = GeneticAlgorithm(generations=60)


def build_plant(samples: int = 400, hold: Hold = "zero", noise: float = 0.0) -> Recording:
    """A first-order lag with dead time under a random binary input, from rest."""
    times = H * np.arange(samples)
    rng = np.random.default_rng(3)
    command = np.repeat(rng.choice([-1.0, 1.0], samples // 5 + 1), 5)[:samples]
    channel = Channel("u", times, command, "V", hold)
    model = load_model("fopdt")
    [y] = simulate(model, [channel], {**TRUE, "x(0)": -2.0}, times=times).channels
    return Recording((channel, replace(y, values=y.values + noise * rng.normal(size=samples))))


def record_of(recording: Recording) -> Record:
    return recording.to_record({"u": "u"}, {"y": "y"})


def make_history(recording: Recording, name: str = "u") -> History:
    found = recording.channel(name).history
    assert found is not None
    return found


def compute_response(record: Record, start: float) -> FloatArray:
    values = {**TRUE, "x(0)": start}
    [found] = simulate(
        load_model("fopdt"), record.inputs, values, times=record.outputs[0].times
    ).channels
    return found.values


@pytest.mark.parametrize("hold", HOLDS)
def test_a_part_with_history_goes_on_as_the_whole_recording_does(hold: Hold) -> None:
    whole = build_plant(hold=hold)
    expected = whole.channel("y").values[CUT:]
    part = record_of(derive_recording(whole, [{"trim": {"rows": [CUT, 400]}}]))
    start = float(expected[0]) - TRUE["y0"]
    np.testing.assert_allclose(compute_response(part, start), expected, atol=1e-9)
    forgetful = record_of(
        derive_recording(whole, [{"trim": {"rows": [CUT, 400], "history": False}}])
    )
    assert np.max(np.abs(compute_response(forgetful, start) - expected)) > 0.1


def test_by_rows_by_time_and_by_fraction_the_history_is_the_same() -> None:
    whole = build_plant(300)
    middle = float(whole.channels[0].times[150])
    for step in (
        {"trim": {"rows": [150, 300]}},
        {"trim": {"start": middle}},
        {"split": {"fraction": 0.5, "part": "validation"}},
    ):
        part = derive_recording(whole, [step])
        times, values = make_history(part)
        np.testing.assert_array_equal(times, whole.channel("u").times[:150])
        np.testing.assert_array_equal(values, whole.channel("u").values[:150])
        assert part.start == middle
        assert part.samples == 150
        assert part.channel("u").total_samples == 300


def test_a_part_from_the_beginning_has_no_history() -> None:
    for step in ({"trim": {"rows": [0, 50]}}, {"split": {"fraction": 0.5, "part": "estimation"}}):
        assert all(one.history is None for one in derive_recording(build_plant(), [step]).channels)


def test_a_history_is_as_long_as_its_part_and_the_samples_for_interpolation() -> None:
    times = H * np.arange(5000.0)
    whole = Recording((Channel("u", times, times), Channel("y", times, times)))
    part = derive_recording(whole, [{"trim": {"rows": [4000, 4100]}}])
    assert make_history(part).times.size == pytest.approx(99 + INTERPOLATION_MARGIN, abs=1)
    assert make_history(part).times[-1] == times[3999]


def test_a_part_of_a_part_has_the_history_of_both() -> None:
    whole = build_plant()
    once = derive_recording(whole, [{"trim": {"rows": [200, 400]}}])
    twice = derive_recording(once, [{"trim": {"rows": [10, 200]}}])
    expected = whole.channel("u").times[:210]
    np.testing.assert_array_equal(
        make_history(twice).times, expected[-make_history(twice).times.size :]
    )
    assert make_history(twice).times.size > 190
    beginning = derive_recording(once, [{"split": {"fraction": 0.5, "part": "estimation"}}])
    assert make_history(beginning).times[-1] == pytest.approx(19.9)
    forgotten = derive_recording(once, [{"trim": {"start": 0, "history": False}}])
    assert forgotten.channel("u").history is None


def test_steps_change_a_history_as_they_change_the_samples() -> None:
    whole = build_plant()
    steps: list[dict[str, Any]] = [
        {"offset": {"u": 0.25}},
        {"unit": {"u": "mV"}},
        {"rename": {"u": "command"}},
        {"hold": {"command": "first"}},
    ]
    before = derive_recording(derive_recording(whole, steps), [{"trim": {"rows": [CUT, 400]}}])
    after = derive_recording(derive_recording(whole, [{"trim": {"rows": [CUT, 400]}}]), steps)
    for one, other in zip(
        make_history(before, "command"), make_history(after, "command"), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    assert make_history(after, "command").values[-1] in (750.0, -1250.0)


def test_a_line_is_taken_off_a_history_where_it_goes_on() -> None:
    times = H * np.arange(100.0)
    ramp = Recording((Channel("u", times, 3 + 2 * times), Channel("y", times, times)))
    steps = [{"trim": {"rows": [50, 100]}}, {"detrend": {"kind": "linear"}}]
    np.testing.assert_allclose(make_history(derive_recording(ramp, steps)).values, 0.0, atol=1e-9)
    mean = derive_recording(ramp, [{"trim": {"rows": [50, 100]}}, {"detrend": {"kind": "mean"}}])
    np.testing.assert_allclose(
        make_history(mean).values, 3 + 2 * times[:50] - (3 + 2 * np.mean(times[50:])), atol=1e-9
    )


@pytest.mark.parametrize("kind", ["gaussian", "uniform-sum"])
def test_noise_on_samples_is_the_same_draw_with_a_history_and_without(kind: str) -> None:
    noise = {"noise": {"sigma": 0.3, "seed": 2, "channels": ["u"], "kind": kind}}
    trimmed = [{"trim": {"rows": [CUT, 400], "history": keep}} for keep in (True, False)]
    known, unknown = (derive_recording(build_plant(), [one, noise]) for one in trimmed)
    np.testing.assert_array_equal(known.channel("u").values, unknown.channel("u").values)
    added = make_history(known).values - build_plant().channel("u").values[:CUT]
    assert np.std(added) == pytest.approx(0.3, rel=0.3)
    # Another part of the stream: the noise of the history is not that of the samples again.
    other = known.channel("u").values[:CUT] - build_plant().channel("u").values[CUT : 2 * CUT]
    assert np.max(np.abs(added - other)) > 0.1


@pytest.mark.parametrize("method", ["linear", "mean"])
def test_a_resampled_part_is_part_of_the_resampled_whole(method: str) -> None:
    resample = {"resample": {"sample_time": 2 * H, "method": method}}
    whole = derive_recording(build_plant(), [resample]).channel("u")
    part = derive_recording(build_plant(), [{"trim": {"rows": [CUT, 400]}}, resample]).channel("u")
    joined = part.history_and_samples
    assert part.times[0] == pytest.approx(CUT * H)
    np.testing.assert_allclose(joined.times, whole.times, atol=1e-9)
    np.testing.assert_allclose(joined.values, whole.values, atol=1e-9)


def test_resampling_keeps_what_one_channel_recorded_before_the_others_began() -> None:
    times = H * np.arange(100.0)
    late = Channel("y", times[40:], times[40:])
    made = derive_recording(
        Recording((Channel("u", times, times), late)), [{"resample": {"sample_time": H}}]
    )
    np.testing.assert_allclose(make_history(made).values, times[:40], atol=1e-9)
    assert made.channel("y").history is None


def test_a_held_history_begins_with_what_was_recorded_first_however_times_are_rounded() -> None:
    """The grid's first point may lie by rounding before the first sample, whose value it is."""
    times = np.round(np.arange(200) / 610.35, 9)
    whole = Recording(tuple(Channel(n, times, np.arange(200.0), hold="zero") for n in "uy"))
    for row in range(20, 60):
        steps = [{"trim": {"rows": [row, 200]}}, {"resample": {"sample_time": 1 / 610.35}}]
        assert make_history(derive_recording(whole, steps)).values[0] <= 1.0


def make_repeats() -> Recording:
    """Three repeats of ten samples, u counting on over all of them."""
    times = np.concatenate([start + H * np.arange(10.0) for start in (0.0, 10.0, 20.0)])
    segments = tuple(Segment(s, s + 0.9, 5.0, {"n": n}) for n, s in enumerate((0.0, 10.0, 20.0)))
    channels = [Channel(name, times, np.arange(30.0)) for name in ("u", "y")]
    return Recording(tuple(channels), segments)


def test_of_segments_only_the_one_that_is_cut_has_a_history_and_only_its_own() -> None:
    made = derive_recording(make_repeats(), [{"trim": {"start": 10.35}}])
    first, second = extract_records(made, {"u": "u"}, {"y": "y"})
    found = first.inputs[0].history
    assert found is not None
    np.testing.assert_array_equal(found.values, [10, 11, 12, 13])
    np.testing.assert_allclose(found.times, [5.0, 5.1, 5.2, 5.3])
    np.testing.assert_allclose(first.inputs[0].times[0], 5.4)
    assert second.inputs[0].history is None
    assert derive_recording(make_repeats(), [{"trim": {"start": 5.0}}]).channel("u").history is None


def test_a_selection_keeps_a_history_with_its_segment() -> None:
    made = derive_recording(make_repeats(), [{"trim": {"start": 10.35}}])
    assert make_history(derive_recording(made, [{"select": {"n": 1}}])).values.tolist() == [
        10,
        11,
        12,
        13,
    ]
    assert derive_recording(made, [{"select": {"n": 2}}]).channel("u").history is None


def test_a_pooled_input_has_what_the_repeats_recorded_before_the_start() -> None:
    pool = {"input": "u", "outputs": ["y"], "bin": H, "start": 5.35}
    made = derive_recording(make_repeats(), [{"pool": pool}])
    np.testing.assert_allclose(make_history(made).times, [5.0, 5.1, 5.2, 5.3])
    np.testing.assert_array_equal(make_history(made).values, [10, 11, 12, 13])
    assert made.channel("y").history is None


def test_a_part_kept_for_validation_knows_the_input_before_it() -> None:
    estimation, validation = split_record(record_of(build_plant()), 0.25)
    assert estimation.inputs[0].history is None
    found = validation.inputs[0].history
    assert found is not None
    assert found.times.size == 300
    assert validation.outputs[0].history is None


def test_a_history_ends_at_its_last_missing_value_and_outputs_have_none() -> None:
    whole = build_plant()
    values = whole.channel("u").values.copy()
    values[100] = np.nan
    broken = Recording((replace(whole.channel("u"), values=values), whole.channel("y")))
    part = record_of(derive_recording(broken, [{"trim": {"rows": [CUT, 400]}}]))
    found = part.inputs[0].history
    assert found is not None
    assert found.times[0] == pytest.approx(101 * H)
    assert part.outputs[0].history is None
    values[CUT - 1] = np.nan
    bare = record_of(derive_recording(broken, [{"trim": {"rows": [CUT, 400]}}]))
    assert bare.inputs[0].history is None


@pytest.mark.parametrize("hold", HOLDS)
def test_a_simulation_reads_a_history_from_behind_its_last_missing_value(hold: Hold) -> None:
    """Given as it was recorded, the input's past may have a gap; its record must not suffer."""
    part = derive_recording(build_plant(hold=hold), [{"trim": {"rows": [CUT, 400]}}])
    [u] = record_of(part).inputs
    times, values = make_history(part)
    gap = replace(u, history=History(times, np.where(np.arange(times.size) < 60, np.nan, values)))
    behind = replace(u, history=History(times[60:], values[60:]))
    found, expected = (
        compute_response(replace(record_of(part), inputs=(one,)), 0.0) for one in (gap, behind)
    )
    np.testing.assert_array_equal(found, expected)
    unknown = replace(u, history=History(times, np.full(times.size, np.nan)))
    none = compute_response(replace(record_of(part), inputs=(replace(u, history=None),)), 0.0)
    np.testing.assert_array_equal(
        compute_response(replace(record_of(part), inputs=(unknown,)), 0.0), none
    )
    assert replace(record_of(part), inputs=(unknown,)).history_duration == 0.0


@pytest.mark.parametrize("hold", HOLDS)
def test_an_input_laid_on_times_before_a_gap_has_what_was_first_behind_it(hold: Hold) -> None:
    past = History(np.arange(4.0), np.array([5.0, np.nan, 2.0, 3.0]))
    channel = Channel("u", np.array([4.0, 5.0]), np.array([4.0, 5.0]), "V", hold, past)
    found = interpolate_channel(channel, np.arange(6.0))
    late = [2.0, 2.0, 3.0, 4.0, 5.0, 5.0]  # a mean acts from the sample before on
    np.testing.assert_array_equal(found, late if hold == "mean" else [2.0, *late[:5]])


def test_a_gap_in_the_history_leaves_a_band_limited_record_usable() -> None:
    whole = build_plant(hold="band-limited")
    kept = np.flatnonzero(np.arange(400) != 90)
    gap = Recording(
        tuple(replace(c, times=c.times[kept], values=c.values[kept]) for c in whole.channels)
    )
    part = record_of(derive_recording(gap, [{"trim": {"start": CUT * H - 0.01}}]))
    expected = whole.channel("y").values[CUT:]
    start = float(expected[0]) - TRUE["y0"]
    # The window of the interpolation ends at the gap, which it feels a little.
    np.testing.assert_allclose(compute_response(part, start), expected, atol=0.02)


@pytest.mark.parametrize(
    ("times", "values"),
    [
        ([0.5, 2.0], [1.0, 1.0]),
        ([0.5, 0.4], [1.0, 1.0]),
        ([np.nan], [1.0]),
        ([0.5, 0.6], [1.0]),
        ([], []),
    ],
)
def test_a_history_that_is_none_is_refused(times: list[float], values: list[float]) -> None:
    with pytest.raises(InvalidRecord, match="history of channel 'u'"):
        Channel(
            "u",
            np.array([1.0]),
            np.array([0.0]),
            history=History(np.array(times), np.array(values)),
        )


def test_whether_a_history_is_kept_is_true_or_false() -> None:
    with pytest.raises(InvalidSettings, match=r"/steps/0/trim/history: found 'no'; need true or"):
        derive_recording(build_plant(), [{"trim": {"start": 1, "history": "no"}}])


def test_estimates_from_a_part_are_nearer_the_truth_where_its_past_is_known() -> None:
    """A short part with a long lag: without the past a fifth of it is driven by a guess."""
    model = load_model("fopdt")
    bounds = {"L": {"upper": 1.5}, "T": {"upper": 5}}
    errors: dict[bool, float] = {}
    for keep in (True, False):
        step = {"trim": {"rows": [CUT, CUT + 40], "history": keep}}
        record = record_of(derive_recording(build_plant(noise=0.01), [step]))
        found = identify(model, record, SHORT, parameters=bounds)
        values = {one.name: one.value for one in found.parameters}
        errors[keep] = abs(values["K"] - TRUE["K"]) + abs(values["T"] - TRUE["T"])
    assert errors[True] < 0.05
    assert errors[False] > 3 * errors[True]
