"""Long work on signals in a child process with limits: both sides of the exchange.

A child takes one of the places of those that read uploads, and its share of the memory. It gets one
task on stdin, writes its signals to a file, and answers with the faults of the request.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import Any

from service.core.errors import FieldError, InvalidRequest, Unavailable, to_field_errors
from service.core.process import temporary_files
from sysid.core.child_processes import (
    CODE_CACHE_VARIABLES,
    OUT_OF_PROCESSOR_TIME,
    limit_resources,
    run_child,
)
from sysid.core.errors import SysidError

SECONDS = 120.0
"""Processor time of a child; the longest simulation takes some 40 s."""
_WALL_SECONDS = 2 * SECONDS  # on a busy machine
_FILE_BYTES = 8 * 1024**3
_MIB = 1024**2


def ask_child(
    module: str, task: Mapping[str, Any], memory_bytes: int, refuse: Callable[[str], FieldError]
) -> Any:
    """Let a child do a task, and return what it has found out.

    Parameters
    ----------
    module : str
        A module whose main function is `answer_task`.
    refuse : callable
        Describes the fault of a task that needs more than a limit, whose text it is given.

    Raises
    ------
    InvalidRequest
        With the faults of the request, or if it needs more than a limit.
    Unavailable
        If the disk of temporary files is full.
    """
    limited = {**task, "seconds": SECONDS, "memory_bytes": memory_bytes}
    try:
        child = run_child(
            module,
            json.dumps(limited).encode(),
            seconds=_WALL_SECONDS,
            variables=CODE_CACHE_VARIABLES,
        )
    except subprocess.TimeoutExpired:
        raise InvalidRequest([refuse(f"{_WALL_SECONDS:g} s")]) from None
    if child.returncode == OUT_OF_PROCESSOR_TIME:
        raise InvalidRequest([refuse(f"{SECONDS:g} s of processor time")])
    answer = _read_answer(child)
    if answer.get("is_out_of_memory"):
        limit = f"{memory_bytes // _MIB} MiB of memory (LAGID_READER_MEMORY_MB)"
        raise InvalidRequest([refuse(limit)])
    if answer.get("is_disk_full"):
        raise Unavailable(temporary_files.FULL_DISK_MESSAGE)
    if "errors" in answer:
        raise InvalidRequest(FieldError(**fault) for fault in answer["errors"])
    return answer["found"]


def _read_answer(child: "subprocess.CompletedProcess[bytes]") -> dict[str, Any]:
    try:
        answer: dict[str, Any] = json.loads(child.stdout)
    except json.JSONDecodeError:
        errors = child.stderr.decode(errors="replace")
        # Ended by the system, or by a library that got no memory.
        if child.returncode < 0 or "memory" in errors.lower():
            return {"is_out_of_memory": True}
        raise RuntimeError(f"a child ended with code {child.returncode}: {errors[-500:]}") from None
    return answer


def answer_task(work: Callable[[dict[str, Any]], Any]) -> int:
    """Do the task on stdin within its limits, and answer on stdout: the child's whole life."""
    task = json.load(sys.stdin)
    limit_resources(
        seconds=task["seconds"], memory_bytes=task["memory_bytes"], file_bytes=_FILE_BYTES
    )
    try:
        answer: dict[str, Any] = {"found": work(task)}
    except SysidError as error:
        answer = {"errors": [fault.to_dict() for fault in to_field_errors(error)]}
    except OSError as error:
        if error.errno not in temporary_files.FULL_DISK_ERRORS:
            raise
        answer = {"is_disk_full": True}
    except MemoryError:
        answer = {"is_out_of_memory": True}
    sys.stdout.write(json.dumps(answer))
    return 0
