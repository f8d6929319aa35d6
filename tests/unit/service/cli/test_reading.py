"""A file that the user names is read or refused in the user's words: options, not fields."""

from pathlib import Path

import httpx
import numpy as np
import pytest
import typer

from service.cli.common import FieldOrigins, name_read_options, report_faults
from service.cli.identify import FileOptions, read_recording
from service.client.calls import build_upload, raise_for_problem
from tests.recorded_files import TIMES, join_rows


def refuse(path: Path, capsys: pytest.CaptureFixture[str], *segments: str) -> str:
    with pytest.raises(typer.Exit):
        read_recording(path, FileOptions(None, segments))
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "Traceback" not in line
    return line


def test_guesses_are_notes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.txt"
    path.write_text("Device: rig\n\n" + join_rows("Zeit;u;y", ";"))
    recording = read_recording(path, FileOptions(None, ()))
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
    assert "name their label columns with --segments" in refuse(path, capsys)
    path.write_text("t,n,u\n0,1,1\n1,2,2\n2,3,3\n")
    assert "leave columns of times and signals out of --segments" in refuse(path, capsys, "n")
    path.write_text('{"t": []}')
    assert "the file is JSON, which is not read; write the signals" in refuse(path, capsys)


def test_refusals_of_the_server_name_options_too(capsys: pytest.CaptureFixture[str]) -> None:
    detail = "row 2: sample_time is given too; 3 segments, name them with segments"
    document = {"errors": [{"pointer": "/rows/2", "detail": detail}], "title": "x"}
    origins = FieldOrigins(rest="rig.csv", rewrite=name_read_options)
    with pytest.raises(typer.Exit), report_faults(origins):
        raise_for_problem(httpx.Response(422, json=document))
    assert capsys.readouterr().err == (
        "lagid: rig.csv: row 2: --sample-time is given too; 3 segments, name them with --segments\n"
    )


@pytest.mark.parametrize("name", ["a.csv", "a.xlsx", "a.csv.gz", "a", "a.unknown"])
def test_a_client_sends_bytes_whatever_the_name(name: str) -> None:
    call = build_upload(Path(name), None, None, None)
    assert call.headers["content-type"] == "application/octet-stream"
    assert call.params["name"] == "a"
