"""Kernels of tests are compiled in the process of the test.

A child process for each costs 0.3 s of processor time, and on a new machine the tests compile a
thousand kernels. The child is tested in `unit/sysid/kernels/test_compilation.py`; commands and
services that tests start use it.
"""

from collections.abc import Iterator

import pytest

from sysid.kernels.compilation import build
from sysid.kernels.compilation.machine_code import compile_assembly
from sysid.kernels.kernel import emit_kernel
from sysid.kernels.layout import KernelVariant
from sysid.models.model import Model


def compile_here(model: Model, variant: KernelVariant) -> bytes:
    """Compile a kernel to object code in this process."""
    return compile_assembly(emit_kernel(model, variant))


@pytest.fixture(scope="session", autouse=True)
def _compile_here() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "compile_kernel", compile_here)
        yield
