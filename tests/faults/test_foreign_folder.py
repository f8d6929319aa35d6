"""A service that is started in a folder with somebody's modules works, and runs none of them."""

import os
import subprocess
import sys
from contextlib import chdir
from pathlib import Path

import pytest

from service.core.states import JobState
from service.formats.sandbox import read_untrusted
from sysid.core.child_processes import build_child_command, build_import_path
from sysid.kernels.compilation.limited_compilation import compile_kernel
from sysid.kernels.layout import KernelVariant
from tests.support.checkout import ROOT
from tests.support.files.foreign_modules import ForeignFolder
from tests.support.library.small_models import duffing
from tests.support.service.commands import check_refusal, run_lagid
from tests.support.service.whole_service import Service
from workers.ray_folders import get_inner_folder


@pytest.fixture
def foreign(tmp_path: Path) -> ForeignFolder:
    return ForeignFolder(tmp_path)


def test_the_modules_tell_when_they_run(foreign: ForeignFolder) -> None:
    command = [sys.executable, "-m", "service.cli.main"]
    done = subprocess.run(command, cwd=foreign.path, capture_output=True, text=True, check=False)
    assert "a module of the working folder was imported" in done.stderr
    assert foreign.list_imported() == ["service"]


def test_the_reader_of_uploads_and_the_compiler_run_no_module_of_the_working_folder(
    foreign: ForeignFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.csv"
    file.write_text("t,u\n0,1\n1,2\n")
    with chdir(foreign.path):
        monkeypatch.setattr(sys, "path", ["", str(foreign.path), ".", *sys.path])
        assert read_untrusted(file).recording.channels[0].values.tolist() == [1.0, 2.0]
        assert compile_kernel(duffing(), KernelVariant())
    assert foreign.list_imported() == []


def test_the_import_path_of_a_child_has_no_working_folder_but_the_programs(
    foreign: ForeignFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", ["", ".", "beside", "/usr/lib/python"])
    with chdir(foreign.path):
        expected = [str(foreign.path / "beside"), "/usr/lib/python", str(ROOT)]
        assert build_import_path().split(os.pathsep) == expected
    with chdir(ROOT):
        monkeypatch.setattr(sys, "path", [str(ROOT), "/usr/lib/python"])
        assert build_import_path().split(os.pathsep) == [str(ROOT), "/usr/lib/python"]
    assert build_child_command("service.cli.main")[1] == "-P"


@pytest.mark.ray
@pytest.mark.slow
def test_a_service_that_is_started_in_a_foreign_folder_computes_and_runs_none_of_its_code(
    service: Service,
) -> None:
    job = service.submit(algorithm={"generations": 5})
    assert service.wait_for_end(job).state is JobState.SUCCEEDED
    dispatchers = service.stand.family.dispatchers()
    assert [os.readlink(f"/proc/{pid}/cwd") for pid in dispatchers] == ["/"] * len(dispatchers)
    assert service.foreign.list_imported() == []


@pytest.mark.ray
@pytest.mark.slow
def test_nobody_else_reaches_rays_folder(service: Service) -> None:
    """Ray opens its own folder to all users, who could replace its logs and sockets."""
    raylets = service.stand.family.named("raylet")
    assert raylets
    for pid in raylets:
        folder = Path(f"/proc/{pid}/cwd").readlink()
        (inner,) = folder.iterdir()
        assert inner == get_inner_folder(folder)
        assert inner.stat().st_mode & 0o077 == 0o077  # so it needs the folder around it
        assert folder.stat().st_mode & 0o077 == 0


@pytest.mark.ray
@pytest.mark.slow
def test_a_second_service_on_the_same_folder_says_so_and_ends(service: Service) -> None:
    words = ("serve", "--port", "0", "--data-dir", service.stand.folder)
    line = check_refusal(run_lagid(*words))
    assert f"`lagid serve` at {service.stand.url}/" in line
    assert f"works on {service.stand.folder}; a second one with --no-dispatcher" in line
