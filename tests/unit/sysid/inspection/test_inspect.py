"""What is found of a record before it is fitted, and that nothing is found of a sound one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.judgement_kinds import draw_case
from lagid import Channel, Record, Recording, check_recording, identify
from service.formats.mcap.mcap_files import write_recording
from service.formats.recordings import read_with_notes
from sysid.core.types import FloatArray
from sysid.data.records import Segment
from sysid.inspection.inspect import inspect_recording
from sysid.inspection.resampling import find_knots, measure_drawn

SAMPLES, PERIOD = 500, 0.5
SEED = 41_000


def build_signal(seed: int = 0, noise: float = 0.05) -> FloatArray:
    random = np.random.default_rng(seed)
    wave = np.sin(0.05 * np.arange(SAMPLES)) + 0.4 * np.sin(0.021 * np.arange(SAMPLES) + 1.0)
    return np.asarray(20.0 + 5.0 * wave + noise * random.standard_normal(SAMPLES))


def find(change: Callable[[FloatArray], FloatArray], times: FloatArray | None = None) -> list[str]:
    """Names of what is found of one changed signal."""
    values = change(build_signal())
    times = PERIOD * np.arange(values.size) if times is None else times
    return [one.explanation for one in check_recording(Recording((Channel("y", times, values),)))]


def repeat_each(values: FloatArray, every: int = 4) -> FloatArray:
    return np.repeat(values[::every], every)


def round_to(values: FloatArray, step: float) -> FloatArray:
    return np.asarray(step * np.round(values / step))


def stick(values: FloatArray) -> FloatArray:
    return np.where((np.arange(SAMPLES) > 100) & (np.arange(SAMPLES) < 150), values[101], values)


def resample(values: FloatArray) -> FloatArray:
    return np.interp(np.arange(SAMPLES), np.arange(0, SAMPLES, 5), values[::5])


def store_means(values: FloatArray) -> FloatArray:
    levels = np.repeat(np.random.default_rng(1).uniform(0, 1, SAMPLES // 20), 20)
    jumps = np.arange(20, SAMPLES, 20)
    levels[jumps] = 0.4 * levels[jumps - 1] + 0.6 * levels[jumps]
    return levels


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda y: y, []),
        (repeat_each, ["repeated reading"]),
        (lambda y: round_to(y, 0.5), ["quantisation"]),
        (lambda y: round_to(y, 0.15), []),
        (lambda y: round_to(y, 0.05), []),
        (lambda y: round_to(y, 0.001), []),
        (lambda y: np.minimum(y, 23.0), ["limit of a sensor"]),
        (stick, ["repeated reading"]),
        (resample, ["interpolated reading"]),
        (store_means, ["half-way values"]),
        (lambda y: np.where(np.arange(SAMPLES) < 300, y, 1.8 * y + 32.0), ["change of a unit"]),
        (lambda y: np.where(np.arange(SAMPLES) < 300, y, y + 30.0), []),
        (lambda y: np.where(np.arange(SAMPLES) == 77, np.nan, y), ["missing values"]),
    ],
)
def test_each_kind_is_found_alone(
    change: Callable[[FloatArray], FloatArray], expected: list[str]
) -> None:
    assert find(change) == expected


def test_stamps_that_are_rounded_scatter_or_follow_no_pace() -> None:
    even = PERIOD * np.arange(SAMPLES)
    random = np.random.default_rng(5)
    assert find(lambda y: y, np.floor(even / 0.3) * 0.3) == ["rounded stamps"]
    assert find(lambda y: y, even + random.uniform(-0.2, 0.2, SAMPLES)) == ["jitter"]
    waits = np.cumsum(random.exponential(PERIOD, SAMPLES))
    assert find(lambda y: y, waits) == ["irregular sampling"]


def test_a_few_lost_rows_are_told_and_an_outage_is() -> None:
    even = PERIOD * np.arange(SAMPLES)
    kept = np.delete(np.arange(SAMPLES), [50, 200, 201])
    (finding,) = check_recording(Recording((Channel("y", even[kept], build_signal()[kept]),)))
    assert "3 of 500 rows" in finding.text
    gone = np.delete(np.arange(SAMPLES), np.arange(100, 200))
    (finding,) = check_recording(Recording((Channel("y", even[gone], build_signal()[gone]),)))
    assert (finding.explanation, finding.spans) == ("outage", ((49.5, 100.0),))


def test_a_channel_that_starts_later_is_told() -> None:
    times = PERIOD * np.arange(SAMPLES)
    late = Channel("u", times[100:], build_signal(1)[100:])
    found = check_recording(Recording((late, Channel("y", times, build_signal()))))
    assert [(one.explanation, one.channels) for one in found] == [("late start", ("u",))]


def test_a_command_that_is_held_repeats_nothing() -> None:
    times = np.arange(400.0)
    levels = np.repeat(np.random.default_rng(2).uniform(0, 1, 40), 10)
    record = Record(Channel("u", times, levels), Channel("y", times, build_signal()[:400]))
    assert check_recording(record) == ()


def test_every_segment_is_inspected_by_itself() -> None:
    times = np.concatenate([start + PERIOD * np.arange(100) for start in (0.0, 1000.0, 2000.0)])
    values = np.tile(np.minimum(build_signal()[:100], 24.0), 3)
    segments = tuple(Segment(start, start + 49.5) for start in (0.0, 1000.0, 2000.0))
    recording = Recording((Channel("y", times, values),), segments)
    (finding,) = inspect_recording(recording)
    assert finding.explanation == "limit of a sensor"
    assert "2 other segments" in finding.text
    assert max(stop for _, stop in finding.spans) > 2000.0


@pytest.mark.parametrize("kind", ["sound_fopdt", "sound_noise_free", "sound_ar1", "sound_cooler"])
def test_nothing_is_found_of_sound_records(kind: str) -> None:
    for seed in range(SEED, SEED + 5):
        assert check_recording(draw_case(kind, seed).recording) == ()


def test_what_happened_is_in_the_result() -> None:
    case = draw_case("saturated", SEED)
    found = identify(case.model, case.recording)
    events = [one for one in found.findings if one.explanation == "limit of a sensor"]
    assert len(events) == 1


def test_the_result_of_a_cut_record_says_so() -> None:
    recording = draw_case("sound_fopdt", SEED + 4).recording
    kept = np.delete(np.arange(recording.samples), np.arange(120, 200))
    channels = tuple(
        replace(one, times=one.times[kept], values=one.values[kept]) for one in recording.channels
    )
    found = identify("fopdt", replace(recording, channels=channels))
    assert "the record is cut" in " ".join(found.warnings)
    assert any(one.name == "x(0)[2]" for one in found.parameters)


def test_levels_that_were_drawn_for_a_test_are_no_polled_sensor() -> None:
    levels = np.repeat(np.random.default_rng(4).uniform(0, 1, SAMPLES // 10), 10)
    assert find(lambda _: levels) == []


def test_a_jump_that_a_conversion_meets_by_chance_is_no_change_of_a_unit() -> None:
    def jump(values: FloatArray) -> FloatArray:
        late = np.arange(SAMPLES) >= 300
        return np.where(late, values + 0.8 * values[300] + 32.0, values)

    assert find(jump) == []


def test_what_an_mcap_file_says_is_inspected_like_a_table(tmp_path: Path) -> None:
    times = np.delete(PERIOD * np.arange(SAMPLES), np.arange(100, 200))
    values = np.delete(build_signal(), np.arange(100, 200))
    write_recording(Recording((Channel("y", times, values),)), tmp_path / "gap.mcap")
    recording, _ = read_with_notes(tmp_path / "gap.mcap")
    assert [one.explanation for one in check_recording(recording)] == ["outage"]


def test_values_in_steps_lie_on_lines_by_chance_and_interpolated_ones_do_not() -> None:
    times = PERIOD * np.arange(SAMPLES)
    for values, is_drawn in (
        (round_to(build_signal(), 0.05), False),
        (resample(build_signal()), True),
    ):
        assert (measure_drawn(values, find_knots(times, values)) > 0.0) == is_drawn
