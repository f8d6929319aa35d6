"""Identity of the machine, for names of files that several machines share."""

import hashlib
import socket
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


def make_machine_tag() -> str:
    """Make a short tag of the machine for file names; without ``/proc`` from the host name."""
    name = read_machine_id() or f"host {socket.gethostname()}"
    return hashlib.sha256(name.encode()).hexdigest()[:_TAG_LENGTH]
