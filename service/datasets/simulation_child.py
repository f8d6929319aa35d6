"""The child process of `large_simulation`: one task on stdin, one answer on stdout."""

import json
import sys
from pathlib import Path
from typing import Any

from service.core.errors import to_field_errors
from service.core.process.temporary_files import FULL_DISK_ERRORS
from service.formats.mcap.mcap_files import read_mcap, write_recording
from sysid.core.child_processes import limit_resources
from sysid.core.errors import SysidError
from sysid.kernels.compilation.compile_task import decode_model
from sysid.simulation.simulate import simulate

_FILE_BYTES = 8 * 1024**3


def main() -> int:
    """Simulate the task and write its outputs; answer with the faults."""
    task = json.load(sys.stdin)
    limit_resources(
        seconds=task["seconds"], memory_bytes=task["memory_bytes"], file_bytes=_FILE_BYTES
    )
    try:
        answer: dict[str, Any] = {"errors": _simulate(task)}
    except OSError as error:
        if error.errno not in FULL_DISK_ERRORS:
            raise
        answer = {"is_disk_full": True}
    except MemoryError:
        answer = {"is_out_of_memory": True}
    sys.stdout.write(json.dumps(answer))
    return 0


def _simulate(task: dict[str, Any]) -> list[dict[str, Any]]:
    *inputs, given = read_mcap(Path(task["source"])).channels
    try:
        outputs = simulate(decode_model(task["model"]), inputs, task["values"], times=given.times)
    except SysidError as error:
        return [fault.to_dict() for fault in to_field_errors(error)]
    write_recording(outputs, task["target"])
    return []


if __name__ == "__main__":
    sys.exit(main())
