"""Which processes belong to a service: by a mark in their environment, or by their session."""

import contextlib
import os
import signal
from pathlib import Path

from workers.processes import Standing, standing

MARK = "LAGID_BROKEN_SERVICE"


class Family:
    """Every process of a service, those of dispatchers that are gone too."""

    def __init__(self, mark: str) -> None:
        self._mark = f"{MARK}={mark}".encode()
        self._sessions: set[int] = set()  # Ray's workers write over their environment

    def members(self) -> dict[int, Standing]:
        """Those that are alive, by number."""
        listed = [int(entry.name) for entry in Path("/proc").glob("[0-9]*")]
        found = {pid: one for pid in listed if (one := standing(pid)) and not one.is_dead}
        marked = {pid for pid in found if self._is_marked(pid)}
        own = os.getsid(0)
        self._sessions |= {found[pid].session for pid in marked} - {own}
        return {
            pid: one for pid, one in found.items()
            if pid in marked or one.session in self._sessions
        }  # fmt: skip

    def named(self, command: str) -> list[int]:
        """Members whose program's name begins so."""
        found = self.members()
        return sorted(pid for pid, one in found.items() if one.command.startswith(command))

    def dispatchers(self) -> list[int]:
        """The dispatchers' processes."""
        return sorted(
            pid for pid in self.members() if b"service.dispatch.process" in _arguments(pid)
        )

    def kill(self) -> None:
        """End what is left."""
        for pid in self.members():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _is_marked(self, pid: int) -> bool:
        try:
            return self._mark in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
        except OSError:
            return False


def _arguments(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""
