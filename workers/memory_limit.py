"""How much memory a worker may use, so that a run that wants too much harms only itself.

Without a limit the machine runs full, and whom the kernel or Ray kills then is not always who
took the memory: Ray kills the youngest task first.
"""

import contextlib
import os
import resource
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from workers.protocol import ItemResult, Records, WorkItem
from workers.tasks import process_pack

MEMORY_SHARE = 0.8
"""Of the machine's memory, for all workers together."""


def compute_worker_memory(workers: int) -> int:
    """What each of so many workers on this machine may use, in bytes."""
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with contextlib.suppress(OSError, ValueError):  # no such file, or "max"
        total = min(total, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    return int(MEMORY_SHARE * total / workers)


def process_pack_within(
    limit: int | None, pack: Sequence[WorkItem], keys: Sequence[str], *shared: Records
) -> tuple[ItemResult, ...]:
    """`workers.tasks.process_pack`, in a process that may use `limit` bytes beyond its program."""
    if limit is not None:
        _limit_memory(limit)
    return process_pack(pack, keys, *shared)


@cache
def _limit_memory(limit: int) -> None:
    """Once in a process: what it holds already is Ray's and the program's."""
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    allowed = _read_used_memory() + limit
    if hard == resource.RLIM_INFINITY or allowed < hard:
        resource.setrlimit(resource.RLIMIT_DATA, (allowed, hard))


def _read_used_memory() -> int:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmData")), 0)
