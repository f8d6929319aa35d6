"""Uploads read in a child process: right answers, and one clear error for whatever goes wrong."""

import sys
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import typer

from service.cli.identify_command import read_input_file
from service.formats import sandbox
from service.formats.limits import DEFAULT_LIMITS, MIB
from service.formats.read_options import ReadOptions
from service.formats.sandbox import read_untrusted
from sysid.core.child_processes import run_child
from sysid.core.errors import UnreadableFile
from sysid.data.records import Channel, Recording
from sysid.inspection.inspect import check_recording
from tests.support.files.mcap_files import json_messages, write_foreign_bytes, write_mcap_bytes
from tests.support.limits import LIMIT_SECONDS

TIMES = np.arange(200) * 0.01


def save_file(folder: Path, content: bytes) -> Path:
    path = folder / "upload"
    path.write_bytes(content)
    return path


def read_refusal(path: Path, **options: object) -> UnreadableFile:
    with pytest.raises(UnreadableFile) as caught:
        read_untrusted(path, ReadOptions(**options))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    return caught.value


def test_a_csv_upload_is_read_with_its_notes_and_hash(tmp_path: Path) -> None:
    content = b"n,u [V]\n1,0.5\n1,\n2,0.25\n"
    read = read_untrusted(
        save_file(tmp_path, content), ReadOptions(sample_time=0.5, segments=("n",))
    )
    np.testing.assert_array_equal(read.recording.channel("u").values, [0.5, np.nan, 0.25])
    assert [one.labels["n"] for one in read.recording.segments] == [1.0, 2.0]
    assert any("n divides the file" in note for note in read.notes)
    assert read.source_sha256 == sha256(content).hexdigest()


def test_an_mcap_upload_comes_through_bit_for_bit(tmp_path: Path) -> None:
    before = Channel("u", TIMES, np.sin(TIMES), "V", "zero")
    read = read_untrusted(save_file(tmp_path, write_mcap_bytes(Recording((before,)))))
    after = read.recording.channel("u")
    assert (after.unit, after.hold) == ("V", "zero")
    np.testing.assert_array_equal(after.values, before.values)
    np.testing.assert_array_equal(after.times, before.times)


def test_the_place_of_a_fault_comes_out_of_the_child(tmp_path: Path) -> None:
    error = read_refusal(save_file(tmp_path, b"t,u\n0,1\n1,x\n"))
    assert (error.row, error.column) == (3, "u")
    content = write_mcap_bytes(Recording((Channel("u", TIMES, TIMES),)))
    assert read_refusal(save_file(tmp_path, content[:60])).byte is not None


def test_missing_values_are_said_and_infinite_ones_refused(tmp_path: Path) -> None:
    messages = json_messages("/a", {"x": 1}, {"x": float("nan")})
    read = read_untrusted(save_file(tmp_path, write_foreign_bytes(messages)))
    (finding,) = check_recording(read.recording)
    assert "'x': 1 of 2 values are missing" in finding.text
    infinite = write_foreign_bytes(json_messages("/a", {"x": 1}, {"x": float("inf")}))
    assert "infinite at t = 0.1 s" in read_refusal(save_file(tmp_path, infinite)).detail


def test_a_file_larger_than_the_limit_is_refused(tmp_path: Path) -> None:
    limits = replace(DEFAULT_LIMITS, file_bytes=10)
    assert "at most 10" in read_refusal(save_file(tmp_path, bytes(11)), limits=limits).detail


@pytest.mark.usefixtures("endless_children")
def test_a_file_that_takes_too_long_is_refused(tmp_path: Path) -> None:
    limits = replace(DEFAULT_LIMITS, seconds=0.01)
    assert "takes more than 0.01 s" in read_refusal(save_file(tmp_path, b""), limits=limits).detail


@pytest.mark.usefixtures("endless_children")
def test_a_file_that_burns_the_processor_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = replace(DEFAULT_LIMITS, seconds=0.9)
    monkeypatch.setattr(sandbox, "run_child", run_for_long)  # its own limit ends it
    error = read_refusal(save_file(tmp_path, b"t,u\n0,1\n"), limits=limits)
    assert "takes more than 0.9 s" in error.detail


def run_for_long(module: str, task: bytes, *, seconds: float, folder: str) -> object:
    return run_child(module, task, seconds=LIMIT_SECONDS + seconds, folder=folder)


@pytest.mark.slow
def test_a_file_that_needs_too_much_memory_is_refused(tmp_path: Path) -> None:
    rows = "".join(f"{k},{k}\n" for k in range(300_000))
    limits = replace(DEFAULT_LIMITS, memory_bytes=64 * MIB)
    error = read_refusal(save_file(tmp_path, f"t,u\n{rows}".encode()), limits=limits)
    assert "64 MiB of memory" in error.detail


def test_a_file_that_makes_the_reader_stop_is_refused(tmp_path: Path) -> None:
    limits = replace(DEFAULT_LIMITS, total_bytes=0)  # the child may not write its answer's file
    error = read_refusal(save_file(tmp_path, b"t,u\n0,1\n1,2\n"), limits=limits)
    assert "crashes its reader" in error.detail


def test_times_that_no_file_can_hold_are_refused(tmp_path: Path) -> None:
    assert "63 bits" in read_refusal(save_file(tmp_path, b"t,u\n-1e12,1\n0,2\n")).detail


def test_identify_reads_mcap_under_the_limits_of_the_service(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = np.arange(20_000) * 0.01
    path = tmp_path / "recording.mcap"
    path.write_bytes(write_mcap_bytes(Recording((Channel("u", times, np.sin(times)),))))
    recording = read_input_file(path, ReadOptions())
    np.testing.assert_array_equal(recording.channel("u").values, np.sin(times))
    smaller = replace(DEFAULT_LIMITS, memory_bytes=64 * MIB)
    with pytest.raises(typer.Exit):
        read_input_file(path, ReadOptions(limits=smaller))
    assert "64 MiB of memory" in capsys.readouterr().err


@pytest.mark.usefixtures("endless_children")
def test_identify_reads_a_file_no_longer_than_the_service(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = replace(DEFAULT_LIMITS, seconds=0.01)
    path = save_file(tmp_path, b"t,u\n0,1\n").rename(tmp_path / "a.mcap")
    with pytest.raises(typer.Exit):
        read_input_file(path, ReadOptions(limits=short))
    assert "takes more than 0.01 s" in capsys.readouterr().err


def test_the_reader_does_not_see_the_secrets_of_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "python"
    program.write_text(f"#!/bin/sh\nexec env > {tmp_path}/seen\n")
    program.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setenv("LAGID_API_KEY", "secret")
    read_refusal(save_file(tmp_path, b"t,u\n0,1\n1,2\n"))
    names = {line.partition("=")[0] for line in (tmp_path / "seen").read_text().splitlines()}
    assert "PYTHONPATH" in names
    assert "LAGID_API_KEY" not in names
