"""Kernels that are compiled in a process of their own: the same code, and no fault of that process
is one of ours."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sysid.kernels import machine_code
from sysid.kernels.kernel import emit_kernel
from sysid.kernels.layout import KernelVariant
from sysid.kernels.machine_code import compile_assembly
from tests.models import duffing

VARIANT = KernelVariant(one_step=False, soft=False, on_grid=True, weighted=False)


@pytest.fixture
def code(monkeypatch: pytest.MonkeyPatch) -> str:
    """Assembly of a kernel, in a process that has compiled as many as it may itself."""
    monkeypatch.setattr(
        machine_code, "_own_compilations", [None] * machine_code.MAX_OWN_COMPILATIONS
    )
    return emit_kernel(duffing(), VARIANT)


def refuse(assembly: str) -> bytes:
    raise AssertionError("compiled in this process")


def test_after_many_kernels_another_process_makes_the_same_code(
    code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = compile_assembly(code)
    monkeypatch.setattr(machine_code, "compile_assembly", refuse)
    assert machine_code.compile_bounded(code) == expected
    assert len(machine_code._own_compilations) == machine_code.MAX_OWN_COMPILATIONS


def test_modules_in_the_folder_one_stands_in_are_not_taken_for_ours(
    code: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    expected = compile_assembly(code)
    (tmp_path / "llvmlite.py").write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    monkeypatch.setattr(machine_code, "compile_assembly", refuse)
    assert machine_code.compile_bounded(code) == expected


@pytest.mark.parametrize(
    "fault", [OSError("no more processes"), subprocess.CalledProcessError(-9, "child")]
)
def test_without_another_process_it_is_compiled_here(
    code: str, fault: Exception, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*_: Any, **__: Any) -> Any:
        raise fault

    monkeypatch.setattr(subprocess, "run", fails)
    assert machine_code.compile_bounded(code) == compile_assembly(code)
    assert "compiled in this process" in caplog.text


def test_the_first_kernels_are_compiled_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_code, "_own_compilations", [])
    monkeypatch.setattr(machine_code, "compile_assembly", lambda assembly: assembly.encode())
    found = [machine_code.compile_bounded(str(i)) for i in range(machine_code.MAX_OWN_COMPILATIONS)]
    assert found == [str(i).encode() for i in range(machine_code.MAX_OWN_COMPILATIONS)]
