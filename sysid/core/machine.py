"""Which machine this is, for the names of files that several machines may share."""

import hashlib
import socket
from functools import cache
from pathlib import Path

_TAG_LENGTH = 6


@cache
def read_machine_id() -> str | None:
    """Name of this boot and of the PID namespace; None where there is no ``/proc``.

    Equal process numbers mean the same process, or its successor, only if this name is equal.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return None


def make_machine_tag() -> str:
    """A short name of the machine for file names; from the host's name if it has no other."""
    name = read_machine_id() or f"host {socket.gethostname()}"
    return hashlib.sha256(name.encode()).hexdigest()[:_TAG_LENGTH]
