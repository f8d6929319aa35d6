"""Files as plants write them: without a header, with markers of bad data, in long format."""

import io
import json
import sys
import warnings
from datetime import UTC, datetime, timedelta
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest

from service.formats.file_kinds import detect_kind
from service.formats.read_options import ReadOptions, build_options
from service.formats.recordings import read_recording, read_with_notes
from service.formats.sandbox_child import read_file
from sysid.core.errors import UnreadableFile
from sysid.data.records import Recording
from sysid.data.table_rules import ReadingNote
from tests.support.files.experiment_files import INPUT, OUTPUT, TIMES, join_rows, write_sheet

BODY = join_rows("t,u,y").partition("\n")[2]
ROWS = [[t, u, y] for t, u, y in zip(TIMES.tolist(), INPUT.tolist(), OUTPUT.tolist(), strict=True)]


def read(content: str | bytes, **options: object) -> tuple[Recording, tuple[str, ...]]:
    data = content if isinstance(content, bytes) else content.encode()
    return read_with_notes(data, build_options(**options))  # type: ignore[arg-type]


def refuse(content: str | bytes, **options: object) -> UnreadableFile:
    with pytest.raises(UnreadableFile) as caught:
        read(content, **options)
    assert "\n" not in str(caught.value)
    return caught.value


def check_experiment(recording: Recording, names: tuple[str, ...] = ("u", "y")) -> None:
    assert recording.names == names
    for name, values in zip(names, (INPUT, OUTPUT), strict=True):
        np.testing.assert_array_equal(recording.channel(name).times, TIMES)
        np.testing.assert_array_equal(recording.channel(name).values, values)


def save_array(array: object) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.asarray(array))
    return stream.getvalue()


HEADERLESS = {
    "commas": BODY,
    "blanks": BODY.replace(",", "   "),
    "aligned": "".join(f"  {line.replace(',', '  ')}\n" for line in BODY.splitlines()),
    "exponents": "".join(f"{t:.7E} {u:.7E} {y:.7E}\n" for t, u, y in ROWS),
    "decimal commas": BODY.replace(",", ";").replace(".", ","),
    "assignment": f"data7=[\n{BODY.replace(',', ' ')}];\n",
    "comments": f"% DaISy: no names\n% of columns\n{BODY.replace(',', ' ')}",
    "sheet": write_sheet(ROWS),
    "ends of rows": BODY.replace("\n", ",\n"),
    "array": save_array(ROWS),
}


@pytest.mark.parametrize("content", HEADERLESS.values(), ids=HEADERLESS)
def test_a_file_without_a_header_takes_names_of_columns(content: str | bytes) -> None:
    assert refuse(content).advice is not None
    check_experiment(read(content, columns="t,u,y")[0])
    recording, _ = read(content, columns="t [min],,flow [l/min]")
    assert recording.names == ("flow",)
    assert recording.channel("flow").unit == "l/min"
    np.testing.assert_allclose(recording.channel("flow").times, 60 * TIMES)


def test_a_refusal_proposes_names_and_times_only_where_they_increase() -> None:
    assert str(refuse(BODY)) == (
        "row 1: the first row holds numbers, so the file has no header; name its columns with "
        "columns=t,c1,c2"
    )
    without = "".join(line.partition(",")[2] + "\n" for line in BODY.splitlines())
    assert str(refuse(without)).endswith(
        "columns=c1,c2. Call the one of times t, or give the sampling period too"
    )
    recording, _ = read(without, columns="u,y", sample_time=0.1)
    np.testing.assert_array_equal(recording.channel("y").values, OUTPUT)
    np.testing.assert_allclose(recording.channel("y").times, TIMES)


def test_names_must_be_as_many_as_columns() -> None:
    error = refuse(BODY, columns="t,u")
    assert error.detail == (
        "the table has 3 columns, and 2 names are given; name its columns with columns=t,c1,c2. "
        "An empty name leaves a column out"
    )
    assert error.advice is not None
    assert error.advice.option == "columns"
    assert "names must differ" in refuse(BODY, columns="t,u,u").detail
    assert "there is no time column; found a, b, c." in refuse(BODY, columns="a,b,c").detail


def test_names_replace_those_of_a_header_and_python_takes_a_list() -> None:
    recording, notes = read(join_rows("zeit,a,b"), columns="t,u,y")
    check_experiment(recording)
    assert "the lines before row 2 were skipped" in notes
    with pytest.warns(match="lines before row 2"):
        check_experiment(read_recording(join_rows("z,a,b").encode(), columns=["t", "u", "y"]))


def test_options_travel_as_json() -> None:
    options = build_options(sample_time=1, segments="a, b", columns="t,,y")
    assert options.list_given() == {
        "sample_time": 1.0,
        "segments": ["a", "b"],
        "columns": ["t", "", "y"],
    }
    assert ReadOptions.from_document(options.to_document()) == options
    with pytest.raises(UnreadableFile, match="sample_time is 0; need a positive number"):
        ReadOptions(0)


MARKED = OUTPUT.copy()
MARKED[[7, 8, 100]] = np.nan


def write_marked(marker: str, header: str = "t,u,y", end: str = "", bad: str = "") -> str:
    """The experiment with a marker in place of three values, and columns of status after it."""
    lines = [header]
    for t, u, y in zip(TIMES, INPUT, MARKED, strict=True):
        is_bad = np.isnan(y)
        lines.append(f"{t:.1f},{u:g},{marker if is_bad else f'{y:.6f}'}{bad if is_bad else end}")
    return "\n".join(lines) + "\n"


MARKERS = [
    "Bad",
    "I/O Timeout",
    "No Data",
    "unavailable",
    ".",
    "-9999",
    "-9999.0",
    "-999.25",
    "1e20",
]


@pytest.mark.parametrize("marker", MARKERS)
def test_markers_of_bad_data_are_missing_and_told(marker: str) -> None:
    recording, notes = read(write_marked(marker))
    np.testing.assert_array_equal(recording.channel("y").values, MARKED)
    np.testing.assert_array_equal(recording.channel("u").values, INPUT)
    told = " ".join(notes)
    if marker != ".":
        shown = repr(marker) if marker[0].isalpha() else f"{float(marker):.16g}"
        assert shown in told


@pytest.mark.parametrize("marker", ["-7", "Offline 2"])
def test_a_marker_is_given(marker: str) -> None:
    np.testing.assert_array_equal(
        read(write_marked(marker), missing=marker)[0].channel("y").values, MARKED
    )


def test_an_unknown_word_is_refused_with_the_option_and_that_works() -> None:
    error = refuse(write_marked("Wartung Pumpe"))
    assert str(error) == (
        "row 9, column 'y': found 'Wartung Pumpe', which is not a number; if it marks a bad value, "
        "give missing='Wartung Pumpe'"
    )
    assert error.advice is not None
    given = error.advice.after.strip("='")
    recording, _ = read(write_marked("Wartung Pumpe"), missing=given)
    np.testing.assert_array_equal(recording.channel("y").values, MARKED)


def test_a_number_that_does_not_stand_apart_is_a_value() -> None:
    near = np.where(np.isnan(MARKED), 999.0, 500.0 + 300.0 * OUTPUT)
    rows = "".join(f"{t},{y}\n" for t, y in zip(TIMES, near, strict=True))
    np.testing.assert_array_equal(read("t,y\n" + rows)[0].channel("y").values, near)
    levels = "t,u\n" + "".join(f"{t},{-9999 if t < 5 else 0}\n" for t in TIMES)
    assert not np.isnan(read(levels)[0].channel("u").values).any()
    kept = read(write_marked("-9999"), missing="none")[0].channel("y").values
    assert np.count_nonzero(kept == -9999) == 3


STATUS = {
    "words beside a channel": write_marked("7.5", "t,u,y,y_status", ",Good", ",Bad"),
    "words for all": write_marked("7.5", "t,u,y,Quality", ',"Good, annotated"', ",Uncertain"),
    "codes of OPC": write_marked("7.5", "t,u,y,y quality", ",192", ",24"),
    "truth": write_marked("7.5", "t,u,y,y.IsGood", ",True", ",False"),
    "numbers of truth": write_marked("7.5", "t,u,y,y valid", ",1", ",0"),
}


@pytest.mark.parametrize("text", STATUS.values(), ids=STATUS)
def test_columns_of_status_are_recognised(text: str) -> None:
    recording, notes = read(text)
    assert recording.names == ("u", "y")
    np.testing.assert_array_equal(recording.channel("y").values, MARKED)
    assert any("3 are bad and read as missing" in note for note in notes)


def test_a_status_of_a_machine_is_none_of_its_values() -> None:
    recording, _ = read(write_marked("7.5", "t,u,y,y status", ",1", ",0"))
    assert recording.names == ("u", "y", "y status")
    recording, notes = read(write_marked("7.5", "t,u,y,status", ",heating", ",idle"))
    assert recording.names == ("u", "y")
    assert not np.isnan(recording.channel("y").values).any()
    assert "column 'status' holds text ('heating') and was left out" in notes


CLOCK = datetime(2026, 11, 1, 10, tzinfo=UTC)
LATER = TIMES[3::2] + 0.025  # s, times of a sensor with a clock of its own


def write_long(
    header: str, row: str, *, order: str = "by signal", times: str = "%Y-%m-%dT%H:%M:%S.%fZ"
) -> str:
    """Two signals, each with its own times: a held input `valve`, and an output `flow`."""
    rows = [(t, "valve", f"{u:g}", "%") for t, u in zip(TIMES, INPUT, strict=True)]
    rows += [(t, "flow", f"{np.sin(t):.6f}", "l/min") for t in LATER]
    if order != "by signal":
        rows.sort(key=lambda one: one[0], reverse=order == "latest first")
    lines = [header]
    for t, name, value, unit in rows:
        moment = (CLOCK + timedelta(seconds=float(t))).strftime(times) if times else f"{t:.3f}"
        lines.append(row.format(t=moment, name=name, value=value, unit=unit))
    return "\n".join(lines) + "\n"


LONG = {
    "Home Assistant": write_long("entity_id,state,last_changed", "{name},{value},{t}"),
    "interleaved": write_long(
        "entity_id,state,last_changed", "{name},{value},{t}", order="by time"
    ),
    "latest first": write_long("timestamp,tag,value", "{t},{name},{value}", order="latest first"),
    "historian with units": write_long(
        "TagName;Timestamp;Value;Unit", "{name};{t};{value};{unit}", order="by time"
    ),
    "seconds": write_long("time,sensor,reading", "{t},{name},{value}", times=""),
    "no usual heading": write_long("when,wo,was", "{t},{name},{value}"),
    "blanks": write_long("t name value", "{t} {name} {value}", times=""),
    "without a header": write_long("", "{t},{name},{value}", times="").lstrip(),
}


@pytest.mark.parametrize("text", LONG.values(), ids=LONG)
def test_a_row_for_each_value_becomes_channels_with_their_own_times(text: str) -> None:
    named = not text[0].isalpha()
    recording, notes = read(text, **({"columns": "t,tag,value"} if named else {}))
    assert set(recording.names) == {"valve", "flow"}
    np.testing.assert_allclose(recording.channel("valve").times, TIMES, atol=1e-9)
    np.testing.assert_array_equal(recording.channel("valve").values, INPUT)
    np.testing.assert_allclose(recording.channel("flow").times, LATER, atol=1e-9)
    np.testing.assert_allclose(recording.channel("flow").values, np.sin(LATER), atol=1e-6)
    assert any("names the signals of column" in note for note in notes)
    if "Z" in text:
        assert recording.started_at == CLOCK
    if "Unit" in text:
        assert [channel.unit for channel in recording.channels] == ["%", "l/min"]


def test_states_of_words_and_bad_rows_of_a_long_table_are_left_out_and_told() -> None:
    rows = [
        *("heater,on", "heater,off", "heater,on"),
        *("room,20.5", "room,unavailable", "room,21.5", "mode,heat", "mode,idle"),
    ]
    text = "entity_id,state,last_changed\n"
    text += "".join(f"{row},2026-11-01T10:00:{i:02d}Z\n" for i, row in enumerate(rows))
    recording, notes = read(text)
    assert recording.names == ("heater", "room")
    assert recording.channel("heater").values.tolist() == [1.0, 0.0, 1.0]
    assert recording.channel("room").times.tolist() == [3.0, 5.0]
    assert "signals of words were left out: mode" in notes
    assert "rows whose word marks a bad value were left out: 'unavailable' (1)" in notes
    assert "row 6, column 'state'" in str(refuse(text.replace("unavailable", "wet")))
    assert "write dates too" in str(refuse("tag,time,value\na,12:00:00,1\na,12:00:01,2\n"))


NONMEM = (
    "ID,TIME,AMT,DV,DVID,EVID\n1,0,100,.,.,1\n1,0,.,0.5,1,0\n1,1,.,3,1,0\n1,1,.,80,2,0\n"
    "1,2,.,2.5,1,0\n1,2,.,70,2,0\n1,12,100,.,.,1\n1,12,.,0.5,1,0\n"
)


def test_rows_of_doses_and_observations_are_channels() -> None:
    recording, notes = read(NONMEM)
    assert recording.names == ("DVID 1", "DVID 2", "AMT")
    assert recording.channel("DVID 2").values.tolist() == [80.0, 70.0]
    assert recording.channel("AMT").times.tolist() == [0.0, 12.0]
    assert any("several values at a time were left out: ID, EVID" in note for note in notes)
    single = "ID,TIME,AMT,DV\n1,0,100,.\n1,0,.,0.5\n1,1,.,3\n1,2,.,2.5\n"
    assert read(single)[0].channel("DV").times.tolist() == [0.0, 1.0, 2.0]
    two = single + single.partition("\n")[2].replace("1,", "2,", 1).replace("\n1,", "\n2,")
    error = refuse(two)
    assert str(error).endswith("If the file has several measurements, divide it by segments=ID.")
    recording, _ = read(two, segments="ID")
    assert [segment.labels["ID"] for segment in recording.segments] == [1.0, 2.0]
    assert recording.channel("DV").values.tolist() == [0.5, 3.0, 2.5, 0.5, 3.0, 2.5]


def test_a_word_among_the_values_of_a_long_table_is_no_header() -> None:
    text = "tag,time,value\n" + "".join(
        f"{name},{i},{'open' if i == 3 else i}\n" for name in "ab" for i in range(20)
    )
    assert "row 5, column 'value': found 'open'" in str(refuse(text))
    recording, _ = read(text, missing="open")
    assert (recording.names, recording.channel("a").values.size) == (("a", "b"), 19)


def test_names_do_not_choose_blanks_inside_of_stamps() -> None:
    text = "2026-01-01 10:00:00,1,2\n2026-01-01 10:00:01,1,3\n2026-01-01 10:00:02,1,4\n"
    assert "the table has 3 columns, and 2 names" in str(refuse(text, columns="t,u"))
    assert read(text, columns="t,u,y")[0].channel("y").values.tolist() == [2.0, 3.0, 4.0]


def test_a_constant_text_beside_one_signal_names_nothing() -> None:
    rows = "".join(f"{t:.1f},{y:.6f},run 7\n" for t, y in zip(TIMES, OUTPUT, strict=True))
    assert read("t,y,name\n" + rows)[0].names == ("y",)
    assert read("t,value,name\n" + rows)[0].names == ("run 7",)


def test_measurements_below_each_other_are_no_long_table() -> None:
    rows = "".join(f"{run},{t:.1f},{t},{t}\n" for run in "AB" for t in TIMES)
    recording, _ = read("run,t,u,y\n" + rows)
    assert (recording.names, len(recording.segments)) == (("u", "y"), 2)
    assert len(read("run,t,u,y\n" + rows, segments="run")[0].segments) == 2


RECORDS = [{"t": t, "u": u, "y": y} for t, u, y in ROWS]
HISTORY = [
    [
        {
            "entity_id": name,
            "state": f"{value:g}",
            "last_changed": (CLOCK + timedelta(seconds=t)).isoformat(),
        }
        for t, value in zip(TIMES.tolist(), values.tolist(), strict=True)
    ]
    for name, values in (("u", INPUT), ("y", OUTPUT))
]
MINIMAL = [
    [
        one if i == 0 else {n: v for n, v in one.items() if n != "entity_id"}
        for i, one in enumerate(part)
    ]
    for part in HISTORY
]
JSON = {
    "records": json.dumps(RECORDS),
    "lines of records": "\n".join(map(json.dumps, RECORDS)),
    "inside an object": json.dumps({"rig": 7, "result": {"data": RECORDS}}),
    "nested": json.dumps(
        [{"t": r["t"], "u": r["u"], "y": r["y"], "at": {"x": None}} for r in RECORDS]
    ),
    "Home Assistant": json.dumps(HISTORY),
    "Home Assistant, minimal": json.dumps(MINIMAL),
    "list for each signal": json.dumps(
        {
            name: [
                {"ts": 1000 * t, "value": str(v)}
                for t, v in zip(TIMES.tolist(), values, strict=True)
            ]
            for name, values in (("u", INPUT.tolist()), ("y", OUTPUT.tolist()))
        }
    ).replace('"ts"', '"time_ms"'),
    "names and rows": json.dumps({"columns": ["t", "u", "y"], "index": [0], "data": ROWS}),
    "series": json.dumps({"results": 1, "fields": [{"name": n} for n in "tuy"], "values": ROWS}),
}


@pytest.mark.parametrize("text", JSON.values(), ids=JSON)
def test_json_of_records_is_a_table(text: str) -> None:
    recording, _ = read(text)
    assert set(recording.names) == {"u", "y"}
    for name, values in (("u", INPUT), ("y", OUTPUT)):
        np.testing.assert_allclose(recording.channel(name).times, TIMES, atol=1e-9)
        np.testing.assert_allclose(recording.channel(name).values, values, rtol=1e-5)


REFUSED_JSON = {
    "arrays": ('{"t": [0, 1], "u": [0, 1]}', "holds no list of records. Write one for each time"),
    "cut off": ('[{"t": 0, "u": 1}, {"t": 1', "begins like JSON and is none: "),
    "second line": ('{"t": 0, "u": 1}\n{"t": 1, "u": 2]}\n', "begins like JSON and is none: "),
    "word": ('[{"t": 0, "u": 1}, {"t": 1, "u": "5 V"}]', "row 2, column 'u': found '5 V'"),
    "no time": ('[{"u": 1, "y": 2}, {"u": 2, "y": 3}]', "there is no time column; found u, y."),
    "deep": ("[" * 100_000, "nested too deeply"),
}


@pytest.mark.parametrize(("text", "words"), REFUSED_JSON.values(), ids=REFUSED_JSON)
def test_json_without_records_is_refused(text: str, words: str) -> None:
    assert words in str(refuse(text))


def test_rows_of_json_without_names_take_columns() -> None:
    assert "so the file has no header" in str(refuse(json.dumps(ROWS)))
    check_experiment(read(json.dumps(ROWS), columns="t,u,y")[0])


def test_files_of_several_loggers_are_joined_on_one_clock(tmp_path: Path) -> None:
    clocks = {"supply": (0.0, INPUT), "room": (2.5, OUTPUT)}
    for name, (late, values) in clocks.items():
        stamps = [CLOCK + timedelta(seconds=late + t) for t in TIMES.tolist()]
        rows = "".join(f"{s.isoformat()};{v:.6f};\n" for s, v in zip(stamps, values, strict=True))
        (tmp_path / f"{name}.csv").write_text(f"timestamp;{name} [degC];\n{rows}")
    paths = [tmp_path / "supply.csv", tmp_path / "room.csv"]
    recording, notes = read_with_notes(paths)
    assert recording.names == ("supply", "room")
    assert recording.started_at == CLOCK
    np.testing.assert_allclose(recording.channel("room").times, TIMES + 2.5)
    assert "clocks are joined: supply begins first, room begins 2.5 s later" in notes
    assert any(note.startswith("room: column 'timestamp' read as UTC") for note in notes)
    contents, _ = read_with_notes([path.read_bytes() for path in paths])
    assert contents.names == ("supply", "room")
    assert read_with_notes(paths[:1])[0].names == ("supply",)
    with pytest.raises(UnreadableFile, match="file 1 has dates and file 2 none"):
        read_with_notes([paths[0].read_bytes(), join_rows("t,u,y").encode()])
    with pytest.raises(UnreadableFile, match="no file in the list"):
        read_with_notes([])
    (tmp_path / "bad.csv").write_text("t,u\n0,5 V\n1,2\n")
    with pytest.raises(UnreadableFile, match=r"bad\.csv: row 2, column 'u': found '5 V'"):
        read_with_notes([paths[0], tmp_path / "bad.csv"])


def save_matlab(folder: Path, version: str, **content: object) -> Path:
    with warnings.catch_warnings(action="ignore"):
        from matio import save_to_mat

        save_to_mat(str(folder / "a.mat"), content, version=version)
    return folder / "a.mat"


def read_here(path: Path) -> Recording:
    """Read a file as the child does, in this process: a child takes seconds to load pandas."""
    return read_file(path, detect_kind(path), ReadOptions())[0]


def refuse_here(path: Path) -> str:
    with pytest.raises(UnreadableFile) as caught:
        read_here(path)
    return str(caught.value)


COLUMNS = {"u": INPUT, "y": OUTPUT}
SPANS = pd.to_timedelta(np.arange(INPUT.size) * 100, unit="ms")


def make_iddata(**changes: object) -> object:
    """An `iddata` as its properties are stored: matrices, names in cells, period in its unit."""
    with warnings.catch_warnings(action="ignore"):
        from matio.utils import MatlabOpaque

    properties = {
        "OutputData_": OUTPUT[:, np.newaxis],
        "InputData_": INPUT[:, np.newaxis],
        "Ts": np.array([[0.1]]),
        "Tstart": np.zeros((0, 0)),
        "SamplingInstants": np.zeros((0, 0)),
        "OutputName": np.array([["y"]], dtype=object),
        "InputName": np.array([["u"]], dtype=object),
        "OutputUnit": np.array([["degC"]], dtype=object),
        "TimeUnit": "seconds",
    }
    return MatlabOpaque({**properties, **changes}, "iddata")


MATLAB = {
    "arrays": {"t": TIMES, **COLUMNS},
    "period": {**COLUMNS, "Ts": 0.1},
    "structure": {"z": {"t": TIMES, **COLUMNS, "name": "rig"}},
    "nested": {"rig": {"log": {"t": TIMES, **COLUMNS}, "name": "rig"}, "note": "of May"},
    "spread": {"rig": {"t": TIMES, "in": {"u": INPUT}, "out": {"y": OUTPUT}, "who": "me"}},
    "table": {"T": pd.DataFrame({"t": TIMES, **COLUMNS})},
    "timetable": {"TT": pd.DataFrame(COLUMNS, index=SPANS)},
    "dated timetable": {"TT": pd.DataFrame(COLUMNS, index=pd.Timestamp("2026-03-14") + SPANS)},
}


@pytest.mark.parametrize("version", ["v7", "v7.3"])
@pytest.mark.parametrize("content", MATLAB.values(), ids=MATLAB)
def test_matlab_of_every_version_is_read(
    tmp_path: Path, content: dict[str, object], version: str
) -> None:
    recording = read_here(save_matlab(tmp_path, version, **content))
    assert set(recording.names) == {"u", "y"}
    for name, values in COLUMNS.items():
        np.testing.assert_allclose(recording.channel(name).times, TIMES, atol=1e-9)
        np.testing.assert_array_equal(recording.channel(name).values, values)
    table = content.get("TT")
    if isinstance(table, pd.DataFrame) and isinstance(table.index, pd.DatetimeIndex):
        assert recording.started_at == table.index[0].to_pydatetime()


@pytest.mark.parametrize("version", ["v7", "v7.3"])
def test_an_iddata_has_its_names_units_and_times(tmp_path: Path, version: str) -> None:
    recording = read_here(save_matlab(tmp_path, version, z=make_iddata()))
    assert recording.names == ("u", "y")
    assert recording.channel("y").unit == "degC"
    np.testing.assert_allclose(recording.channel("y").times, TIMES)
    np.testing.assert_array_equal(recording.channel("y").values, OUTPUT)
    minutes = make_iddata(TimeUnit="minutes", Ts=np.array([[0.5]]), Tstart=np.array([[2.0]]))
    late = read_here(save_matlab(tmp_path, version, z=minutes)).channel("y")
    np.testing.assert_allclose(late.times, 120 + 30 * np.arange(INPUT.size))
    uneven = make_iddata(SamplingInstants=(TIMES**1.1)[:, np.newaxis], Ts=np.zeros((0, 0)))
    times = read_here(save_matlab(tmp_path, version, z=uneven)).channel("y").times
    np.testing.assert_allclose(times, TIMES**1.1)


def test_several_records_of_a_matlab_file_are_refused_by_name(tmp_path: Path) -> None:
    one = {"t": TIMES, **COLUMNS}
    error = refuse_here(save_matlab(tmp_path, "v7.3", may=one, june=one))
    assert "the file holds june, may; need arrays such as t, u and y" in error
    assert "save('file.mat', '-struct', 'name')" in error
    cells = np.empty((1, 2), dtype=object)
    cells[0, 0] = cells[0, 1] = OUTPUT[:, np.newaxis]
    several = save_matlab(tmp_path, "v7.3", z=make_iddata(OutputData_=cells))
    assert "holds 2 experiments; save one: z = getexp(z, 1)" in refuse_here(several)
    whole = save_matlab(tmp_path, "v7.3", **one)
    whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert "the MATLAB file cannot be read" in refuse_here(whole)


@pytest.mark.parametrize("way", ["link", "values", "virtual"])
def test_a_matlab_file_reads_no_other_file(tmp_path: Path, way: str) -> None:
    save_matlab(tmp_path, "v7.3", t=TIMES, u=INPUT)
    secret = tmp_path / "secret.h5"
    secret.write_bytes(INPUT.tobytes())
    with h5py.File(tmp_path / "a.mat", "a") as file:
        if way == "link":
            file["y"] = h5py.ExternalLink(str(secret), "/y")
        elif way == "values":
            stored = [(str(secret), 0, INPUT.nbytes)]
            file.create_dataset("y", INPUT.shape, "<f8", external=stored)
        else:
            layout = h5py.VirtualLayout(INPUT.shape, "<f8")
            layout[:] = h5py.VirtualSource(str(secret), "y", shape=INPUT.shape)
            file.create_virtual_dataset("y", layout)
    assert "another file" in refuse_here(tmp_path / "a.mat")


def test_objects_of_matlab_come_through_the_child(tmp_path: Path) -> None:
    recording, notes = read_with_notes(save_matlab(tmp_path, "v7.3", z=make_iddata()))
    np.testing.assert_array_equal(recording.channel("y").values, OUTPUT)
    assert "the fields of 'z' were read" in notes


def test_matlab_without_its_library_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = save_matlab(tmp_path, "v7.3", **COLUMNS)
    monkeypatch.setitem(sys.modules, "matio", None)
    assert "pip install 'lagid[matlab]'" in refuse_here(path)


@pytest.mark.parametrize(("heading", "unit"), [("t [min]", "min"), ("time (h)", "h"), ("t/d", "d")])
def test_a_channel_knows_the_unit_of_its_times(heading: str, unit: str) -> None:
    recording, _ = read(join_rows(f"{heading},u,y"))
    assert {channel.time_unit for channel in recording.channels} == {unit}
    assert read(join_rows("t,u,y"))[0].channel("u").time_unit == "s"
    with pytest.warns(ReadingNote, match=f"converted from {unit} to s"):
        assert Recording({heading: TIMES, "u": INPUT}).channel("u").time_unit == unit


def test_excluded_times_cut_a_record_and_excluded_values_are_missing() -> None:
    recording, notes = read(join_rows("t,u,y"), exclude="t=5:9.95, y=-0.3:")
    assert len(recording.segments) == 2
    first, second = recording.split_segments()
    assert (first.channel("u").values.size, second.channel("u").values.size) == (50, 140)
    np.testing.assert_array_equal(second.channel("u").values, INPUT[100:])
    kept = np.where(OUTPUT >= -0.3, np.nan, OUTPUT)
    np.testing.assert_array_equal(second.channel("y").values, kept[100:])
    assert "t=5:9.95 excludes 50 rows; what follows is a measurement of its own" in notes
    assert f"y=-0.3: excludes {np.count_nonzero(OUTPUT >= -0.3)} values of 'y'" in notes


def test_rows_are_excluded_by_a_word_and_from_long_tables() -> None:
    text = write_marked("7.5", "t,u,y,mode", ",auto", ",Service")
    recording, _ = read(text, exclude="mode=service")
    assert len(recording.segments) == 3
    assert 7.5 not in recording.channel("y").values
    long, _ = read(LONG["seconds"], exclude="t=:1.95")
    assert long.channel("valve").values.size == INPUT.size - 20


@pytest.mark.parametrize(
    ("condition", "words"),
    [
        ("z=1:2", "exclude z=1:2: there is no column 'z'"),
        ("t=a:2", "exclude t=a:2: found 'a:2'; need a range such as 100:200"),
        ("y=2:1", "exclude y=2:1: found '2:1'; need a range"),
        ("t=:", "exclude: t=: excludes every row"),
        ("t", "exclude t: found ''; need a range"),
    ],
)
def test_an_exclusion_that_cannot_be_is_refused(condition: str, words: str) -> None:
    assert words in str(refuse(join_rows("t,u,y"), exclude=condition))
