"""Temporary files of processes that are gone are cleared; those of the living stay."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from service.core.process import temporary_files
from sysid.core import machine
from tests.support.limits import LIMIT_SECONDS
from workers import local_ray, ray_folders
from workers.errors import ClusterUnavailable

LEAVE = """
import sys
from service.core.process import temporary_files
open(sys.argv[1] + temporary_files.make_temporary_prefix(), "w")
"""
ELSEWHERE = "another boot pid:[4026531836]"


@pytest.fixture
def ended_process() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_what_a_dead_process_left_goes_and_what_a_living_one_has_stays(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", LEAVE, f"{tmp_path}/"], check=True, timeout=LIMIT_SECONDS)
    assert len(list(tmp_path.iterdir())) == 1
    mine = tmp_path / f"{temporary_files.make_temporary_prefix()}file"
    mine.touch()
    other = tmp_path / "lagid-tmp-another-host-1-file"
    other.touch()
    temporary_files.remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {mine.name, other.name}
    old = 2 * temporary_files.STALE_SECONDS
    os.utime(other, (other.stat().st_mtime - old, other.stat().st_mtime - old))
    temporary_files.remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == [mine]


def test_a_file_that_goes_while_it_is_looked_at_is_no_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone, left = (tmp_path / f"lagid-tmp-another-host-{number}-file" for number in (1, 2))
    left.touch()
    os.utime(left, (0.0, 0.0))
    monkeypatch.setattr(Path, "glob", lambda *_: [gone, left])
    temporary_files.remove_leftovers(tmp_path)
    assert not left.exists()


def test_a_living_process_of_another_pid_namespace_keeps_its_files_and_rays_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ended_process: int
) -> None:
    monkeypatch.setattr(ray_folders, "_choose_base_folder", lambda: tmp_path)
    with monkeypatch.context() as there:  # its number is there one that has ended here
        there.setattr(machine, "read_machine_id", lambda: ELSEWHERE)
        there.setattr(os, "getpid", lambda: ended_process)
        theirs = [
            tmp_path / f"{temporary_files.make_temporary_prefix()}file",
            ray_folders.get_ray_folder(ended_process),
        ]
    for path in theirs:
        path.mkdir()
    gone = ray_folders.get_ray_folder(ended_process)
    gone.mkdir()
    temporary_files.remove_leftovers(tmp_path)
    ray_folders.clear_dead_dispatchers()
    assert set(tmp_path.iterdir()) == set(theirs)


def test_files_of_a_process_whose_number_another_has_by_now_go(tmp_path: Path) -> None:
    number = os.getpid()
    former = tmp_path / f"lagid-tmp-{machine.make_machine_tag()}-{number}-1-file"
    former.touch()
    temporary_files.remove_leftovers(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_rays_folder_is_not_one_that_somebody_else_has_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_folders, "_choose_base_folder", lambda: tmp_path)
    folder, target = ray_folders.get_ray_folder(os.getpid()), tmp_path / "elsewhere"
    target.mkdir()
    folder.symlink_to(target)  # as what another has made, it cannot be removed as a folder is
    with pytest.raises(ClusterUnavailable, match="cannot be made"):
        local_ray.make_folder()
    folder.unlink()
    made = local_ray.make_folder()
    assert made == folder
    assert made.stat().st_mode & 0o077 == 0


def test_the_paths_of_rays_sockets_are_short_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    base = "/" + "b" * (ray_folders._MAX_BASE_LENGTH - 1)
    monkeypatch.setattr(tempfile, "gettempdir", lambda: base)
    most = 2**22 - 1  # the highest number of a process
    session = f"session_2026-01-01_00-00-00_000000_{most}/sockets/plasma_store"
    path = ray_folders.get_inner_folder(ray_folders.get_ray_folder(most)) / session
    assert str(path).startswith(base)
    assert len(str(path)) <= 107
