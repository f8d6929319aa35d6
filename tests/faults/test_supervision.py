"""The supervisor: restarts what ends, and leaves no process behind."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path

import pytest

from service.core.settings import Settings
from service.dispatch import supervisor as supervision
from service.dispatch.supervisor import (
    Supervisor,
    find_session_processes,
    make_paths_absolute,
    to_environment,
)
from tests.support.limits import LIMIT_SECONDS

# A child with a child of its own in another process group, as Ray's helpers are.
CHILD = """
import os, subprocess, sys, time
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"], process_group=0)
open(sys.argv[1], "a").write(f"{os.getpid()}\\n")
time.sleep(600)
"""

OWNER = """
import sys, time
from service.dispatch.supervisor import Supervisor
supervisor = Supervisor([sys.executable, "-c", sys.argv[2], sys.argv[1]], {})
supervisor.start()
time.sleep(600)
"""

# Ends when its standard input does.
ORPHAN = """
import os, sys
open(sys.argv[1], "a").write(f"{os.getpid()}\\n")
sys.stdin.buffer.read()
"""


def until(holds: Callable[[], bool], what: str) -> None:
    limit = time.monotonic() + LIMIT_SECONDS
    while not holds():
        assert time.monotonic() < limit, f"{what} did not come true"
        time.sleep(0.02)


def pids(file: Path) -> list[int]:
    return [int(line) for line in file.read_text().split()] if file.exists() else []


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_stopping_ends_the_child_and_every_process_it_started(tmp_path: Path) -> None:
    file = tmp_path / "pids"
    supervisor = Supervisor([sys.executable, "-c", CHILD, str(file)], {})
    supervisor.start()
    until(lambda: len(pids(file)) == 1, "the start")
    family = find_session_processes(pids(file)[0])
    supervisor.stop()
    assert len(family) == 2
    until(lambda: not any(map(is_alive, family)), "the end of all")
    assert supervisor.pid is None


def test_a_killed_child_is_started_anew_and_its_orphans_are_killed(tmp_path: Path) -> None:
    file = tmp_path / "pids"
    supervisor = Supervisor([sys.executable, "-c", CHILD, str(file)], {})
    supervisor.start()
    until(lambda: len(pids(file)) == 1, "the start")
    family = find_session_processes(pids(file)[0])
    os.kill(pids(file)[0], signal.SIGKILL)
    until(lambda: len(pids(file)) == 2, "the second start")
    assert not any(map(is_alive, family))
    supervisor.stop()
    until(lambda: not any(map(is_alive, pids(file))), "the end of all")


def test_a_child_that_stays_stopped_is_killed_and_started_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervision, "POLL_SECONDS", 0.05)
    monkeypatch.setattr(supervision, "STOPPED_SECONDS", 0.2)
    file = tmp_path / "pids"
    supervisor = Supervisor([sys.executable, "-c", CHILD, str(file)], {})
    supervisor.start()
    until(lambda: len(pids(file)) == 1, "the start")
    os.kill(pids(file)[0], signal.SIGSTOP)
    until(lambda: len(pids(file)) == 2, "the second start")
    assert not is_alive(pids(file)[0])
    supervisor.stop()


def test_a_child_learns_that_its_supervisor_was_killed(tmp_path: Path) -> None:
    file = tmp_path / "pids"
    owner = subprocess.Popen([sys.executable, "-c", OWNER, str(file), ORPHAN])
    until(lambda: len(pids(file)) == 1, "the start")
    owner.kill()
    owner.wait()
    until(lambda: not is_alive(pids(file)[0]), "the end of the orphan")


def test_the_settings_of_the_child_are_those_of_the_parent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hosts = ("lab.example", "proxy.example")
    settings = Settings(data_dir=tmp_path / "data", cpus=3, lease_seconds=7.0, allowed_hosts=hosts)
    for name, value in to_environment(settings).items():
        monkeypatch.setenv(name, value)
    assert Settings() == settings


def test_paths_of_the_environment_hold_in_the_folder_of_the_child(tmp_path: Path) -> None:
    with chdir(tmp_path):
        paths = make_paths_absolute({"TMPDIR": "tmp", "LAGID_CACHE_DIR": "/cache", "HOME": "h"})
    assert paths.pop("PYTHONPATH").split(os.pathsep)
    assert paths == {"TMPDIR": str(tmp_path / "tmp"), "LAGID_CACHE_DIR": "/cache"}


def test_the_log_of_a_child_is_for_its_owner_only(tmp_path: Path) -> None:
    log = tmp_path / "logs" / "a.log"
    supervisor = Supervisor([sys.executable, "-S", "-c", "print(1)"], {}, log)
    supervisor.start()
    until(log.exists, "the log")
    supervisor.stop()
    assert (log.stat().st_mode & 0o777, log.parent.stat().st_mode & 0o777) == (0o600, 0o700)


def test_a_child_that_was_at_work_is_started_again_without_waiting_longer_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervision, "FIRST_PAUSE_SECONDS", 0.02)
    monkeypatch.setattr(supervision, "MAX_PAUSE_SECONDS", 600.0)
    monkeypatch.setattr(supervision, "LIVED_SECONDS", 0.0)
    file = tmp_path / "pids"
    leave = f"os._exit({supervision.RESTART_EXIT_CODE})"
    code = f"import os, sys; open(sys.argv[1], 'a').write('1\\n'); {leave}"
    supervisor = Supervisor([sys.executable, "-S", "-c", code, str(file)], {})
    supervisor.start()
    until(lambda: len(pids(file)) >= 12, "the twelfth start")
    supervisor.stop()
