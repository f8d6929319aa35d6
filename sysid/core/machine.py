"""The machine: its identity, for names of files that several machines share, and its memory."""

import hashlib
import os
import socket
from contextlib import suppress
from functools import cache
from pathlib import Path

_TAG_LENGTH = 6


@cache
def read_machine_id() -> str | None:
    """Read the identity of this boot and PID namespace; None where there is no ``/proc``.

    Process numbers can be compared only if this identity is equal.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return None


def read_memory_bytes() -> int:
    """Read the memory that this machine, or the container around this process, has in bytes."""
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with suppress(OSError, ValueError):  # no such file, or "max"
        total = min(total, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    return total


def make_machine_tag() -> str:
    """Make a short tag of the machine for file names; without ``/proc`` from the host name."""
    name = read_machine_id() or f"host {socket.gethostname()}"
    return hashlib.sha256(name.encode()).hexdigest()[:_TAG_LENGTH]
