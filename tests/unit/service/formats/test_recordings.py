"""Files as loggers, spreadsheets and other programs write them: all give the same experiment."""

import doctest
import io
import pickle
import re
import struct
import sys
import warnings
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import lagid
from service.formats import recordings
from service.formats.file_kinds import SUFFIXES, detect_kind
from service.formats.read_options import ReadOptions
from service.formats.recordings import read_recording, read_with_notes
from service.formats.sandbox_child import read_file
from service.formats.tabular import csv_recordings, table_columns
from service.formats.tabular.csv_recordings import read_csv
from service.formats.tabular.table_layout import PEEK_ROWS
from service.formats.tabular.text_files import open_text
from sysid.core.errors import UnreadableFile
from sysid.data.records import Recording
from sysid.data.table_rules import ReadingNote
from sysid.inspection.inspect import check_recording
from tests.support.checkout import ROOT
from tests.support.files.experiment_files import (
    INPUT,
    OUTPUT,
    START,
    TIMES,
    N,
    compress,
    join_rows,
    stamp,
    write_binary_sheet,
    write_experiment_sheet,
    write_mat,
    write_npz,
    write_old_sheet,
    write_open_sheet,
    write_parquet,
    write_sheet,
)

ROWS = join_rows("t,u,y")
BODY = ROWS.partition("\n")[2]
EPOCH = START.replace(tzinfo=UTC).timestamp()


def read_bytes(
    folder: Path, content: bytes, suffix: str = "", **options: Any
) -> tuple[Recording, list[str]]:
    """Read a file as the child does, in this process."""
    path = folder / f"file{suffix}"
    path.write_bytes(content)
    return read_file(path, detect_kind(path, suffix), ReadOptions(**options))


def check_experiment(recording: Recording, names: tuple[str, str] = ("u", "y")) -> None:
    assert recording.names == names
    for name, values in zip(names, (INPUT, OUTPUT), strict=True):
        np.testing.assert_array_equal(recording.channel(name).times, TIMES)
        np.testing.assert_array_equal(recording.channel(name).values, values)


TEXTS = {
    "parentheses": join_rows("Time (s),u (V),y (degC)"),
    "slashes": join_rows("t/s,u/V,y/degC"),
    "words": join_rows("t in s;u in V;y in degC", ";"),
    "row of units": join_rows("t,u,y\ns,V,degC"),
    "row of units in parentheses": join_rows("Time,u,y\n(s),(V),(degC)\n"),
    "standard": join_rows("t [s],u [V],y [degC]"),
    "blanks": join_rows("Time (s)  u (V)   y [degC]", "  "),
    "bars of a scope": "# Scope\n" + join_rows("t|u|y\n[s]|[V]|[degC]", "|"),
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_units_stand_in_headings_or_in_a_row_of_their_own(text: str) -> None:
    recording, _ = read_csv(text.encode())
    check_experiment(recording)
    assert [channel.unit for channel in recording.channels] == ["V", "degC"]


DIALECTS = {
    "semicolons": join_rows("t;u;y", ";"),
    "decimal commas": join_rows(
        "t;u;y", ";", commas=True, time=lambda t: f"{t:.1f}".replace(".", ",")
    ),
    "tabs": join_rows("t\tu\ty", "\t"),
    "bars": join_rows("t|u|y", "|"),
    "blanks": join_rows("t u y", " "),
    "aligned": join_rows("   t     u     y", "    "),
    "separator named": "sep=;\n" + join_rows("t;u;y", ";"),
    "comments": "# logger XY\n# 2026-01-01\n" + ROWS,
    "comment as header": "# t u y\n" + BODY.replace(",", " "),
    "comment as header above commas": "# t u y\n" + BODY,
    "comments of octave": "% Created by Octave\n% t u y\n" + BODY.replace(",", " "),
    "comment among rows": ROWS.replace("\n2.0,", "\n# paused\n2.0,"),
    "preamble": "Device: Scope 1\nDate: 2026-01-01\n\n" + ROWS,
    "preamble of pairs": "Model,DS1054Z\nSample Rate,1000\nLength,10000\n\n" + ROWS,
    "long preamble": "".join(f"Setting {i}: value {i}\n" for i in range(60)) + ROWS,
    "blank rows first": "\n\n" + ROWS,
    "index": ",t,u,y\n" + "".join(f"{i},{row}\n" for i, row in enumerate(BODY.splitlines())),
    "index without heading": "t u y\n"
    + "".join(f'"{i}" {row}\n' for i, row in enumerate(BODY.replace(",", " ").splitlines(), 1)),
    "index of times": ROWS.replace("t,u,y", ",u,y"),
    "end of rows": join_rows("t,u,y,", end=","),
    "end of rows, not of header": join_rows("t,u,y", end=","),
    "empty column": join_rows("t,u,y,Comment", end=","),
    "text column": join_rows("t,u,y,valve", end=",OPEN"),
    "time last": "u,y,t\n"
    + "".join(f"{row.partition(',')[2]},{row.partition(',')[0]}\n" for row in BODY.splitlines()),
    "German": join_rows("Zeit;u;y", ";"),
    "unit in the name": join_rows("time_ms,u,y", time=lambda t: f"{1000 * t:.0f}"),
    "LabVIEW": join_rows("X_Value\tu\ty\tComment", "\t", end="\t"),
    "end mark": ROWS + "\x1a",
}


@pytest.mark.parametrize("text", DIALECTS.values(), ids=DIALECTS)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_dialects_of_text_give_the_same_samples(text: str, end: str) -> None:
    check_experiment(read_csv(text.replace("\n", end).encode())[0])


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "latin-1", "cp1252", "utf-16", "utf-16-le", "utf-16-be"]
)
def test_encodings_are_recognised(encoding: str) -> None:
    recording, notes = read_csv(join_rows("t,u,y [°C]").encode(encoding))
    check_experiment(recording)
    assert recording.channel("y").unit == "°C"
    guessed = [note for note in notes if "Windows-1252" in note]
    assert bool(guessed) == (encoding in ("latin-1", "cp1252"))


def test_a_file_that_is_not_there_is_told() -> None:
    with pytest.raises(FileNotFoundError, match=r"^there is no file nofile\.csv$"):
        read_recording("nofile.csv")


def test_a_compressed_text_is_read() -> None:
    check_experiment(read_csv(compress(ROWS))[0])
    with pytest.raises(UnreadableFile, match="damaged or cut off"):
        read_csv(compress(ROWS)[:-20])


STAMPS = {
    "iso basic": ("timestamp", stamp("%Y%m%dT%H%M%S.%f")),
    "comma after the date": ("t", stamp("%d.%m.%Y, %H:%M:%S.%f")),
    "iso": ("timestamp", lambda t: (START + timedelta(seconds=t)).isoformat()),
    "blank": ("time", stamp("%Y-%m-%d %H:%M:%S.%f")),
    "slashes": ("Time", stamp("%Y/%m/%d %H:%M:%S.%f")),
    "German": ("Zeit", stamp("%d.%m.%Y %H:%M:%S,%f")),
    "day first": ("t", stamp("%d/%m/%Y %H:%M:%S.%f")),
    "month first": ("t", stamp("%m/%d/%Y %H:%M:%S.%f")),
    "two digits": ("t", stamp("%d.%m.%y %H:%M:%S.%f")),
    "American": ("Time", stamp("%m/%d/%Y %I:%M:%S.%f %p")),
    "month by name": ("t", stamp("%d-%b-%Y %H:%M:%S.%f")),
    "name of its own": ("recorded", stamp("%Y-%m-%dT%H:%M:%S.%f", 6)),
    "no name": ("", stamp("%Y-%m-%d %H:%M:%S.%f", 6)),
    "two columns": ("Datum;Uhrzeit", stamp("%d.%m.%Y;%H:%M:%S,%f")),
    "times first": ("time;date", stamp("%H:%M:%S.%f;%Y-%m-%d")),
}


def test_a_temperature_called_t_is_no_time_if_there_is_another() -> None:
    recording, _ = read_csv(b"T,timestamp,u\n20.5,0,1\n20.6,1,2\n20.4,2,3\n")
    assert recording.names == ("T", "u")
    below, _ = read_csv(b"Device: Scope 1\n\nt T y\n0 1 2\n1 2 3\n")
    assert below.names == ("T", "y")
    daily, _ = read_csv(b"day,u\n2026-03-01,1\n2026-03-02,2\n2026-03-04,3\n")
    assert daily.channel("u").times.tolist() == [0, 86400, 259200]


@pytest.mark.parametrize("case", STAMPS.values(), ids=STAMPS)
def test_local_date_stamps_become_seconds_and_keep_the_clock(case: Any) -> None:
    name, time = case
    recording, notes = read_csv(join_rows(f"{name};u;y", ";", time=time).encode())
    check_experiment(recording)
    assert recording.started_at == START
    assert recording.started_at.tzinfo is None
    assert any(re.search(r"read as local time stamps, 0\.1 s apart, from 2026-", n) for n in notes)


@pytest.mark.parametrize(
    ("zone", "hours"), [("Z", 0), ("+00:00", 0), (" UTC", 0), ("+01:00", -1), (" -0130", 1.5)]
)
def test_stamps_with_a_zone_are_in_utc(zone: str, hours: float) -> None:
    write = stamp("%Y-%m-%dT%H:%M:%S.%f")
    recording, _ = read_csv(join_rows("t,u,y", time=lambda t: write(t) + zone).encode())
    check_experiment(recording)
    assert recording.started_at == START.replace(tzinfo=UTC) + timedelta(hours=hours)


@pytest.mark.parametrize(
    ("heading", "size"), [("t [ms]", 1e3), ("t", 1), ("t", 1e3), ("time_us", 1e6), ("time", 1e9)]
)
def test_a_clock_since_1970_is_counted_from_the_first_sample(heading: str, size: float) -> None:
    def write(t: float) -> str:
        tenths = round(EPOCH * 10 + t * 10)
        return f"{tenths / 10:.3f}" if size == 1 else str(tenths * round(size) // 10)

    recording, notes = read_csv(join_rows(f"{heading},u,y", time=write).encode())
    check_experiment(recording)
    assert recording.started_at == START.replace(tzinfo=UTC)
    assert any("2026-03-14 23:59:58 UTC" in note for note in notes)


def test_times_of_day_go_on_after_midnight() -> None:
    recording, notes = read_csv(join_rows("t,u,y", time=stamp("%H:%M:%S.%f")).encode())
    check_experiment(recording)
    assert recording.started_at is None
    assert any("times of day, 0.1 s apart, from 23:59:58" in note for note in notes)


@pytest.mark.parametrize("heading", ["time", "Zeit", "time [day]"])
def test_serial_dates_of_a_spreadsheet_are_time_stamps(heading: str) -> None:
    days = (START - datetime.fromisoformat("1899-12-30")) / timedelta(days=1)
    text = join_rows(f"{heading},u,y", time=lambda t: repr(float(days + t / 86_400)))
    recording, notes = read_with_notes(text.encode())
    check_experiment(recording)
    assert recording.started_at == START
    assert any("serial dates of a spreadsheet" in note for note in notes)
    seconds, _ = read_with_notes(
        join_rows("time,u,y", time=lambda t: repr(float(days + 10 * t))).encode()
    )
    assert seconds.duration == 10 * TIMES[-1]


def test_midnight_that_is_written_as_a_date_is_one_of_the_stamps() -> None:
    text = join_rows("t,u,y", time=stamp("%Y-%m-%d %H:%M:%S.%f"))
    assert " 00:00:00.000" in text
    check_experiment(read_csv(text.replace(" 00:00:00.000", "").encode())[0])


def test_of_two_orders_of_day_and_month_the_one_is_taken_in_which_times_increase() -> None:
    rows = "".join(f"{3 + day:02}/04/2026 12:00:00,{day}\n" for day in range(3))
    recording, notes = read_csv(f"t,u\n{rows}".encode())
    assert recording.channel("u").times.tolist() == [0, 86400, 172800]
    assert any("day before the month" in note for note in notes)
    rows = "".join(f"04/{3 + day:02}/2026 12:00:00,{day}\n" for day in range(3))
    assert read_csv(f"t,u\n{rows}".encode())[0].started_at == datetime.fromisoformat(
        "2026-04-03T12:00"
    )


def test_stamps_that_are_too_coarse_or_mixed_are_refused_with_the_way_out() -> None:
    coarse = join_rows("Zeit,u,y", time=stamp("%Y-%m-%d %H:%M:%S")).encode()
    with pytest.raises(UnreadableFile, match="too coarse, give the sampling period with sample_t"):
        read_csv(coarse)
    recording, notes = read_csv(coarse, ReadOptions(sample_time=0.1))
    np.testing.assert_allclose(recording.channel("u").times, TIMES, atol=1e-12)
    assert recording.started_at == START
    assert "samples are 0.1 s apart; column 'Zeit' gives the start" in notes
    mixed = b"time,u\n2026-11-20 08:00:00,1\n20.11.2026 08:01,2\n"
    with pytest.raises(UnreadableFile, match=r"row 3, column 'time': found '20\.11\.2026 08:01'"):
        read_csv(mixed)


@pytest.mark.parametrize("word", ["NA", "N/A", "null", "-", "nan", "#N/A", "#DIV/0!", "None", ""])
def test_words_of_missing_values_are_missing(word: str) -> None:
    text = ROWS.replace(f",{OUTPUT[7]:.6f}\n", f",{word}\n")
    recording, _ = read_csv(text.encode())
    assert np.flatnonzero(np.isnan(recording.channel("y").values)).tolist() == [7]
    assert any(f"1 of {N} values are missing" in one.text for one in check_recording(recording))


def test_true_and_false_are_numbers_and_said() -> None:
    recording, notes = read_csv(b"t,on,y\n0,True,1\n1,False,2\n2,True,3\n")
    assert recording.channel("on").values.tolist() == [1, 0, 1]
    assert any("true and false" in note for note in notes)


def test_what_is_left_out_is_said() -> None:
    text = join_rows("t,u,y,valve,when,memo", end=",OPEN,2026-03-01 12:00:00,")
    notes = " ".join(read_csv(text.encode())[1])
    assert "column 'valve' holds text ('OPEN') and was left out" in notes
    assert "column 'when' holds time stamps" in notes
    assert "columns without any value were left out: memo" in notes


REFUSED = {
    "a number after texts": (
        "t,u,v\n" + "".join(f"{k},{k},OPEN\n" for k in range(300)) + "300,1,5\n",
        "row 302, column 'v': found '5' in a column that begins with text",
    ),
    "units in cells": (join_rows("t,u,y", end=" V"), "write numbers alone, and their unit"),
    "thousands": ("t;y\n0.1;1,000.5\n0.2;1,001.5\n", "thousands separators"),
    "no header": (BODY, "so the file has no header; name its columns with columns=t,c1,c2"),
    "no time": (join_rows("a,u,y"), "give the sampling period"),
    "JSON of one column": ('[{"t": 0}]', "there is only one column ('t')"),
    "XML": ('<?xml version="1.0"?><a/>', "XML or HTML, which is not read"),
}


@pytest.mark.parametrize(("text", "words"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_read_is_refused_with_what_to_do(
    tmp_path: Path, text: str, words: str
) -> None:
    with pytest.raises(UnreadableFile, match=re.escape(words)) as caught:
        read_bytes(tmp_path, text.encode())
    assert "\n" not in caught.value.detail


@pytest.mark.parametrize(
    ("head", "words"),
    [
        (b"\x89HDF\r\n\x1a\n" + bytes(100), "HDF5"),
        (b"MATLAB 7.3 MAT-file" + bytes(500), "the MATLAB file cannot be read"),
        (b"MDF     4.10" + bytes(60), "ASAM MDF"),
        (b"TDSm" + bytes(60), "NI TDMS"),
        (b"PK\x03\x04" + bytes(22) + b"\x05\0\0\0a.csv" + bytes(60), "a ZIP archive"),
        (b"\x80\x04\x95" + bytes(60), "a Python pickle"),
        (b"%PDF-1.7\n\xe2\xe3" + bytes(60), "a PDF"),
    ],
)
def test_a_kind_that_is_recognised_is_named_in_its_refusal(
    tmp_path: Path, head: bytes, words: str
) -> None:
    with pytest.raises(UnreadableFile, match=re.escape(words)):
        read_bytes(tmp_path, head)


def test_a_text_that_begins_like_another_kind_is_a_text() -> None:
    check_experiment(read_csv(ROWS.replace("t,u,y", "time,MDF ,y").encode())[0], ("MDF", "y"))
    check_experiment(read_csv(b"RIFF test\n\n" + ROWS.encode())[0])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (ROWS + "Mean,0.875,0.1\nStd,0.2,0.3\n", "rows 242 to 243 are below the data ('Mean')"),
        (ROWS + "\n\nEnd of file\n", "row 244 is below the data ('End of file')"),
        (
            join_rows("time;u;y", ";", time=stamp("%Y-%m-%d %H:%M:%S.%f")) + "Mittel;0.5;0.3\n",
            "row 242 is below the data ('Mittel')",
        ),
        (
            "u,y,t\n"
            + "".join(f"{u},{y},{t}\n" for u, y, t in zip(INPUT, OUTPUT, TIMES, strict=True))
            + "End\n",
            "row 242 is below the data ('End')",
        ),
    ],
)
def test_words_below_the_data_are_left_out_and_said(text: str, told: str) -> None:
    recording, notes = read_with_notes(text.encode())
    check_experiment(recording)
    assert f"{told} and left out" in notes


def test_words_below_the_data_are_found_wherever_blocks_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for rows in range(N - 2, N + 4):
        monkeypatch.setattr(table_columns, "BLOCK_ROWS", rows)
        recording, notes = read_with_notes((ROWS + "Mean,1,2\n" * 3).encode())
        check_experiment(recording)
        assert notes == ("rows 242 to 244 are below the data ('Mean') and left out",)


@pytest.mark.parametrize(
    "end", ["4.0,1,abc\n", "4V,1,2\n", ",0.8,0.1\n", "end\n" * 21, "Mean,1,2\n4.0,1,2\n"]
)
def test_a_fault_in_the_last_rows_is_no_footer(end: str) -> None:
    with pytest.raises(UnreadableFile, match=r"^row 242"):
        read_with_notes((ROWS + end).encode())


def test_labels_that_divide_every_row_are_refused() -> None:
    text = join_rows("Zeit,u,y", time=stamp("%Y-%m-%d %H:%M:%S.%f"))
    with pytest.raises(UnreadableFile, match=f"into {N} segments, of which {N} have one sample"):
        read_csv(text.encode(), ReadOptions(segments=("Zeit",), sample_time=0.1))


ARRAYS: dict[str, dict[str, object]] = {
    "columns": {"t": TIMES, "u": INPUT, "y": OUTPUT},
    "matrices": {"time": TIMES[:, None], "u": INPUT[None, :], "y": OUTPUT[:, None]},
}


@pytest.mark.parametrize("arrays", ARRAYS.values(), ids=ARRAYS)
@pytest.mark.parametrize("write", [write_npz, lambda **arrays: write_mat(arrays)])
def test_arrays_are_channels(tmp_path: Path, arrays: dict[str, object], write: Any) -> None:
    check_experiment(read_bytes(tmp_path, write(**arrays))[0])


def test_a_matrix_has_a_channel_for_each_signal(tmp_path: Path) -> None:
    content = write_npz(t=TIMES, y=np.stack([INPUT, OUTPUT]), other=np.zeros(7))
    recording, notes = read_bytes(tmp_path, content)
    check_experiment(recording, ("y1", "y2"))
    assert "other hold no samples of a signal and were left out" in notes


@pytest.mark.parametrize(("name", "value"), [("Ts", 0.1), ("fs", 10.0), ("dt", [[0.1]])])
def test_a_sampling_period_among_the_arrays_gives_the_times(
    tmp_path: Path, name: str, value: Any
) -> None:
    for content in (
        write_npz(u=INPUT, y=OUTPUT, **{name: value}),
        write_mat({"z1": {"u": INPUT, "y": OUTPUT, name: value}}),
    ):
        recording, notes = read_bytes(tmp_path, content)
        np.testing.assert_allclose(recording.channel("y").times, TIMES, atol=1e-12)
        assert f"the sampling period of 0.1 s was taken from {name!r}" in notes


def test_structures_of_matlab_are_opened_if_there_is_one(tmp_path: Path) -> None:
    signals = [{"values": INPUT, "label": "u"}, {"values": OUTPUT, "label": "y"}]
    simulink = write_mat({"out": {"time": TIMES, "signals": signals, "blockName": "rig"}})
    check_experiment(read_bytes(tmp_path, simulink)[0])
    nested = write_mat({"data": {"run": {"t": TIMES, "u": INPUT, "y": OUTPUT}}})
    check_experiment(read_bytes(tmp_path, nested)[0])
    one = {"u": INPUT, "y": OUTPUT, "Ts": 0.1}
    with pytest.raises(UnreadableFile, match="the file holds ze, zv; need arrays"):
        read_bytes(tmp_path, write_mat({"ze": one, "zv": one}))


def test_matlab_4_is_recognised_without_a_suffix(tmp_path: Path) -> None:
    content = write_mat({"t": TIMES, "u": INPUT, "y": OUTPUT}, "4")
    check_experiment(read_bytes(tmp_path, content)[0])


def test_objects_and_arrays_without_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnreadableFile, match="an array holds Python objects"):
        read_bytes(tmp_path, write_npz(t=TIMES, u=np.array([{}] * N, dtype=object)))
    np.save(tmp_path / "a.npy", np.stack([TIMES, INPUT]))
    with pytest.raises(UnreadableFile, match="one array without names"):
        read_bytes(tmp_path, (tmp_path / "a.npy").read_bytes())
    with pytest.raises(UnreadableFile, match="the MATLAB file cannot be read"):
        read_bytes(tmp_path, b"MATLAB 5.0 MAT-file" + bytes(200))


def test_an_array_that_is_infinite_or_without_a_time_is_refused(tmp_path: Path) -> None:
    broken = np.where(TIMES == 0.5, np.inf, OUTPUT)
    with pytest.raises(UnreadableFile, match="row 6, column 'y': the value is infinite"):
        read_bytes(tmp_path, write_npz(t=TIMES, y=broken))
    with pytest.raises(UnreadableFile, match="row 6, column 't': the time is missing"):
        read_bytes(tmp_path, write_npz(t=np.where(TIMES == 0.5, np.nan, TIMES), y=OUTPUT))


def test_parquet_keeps_units_stamps_and_zones(tmp_path: Path) -> None:
    plain = write_parquet(**{"t [ms]": TIMES * 1000, "u [V]": INPUT, "y": OUTPUT})
    recording, _ = read_bytes(tmp_path, plain)
    check_experiment(recording)
    assert recording.channel("u").unit == "V"
    stamps = [START + timedelta(seconds=float(t)) for t in TIMES]
    columns = {"u": INPUT, "y": OUTPUT, "valve": ["OPEN"] * N, "list": [[1]] * N}
    recording, notes = read_bytes(tmp_path, write_parquet(when=stamps, **columns))
    check_experiment(recording)
    assert recording.started_at == START
    assert any("'list' holds List" in note for note in notes)
    zoned = [moment.replace(tzinfo=UTC) for moment in stamps]
    recording, _ = read_bytes(tmp_path, write_parquet(when=zoned, u=INPUT, y=OUTPUT))
    assert recording.started_at == START.replace(tzinfo=UTC)
    with pytest.raises(UnreadableFile, match="the Parquet file cannot be read"):
        read_bytes(tmp_path, plain[: len(plain) // 2])


def test_parquet_without_its_library_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = write_parquet(t=TIMES, u=INPUT)
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(UnreadableFile, match=r"pip install 'lagid\[parquet\]'$"):
        read_bytes(tmp_path, content)
    check_experiment(read_csv(join_rows("t,u,y", time=STAMPS["iso"][1]).encode())[0])


def test_a_sheet_is_found_below_a_preamble_and_beside_others(tmp_path: Path) -> None:
    recording, notes = read_bytes(tmp_path, write_experiment_sheet(("Info", "Data")))
    check_experiment(recording)
    assert "sheet 'Data' was read, one of 2 sheets" in notes
    rows = zip(range(N), TIMES.tolist(), INPUT.tolist(), OUTPUT.tolist(), strict=True)
    table = [["Rig 7"], ["operator", "X"], ["", "t", "u", "y"], ["", "s", "V", "Pa"], *rows]
    recording, notes = read_bytes(tmp_path, write_sheet(table))
    check_experiment(recording)
    assert recording.channel("y").unit == "Pa"
    assert "column 1 (no name) counts rows and was left out" in notes
    faulty = [["t", "u"], [0.0, 1.0], [1.0, "x"]]
    with pytest.raises(UnreadableFile, match="row 3, column 'u': found 'x'"):
        read_bytes(tmp_path, write_sheet(faulty))
    with pytest.raises(UnreadableFile, match="cannot be opened"):
        read_bytes(tmp_path, write_experiment_sheet()[:700])


@pytest.mark.parametrize("write", [write_open_sheet, write_old_sheet, write_binary_sheet])
def test_open_documents_and_old_and_binary_excel_files_are_sheets_too(
    tmp_path: Path, write: Any
) -> None:
    rows = zip(TIMES.tolist(), INPUT.tolist(), OUTPUT.tolist(), strict=True)
    content = write([["t", "u", "y"], *rows])
    check_experiment(read_bytes(tmp_path, content)[0])
    with pytest.raises(UnreadableFile, match="cannot be opened"):
        read_bytes(tmp_path, content[: len(content) // 2])


def test_read_recording_warns_of_what_it_guessed(tmp_path: Path) -> None:
    path = tmp_path / "scope.csv"
    path.write_text("Device: Scope 1\n\n" + ROWS)
    with pytest.warns(
        ReadingNote, match="the header is in row 3; the lines before it were skipped"
    ):
        check_experiment(read_recording(path))
    with warnings.catch_warnings():
        check_experiment(read_recording(ROWS.encode()))
        path.write_text(ROWS)
        check_experiment(read_recording(str(path)))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"source": None}, "found None; need the path of a file"),
        ({"source": 3}, "found 3; need the path of a file"),
        (
            {"source": pd.DataFrame({"t": [0]})},
            "an object of type DataFrame of shape (1, 1);",
        ),
        ({"source": {"t": [0]}}, "A table is a recording already: give it to identify"),
        ({"sample_time": "0.1 s"}, "sample_time is '0.1 s'; need a positive number"),
        ({"sample_time": -1}, "sample_time is -1; need a positive number"),
        ({"segments": "run"}, "there is no label column 'run'"),
    ],
)
def test_a_wrong_argument_of_the_reader_is_told(arguments: dict[str, Any], told: str) -> None:
    with pytest.raises(UnreadableFile, match=re.escape(told)):
        read_recording(**{"source": ROWS.encode(), **arguments})


def test_one_label_column_may_be_a_text() -> None:
    rows = b"run,t,u\na,0,1\na,1,2\nb,0,3\nb,1,4\n"
    recording, _ = read_with_notes(rows, ReadOptions(segments=("run",)))
    assert [segment.labels["run"] for segment in recording.segments] == ["a", "b"]


def test_an_open_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "rig.csv"
    path.write_text(ROWS)
    with path.open() as text, path.open("rb") as binary:
        for source in (text, binary, io.BytesIO(ROWS.encode()), io.StringIO(ROWS)):
            check_experiment(read_recording(source))
    check_experiment(read_recording(io.BytesIO(write_experiment_sheet())))


def test_a_plain_text_is_opened_once(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []

    def count(*arguments: Any) -> Any:
        opened.append(arguments)
        return open_text(*arguments)

    monkeypatch.setattr(csv_recordings, "open_text", count)
    check_experiment(read_recording(ROWS.encode()))
    assert len(opened) == 1
    stamps = join_rows("t,u,y", time=stamp("%Y-%m-%d %H:%M:%S.%f"))
    check_experiment(read_with_notes(stamps.encode())[0])  # by a child, after one look
    assert len(opened) == 2


def test_a_refusal_is_an_error_of_the_library_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "rig.csv"
    path.write_text("t,u\n0,1\n1,5 V\n")
    with pytest.raises(lagid.SysidError) as caught:
        lagid.read_recording(path)
    error = caught.value
    assert isinstance(error, lagid.UnreadableFile)
    assert (error.name, error.row, error.column) == (str(path), 3, "u")
    assert str(error) == f"{path}: {error.detail}"
    assert error.detail.startswith("row 3, column 'u': found '5 V'")
    assert error.pointer == "/rows/3/u"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    with pytest.raises(lagid.UnreadableFile, match=r"^row 3"):
        lagid.read_recording(path.read_bytes())


def test_every_kind_comes_through_the_child_with_its_clock(tmp_path: Path) -> None:
    stamps = join_rows("Zeit;u;y", ";", time=stamp("%d.%m.%Y %H:%M:%S,%f"))
    recording, notes = read_with_notes(stamps.encode())
    check_experiment(recording)
    assert recording.started_at == START
    (note,) = notes
    assert note == (
        "column 'Zeit' read as local time stamps, 0.1 s apart, from 2026-03-14 23:59:58"
    )
    path = tmp_path / "a.xlsx"
    path.write_bytes(write_experiment_sheet())
    check_experiment(read_with_notes(path)[0])


def test_a_kind_is_told_by_bytes_and_only_then_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(write_npz(t=TIMES))
    assert detect_kind(path, ".csv") == "numpy"
    path.write_bytes(b"no mcap")
    assert detect_kind(path, ".MCAP") == "mcap"
    path.write_bytes(struct.pack("<5i", 0, 40, 1, 0, 2) + b"t\0")
    assert detect_kind(path) == "matlab"
    path.write_bytes(struct.pack("<5i", 1, 40, 1, 0, 2) + b"t,")
    assert detect_kind(path) == "csv"


def test_the_examples_of_the_reader_and_of_its_page_run(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert doctest.testmod(recordings).failed == 0
    page = (ROOT / "docs/recordings.md").read_text(encoding="utf-8")
    (snippet,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        exec(snippet, {})
    assert {entry.category for entry in caught} == {ReadingNote}
    assert "'Zeit' read as local time stamps, 0.1 s apart" in str(caught[-1].message)
    assert capsys.readouterr().out == "('Ventil', 'Druck') 2026-03-14 08:00:00\n"


def test_the_page_lists_every_suffix_that_forms_offer() -> None:
    page = (ROOT / "docs/recordings.md").read_text(encoding="utf-8")
    names = {".csv": "CSV", ".mcap": "MCAP", ".parquet": "Parquet", ".gz": "gzip"}
    texts = (".txt", ".tsv", ".dat", ".asc")  # any name of a text
    missing = [s for s in SUFFIXES if s not in texts and names.get(s, f"`{s}`") not in page]
    assert missing == []


def test_a_temperature_called_t_is_the_time_with_a_note_and_never_beside_a_period() -> None:
    rows = ["T,u", "20,0", "21,1", "22,1"]
    assert read_rows(rows)[1] == ("column 'T' was read as the time in s",)
    recording, notes = read_rows(rows, sample_time=0.5)
    assert recording.names == ("T", "u")
    assert recording.channel("T").times.tolist() == [0.0, 0.5, 1.0]
    assert notes == ()
    with pytest.raises(UnreadableFile, match=r"there is no time column; found T, u\."):
        read_rows(["T [°C],u", *rows[1:]])
    with pytest.raises(
        UnreadableFile,
        match=r"column; found u, and T as labels of segments, one measurement each\.",
    ):
        read_rows(rows, segments=["T"])
    assert read_rows(["T [ms],u", *rows[1:]])[0].names == ("u",)
    arrays = write_npz(T=20 + TIMES, u=INPUT, Ts=0.5)
    recording, _ = read_with_notes(arrays)
    assert recording.names == ("T", "u")
    assert recording.sampling.period == 0.5


def test_a_zone_belongs_to_its_column() -> None:
    local = [START + timedelta(seconds=k) for k in range(9)]
    utc = [moment.replace(tzinfo=UTC) for moment in local]
    for time, logged in ((local, utc), (utc, local)):
        recording, notes = read_with_notes(write_parquet(time=time, logged=logged, u=[1.0] * 9))
        assert recording.started_at == time[0]
        zone = "UTC" if time is utc else "local"
        assert any(f"column 'time' read as {zone} time stamps" in note for note in notes)


@pytest.mark.parametrize("name", ["t [ms]", "time_ms", "t [min]", "elapsed"])
def test_a_time_span_is_in_seconds_whatever_its_heading_says(name: str) -> None:
    spans = [timedelta(seconds=k) for k in range(9)]
    recording, _ = read_with_notes(write_parquet(**{name: spans, "u": [1.0] * 9}))
    assert recording.channel("u").times.tolist() == list(range(9))


LATE = PEEK_ROWS + 50  # a row after those that the layout is guessed from


def read_rows(rows: list[str], **reading: object) -> tuple[Recording, tuple[str, ...]]:
    return read_with_notes("\n".join(rows).encode(), ReadOptions(**reading))


@pytest.mark.parametrize("separator", [";", "\t", "|", " "])
@pytest.mark.parametrize("block", [3, 50_000])
def test_decimal_commas_may_come_late(
    separator: str, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table_columns, "BLOCK_ROWS", block)
    rows = ["t;u;y", *(f"{k};0;20" for k in range(LATE)), f"{LATE};1;20,5"]
    recording, notes = read_rows([row.replace(";", separator) for row in rows])
    assert recording.channel("y").values[-1] == 20.5
    assert notes[-1] == "decimal commas were read as decimal points"


def test_a_late_decimal_comma_is_a_fault_among_points() -> None:
    rows = ["t;y", "0;1.5", *(f"{k};20" for k in range(1, LATE)), f"{LATE};20,5"]
    with pytest.raises(UnreadableFile, match=f"row {LATE + 2}.*other numbers of the file"):
        read_rows(rows)


@pytest.mark.parametrize("gap", [50, LATE])
@pytest.mark.parametrize("name", ["No", "index", "Nr."])
def test_an_index_with_a_gap_is_a_signal_with_a_note(name: str, gap: int) -> None:
    rows = [f"{name},t,u", *(f"{k + (k >= gap)},{k},0" for k in range(LATE + 9))]
    recording, notes = read_rows(rows)
    assert recording.names == (name, "u")
    assert recording.channel(name).values[-1] == LATE + 9
    assert notes == (f"column {name!r} does not count the rows, so it is a signal",)


def test_an_index_that_restarts_with_segments_is_a_signal_with_a_note() -> None:
    rows = ["index,run,t,u", *(f"{k % 300},{k // 300},{k % 300},0" for k in range(600))]
    recording, notes = read_rows(rows, segments=["run"])
    assert recording.names == ("index", "u")
    assert "column 'index' does not count the rows, so it is a signal" in notes


def test_a_long_preamble_is_skipped() -> None:
    rows = [*(f"meta line {k}" for k in range(LATE)), "t,u", *(f"{k},0" for k in range(50))]
    recording, notes = read_rows(rows)
    assert recording.samples == 50
    assert notes == (f"the header is in row {LATE + 1}; the lines before it were skipped",)
    sheet = write_sheet([["meta", k] for k in range(LATE)] + [["t", "u"], [0, 1], [1, 2]])
    assert read_with_notes(sheet)[0].samples == 2


@pytest.mark.parametrize("row", [3, 50, 100, 150])
@pytest.mark.parametrize("change", [",9", ""])
def test_a_row_of_another_width_is_named_wherever_it_is(
    tmp_path: Path, row: int, change: str
) -> None:
    rows = [f"{0.1 * k:.1f},{k % 2},{0.5 * k}" for k in range(240)]
    rows[row - 2] = rows[row - 2] + change if change else rows[row - 2].rpartition(",")[0]
    file = tmp_path / "bad.csv"
    file.write_text("\n".join(["t,u,y", *rows]))
    found = 4 if change else 2
    with pytest.raises(UnreadableFile, match=f"has {found} fields, but the header has 3") as error:
        read_recording(file)
    assert error.value.row == row
