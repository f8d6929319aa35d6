"""A small child that ends its parent if no thread of Python runs there any more.

Native code that keeps the lock of Python stops every thread, also those that watch. So the parent
says every second that it runs. The child counts naps without a word. It naps as well where the
machine stands still, and a parent that was stopped (SIGSTOP, a debugger) begins anew. So only a
parent that could have spoken is ended. It is asked by SIGABRT, at which it writes the stack of each
thread, and then killed.
"""

import os
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress

from sysid.core.child_processes import build_child_command, build_import_path

NAP_SECONDS = 1.0
KILL_SECONDS = 10.0
"""Time for the stacks of the parent."""


class OuterWatch:
    """The child of this process, which is started anew if it has ended."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._child: subprocess.Popen[bytes] | None = None

    def speak(self) -> None:
        """Say that this process runs; without memory for a child nobody hears it."""
        with suppress(OSError):
            if self._child is None or self._child.poll() is not None:
                self.close()
                self._child = self._start_child()
            assert self._child.stdin is not None
            os.write(self._child.stdin.fileno(), b".")  # an error if it is stopped or has ended

    def close(self) -> None:
        """Let the child end."""
        if self._child is not None and self._child.stdin is not None:
            self._child.stdin.close()
            self._child.wait()
        self._child = None

    def _start_child(self) -> "subprocess.Popen[bytes]":
        child = subprocess.Popen(
            build_child_command(__name__, str(self._seconds)),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": build_import_path()},
        )
        assert child.stdin is not None
        os.set_blocking(child.stdin.fileno(), False)
        return child


def watch_parent(seconds: float, parent: int, words: int = 0) -> None:
    """End the parent if it is silent for `seconds`; return once it has ended by itself.

    Parameters
    ----------
    parent : int
        Its process id.
    words : int
        The file from which its words are read.
    """
    nap = min(NAP_SECONDS, seconds / 5)
    silent = 0.0
    while silent < seconds:
        heard, _, _ = select.select([words], [], [], nap)
        if heard and not os.read(words, 4096):
            return
        silent = 0.0 if heard or _is_stopped(parent) else silent + nap
    os.kill(parent, signal.SIGABRT)
    limit = time.monotonic() + KILL_SECONDS
    while os.getppid() == parent and time.monotonic() < limit:
        time.sleep(nap)
    if os.getppid() == parent:
        os.kill(parent, signal.SIGKILL)


def _is_stopped(pid: int) -> bool:
    from service.core.process.process_identity import is_stopped  # needed only in a silence

    return is_stopped(pid)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's
    watch_parent(float(sys.argv[1]), os.getppid())
