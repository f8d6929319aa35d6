"""Processes as ``/proc`` shows them, and what Ray may leave behind; imports neither Ray nor NumPy.

Where there is no ``/proc``, nothing is known of a process but whether its number is in use.
"""

import contextlib
import hashlib
import os
import shutil
import signal
import socket
import tempfile
from collections.abc import Collection
from functools import cache
from pathlib import Path
from typing import NamedTuple

_PROC = Path("/proc")
_TAG_LENGTH = 6
_LONGEST_BASE = 22  # what Ray's names and numbers of seven digits leave of a socket's path


class Standing(NamedTuple):
    """What a process is; dead ones are only waited for, stopped ones wait for SIGCONT."""

    command: str
    is_dead: bool
    is_stopped: bool
    parent: int
    session: int
    started: int


def standing(pid: int) -> Standing | None:
    """The process of that number; None if there is none, or no ``/proc``."""
    try:
        text = (_PROC / str(pid) / "stat").read_text(errors="replace")
    except OSError:
        return None
    head, _, tail = text.rpartition(")")
    fields = tail.split()  # from the third on, as proc_pid_stat(5) counts them
    command = head.partition("(")[2]
    state, parent, session, started = fields[0], fields[1], fields[3], fields[19]
    is_dead, is_stopped = state in "ZX", state in "Tt"
    return Standing(command, is_dead, is_stopped, int(parent), int(session), int(started))


def is_running(pid: int) -> bool:
    """Whether a process of that number is there and does not merely wait to be buried."""
    found = standing(pid)
    if found is not None:
        return not found.is_dead
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


@cache
def machine() -> str | None:
    """Names this boot and the namespace in which its processes are numbered; None if unknown.

    Two processes of one number are the same, or one after the other, only if this is the same.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return None


def tag() -> str:
    """A short name of the machine for the names of files; that of the host if it is unknown."""
    name = machine() or f"host {socket.gethostname()}"
    return hashlib.sha256(name.encode()).hexdigest()[:_TAG_LENGTH]


def has_ended(pid: int, started: int | None) -> bool:
    """Whether the process of this machine that had the number `pid` has ended.

    Another one may have its number by now: `started` tells them apart, unless it is None.
    """
    found = standing(pid)
    if found is None or started is None:
        return not is_running(pid)
    return found.is_dead or found.started != started


def children(commands: Collection[str]) -> tuple[int, ...]:
    """Living children of this process that run one of these programs; none without ``/proc``."""
    here = os.getpid()
    found = ((pid, standing(pid)) for pid in _listed())
    return tuple(
        pid for pid, one in found
        if one is not None and one.parent == here and one.command in commands and not one.is_dead
    )  # fmt: skip


def of_session(session: int) -> tuple[int, ...]:
    """The processes of a session; where there is no ``/proc``, at most its leader."""
    found = []
    for pid in _listed() or (session,):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if os.getsid(pid) == session:
                found.append(pid)
    return tuple(found)


def kill(pids: Collection[int]) -> None:
    """Kill processes, but never this one."""
    for pid in pids:
        if pid != os.getpid():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)


def folder_of(pid: int) -> Path:
    """Ray's folder for the dispatcher of that number.

    Its path must be short: Ray puts sockets below it, and a socket's path has 107 bytes at most.
    """
    return _base() / f"{_prefix()}{pid}"


def of_folder(pid: int) -> tuple[int, ...]:
    """Processes of Ray whose arguments name the folder of that dispatcher.

    Workers hide theirs, but end by themselves when their raylet does.
    """
    mark = f"{folder_of(pid)}/".encode()
    return tuple(one for one in _listed() if mark in _arguments(one))


def clear_after(pid: int) -> None:
    """Kill what the Ray of a dispatcher that is gone has left running, and remove its folder."""
    kill(of_folder(pid))
    shutil.rmtree(folder_of(pid), ignore_errors=True)


def clear_after_the_dead() -> None:
    """Do so for every dispatcher of this machine that is gone.

    Folders of others are left alone: in another PID namespace the number is somebody else's.
    """
    for folder in _base().glob(f"{_prefix()}*"):
        owner = folder.name.removeprefix(_prefix())
        if owner.isdigit() and not is_running(int(owner)):
            clear_after(int(owner))


def _prefix() -> str:
    return f"lagid-{tag()}-"


def _base() -> Path:
    base = Path(tempfile.gettempdir())
    return base if len(str(base)) <= _LONGEST_BASE else Path("/tmp")


def _listed() -> tuple[int, ...]:
    return tuple(int(entry.name) for entry in _PROC.glob("[0-9]*"))


def _arguments(pid: int) -> bytes:
    try:
        return (_PROC / str(pid) / "cmdline").read_bytes()
    except OSError:
        return b""
