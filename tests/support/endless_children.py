"""Children whose work never ends, so that each limit of time is met on any machine.

As a program it runs a child of this package with its work replaced by a loop. The child still
reads its task and sets its limits itself.
"""

import sys
from functools import partial
from importlib import import_module
from typing import NoReturn

import pytest

from sysid.core import child_processes
from sysid.core.child_processes import build_child_command

WORK = {
    "sysid.kernels.compilation.compiler_child": "compile_assembly",
    "service.formats.sandbox_child": "read_file",
}
"""The children, and the function of each that is replaced."""


@pytest.fixture
def endless_children(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each child that is started work for ever."""
    build = partial(build_child_command, __name__)
    monkeypatch.setattr(child_processes, "build_child_command", build)


def burn_processor_time(*_task: object) -> NoReturn:
    """Take processor time without end."""
    while True:
        pass


if __name__ == "__main__":
    name = sys.argv[1]
    child = import_module(name)
    setattr(child, WORK[name], burn_processor_time)
    sys.exit(child.main())
