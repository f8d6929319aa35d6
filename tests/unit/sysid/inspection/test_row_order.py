"""Rows out of order or twice, and clocks that restart."""

import numpy as np
import pytest

from lagid import UnreadableFile, read_recording
from service.formats.recordings import read_with_notes
from sysid.core.types import BoolArray, IntArray
from sysid.inspection.row_order import repair_order


def differ(rows: IntArray) -> BoolArray:
    return np.zeros(rows.size, dtype=np.bool_)


def write(rows: list[tuple[float, float]]) -> bytes:
    return ("t,y\n" + "".join(f"{t:g},{y:g}\n" for t, y in rows)).encode()


def test_increasing_times_need_no_repair() -> None:
    assert repair_order(np.arange(10.0), differ) is None


def test_a_row_whose_place_is_taken_is_left_out() -> None:
    rows = [(0.28, 9.0), *((0.01 * k, float(k)) for k in range(100))]
    recording, notes = read_with_notes(write(rows))
    assert recording.channels[0].values.tolist() == [float(k) for k in range(100)]
    assert any("1 of 101 rows are out of order" in note for note in notes)


def test_a_row_that_came_late_goes_to_its_hole() -> None:
    rows = [(float(k), float(k)) for k in range(100)]
    rows.insert(60, rows.pop(50))
    recording, _ = read_with_notes(write(rows))
    assert recording.channels[0].values.tolist() == [float(k) for k in range(100)]


def test_rows_that_are_written_twice_count_once() -> None:
    rows = [(float(k), float(k)) for k in range(50)]
    recording, notes = read_with_notes(write([*rows[:20], rows[19], *rows[20:]]))
    assert recording.samples == 50
    assert any("1 of 51 rows are written twice" in note for note in notes)


def test_a_clock_that_restarts_begins_another_measurement() -> None:
    rows = [(float(k), float(k)) for k in range(30)]
    recording, notes = read_with_notes(write([*rows, *rows]))
    assert len(recording.segments) == 2
    assert any("the clock goes back 1 time" in note for note in notes)


def test_two_values_at_one_time_are_refused() -> None:
    rows = [(float(k), 1.0) for k in range(40)]
    rows.insert(21, (20.0, 2.0))
    with pytest.raises(UnreadableFile, match="repeats"):
        read_recording(write(rows))


def test_rows_without_order_are_refused() -> None:
    random = np.random.default_rng(1)
    rows = [(float(t), 1.0) for t in random.permutation(40)]
    with pytest.raises(UnreadableFile, match="decreases"):
        read_recording(write(rows))
