"""The lock of a data folder: held once, told with its holder, and never stale."""

import subprocess
import sys
from pathlib import Path

import pytest

from service.core.errors import Misconfigured
from service.core.process.folder_lock import lock_folder

HOLD = """
import pathlib, sys
from service.core.process.folder_lock import lock_folder
with lock_folder(pathlib.Path(sys.argv[1]), "") as lock:
    lock.describe_holder("the first")
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_folder_is_locked_once_and_free_again_after_the_holder_was_killed(
    tmp_path: Path,
) -> None:
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        with pytest.raises(Misconfigured) as refused, lock_folder(tmp_path, "use another"):
            pass
        assert str(refused.value) == f"the first works on {tmp_path}; use another"
        holder.kill()
    with lock_folder(tmp_path, "use another"):
        pass


def test_a_holder_that_is_not_described_yet_has_a_general_name(tmp_path: Path) -> None:
    with lock_folder(tmp_path, "") as lock:
        lock.describe_holder("before")
    with (
        lock_folder(tmp_path, ""),
        pytest.raises(Misconfigured, match="another `lagid serve` works"),
        lock_folder(tmp_path, "use another"),
    ):
        pass


def test_a_lock_that_cannot_be_opened_is_told(tmp_path: Path) -> None:
    (tmp_path / "serve.lock").mkdir()
    with (
        pytest.raises(Misconfigured, match=r"serve\.lock cannot be opened"),
        lock_folder(tmp_path, ""),
    ):
        pass
