"""Whether another process of this machine has ended, as far as it can be seen."""

import os
import subprocess
import sys
from collections.abc import Iterator

import psutil
import pytest

from service.core.process.process_identity import (
    describe_process,
    has_process_ended,
    is_awake,
    is_gone,
    read_start,
)


@pytest.fixture
def child() -> Iterator["subprocess.Popen[str]"]:
    """A process that waits."""
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, text=True)
    yield process
    process.kill()
    process.communicate()


def test_a_process_that_only_waits_to_be_buried_has_ended(child: "subprocess.Popen[str]") -> None:
    started = read_start(child.pid)
    assert not has_process_ended(child.pid, started)
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert has_process_ended(child.pid, started)
    assert has_process_ended(child.pid, None)
    child.wait()
    assert has_process_ended(child.pid, started)
    assert read_start(child.pid) is None


def test_a_start_stays_when_the_clock_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    platform = sys.modules[psutil.Process()._proc.__module__]
    details, boot = describe_process(), psutil.boot_time()
    for step in (-3600.0, 1.0, 3600.0):
        monkeypatch.setattr(platform, "boot_time", lambda step=step: boot + step)
        assert psutil.boot_time() == boot + step
        assert read_start(os.getpid()) == details["started"]
        assert not is_gone(details)


def test_a_process_that_proc_hides_from_this_user_is_neither_gone_nor_awake(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    details = describe_process()

    def hide(pid: int) -> None:
        raise psutil.NoSuchProcess(pid)

    def forbid(pid: int, number: int) -> None:
        assert number == 0
        raise PermissionError

    monkeypatch.setattr(psutil, "Process", hide)
    assert not is_awake(details)
    with monkeypatch.context() as other_user:
        other_user.setattr(os, "kill", forbid)
        assert not is_gone(details)
        assert not is_awake(details)
