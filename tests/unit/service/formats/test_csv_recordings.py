"""CSV files: what is understood, and that every fault is told with its place in one line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.formats.limits import DEFAULT_LIMITS
from service.formats.read_options import ReadOptions
from service.formats.tabular.csv_recordings import generate_csv, read_csv
from sysid.core.errors import UnreadableFile
from sysid.data.records import Channel, Recording
from sysid.inspection.inspect import check_recording


def read_refusal(content: str | bytes, **options: object) -> UnreadableFile:
    data = content if isinstance(content, bytes) else content.encode()
    with pytest.raises(UnreadableFile) as caught:
        read_csv(data, ReadOptions(**options))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    return caught.value


def test_names_units_times_and_values_are_read() -> None:
    recording, notes = read_csv(b"t,u [V],y [m/s]\n0,1,-2.5\n0.1,2,3e-3\n0.2,3,4\n")
    assert recording.names == ("u", "y")
    assert [channel.unit for channel in recording.channels] == ["V", "m/s"]
    np.testing.assert_array_equal(recording.channels[0].times, [0, 0.1, 0.2])
    np.testing.assert_array_equal(recording.channels[1].values, [-2.5, 3e-3, 4])
    assert notes == ()


@pytest.mark.parametrize("name", ["t", "t_s", "t [s]", "time", "Time [s]", "T_S"])
def test_the_time_column_goes_by_several_names(name: str) -> None:
    recording, _ = read_csv(f"{name},u\n0,1\n1,2\n".encode())
    assert recording.names == ("u",)


@pytest.mark.parametrize(
    ("unit", "row", "seconds"),
    [("min", 0.1, 6.0), ("ms", 3.0, 0.003), ("h", 0.5, 1800.0), ("Sec", 3.0, 3.0)],
)
def test_times_in_another_unit_become_seconds(unit: str, row: float, seconds: float) -> None:
    recording, notes = read_csv(f"t [{unit}],u\n0,1\n{row},2\n{2 * row},3\n".encode())
    assert recording.channel("u").times.tolist() == [0.0, seconds, 2 * seconds]
    told = f"times were converted from {unit} to s: delays and time constants are in s"
    assert notes == (() if unit == "Sec" else (told,))


def test_times_in_milliseconds_are_the_nearest_numbers_of_seconds() -> None:
    rows = "".join(f"{k},{k}\n" for k in range(1, 1000))
    recording, _ = read_csv(f"t [ms],u\n{rows}".encode())
    expected = [float(f"0.{k:03}") for k in range(1, 1000)]
    assert recording.channel("u").times.tolist() == expected


def test_a_unit_that_is_part_of_a_name_stays_in_the_name() -> None:
    recording, _ = read_csv(b"t_s,P1_true_Pa\n0,1\n1,2\n")
    assert recording.names == ("P1_true_Pa",)


@pytest.mark.parametrize("sign", [",", ";", "\t"])
def test_comma_semicolon_and_tab_separate(sign: str) -> None:
    recording, _ = read_csv(sign.join("tuy").encode() + f"\n0{sign}1{sign}2\n".encode())
    assert [channel.values[0] for channel in recording.channels] == [1, 2]


@pytest.mark.parametrize("sign", [";", "\t"])
def test_decimal_commas_are_detected_and_said(sign: str) -> None:
    recording, notes = read_csv("t;u\n0,0;1,5\n0,1;-2\n".replace(";", sign).encode())
    np.testing.assert_array_equal(recording.channel("u").values, [1.5, -2])
    assert any("decimal commas" in note for note in notes)


def test_a_byte_order_mark_windows_line_ends_blank_rows_and_quotes_do_no_harm() -> None:
    recording, _ = read_csv(b'\xef\xbb\xbf"t","u"\r\n0,"1"\r\n\r\n1,2\r\n\r\n')
    np.testing.assert_array_equal(recording.channel("u").values, [1, 2])


def test_a_given_sampling_period_stands_for_the_time_column() -> None:
    recording, _ = read_csv(b"u,y\n1,2\n3,4\n5,6\n", ReadOptions(sample_time=0.5))
    np.testing.assert_array_equal(recording.channel("y").times, [0, 0.5, 1])
    single, _ = read_csv(b"u\n1\n2\n", ReadOptions(sample_time=0.5))
    assert single.names == ("u",)


def test_a_path_is_read_like_its_content(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"t,u\n0,1\n1,2\n")
    recording, _ = read_csv(tmp_path / "a.csv")
    assert recording.samples == 2


def test_irregular_times_are_kept_and_said() -> None:
    recording, _ = read_csv(b"t,u\n0,1\n1,2\n5,3\n")
    np.testing.assert_array_equal(recording.channel("u").times, [0, 1, 5])
    assert [one.explanation for one in check_recording(recording)] == ["irregular sampling"]


def test_missing_values_become_nan_and_are_said() -> None:
    recording, _ = read_csv(b"t,u,y\n0,1,\n1,2,NaN\n2,3,7\n")
    np.testing.assert_array_equal(recording.channel("y").values, [np.nan, np.nan, 7])
    (finding,) = check_recording(recording)
    assert "2 of 3 values are missing" in finding.text
    assert "t = 0 s" in finding.text


def test_the_times_of_a_clock_are_counted_from_the_first() -> None:
    recording, notes = read_csv(b"t,u\n1700000000.5,1\n1700000001.5,2\n")
    np.testing.assert_array_equal(recording.channel("u").times, [0, 1])
    assert any("1700000000.5" in note for note in notes)


def test_segments_are_laid_end_to_end_with_their_labels() -> None:
    content = (
        b"length,phase,t,u\n1,fill,0,1\n1,fill,0.5,2\n1,vent,0.1,3\n1,vent,0.3,4\n2,vent,0,5\n"
    )
    recording, _ = read_csv(content, ReadOptions(segments=("length", "phase")))
    assert recording.names == ("u",)
    np.testing.assert_array_equal(recording.channel("u").times, [0, 0.5, 1, 1.2, 2])
    assert [dict(one.labels) for one in recording.segments] == [
        {"length": 1.0, "phase": "fill"},
        {"length": 1.0, "phase": "vent"},
        {"length": 2.0, "phase": "vent"},
    ]
    pieces = recording.split_segments()
    np.testing.assert_array_equal(pieces[1].channel("u").times, [0.1, 0.3])


def test_the_axis_of_segments_has_the_decimals_that_were_written() -> None:
    rows = "".join(f"{n},{0.3 + 0.1 * k:.1f},{k}\n" for n in range(4) for k in range(9))
    recording, _ = read_csv(f"n,t,u\n{rows}".encode(), ReadOptions(segments=("n",)))
    expected = [float(f"{n + 0.1 * k:.1f}") for n in range(4) for k in range(9)]
    assert recording.channel("u").times.tolist() == expected
    for piece in recording.split_segments():
        assert piece.channel("u").times.tolist() == [0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1]


def test_a_segment_as_long_as_a_round_step_does_not_touch_the_next() -> None:
    recording, _ = read_csv(b"n,t,u\n1,0,1\n1,1,2\n2,0,3\n2,1,4\n", ReadOptions(segments=("n",)))
    assert recording.channel("u").times.tolist() == [0.0, 1.0, 2.0, 3.0]


def test_labels_are_numbers_only_if_all_of_them_are_finite() -> None:
    recording, _ = read_csv(
        b"n,m,t,u\n1,1,0,1\n1,1,1,1\nnan,2,0,2\nnan,2,1,2\n", ReadOptions(segments=("n", "m"))
    )
    assert [dict(one.labels) for one in recording.segments] == [
        {"n": "1", "m": 1.0},
        {"n": "nan", "m": 2.0},
    ]


def test_equal_times_are_allowed_inside_repeats_only() -> None:
    recording, notes = read_csv(b"n,t,u\n1,0,1\n1,0,2\n2,0,3\n", ReadOptions(segments=("n",)))
    assert recording.samples == 3
    assert any("same time" in note for note in notes)


def test_a_text_in_a_column_of_numbers_is_told_with_row_and_column() -> None:
    error = read_refusal("t,u,y\n0,1,2\n1,2,oops\n")
    assert (error.row, error.column) == (3, "y")
    assert "'oops'" in error.detail
    assert error.pointer == "/rows/3/y"


def test_blank_rows_count_where_a_fault_is_told() -> None:
    assert read_refusal("t,u\n0,1\n\n\n1,2\n\n2,x\n").row == 7
    assert read_refusal("t,u\n0,1\n\n0,2\n").row == 4


def test_the_row_of_a_fault_far_down_is_right() -> None:
    rows = "".join(f"{k},{k}\n" for k in range(120_000))
    assert read_refusal(f"t,u\n{rows}120000,x\n").row == 120_002


@pytest.mark.parametrize(
    ("rows", "words"),
    [("0,1\n0.5,1\n0.5,2\n", "repeats"), ("0,1\n0.5,1\n0.25,2\n", "decreases")],
)
def test_repeated_and_decreasing_times_are_told_with_both_values(rows: str, words: str) -> None:
    error = read_refusal("t,u\n" + rows)
    assert (error.row, error.column) == (4, "t")
    assert words in error.detail
    assert "0.5 s is followed by" in error.detail


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "the file is empty"),
        ("\n\n", "first rows are empty"),
        ("t\n1\n2\n", "only one column"),
        ("1\n2\n", "only one column"),
        ("t,u\n", "no rows"),
        ("t,u\n\n\n", "no rows"),
        ("A letter about the plant.\n\nIt has words, and a comma.\n", "this is not a table"),
        ("# Title\n\nIt has 12 words; and 5 more.\n- one, two\n", "this is not a table"),
        ("a,u.\n0,1\n", "found a, u. Name one of them"),
        ("a b c d e f g h i j\n0 1 2 3 4 5 6 7 8 9\n", "a, b, c, d, e, f, g, h and 2 more. Name"),
        ("1,2\n3,4\n", "header"),
        ("a,u\n0,1\n", "no time column"),
        ("t,\n0,1\n", "has no name"),
        ("t [V],u\n0,1\n", "times are in [V]; need seconds, or another unit of time"),
        ("t [Hz],u\n0,1\n", "need seconds"),
        ("t;u\n0.5;1,5\n", "other numbers of the file have points"),
        ("t;u\n1,5;2,5\n2,5;abc.d\n", "marks a bad value, give missing=abc.d"),
        ("t,u,u\n0,1,2\n", "names must differ"),
        ("t,u\n0,1\n1\n", "has 1 fields, but the header has 2"),
        ("t,u\n0,1\n1,2,3\n", "has 3 fields, but the header has 2"),
        ("t,u\n0,1,5\n2,2,5\n", "if commas are decimal signs, separate the columns by semicolons"),
        ("t,u\n0,nan\n1,\n", "every value is missing"),
        ("t,u\n0,1\nnan,2\n", "the time is missing"),
        ("t,u\n0,1\n,2\n", "the time is missing"),
        ("t,u\n0,1\n1,inf\n", "must be finite"),
        ("t,u\n0,1\n1,1e999\n", "must be finite"),
        ("t,u\n0,1_000\n", "not a number"),
        ("t;u\n0;1,5\n1;1.5\n", "not a number"),
        ("t;u\n0;1,5\n1;1.234,5\n", "mixed"),
        ('t,u\n0,"1\n', "cannot be read"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(content: str, words: str) -> None:
    assert words in read_refusal(content).detail


def test_bytes_that_are_no_text_are_told_with_their_place() -> None:
    assert read_refusal(b"t,u\n0,1\n1,\xb5\n").row == 3
    assert read_refusal(b"t,u\n0,1\n\x01").byte == 8
    assert read_refusal(b"\x7fELF\0\0").byte == 4


def test_a_row_without_end_is_refused_before_it_fills_the_memory() -> None:
    assert "longer than" in read_refusal(b"t,u\n" + b"1" * 1_000_100).detail


def test_time_told_twice_or_wrongly_is_refused() -> None:
    assert (
        "Remove it, or leave out sample_time" in read_refusal("t,u\n0,1\n", sample_time=0.1).detail
    )
    assert "positive" in read_refusal("u,y\n0,1\n", sample_time=0.0).detail


def test_an_unknown_label_column_is_refused_with_the_nearest() -> None:
    assert "did you mean 'length'" in read_refusal("t,length\n0,1\n", segments=("lenght",)).detail
    assert "no signal" in read_refusal("t,length\n0,1\n", segments=("length",)).detail


def test_channels_with_other_times_are_written_in_rows_of_their_own() -> None:
    slow = Channel("u", np.array([0.05, 0.25]), np.array([1.0, 2.0]), "V")
    fast = Channel("y", np.array([0.0, 0.1, 0.2]), np.array([0.1, np.nan, 0.3]))
    text = "".join(generate_csv(Recording((slow, fast))))
    assert text.splitlines() == [
        "t,u [V],y",
        "0.0,,0.1",
        "0.05,1.0,",
        "0.1,,",
        "0.2,,0.3",
        "0.25,2.0,",
    ]


def test_a_time_of_several_channels_has_one_row_and_is_read_back() -> None:
    slow = Channel("u", np.array([0.0, 0.2, 0.4]), np.array([1.0, 2.0, 3.0]), "V")
    fast = Channel("y", np.array([0.0, 0.1, 0.2]), np.array([0.1, 0.2, 0.3]))
    text = "".join(generate_csv(Recording((slow, fast))))
    assert text.splitlines() == [
        "t,u [V],y",
        "0.0,1.0,0.1",
        "0.1,,0.2",
        "0.2,2.0,0.3",
        "0.4,3.0,",
    ]
    back, _ = read_csv(text.encode())
    values = [back.channel(name).values for name in ("u", "y")]
    np.testing.assert_array_equal(values[0], [1.0, np.nan, 2.0, 3.0])
    np.testing.assert_array_equal(values[1], [0.1, 0.2, 0.3, np.nan])


def test_a_channel_with_several_values_at_a_time_has_a_row_for_each() -> None:
    once = Channel("u", np.array([0.0, 0.1]), np.array([1.0, 2.0]))
    pooled = Channel("y", np.array([0.0, 0.1, 0.1]), np.array([5.0, 6.0, 7.0]))
    text = "".join(generate_csv(Recording((once, pooled))))
    assert text.splitlines() == ["t,u,y", "0.0,1.0,5.0", "0.1,2.0,6.0", "0.1,,7.0"]


def test_a_stray_quote_is_told_with_its_row() -> None:
    assert read_refusal('t,u\n0,1\n1,2\n2,"3"x\n').row == 4


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("=1+1", "'=1+1"),
        ("@SUM(A1)", "'@SUM(A1)"),
        ("+x", "'+x"),
        ("x=1", "x=1"),
        ("a;=1+1", "a;'=1+1"),
    ],
)
def test_no_name_or_label_is_a_formula_in_a_spreadsheet_and_each_comes_back(
    name: str, written: str
) -> None:
    content = f"t,run,{name} [V],y [m]\n0,{name},1,2\n1,{name},1,2\n"
    before, _ = read_csv(content.encode(), ReadOptions(segments=("run",)))
    text = "".join(generate_csv(before))
    assert text.splitlines()[0] == f"t,run,{written} [V],y [m]"
    assert text.splitlines()[1].split(",")[1] == written
    after, _ = read_csv(text.encode(), ReadOptions(segments=("run",)))
    assert [channel.name for channel in after.channels] == [name, "y"]
    assert after.segments == before.segments


def test_more_signals_than_the_limit_are_refused_before_anything_below_the_header() -> None:
    limits = replace(DEFAULT_LIMITS, channels=3)
    for header, options in (
        ("t,a,b,c,d", {}),
        ("a,b,c,d", {"sample_time": 1.0}),
        ("t,run,a,b,c,d", {"segments": ["run"]}),
    ):
        error = read_refusal(f"{header}\n0,this is no row\n", limits=limits, **options)
        assert error.row == 1
        assert f"the header has {header.count(',') + 1} columns; at most 3 signals" in str(error)
    assert len(read_csv(b"t,a,b,c\n0,1,2,3\n", ReadOptions(limits=limits))[0].channels) == 3


def test_more_rows_than_the_limit_are_refused() -> None:
    limits = replace(DEFAULT_LIMITS, messages=3)
    assert (
        read_csv(b"t,u\n0,1\n1,2\n2,3\n", ReadOptions(limits=limits))[0].channels[0].values.size
        == 3
    )
    assert "more than 3 rows" in str(read_refusal("t,u\n0,1\n1,2\n2,3\n3,4\n", limits=limits))
