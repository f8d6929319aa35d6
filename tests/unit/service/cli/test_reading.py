"""A file that the user names is read or refused in the user's words: options, not fields."""

from pathlib import Path

import httpx
import numpy as np
import pytest
import typer

from service.cli.common import report_faults, upload_origins
from service.cli.identify_command import read_input_file
from service.client.calls import build_upload, raise_for_problem
from service.formats.read_options import ReadOptions
from tests.support.files.experiment_files import TIMES, join_rows, write_parquet


def refuse(path: Path, capsys: pytest.CaptureFixture[str], *segments: str) -> str:
    with pytest.raises(typer.Exit):
        read_input_file(path, ReadOptions(segments=segments))
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "Traceback" not in line
    return line


def test_guesses_are_notes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.txt"
    path.write_text("Device: rig\n\n" + join_rows("Zeit;u;y", ";"))
    recording = read_input_file(path, ReadOptions())
    np.testing.assert_array_equal(recording.channel("u").times, TIMES)
    notes = capsys.readouterr().err.splitlines()
    assert "note: the header is in row 3; the lines before it were skipped" in notes
    assert "note: column 'Zeit' was read as the time in s" in notes


def test_a_refusal_names_the_file_and_the_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.csv"
    path.write_text("u,y\n1,2\n2,3\n")
    line = refuse(path, capsys)
    assert f"lagid: {path}: row 1: there is no time column; found u, y." in line
    assert "give the sampling period with --sample-time." in line
    path.write_text("t,u\n0,1\n0,2\n")
    assert "remove it and give the sampling period with --sample-time" in refuse(path, capsys)
    path.write_text("t,n,u\n0,1,1\n1,2,2\n2,3,3\n")
    assert "leave columns of times and signals out of --segments" in refuse(path, capsys, "n")
    path.write_text('{"t": []}')
    assert "the JSON holds no list of records. Write one for each time" in refuse(path, capsys)


def test_refusals_of_the_server_name_options_too(capsys: pytest.CaptureFixture[str]) -> None:
    detail = "row 2, column 'segments': in segments; name it in segments."
    fault = {"pointer": "/rows/2", "detail": detail, "option": "segments"}
    with pytest.raises(typer.Exit), report_faults(upload_origins(Path("rig.csv"))):
        raise_for_problem(httpx.Response(422, json={"errors": [fault], "title": "x"}))
    assert capsys.readouterr().err == (
        "lagid: rig.csv: row 2, column 'segments': in segments; name it in --segments.\n"
    )


def test_columns_called_like_options_keep_their_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.csv"
    path.write_text("t,sample_time,y\n0,1,2\n1,5x,3\n2,1,3\n")
    line = refuse(path, capsys)
    assert "column 'sample_time': found '5x'" in line
    assert line.endswith("name it in --segments\n")
    path.write_text("sample_time,y\n0,1\n1,2\n")
    line = refuse(path, capsys)
    assert "found sample_time, y. Name one" in line
    assert line.endswith("with --sample-time.\n")
    path.write_bytes(write_parquet(sample_time=[0.0, 1.0], y=[1.0, 2.0]))  # read by a child
    assert refuse(path, capsys) == line.replace("row 1: ", "")


@pytest.mark.parametrize("name", ["a.csv", "a.xlsx", "a.csv.gz", "a", "a.unknown"])
def test_a_client_sends_bytes_whatever_the_name(name: str) -> None:
    call = build_upload(Path(name), None, {})
    assert call.headers["content-type"] == "application/octet-stream"
    assert call.params["name"] == "a"
