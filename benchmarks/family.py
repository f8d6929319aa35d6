"""Memory and CPU time of the processes that a benchmark has started, from /proc."""

import os
from pathlib import Path

_TICKS = os.sysconf("SC_CLK_TCK")
_GENERATIONS = 8  # of processes; Ray's depth is 4


def members() -> set[int]:
    """Numbers of the process that asks and of its descendants."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            fields = _fields(int(entry.name))
            if fields:
                parents[int(entry.name)] = int(fields[1])
    family = {os.getpid()}
    for _ in range(_GENERATIONS):
        family |= {child for child, parent in parents.items() if parent in family}
    return family


def cpu_seconds() -> dict[str, float]:
    """CPU time of the family so far, by what each process is."""
    spent: dict[str, float] = {}
    for process in members():
        fields = _fields(process)
        if fields:
            name = kind(process)
            spent[name] = spent.get(name, 0.0) + (int(fields[11]) + int(fields[12])) / _TICKS
    return spent


def memory_megabytes() -> dict[str, float]:
    """Proportional set size by what each process is; of several the largest."""
    sizes: dict[str, float] = {}
    for process in members():
        name = kind(process)
        sizes[name] = max(sizes.get(name, 0.0), pss_bytes(process) / 1e6)
    return sizes


def pss_bytes(process: int) -> float:
    """Proportional set size of one process; 0 if it has ended."""
    try:
        text = Path(f"/proc/{process}/smaps_rollup").read_text()
    except OSError:
        return 0.0
    lines = (line.split() for line in text.splitlines())
    return sum(1024.0 * float(line[1]) for line in lines if line[0] == "Pss:")


def kind(process: int) -> str:
    """What a process of the service is, by its command line."""
    try:
        words = Path(f"/proc/{process}/cmdline").read_bytes().decode(errors="replace")
    except OSError:
        return "ended"
    for mark, name in (
        ("ray::", "workers"),
        ("service.dispatch.process", "dispatcher"),
        ("serve", "web process"),
        ("gcs_server", "Ray"),
        ("raylet", "Ray"),
        ("/ray/", "Ray"),
    ):
        if mark in words:
            return name
    return "this program"


def _fields(process: int) -> list[str]:
    """The fields of /proc/N/stat from the state on; none if it has ended."""
    try:
        stat = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return []
    return stat.rpartition(")")[2].split()
