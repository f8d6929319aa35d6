"""Find the processes of a service by a mark in their environment or by their session."""

import os
from collections.abc import Callable
from contextlib import suppress

import psutil

MARK = "LAGID_BROKEN_SERVICE"


class Family:
    """Every process of a service, those of dispatchers that are gone too."""

    def __init__(self, mark: str) -> None:
        self._mark = mark
        self._sessions: set[int] = set()  # Ray's workers write over their environment

    def members(self) -> list[psutil.Process]:
        """Those that are alive."""
        alive = {}
        for process in psutil.process_iter(["name", "status", "environ"]):
            if process.info["status"] not in (None, psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD):
                with suppress(ProcessLookupError, PermissionError):
                    alive[process] = os.getsid(process.pid)
        marked = {
            process for process in alive if (process.info["environ"] or {}).get(MARK) == self._mark
        }
        self._sessions |= {alive[process] for process in marked} - {os.getsid(0)}
        return [
            process for process in alive if process in marked or alive[process] in self._sessions
        ]

    def named(self, command: str) -> list[int]:
        """Members whose program's name begins so."""
        return self._select(lambda process: process.name().startswith(command))

    def dispatchers(self) -> list[int]:
        """The dispatchers' processes."""
        return self._select(lambda process: "service.dispatch.process" in process.cmdline())

    def kill(self) -> None:
        """End what is left."""
        for process in self.members():
            with suppress(psutil.NoSuchProcess):
                process.kill()

    def _select(self, is_meant: Callable[[psutil.Process], bool]) -> list[int]:
        pids = []
        for process in self.members():
            with suppress(psutil.NoSuchProcess):
                if is_meant(process):
                    pids.append(process.pid)
        return sorted(pids)
