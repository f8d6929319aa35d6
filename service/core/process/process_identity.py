"""Identify this process, and check whether another process of this machine still runs."""

import os
import socket
from collections.abc import Mapping
from typing import Any

import psutil

from sysid.core.machine import read_machine_id

_ENDED = frozenset({psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD})
_STOPPED = frozenset({psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP})
_START_TOLERANCE = 200
"""Tolerance of two readings of one start, in 1/100 s: the boot time may be corrected meanwhile."""


def read_start(pid: int) -> int | None:
    """Read the start of a process in 1/100 s after the boot; None if there is no such process.

    Unlike the time of day, it does not change when the clock is set.
    """
    try:
        start: float = psutil.Process(pid).create_time() - psutil.boot_time()
    except psutil.Error:
        return None
    return round(100 * start)


def describe_process() -> dict[str, Any]:
    """Describe this process, so that another process can check later whether it has ended."""
    pid, machine = os.getpid(), read_machine_id()
    host, started = socket.gethostname(), read_start(pid)
    return {"host": host, "pid": pid, "machine": machine, "started": started}


def has_process_ended(pid: int, started: int | None) -> bool:
    """Return whether the process of this machine that had the number `pid` has ended.

    Another process may have its number by now. `started` distinguishes them, unless it is None.
    """
    status, start = _read_status(pid), read_start(pid)
    if status is None:
        return not _is_hidden(pid)
    is_other = start is not None and started is not None and abs(start - started) > _START_TOLERANCE
    return is_other or status in _ENDED


def is_stopped(pid: int) -> bool:
    """Return whether a process exists but is stopped (SIGSTOP)."""
    return _read_status(pid) in _STOPPED


def is_gone(details: Mapping[str, Any]) -> bool:
    """Return whether a described process has ended; False if this process cannot see it."""
    return _is_visible(details) and has_process_ended(details["pid"], details["started"])


def is_awake(details: Mapping[str, Any]) -> bool:
    """Return whether a described process is visible, runs and is not stopped (SIGSTOP)."""
    if not _is_visible(details) or is_gone(details):
        return False
    return _read_status(details["pid"]) not in {None, *_STOPPED}


def _is_visible(details: Mapping[str, Any]) -> bool:
    """Return whether a description is complete and its process is visible from here."""
    machine = read_machine_id()
    is_complete = isinstance(details.get("pid"), int) and isinstance(details.get("started"), int)
    return machine is not None and details.get("machine") == machine and is_complete


def _read_status(pid: int) -> str | None:
    """Read the status of a process; None if it does not exist, or this user may not see it."""
    status: str | None
    try:
        status = psutil.Process(pid).status()
    except psutil.ZombieProcess:
        status = psutil.STATUS_ZOMBIE
    except psutil.Error:
        status = None
    return status


def _is_hidden(pid: int) -> bool:
    """Return whether the number is in use, though ``/proc`` hides the process from this user."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return False
