"""The child process of `limited_compilation`: a task on stdin, object code on stdout."""

import sys

from sysid.core.child_processes import limit_resources
from sysid.kernels.compilation.compile_task import decode_task
from sysid.kernels.compilation.machine_code import compile_assembly
from sysid.kernels.kernel import emit_kernel


def main() -> None:
    """Emit and compile the kernel of the task."""
    task = decode_task(sys.stdin.buffer.read())
    limit_resources(seconds=task.seconds, memory_bytes=task.memory_bytes, file_bytes=0)
    sys.stdout.buffer.write(compile_assembly(emit_kernel(task.model, task.variant)))


if __name__ == "__main__":
    main()
