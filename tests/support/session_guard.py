"""Ends what a session of tests has started and removes its folder, also when pytest is killed.

Run as ``python session_guard.py PYTEST FOLDER``: a process beside pytest. It waits until pytest has
ended, or has asked for the end on standard input. It finds the processes of the session by a
variable of their environment, or by their open files. It finds their descendants too: workers of
Ray and PostgreSQL overwrite the memory that shows their environment.
"""

import contextlib
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psutil

SESSION_VARIABLE = "LAGID_TEST_SESSION"
"""Set for every process of a session: the folder of the session."""
BASE = Path("/tmp")
"""Sessions have their folders here. Sockets need a short path."""
LOOK_SECONDS = 0.5
"""Pause between two checks whether pytest lives."""
ORDERLY_SECONDS = 5.0
"""Time limit for processes that remove shared memory when they end in order."""
END_SECONDS = 30.0
"""Time limit for the end of all processes."""


class Guard:
    """The guard as pytest sees it; `folder` takes the temporary files of the session."""

    def __init__(self) -> None:
        self.folder = _make_folder()
        self._process = subprocess.Popen(
            [sys.executable, "-I", __file__, str(os.getpid()), str(self.folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # a signal to the group of pytest does not end it
            text=True,
        )

    def mark_environment(self) -> None:
        """Put the temporary files of this process and of its children into the folder.

        Folders of `tmp_path` stay where pytest keeps them. Ray's address file follows.
        """
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", tempfile.gettempdir())
        os.environ.update({SESSION_VARIABLE: str(self.folder), "TMPDIR": str(self.folder)})
        os.environ.pop("RAY_TMPDIR", None)
        tempfile.tempdir = None  # so that the variable is read again

    def remove_when_killed(self, folder: Path) -> None:
        """Have this folder removed as well if pytest is killed."""
        self._send_line(str(folder))

    def end_session(self) -> None:
        """End every process of the session but this one.

        Its folder is removed when this one has ended. Finalizers of `multiprocessing` run until
        then, and remove what they have there.
        """
        self._send_line("")
        assert self._process.stdout is not None
        self._process.stdout.readline()

    def _send_line(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()


def _make_folder() -> Path:
    """Make a folder whose path is short enough for Ray's folder of a service inside."""
    while True:
        folder = BASE / f"lg{os.urandom(2).hex()}"
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
            return folder


def guard_session(pytest: int, session: str) -> None:
    """End the processes of a session when pytest asks for it; clear it when pytest has ended."""
    folders = [session]
    for line in read_until_death(pytest):
        if line:
            folders.append(line)
            continue
        folders = [session]  # pytest keeps its own after an orderly end
        end_processes(session, spared=pytest)
        with contextlib.suppress(BrokenPipeError):  # pytest has been killed while it waited
            os.write(1, b"\n")
    end_processes(session, spared=pytest)
    for folder in folders:
        unmount_below(folder)
        shutil.rmtree(folder, ignore_errors=True)


def unmount_below(folder: str) -> None:
    """Unmount what a test has mounted in a folder, such as a small disk."""
    for line in Path("/proc/mounts").read_text().splitlines():
        place = line.split()[1]
        if place.startswith(f"{folder}/"):
            subprocess.run(["umount", "-l", place], check=False, capture_output=True)


def read_until_death(pytest: int) -> Iterator[str]:
    """Read the lines of standard input until pytest has ended."""
    pending = b""
    while True:
        if select.select([0], [], [], LOOK_SECONDS)[0]:
            read = os.read(0, 4096)
            *lines, pending = (pending + read).split(b"\n")
            yield from map(os.fsdecode, lines)
            if not read:
                return
        elif os.getppid() != pytest:
            return  # a forked child holds the other end


def end_processes(session: str, spared: int) -> None:
    """Kill the processes of a session until none is found but one, and its tracker."""
    begun = time.monotonic()
    while (elapsed := time.monotonic() - begun) < END_SECONDS:
        found = [one for one in find_processes(session) if not _ends_with(one, spared)]
        if not found:
            return
        for process in found:
            number = signal.SIGKILL if elapsed > ORDERLY_SECONDS else choose_signal(process)
            with contextlib.suppress(psutil.Error):
                process.send_signal(number)
        time.sleep(0.05)


def _ends_with(process: psutil.Process, spared: int) -> bool:
    """Whether it is the spared process, or its tracker of semaphores, which ends behind it."""
    with contextlib.suppress(psutil.Error):
        return process.pid == spared or (process.ppid() == spared and _is_tracker(process))
    return False


def choose_signal(process: psutil.Process) -> int:
    """Choose the signal that ends a process; 0 if it ends by itself after others.

    PostgreSQL and Python's tracker of semaphores remove shared memory when they end in order.
    """
    try:
        parent = process.parent()
        if _is_postmaster(process.cmdline()):
            return signal.SIGQUIT
        if _is_tracker(process) or _is_postmaster(parent.cmdline() if parent else []):
            return 0
    except psutil.Error:
        return 0
    return signal.SIGKILL


def _is_tracker(process: psutil.Process) -> bool:
    return any("resource_tracker" in word for word in process.cmdline())


def _is_postmaster(command: list[str]) -> bool:
    return bool(command) and command[0].endswith("/bin/postgres")


def find_processes(session: str) -> list[psutil.Process]:
    """Find the living processes of a session, and their descendants."""
    alive = [one for one in psutil.process_iter(["ppid", "status", "cmdline"]) if _is_alive(one)]
    found = {one.pid for one in alive if belongs_to(one, session)}
    size = 0
    while size < len(found):
        size = len(found)
        found |= {one.pid for one in alive if one.info["ppid"] in found}
    return [one for one in alive if one.pid in found]


def _is_alive(process: psutil.Process) -> bool:
    """Whether a process may still be ended; guards are no part of a session."""
    is_guard = __file__ in (process.info["cmdline"] or ())
    return not is_guard and process.info["status"] != psutil.STATUS_ZOMBIE


def belongs_to(process: psutil.Process, session: str) -> bool:
    """Whether the environment of a process names the session, or it has a file of it open.

    Agents of Ray overwrite their environment, and outlive their parent by a minute.
    """
    with contextlib.suppress(psutil.Error):
        if process.environ().get(SESSION_VARIABLE) == session:
            return True
    with contextlib.suppress(psutil.Error, OSError):
        opened = Path(f"/proc/{process.pid}/fd").iterdir()
        return any(os.readlink(file).startswith(f"{session}/") for file in opened)
    return False


if __name__ == "__main__":
    guard_session(int(sys.argv[1]), sys.argv[2])
