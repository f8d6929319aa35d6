"""Files as plants write them: without a header, with markers of bad data, in long format."""

import io

import numpy as np
import pytest

from service.formats.read_options import ReadOptions, build_options
from service.formats.recordings import read_recording, read_with_notes
from sysid.core.errors import UnreadableFile
from sysid.data.records import Recording
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
    assert "channel 'y': 3 of 240 values are missing" in told
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
