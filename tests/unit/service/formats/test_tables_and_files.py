"""A table of pandas and the file of the same table are one recording: the same rules read both."""

import warnings
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest

from service.formats.recordings import read_recording
from sysid.core.errors import UnreadableFile
from sysid.data.records import Recording
from sysid.data.table_rules import ReadingNote

TIMES = np.arange(40) / 10.0
INPUT = np.where(TIMES < 1, 0.0, 1.0)
OUTPUT = np.round(np.sin(TIMES), 6)
CLOCK = 1773475200.5


def read(source: Callable[[], Recording]) -> tuple[Recording, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        recording = source()
    notes = [one for one in caught if one.category is ReadingNote]
    assert {one.filename for one in notes} <= {__file__}  # the place where the user reads
    return recording, [str(one.message) for one in notes]


def assert_same(table: pd.DataFrame) -> Recording:
    """Read a table and its file; they are the same bit for bit, and so are their notes."""
    content = table.to_csv(index=False).encode()
    (file, of_file), (frame, of_frame) = (
        read(source) for source in (lambda: read_recording(content), lambda: Recording(table))
    )
    assert frame.names == file.names
    assert frame.started_at == file.started_at
    for channel, other in zip(frame.channels, file.channels, strict=True):
        assert channel.unit == other.unit
        assert np.array_equal(channel.times, other.times)
        assert np.array_equal(channel.values, other.values, equal_nan=True)
    assert of_frame == of_file
    return frame


@pytest.mark.parametrize(
    ("time", "scale"),
    [
        *((name, 1.0) for name in ("t", "Time (s)", "t/s", "timestamp", "Zeit", "elapsed")),
        *((name, 1.0) for name in ("t [sec]", "Elapsed Time", "x value", "T")),
        *((name, 1e3) for name in ("time_ms", "t [ms]", "Time (msec)")),
        *((name, 1 / 3600) for name in ("t [hours]", "t/h", "time in h")),
    ],
)
def test_the_time_has_the_same_name_and_unit(time: str, scale: float) -> None:
    table = pd.DataFrame({time: TIMES * scale, "u (V)": INPUT, "y [°C]": OUTPUT})
    recording = assert_same(table)
    assert recording.names == ("u", "y")
    np.testing.assert_allclose(recording.channels[0].times, TIMES, rtol=0, atol=1e-9)


def test_a_rising_temperature_is_not_the_time() -> None:
    table = pd.DataFrame({"T": 20 + TIMES, "time": TIMES, "u": INPUT})
    assert assert_same(table).names == ("T", "u")


@pytest.mark.parametrize("size", [1.0, 1e3, 1e6])
def test_a_clock_since_1970_is_counted_from_its_first_sample(size: float) -> None:
    times = np.round(CLOCK * size + TIMES * size, 6)
    recording = assert_same(pd.DataFrame({"t": times, "u": INPUT}))
    assert recording.started_at is not None
    assert recording.started_at.timestamp() == CLOCK
    np.testing.assert_allclose(recording.channels[0].times, TIMES, rtol=0, atol=1e-6)


def test_serial_dates_of_a_spreadsheet_are_dates() -> None:
    recording = assert_same(pd.DataFrame({"t": 46095.25 + TIMES / 86_400, "u": INPUT}))
    assert str(recording.started_at) == "2026-03-14 06:00:00"


@pytest.mark.parametrize("name", ["No", "Index", "Sample", "Sample #", "record_number", "Scan No."])
def test_an_index_that_counts_rows_is_left_out(name: str) -> None:
    table = pd.DataFrame({name: np.arange(40) + 1, "t": TIMES, "u": INPUT})
    with pytest.warns(ReadingNote, match="counts rows and was left out"):
        assert Recording(table).names == ("u",)
    with pytest.warns(ReadingNote, match="counts rows and was left out"):
        assert read_recording(table.to_csv(index=False).encode()).names == ("u",)
    gap = pd.DataFrame({name: np.arange(40) * 2, "t": TIMES, "u": INPUT})
    assert assert_same(gap).names == (name, "u")


def test_an_index_alone_is_no_time_and_is_told() -> None:
    content = b"Sample,u,y\n1,0,0\n2,1,0\n3,1,1\n"
    with pytest.raises(UnreadableFile, match=r"Column 'Sample' only counts rows.*sample_time\."):
        read_recording(content)
    with pytest.warns(ReadingNote, match="Sample.* counts rows and was left out"):
        assert read_recording(content, sample_time=0.1).names == ("u", "y")


def test_a_time_that_repeats_may_be_no_time() -> None:
    content = b"t,u,y\n0,0,0\n1,1,0\n1,1,1\n"
    with pytest.raises(UnreadableFile, match=r"repeats.*remove it and give .* sample_time"):
        read_recording(content)
    without = b"u,y\n0,0\n1,0\n1,1\n"
    assert read_recording(without, sample_time=0.1).duration == 0.2


def test_dates_are_rounded_once() -> None:
    dates = pd.date_range("2026-03-14", periods=10, freq="100ms")
    table = pd.DataFrame({"time": dates, "u": INPUT[:10]})
    file = read(lambda: read_recording(table.to_csv(index=False).encode()))[0]
    spans = table[["u"]].set_index(dates - dates[0])
    for other in (table, table.set_index("time"), spans):
        assert np.array_equal(Recording(other).channels[0].times, file.channels[0].times)
    assert file.channels[0].times[3] == 0.3


def test_a_channel_is_named_by_its_column_or_without_the_unit() -> None:
    from sysid.identification.identify_arguments import read_records
    from sysid.models.catalogue.load import resolve_model

    table = pd.DataFrame({"t": TIMES, "u (V)": INPUT, "y": OUTPUT})
    model = resolve_model("fopdt")
    for name in ("u (V)", "u"):
        (record,) = read_records(model, table, {"u": name, "y": "y"}).records
        assert record.inputs[0].unit == "V"
