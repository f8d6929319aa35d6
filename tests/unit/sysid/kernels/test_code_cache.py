"""Compiled kernels on disk: found again, private, and never trusted when something is off."""

import os
from pathlib import Path

import numpy as np
import pytest

from sysid.core import code_cache
from sysid.kernels.compilation import build
from sysid.kernels.layout import KernelVariant
from sysid.models.model import Model
from sysid.simulation.problem import Problem
from tests.support.library.small_models import difference, duffing, individuals, record


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder, and a process that has loaded no kernel."""
    loops = os.environ.get("NUMBA_CACHE_DIR") or str(code_cache.find_cache_folder())
    monkeypatch.setenv("NUMBA_CACHE_DIR", loops)  # these are not what is looked at here
    monkeypatch.setenv("LAGID_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(build, "_kernel_addresses", {})
    return tmp_path / "cache"


def compute_fitness() -> np.ndarray:
    problem = Problem.build(duffing(), [record()])
    return problem.evaluate_fitness(individuals(problem, 4))


def refuse(model: Model, variant: KernelVariant) -> bytes:
    raise AssertionError("compiled again")


def test_a_kernel_is_compiled_once_and_found_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = compute_fitness()
    assert len(list(folder.glob("*.o"))) == 1
    monkeypatch.setattr(build, "_kernel_addresses", {})
    monkeypatch.setattr(build, "compile_kernel", refuse)
    np.testing.assert_array_equal(compute_fitness(), first)


def test_the_cache_folder_is_private(folder: Path) -> None:
    compute_fitness()
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_folder_that_others_may_write_to_is_not_used(folder: Path) -> None:
    folder.mkdir(mode=0o777)
    folder.chmod(0o777)
    compute_fitness()
    assert not list(folder.iterdir())


@pytest.mark.parametrize("damage", ["flip", "cut", "empty", "another kernel"])
def test_a_damaged_file_is_made_again(
    folder: Path, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = compute_fitness()
    (path,) = folder.glob("*.o")
    content = bytearray(path.read_bytes())
    if damage == "flip":
        content[len(content) // 2] ^= 1
    elif damage == "another kernel":
        key = build.compute_kernel_key(difference({"x": "c*x(k-1)"}, "x"), KernelVariant())
        code_cache.store_code(key, b"something else")
        content = bytearray((folder / f"{key}.o").read_bytes())
    path.write_bytes(bytes({"cut": content[:100], "empty": content[:0]}.get(damage, content)))
    monkeypatch.setattr(build, "_kernel_addresses", {})
    np.testing.assert_array_equal(compute_fitness(), first)
    assert path.stat().st_size > 1000


def test_without_a_writable_folder_kernels_still_work(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder.parent.joinpath("file").write_text("not a folder")
    monkeypatch.setenv("LAGID_CACHE_DIR", str(folder.parent / "file" / "cache"))
    assert np.all(np.isfinite(compute_fitness()))


def test_the_key_tells_models_and_variants_apart_but_not_their_bounds() -> None:
    model = duffing()
    keys = {
        build.compute_kernel_key(model, KernelVariant(one, soft, grid, weight))
        for one in (True, False)
        for soft in (True, False)
        for grid in (True, False)
        for weight in (True, False)
    }
    assert len(keys) == 16
    narrow = Problem.build(model, [record()], parameters={"c": {"lower": 0.1}}).model
    assert build.compute_kernel_key(narrow, KernelVariant()) in keys
    assert build.compute_kernel_key(difference({"x": "c*x(k-1)"}, "x"), KernelVariant()) not in keys


def test_a_stale_temporary_file_is_left_nowhere(folder: Path) -> None:
    compute_fitness()
    assert os.listdir(folder) == [path.name for path in folder.glob("*.o")]
