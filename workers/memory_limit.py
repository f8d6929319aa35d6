"""Memory limit of a worker, so that a run that needs too much harms only itself.

Without a limit the memory of the machine fills up. The kernel or Ray then kills a process, and not
always the one that took the memory: Ray kills the youngest task first.
"""

import resource
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from sysid.core.machine import read_memory_bytes
from workers.protocol import Encoder, PackResult, Records, WorkItem
from workers.tasks import run_pack

MEMORY_SHARE = 0.8
"""Share of the machine's memory for all workers together."""


def compute_worker_memory(workers: int) -> int:
    """Compute the memory limit of each of `workers` workers on this machine, in bytes."""
    return int(MEMORY_SHARE * read_memory_bytes() / workers)


def process_pack_within(
    limit: int | None,
    encoder: Encoder,
    pack: Sequence[WorkItem],
    keys: Sequence[str],
    *shared: Records,
) -> PackResult:
    """Process a pack in a process that may use `limit` bytes in addition to its program."""
    if limit is not None:
        _limit_memory(limit)
    return run_pack(encoder, pack, keys, *shared)


@cache
def _limit_memory(limit: int) -> None:
    """Limit this process once; memory in use by then belongs to Ray and the program."""
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
