"""Kernels are compiled in a child with limits: the same code, and a clear error beyond them."""

import sys
from pathlib import Path

import pytest

from sysid.core.errors import InvalidModel
from sysid.kernels.compilation import build, limited_compilation
from sysid.kernels.compilation.compile_task import CompileTask, decode_task, encode_task
from sysid.kernels.compilation.limited_compilation import compile_kernel
from sysid.kernels.compilation.machine_code import compile_assembly
from sysid.kernels.kernel import emit_kernel
from sysid.kernels.layout import KernelVariant
from sysid.models.catalogue.load import catalogue, load_model
from sysid.models.model import Model
from tests.support.library.small_models import differential, duffing

VARIANT = KernelVariant(one_step=False, soft=False, on_grid=True, weighted=False)


def large_model() -> Model:
    """A model whose compilation takes far more memory than the interpreter."""
    terms = "+".join(f"tanh(y)*exp(-y*b)*sin({n}*b)" for n in range(90))
    bounds = {"b": {"lower": 0, "upper": 1}}
    return differential({"y": terms}, "y", parameters=bounds)


@pytest.fixture
def foreign_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "llvmlite.py").write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])


@pytest.mark.usefixtures("foreign_working_folder")
def test_the_child_compiles_the_same_code_and_imports_nothing_of_the_working_folder() -> None:
    assert compile_kernel(duffing(), VARIANT) == compile_assembly(emit_kernel(duffing(), VARIANT))


@pytest.mark.usefixtures("endless_children")
def test_the_time_of_a_compilation_is_told_to_the_operator(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = limited_compilation.get_compile_seconds()
    monkeypatch.setattr(limited_compilation, "_WALL_SECONDS", 0.01)
    with pytest.raises(InvalidModel):
        compile_kernel(duffing(), VARIANT)
    assert limited_compilation.get_compile_seconds() >= before + 0.01


@pytest.mark.parametrize("name", catalogue())
def test_the_task_of_the_child_has_all_that_a_kernel_depends_on(name: str) -> None:
    model = load_model(name)
    task = decode_task(encode_task(CompileTask(model, VARIANT, 1.5, 7)))
    assert (task.variant, task.seconds, task.memory_bytes) == (VARIANT, 1.5, 7)
    assert emit_kernel(task.model, task.variant) == emit_kernel(model, VARIANT)


@pytest.mark.parametrize(
    ("limit", "value", "told"),
    [
        ("PROCESSOR_SECONDS", 1.0, "more than 1 s of processor time"),
        ("_WALL_SECONDS", 0.3, "more than 0.3 s;"),
    ],
)
@pytest.mark.usefixtures("endless_children")
def test_a_model_beyond_a_limit_of_time_is_refused_with_the_limit(
    monkeypatch: pytest.MonkeyPatch, limit: str, value: float, told: str
) -> None:
    monkeypatch.setattr(limited_compilation, limit, value)
    assert told in refuse_model(duffing())


def test_a_model_beyond_the_limit_of_memory_is_refused_with_the_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(limited_compilation, "MEMORY_BYTES", 200 * 1024**2)
    assert "more than 200 MiB of memory" in refuse_model(large_model())


def refuse_model(model: Model) -> str:
    """Return what is said of a model that cannot be compiled."""
    with pytest.raises(InvalidModel) as refused:
        compile_kernel(model, VARIANT)
    (fault,) = refused.value.faults
    assert fault.pointer == "/equations"
    return fault.detail


def test_what_was_refused_is_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Model] = []

    def refuse(model: Model, variant: KernelVariant) -> bytes:
        calls.append(model)
        raise limited_compilation._build_error("1 s")

    monkeypatch.setattr(build, "_refused_kernels", {})
    monkeypatch.setattr(build, "load_code", lambda key: None)
    monkeypatch.setattr(build, "_kernel_addresses", {})
    monkeypatch.setattr(build, "compile_kernel", refuse)
    for _ in range(2):
        with pytest.raises(InvalidModel, match="needs more than 1 s"):
            build.get_kernel_address(duffing(), VARIANT)
    assert len(calls) == 1


def test_an_error_of_the_child_is_no_fault_of_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limited_compilation, "encode_task", lambda task: b"no task")
    with pytest.raises(RuntimeError, match="JSONDecodeError"):
        compile_kernel(duffing(), VARIANT)
