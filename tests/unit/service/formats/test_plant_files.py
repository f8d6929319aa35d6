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
