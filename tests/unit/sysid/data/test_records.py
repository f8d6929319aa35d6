"""Recordings: experiments made from channels, samplings, splitting."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.errors import InvalidRecord, InvalidSettings, suggest_name
from sysid.data.outages import extract_records
from sysid.data.records import (
    Channel,
    History,
    Record,
    Recording,
    Segment,
    find_common_sample_time,
    measure_sampling,
    trim_missing_history,
)
from sysid.data.splitting import split_record


def make_ramp(name: str, samples: int = 10, period: float = 0.1) -> Channel:
    return Channel(name, np.arange(samples) * period, np.arange(samples, dtype=float))


def test_a_record_carries_the_models_names() -> None:
    recording = Recording((make_ramp("P1"), make_ramp("P2")))
    record = recording.to_record({"u": "P1"}, {"y": "P2"}, "tube")
    assert [one.name for one in (*record.inputs, *record.outputs)] == ["u", "y"]
    assert record.duration == pytest.approx(0.9)


def test_an_unknown_channel_is_told_with_the_nearest() -> None:
    with pytest.raises(InvalidRecord, match="did you mean 'P1'"):
        Recording((make_ramp("P1"),)).to_record({"u": "P11"}, {"y": "P1"})


def test_of_very_many_names_a_message_lists_some() -> None:
    told = suggest_name("zzz", (f"dataset {n:03}" for n in range(150)))
    assert told.startswith("; known are dataset 000, ")
    assert told.endswith("dataset 029, and 120 more")
    assert suggest_name("zzz", ["b", "a"]) == "; known are a, b"


def test_an_output_that_is_its_own_input_is_refused() -> None:
    recording = Recording((make_ramp("P1"), make_ramp("P2")))
    with pytest.raises(InvalidRecord, match="'P2' is both input 'u' and output 'y'"):
        recording.to_record({"u": "P2"}, {"y": "P2"})


def test_a_sample_without_a_value_is_no_sample_of_an_input() -> None:
    holes = Channel("x", np.arange(3.0), np.array([1.0, np.nan, 2.0]))
    recording = Recording((holes,))
    assert recording.to_record({}, {"y": "x"}).outputs[0].values.size == 3
    assert recording.to_record({"u": "x"}, {}).inputs[0].times.tolist() == [0.0, 2.0]
    empty = Recording((replace(holes, values=np.full(3, np.nan)),))
    for roles in (({"u": "x"}, {}), ({}, {"y": "x"})):
        with pytest.raises(InvalidRecord, match="has no value"):
            empty.to_record(*roles)


def test_several_segments_are_several_experiments_on_their_own_times() -> None:
    channel = Channel("y", np.array([0.0, 0.5, 1.0, 1.25]), np.arange(4.0))
    segments = (Segment(0, 0.5, 0.0, {"n": 1}), Segment(1, 1.25, 3.0, {"n": 2}))
    recording = Recording((channel,), segments)
    with pytest.raises(InvalidRecord, match="2 segments"):
        recording.to_record({}, {"y": "y"})
    first, second = extract_records(recording, {}, {"y": "y"})
    np.testing.assert_array_equal(first.outputs[0].times, [0, 0.5])
    np.testing.assert_array_equal(second.outputs[0].times, [3, 3.25])


def test_a_part_holds_the_samples_at_both_of_its_ends() -> None:
    channel = Channel("y", np.arange(6.0), np.arange(6.0) ** 2)
    np.testing.assert_array_equal(channel.slice_time(1.0, 4.0).times, [1, 2, 3, 4])
    with pytest.raises(InvalidRecord, match=r"no sample from 1\.25 to 1\.75 s"):
        channel.slice_time(1.25, 1.75)


def test_a_record_is_known_before_its_start_as_long_as_all_inputs_are() -> None:
    def make_input(since: float | None) -> Channel:
        before = None if since is None else np.arange(since, 0.0)
        history = None if before is None else History(before, np.ones(before.size))
        return Channel("u", np.arange(3.0), np.ones(3), history=history)

    output = Channel("y", np.arange(3.0), np.ones(3))
    assert Record((make_input(-5.0), make_input(-2.0)), (output,)).history_duration == 2.0
    assert Record((make_input(-5.0), make_input(None)), (output,)).history_duration == 0.0
    assert Record((), (output,)).history_duration == 0.0


def test_a_history_is_cut_behind_the_last_of_its_gaps() -> None:
    holes = np.array([1.0, np.nan, 3.0, np.nan, 5.0, 6.0])
    kept = trim_missing_history(History(np.arange(-6.0, 0.0), holes))
    assert kept is not None
    assert (kept.times.tolist(), kept.values.tolist()) == ([-2, -1], [5, 6])


def test_one_sample_off_its_place_makes_a_long_record_irregular() -> None:
    times = np.arange(1000) * 0.1
    times[500] += 0.02
    assert not measure_sampling(times).is_regular


def test_records_have_one_sampling_period_only_if_all_outputs_share_it() -> None:
    slow, fast = (Record((), (make_ramp("y", 20, period),)) for period in (0.2, 0.1))
    assert find_common_sample_time([slow, slow]) == pytest.approx(0.2)
    assert find_common_sample_time([slow, fast]) is None


def test_regular_and_irregular_times_are_told_apart() -> None:
    assert measure_sampling(np.arange(5) * 0.1).is_regular
    assert measure_sampling(
        np.round(np.arange(100) / 610.35, 5)
    ).is_regular  # printed with few digits
    irregular = measure_sampling(np.array([0.0, 1.0, 2.0, 5.0]))
    assert not irregular.is_regular
    assert irregular.period == 1.0
    assert "irregular" in str(irregular)
    assert "every 0.1 s" in str(measure_sampling(np.arange(5) * 0.1))
    assert str(measure_sampling(np.zeros(1))) == "one sample"


def test_splitting_gives_every_sample_to_one_part() -> None:
    record = Record((make_ramp("u", 20, 0.05),), (make_ramp("y"),))
    estimation, validation = split_record(record, 0.3)
    assert [part.outputs[0].values.size for part in (estimation, validation)] == [7, 3]
    for before, kinds in ((record.inputs, "inputs"), (record.outputs, "outputs")):
        parts = [getattr(part, kinds)[0].values for part in (estimation, validation)]
        np.testing.assert_array_equal(np.concatenate(parts), before[0].values)
    assert estimation.stop < validation.start


@pytest.mark.parametrize("fraction", [0.0, 1.0, -1.0, 0.01, float("nan")])
def test_a_fraction_that_leaves_a_part_empty_is_refused(fraction: float) -> None:
    with pytest.raises(InvalidSettings, match="/validation/fraction"):
        split_record(Record((), (make_ramp("y"),)), fraction)


def test_a_channel_without_samples_in_a_part_is_told() -> None:
    early = Channel("u", np.array([0.0]), np.array([1.0]))
    with pytest.raises(InvalidSettings, match="channel 'u' has no sample"):
        split_record(Record((early,), (make_ramp("y"),)), 0.5)
