"""A killed pytest leaves no process, no shared memory and no folder behind."""

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.support.checkout import ROOT
from tests.support.cluster.dispatch_place import until
from tests.support.session_guard import find_processes

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.postgres, pytest.mark.timeout(300)]

TESTS = """
import os, subprocess, sys, tempfile, time
from pathlib import Path
from benchmarks.breaking.disks import small_disk
from tests.support.storage.databases import postgres_url
from tests.support.session_guard import SESSION_VARIABLE
from workers.local_ray import LocalRay

def test_waits(tmp_path):
    postgres_url()
    disk = small_disk(Path(tempfile.mkdtemp()), 1)
    disk.__enter__()  # where it can be mounted; the guard unmounts it
    ray = LocalRay(1).module
    ray.get(ray.remote(lambda: 1).remote())
    sleeping = [sys.executable, "-c", "import time; time.sleep(600)"]
    subprocess.Popen(sleeping, start_new_session=True)
    said = Path(__file__).with_name("said.part")
    said.write_text(f"{os.environ[SESSION_VARIABLE]} {tmp_path}")
    said.rename(said.with_suffix(""))
    time.sleep(600)
"""


def find_shared_memory(process: psutil.Process) -> set[Path]:
    """Find the files of shared memory that a process uses."""
    maps = Path(f"/proc/{process.pid}/maps").read_text().splitlines()
    return {Path(line.split()[5]) for line in maps if " /dev/shm/" in line}


def is_alive(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_a_killed_pytest_leaves_nothing(tmp_path: Path) -> None:
    tests, said = tmp_path / "test_waits.py", tmp_path / "said"
    tests.write_text(TESTS)
    options = [
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "tests.conftest",
        "-c",
        ROOT / "pyproject.toml",
    ]
    with (tmp_path / "log").open("w") as log:
        child = subprocess.Popen(
            [sys.executable, "-m", "pytest", *options, tests],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=log,
            stderr=log,
        )
    try:
        until(lambda: said.exists() or child.poll() is not None, "the test ran")
        session, folder = map(Path, said.read_text().split())
        family = find_processes(str(session))
        shared = {file for process in family for file in find_shared_memory(process)}
        names = {process.name() for process in family}
        assert {"postgres", "gcs_server", "raylet", "ray::IDLE"} <= names
        assert any(file.name.startswith("PostgreSQL") for file in shared)
        assert session.exists()
        assert folder.exists()
    finally:
        child.kill()
        child.wait()
    until(lambda: not any(map(is_alive, family)), "the end of all processes")
    until(lambda: not session.exists(), "the end of the folder of the session")
    until(lambda: not folder.exists(), "the end of the folder of the test")
    assert [file for file in shared if file.exists()] == []
