"""Arrays and tables of other libraries become channels; what cannot be read is told in a line."""

import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pandas as pd
import polars
import pytest
import xarray as xr

from sysid.core.errors import InvalidRecord
from sysid.data.records import Channel, History, Record, Recording
from sysid.inspection.inspect import check_recording

TIMES = np.array([0.0, 0.5, 1.0, 1.75])
VALUES = np.array([1.0, 3.0, 2.0, 5.0])
START = pd.Timestamp("2026-11-20 08:00").to_pydatetime()  # a date without a zone
DATES = [START + timedelta(seconds=float(time)) for time in TIMES]
BERLIN = pd.DatetimeIndex(DATES, tz="Europe/Berlin")


def make_frame(**more: object) -> pd.DataFrame:
    return pd.DataFrame({"P1 [bar]": VALUES, "P2": VALUES + 1, **more}, index=TIMES)


@pytest.mark.parametrize(
    "times",
    [
        TIMES,
        list(TIMES),
        tuple(TIMES),
        TIMES[:, None],
        TIMES.astype(np.float32),
        TIMES.astype(">f8"),
        pd.Series(TIMES),
        pd.Index(TIMES),
        pd.to_timedelta(TIMES, unit="s"),
        [timedelta(seconds=float(time)) for time in TIMES],
        DATES,
        [date.replace(tzinfo=UTC) for date in DATES],
        np.array(DATES, dtype="datetime64[us]"),
        pd.DatetimeIndex(DATES),
        BERLIN,
        pd.Series(BERLIN),
        xr.DataArray(TIMES),
    ],
    ids=lambda times: type(times).__name__,
)
def test_times_of_any_kind_are_seconds(times: object) -> None:
    channel = Channel("u", times, VALUES)
    assert channel.times.dtype == np.float64
    assert np.array_equal(channel.times, TIMES)


@pytest.mark.parametrize(
    "values",
    [
        list(VALUES),
        VALUES[:, None],
        VALUES.astype(np.float32),
        VALUES.astype(np.int16),
        VALUES.astype(">f8"),
        np.repeat(VALUES, 2)[::2],
        pd.Series(VALUES, dtype="Float64"),
        pd.Series(VALUES, dtype="object"),
        xr.DataArray(VALUES),
    ],
    ids=lambda values: type(values).__name__,
)
def test_values_of_any_kind_are_arrays_for_compiled_code(values: object) -> None:
    channel = Channel("u", TIMES, values)
    assert np.array_equal(channel.values, VALUES)
    assert channel.values.dtype.str == np.dtype(np.float64).str
    assert channel.values.flags.c_contiguous
    assert channel.values.flags.writeable


@pytest.mark.parametrize(
    "values",
    [
        [1.0, math.nan, 3.0],
        pd.Series([1.0, None, 3.0], dtype="Float64"),
        pd.Series([1, None, 3], dtype="Int64"),
        [1.0, None, 3.0],
        np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False]),
    ],
    ids=["nan", "Float64", "Int64", "None", "masked"],
)
def test_a_missing_value_is_nan(values: object) -> None:
    assert np.array_equal(np.isnan(Channel("y", [0, 1, 2], values).values), [False, True, False])


def test_arrays_of_float64_are_not_copied() -> None:
    channel = Channel("u", TIMES, VALUES)
    assert channel.times is TIMES
    assert channel.values is VALUES


def test_a_history_may_be_lists() -> None:
    channel = Channel("u", TIMES, VALUES, history=History([-2, -1], [0, 1]))
    assert channel.history is not None
    assert channel.history.values.dtype == np.float64
    assert channel.total_samples == 6


@pytest.mark.parametrize(
    "table",
    [
        make_frame(),
        make_frame().rename_axis("t [s]"),
        make_frame().rename_axis("t").reset_index(),
        make_frame().set_index(pd.Index(1000 * TIMES, name="time [ms]")),
        make_frame().set_index(pd.DatetimeIndex(DATES)),
        make_frame().set_index(BERLIN),
        make_frame().set_index(BERLIN).rename_axis("Zeit").reset_index(),
        make_frame().set_index(pd.to_timedelta(TIMES, unit="s")),
        {"t": TIMES, "P1 [bar]": VALUES, "P2": list(VALUES + 1)},
        np.array(
            list(zip(TIMES, VALUES, VALUES + 1, strict=True)),
            dtype=[("Time [s]", "f8"), ("P1 [bar]", "f4"), ("P2", "f8")],
        ),
        xr.Dataset(
            {"P1": ("time", VALUES, {"units": "bar"}), "P2": ("time", VALUES + 1)},
            coords={"time": TIMES},
        ),
        xr.DataArray(
            np.stack([VALUES, VALUES + 1]),
            dims=("channel", "time"),
            coords={"channel": ["P1 [bar]", "P2"], "time": np.array(DATES, "datetime64[ns]")},
        ),
    ],
    ids=[
        "float index",
        "named index",
        "column t",
        "milliseconds",
        "dates",
        "dates with zone",
        "only column of dates",
        "time spans",
        "mapping",
        "structured",
        "dataset",
        "array of channels",
    ],
)
@pytest.mark.filterwarnings("ignore:times were converted from ms")
def test_a_table_is_a_recording(table: object) -> None:
    recording = Recording(table)
    assert recording.names == ("P1", "P2")
    assert [channel.unit for channel in recording.channels] == ["bar", "1"]
    for channel, values in zip(recording.channels, (VALUES, VALUES + 1), strict=True):
        assert np.allclose(channel.times, TIMES, rtol=0, atol=1e-12)
        assert np.array_equal(channel.values, values)


def test_a_table_of_polars_is_a_recording() -> None:
    table = polars.DataFrame({"when": DATES, "P1 [bar]": [1.0, None, 3.0, 4.0]})
    recording = Recording(table.with_columns(polars.col("when").dt.replace_time_zone("CET")))
    [channel] = recording.channels
    assert (channel.name, channel.unit) == ("P1", "bar")
    assert np.array_equal(channel.times, TIMES)
    assert np.array_equal(np.isnan(channel.values), [False, True, False, False])
    assert recording.started_at == pd.Timestamp(START, tz="CET")
    assert recording.started_at.hour == START.hour


def test_the_clock_of_dates_is_kept_by_a_recording() -> None:
    started = Recording(make_frame().set_index(BERLIN)).started_at
    assert started == BERLIN[0]
    assert started.hour == START.hour
    assert Recording(make_frame().set_index(pd.DatetimeIndex(DATES))).started_at == START
    assert Recording(make_frame()).started_at is None


def test_a_series_is_a_channel_with_its_times() -> None:
    series = pd.Series(VALUES, index=pd.DatetimeIndex(DATES))
    series.attrs["units"] = "V"
    channel = Channel("u", series)
    assert np.array_equal(channel.times, TIMES)
    assert channel.unit == "V"
    assert Channel("u", series, unit="mV").unit == "mV"


@pytest.mark.parametrize("as_side", ["series", "frame", "channel", "list"])
def test_series_of_dates_keep_their_distance(as_side: str) -> None:
    u = pd.Series(VALUES, index=pd.DatetimeIndex(DATES), name="u")
    late = u.iloc[2:].rename("y")
    sides = {
        "series": (u, late),
        "frame": (u.to_frame(), late.to_frame()),
        "channel": (Channel("u", u), Channel("y", late)),
        "list": ([u], [Channel("y", late)]),
    }
    record = Record(*sides[as_side])
    assert np.array_equal(record.inputs[0].times, TIMES)
    assert np.array_equal(record.outputs[0].times, TIMES[2:])
    again = Record(record.inputs, record.outputs)
    assert np.array_equal(again.outputs[0].times, TIMES[2:])


@pytest.mark.parametrize(
    "change",
    [
        lambda channel: replace(channel, hold="zero"),
        lambda channel: channel.slice_time(0.0, 1.5),
        lambda channel: channel.slice_with_history(0.25, 1.5),
        lambda channel: replace(channel, history=History([-1.0], [0.0])).history_and_samples,
        lambda channel: pickle.loads(pickle.dumps(channel)),
        lambda channel: Recording((channel,)).channel(channel.name),
        lambda channel: Recording((channel,)).replace_holds({channel.name: "zero"}).channels[0],
    ],
)
def test_a_changed_channel_keeps_its_date(change: Callable[[Channel], Channel]) -> None:
    u = Channel("u", pd.Series(VALUES, index=pd.DatetimeIndex(DATES)))
    late = u.started_at + timedelta(seconds=1)
    record = Record(change(u), change(replace(u, name="y", started_at=late)))
    moved = record.outputs[0].times - record.inputs[0].times
    assert np.allclose(moved, 1.0, rtol=0, atol=1e-12)
    assert record.outputs[0].started_at == record.inputs[0].started_at == START


def test_files_with_dates_keep_their_distance() -> None:
    first, second = (
        Recording({"t": TIMES, name: VALUES}, started_at=START + timedelta(seconds=late))
        for name, late in (("u", 0), ("y", 2))
    )
    record = Record(first.channel("u"), second.channel("y"))
    assert np.array_equal(record.outputs[0].times, TIMES + 2)


def test_a_channel_of_dates_is_not_joined_with_one_of_seconds() -> None:
    u, y = Channel("u", DATES, VALUES), Channel("y", TIMES, VALUES)
    with pytest.raises(InvalidRecord, match="'u' has dates, and channel 'y' has seconds"):
        Record(u, y)
    assert Record(u, replace(y, started_at=START)).outputs[0].times[0] == 0.0
    assert Recording((u, y), started_at=START).started_at == START


def test_a_recording_counts_from_the_date_that_it_is_given() -> None:
    recording = Recording((Channel("u", DATES, VALUES),), started_at=START - timedelta(seconds=3))
    assert np.array_equal(recording.channels[0].times, TIMES + 3)


def test_dates_with_and_without_zone_are_not_mixed() -> None:
    with pytest.raises(InvalidRecord, match="some dates have a time zone and others have none"):
        Record(Channel("u", BERLIN, VALUES), Channel("y", DATES, VALUES))


def test_one_channel_may_stand_for_a_side() -> None:
    record = Record(Channel("u", TIMES, VALUES), Channel("y", TIMES, VALUES))
    assert [channel.name for channel in (*record.inputs, *record.outputs)] == ["u", "y"]


def test_texts_of_channels_and_records_are_short() -> None:
    many = {"t": TIMES} | {f"c{number}": VALUES for number in range(40)}
    text = repr(Recording(many))
    assert text.startswith("Recording of 40 channels, from 0 to 1.75 s\n  c0: 4 samples, irregular")
    assert text.endswith("and 28 more")
    holes = Channel("y", TIMES, [1, 2, math.nan, 3], unit="bar")
    assert repr(holes).endswith("values from 1 to 3, 1 missing")
    assert repr(Record((), ())) == "Record, without channels"
    assert repr(Recording(())) == "Recording of 0 channels"


@pytest.mark.parametrize("start", [None, datetime(2026, 1, 31, 12, tzinfo=UTC)])
def test_a_recording_is_a_table_that_reads_back(start: datetime | None) -> None:
    u = Channel("u", TIMES, VALUES, unit="bar", started_at=start)
    y = Channel("y", TIMES[1:], VALUES[1:], started_at=start)
    table = Recording((y, u)).to_pandas()
    assert list(table.columns) == ["y", "u [bar]"]
    assert table.index.name == ("t" if start is None else "time")
    again = Recording(table)
    assert again.started_at == start
    assert again["u"].unit == "bar"
    assert np.array_equal(again["u"].times, TIMES)
    assert np.array_equal(again["y"].values, [np.nan, *VALUES[1:]], equal_nan=True)
    assert np.array_equal(Record(u, u).to_pandas().to_numpy(), np.column_stack([VALUES, VALUES]))


def test_channels_are_found_by_name() -> None:
    u, y = Channel("P1", TIMES, VALUES), Channel("P2", TIMES, VALUES)
    for recording in (Recording((u, y)), Record(u, y)):
        assert recording["P2"] is y
        assert (len(recording), list(recording), "P1" in recording) == (2, ["P1", "P2"], True)
        with pytest.raises(InvalidRecord, match="no channel 'speed'; known are P1, P2"):
            recording["speed"]


def test_times_that_repeat_have_no_common_table() -> None:
    pooled = Channel("a", [0.0, 0.0, 1.0], [1.0, 2.0, 3.0])
    assert Recording((pooled,)).to_pandas().shape == (3, 1)
    with pytest.raises(InvalidRecord, match="times repeat"):
        Recording((pooled, Channel("b", TIMES, VALUES))).to_pandas()


@pytest.mark.parametrize(
    ("build", "told"),
    [
        (
            lambda: Channel("u", TIMES, ["a", "b", "c", "d"]),
            "channel 'u' has text: 'a' at sample 1; need numbers",
        ),
        (lambda: Channel("u", TIMES, DATES), "channel 'u' has dates; need numbers"),
        (lambda: Channel("u", TIMES, VALUES + 1j), "has complex numbers"),
        (lambda: Channel("u", TIMES, VALUES[None, :]), r"values of shape \(1, 4\)"),
        (lambda: Channel("u", [0, 1], [[1, 2], [3]]), "cannot be read as numbers"),
        (lambda: Channel("u", VALUES), "channel 'u' has no values"),
        (
            lambda: Channel("u", None, VALUES),
            "the times of channel 'u' are not finite|cannot be read|shape",
        ),
        (lambda: Channel("u", ["2026-01-01"] * 4, VALUES), "are text such as '2026-01-01'"),
        (lambda: Channel("u", [*DATES[:3], pd.NaT], VALUES), "have NaT among dates"),
        (lambda: Channel("u", pd.DatetimeIndex([*DATES[:3], None]), VALUES), "1 missing dates"),
        (lambda: Channel("u", pd.period_range("2026", periods=4, freq="h"), VALUES), "numbers"),
        (lambda: Channel(3, TIMES, VALUES), "a channel has the name 3"),
        (lambda: Channel("u", pd.Series(VALUES)), "index of the series counts its rows"),
        (lambda: Record(5, 6), "the input side: found an object of type int"),
        (lambda: Record("heating.csv", ()), "found the text 'heating.csv'"),
        (lambda: Record(np.ones((4, 2)), ()), r"type ndarray of shape \(4, 2\)"),
        (lambda: Record([VALUES], ()), "has an object of type ndarray of shape"),
        (lambda: Recording(pd.DataFrame({"a": VALUES})), "has no times.*Columns: a$"),
        (lambda: Recording(pd.DataFrame({"t": TIMES, "note": list("abcd")})), "'note' has text"),
        (lambda: Recording(pd.DataFrame([[0, 1, 2]], columns=["t", "x", "x"])), "column 'x'"),
        (lambda: Recording({"t": [0, 1], "x": [1, 2], "x [V]": [1, 2]}), "column 'x'"),
        (lambda: Recording({"t [furlong]": [0, 1], "x": [1, 2]}), "'furlong', which is no unit"),
        (lambda: Recording(xr.DataArray(np.ones((2, 3)))), "has dimensions dim_0, dim_1"),
        (
            lambda: Recording(make_frame().set_index(pd.MultiIndex.from_product([[0, 1], [2, 3]]))),
            "has no times",
        ),
    ],
)
def test_what_cannot_be_read_is_told_in_one_line(build, told: str) -> None:
    with pytest.raises(InvalidRecord, match=told) as caught:
        build()
    assert "\n" not in str(caught.value)


def _table(**columns: list[Any]) -> dict[str, list[Any]]:
    return {"t": [0.0, 1.0, 2.0, 3.0], "u": [0.0, 1.0, 1.0, 0.0], **columns}


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        (_table(u=[0.0, np.inf, 1.0, 0.0]), "channel 'u' is infinite at t = 1 s"),
        (_table(t=[0.0, 1.0, 1.0, 2.0]), "samples 2 and 3 are both at 1 s"),
        (_table(u=[0.0, 1.0, "abc", 0.0]), "has text: 'abc' at sample 3"),
    ],
)
def test_what_is_refused_in_a_file_is_refused_in_a_table(
    table: dict[str, list[Any]], reason: str
) -> None:
    with pytest.raises(InvalidRecord, match=reason):
        Recording(table)


def test_missing_values_of_a_table_are_told_as_those_of_a_file() -> None:
    recording = Recording(_table(u=[0.0, np.nan, None, 0.0]))
    (finding,) = check_recording(recording)
    assert "'u': 2 of 4 values are missing" in finding.text
    assert "the first at t = 1 s" in finding.text
    assert np.isnan(recording.channels[0].values).sum() == 2
