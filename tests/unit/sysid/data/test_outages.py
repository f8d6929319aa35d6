"""Outages: which gaps are some, and where a record is cut."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.types import BoolArray, FloatArray
from sysid.data.outages import extract_records, find_cuts, find_outages, list_cuts
from sysid.data.records import Channel, Recording

SAMPLES = 600
GONE = slice(250, 400)


def build_recording(u: FloatArray | None = None) -> Recording:
    times = np.arange(float(SAMPLES))
    moves = np.repeat(np.random.default_rng(3).uniform(0, 1, SAMPLES // 20), 20)
    return Recording(
        (Channel("u", times, moves if u is None else u), Channel("y", times, np.sin(0.1 * times)))
    )


def drop_rows(recording: Recording, kept: BoolArray) -> Recording:
    channels = (
        replace(one, times=one.times[kept], values=one.values[kept]) for one in recording.channels
    )
    return replace(recording, channels=tuple(channels))


def empty_cells(recording: Recording, name: str) -> Recording:
    def empty(channel: Channel) -> Channel:
        values = channel.values.copy()
        values[GONE] = np.nan
        return replace(channel, values=values)

    channels = (empty(one) if one.name == name else one for one in recording.channels)
    return replace(recording, channels=tuple(channels))


def find_kept() -> BoolArray:
    kept = np.ones(SAMPLES, dtype=bool)
    kept[GONE] = False
    return kept


def test_rows_that_are_lost_one_by_one_are_no_outage() -> None:
    random = np.random.default_rng(1)
    for share in (0.01, 0.1, 0.5):
        times = np.arange(2000.0)[random.random(2000) > share]
        assert find_outages(times) == []


def test_gaps_between_bursts_of_a_few_samples_are_no_outages() -> None:
    begins = np.cumsum([0, 30, 34, 36, 33, 35, 31])
    times = (begins[:, None] + np.arange(5)).ravel().astype(float)
    assert find_outages(times) == []
    once = np.concatenate([np.arange(40.0), 60.0 + np.arange(40.0)])
    assert [one.rows for one in find_outages(once)] == [20]  # such a gap alone is one


def test_one_outage_does_not_hide_another() -> None:
    times = np.delete(np.arange(1000.0), np.r_[100:300, 500:700])
    assert [(one.start, one.rows) for one in find_outages(times)] == [(99.0, 200), (499.0, 200)]


def test_empty_cells_and_missing_rows_are_cut_alike() -> None:
    roles = {"u": "u"}, {"y": "y"}
    by_rows = extract_records(drop_rows(build_recording(), find_kept()), *roles)
    by_cells = extract_records(empty_cells(build_recording(), "u"), *roles)
    for records in (by_rows, by_cells):
        first, second = records
        assert (first.start, first.stop) == (0.0, 249.0)
        assert (second.start, second.stop) == (450.0, 599.0)
        assert second.history_duration == 50.0
        assert second.inputs[0].history is not None
        assert second.inputs[0].history.times[0] == 400.0


def test_an_output_without_values_for_a_while_is_not_cut() -> None:
    (record,) = extract_records(empty_cells(build_recording(), "y"), {"u": "u"}, {"y": "y"})
    assert record.outputs[0].values.size == SAMPLES


def test_an_input_at_rest_needs_no_cut() -> None:
    step = np.where(np.arange(SAMPLES) < 30, 0.0, 1.0)
    step[:20] = 0.0
    still = drop_rows(build_recording(np.zeros(SAMPLES)), find_kept())
    assert find_cuts(still, ["u"]) == ()
    assert find_cuts(drop_rows(build_recording(step), find_kept()), ["u"]) != ()


def test_an_experiment_that_is_far_shorter_than_the_others_is_left_out() -> None:
    kept = np.ones(SAMPLES, dtype=bool)
    kept[400:570] = False
    (record,) = extract_records(drop_rows(build_recording(), kept), {"u": "u"}, {"y": "y"})
    assert record.stop == 399.0


def test_an_input_that_starts_later_begins_the_experiment() -> None:
    recording = build_recording()
    late = replace(
        recording.channel("u"),
        times=recording.channel("u").times[200:],
        values=recording.channel("u").values[200:],
    )
    recording = replace(recording, channels=(late, recording.channel("y")))
    (record,) = extract_records(recording, {"u": "u"}, {"y": "y"})
    assert record.start == pytest.approx(200.0 + 0.25 * 399.0, abs=1.0)


def test_an_input_that_is_logged_at_its_changes_is_not_silent_between_them() -> None:
    random = np.random.default_rng(2)
    moments = np.concatenate([[0.0], np.cumsum(random.exponential(20.0, 20))])
    command = Channel("u", moments, random.uniform(0, 1, 21), hold="zero")
    times = np.arange(0.0, moments[-1] + 400.0)
    recording = Recording((command, Channel("y", times, np.sin(times))))
    assert find_cuts(recording, ["u"]) == ()


def test_outages_that_overlap_are_one() -> None:
    cuts = list_cuts(0.0, 100.0, [(20.0, 60.0), (30.0, 40.0)])
    assert [(one.known_from, one.stop) for one in cuts] == [(0.0, 20.0), (60.0, 100.0)]
