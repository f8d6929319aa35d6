"""Machine code on disk is used only with the sources it came from, and only if it is whole."""

import ast
import logging
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.compiler import CompileResult
from numba.core.runtime import nrt
from packaging.requirements import Requirement

from sysid.core import code_cache, jit
from sysid.search import levenberg_marquardt

pytestmark = pytest.mark.slow

ROOT = Path(jit.__file__).parents[2]
PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
from sysid.core import jit
jit.get_sources_digest = lambda module: sys.argv[2]
from module import doubled
print(doubled(2.0), sum(doubled.stats.cache_hits.values()))
"""
MODULE = """
from sysid.core.jit import jit_compile

@jit_compile
def doubled(x):
    return 2.0 * x
"""


def double_value(x: float) -> float:
    return 2.0 * x


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder, and a process that has told nothing yet."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(code_cache, "_logged_reasons", [])
    return tmp_path / "cache"


def hits() -> int:
    """How often a new copy of the function was found on disk; its result is right anyway."""
    copy: Any = jit.jit_compile(double_value)
    assert copy(2.0) == 4.0
    return sum(copy.stats.cache_hits.values())


class Names:
    """What the names at the top of a module stand for."""

    def __init__(self, path: Path) -> None:
        self.imported: dict[str, tuple[Path, str]] = {}
        self.made: dict[str, ast.AST] = {}
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sysid."):
                source = ROOT.joinpath(*str(node.module).split(".")).with_suffix(".py")
                for alias in node.names:
                    self.imported[alias.asname or alias.name] = (source, alias.name)
            elif isinstance(node, ast.FunctionDef):
                self.made[node.name] = node
            elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for name in {one for target in targets for one in names_in(target)}:
                    self.made[name] = what_is_compiled(node.value)


def list_frozen(known: dict[Path, Names], module: Path) -> set[Path]:
    """Modules that compiled functions of a module come from or take values from."""
    waiting = [
        (module, name)
        for name, node in known[module].made.items()
        if isinstance(node, ast.FunctionDef) and is_compiled(node)
    ]
    seen: set[tuple[Path, str]] = set()
    while waiting:
        path, name = one = waiting.pop()
        if one in seen:
            continue
        seen.add(one)
        if name in known[path].imported:
            waiting.append(known[path].imported[name])
        elif name in known[path].made:
            waiting += [(path, used) for used in names_in(known[path].made[name])]
    return {path for path, name in seen if name in known[path].made}


def what_is_compiled(value: ast.expr) -> ast.expr:
    """A function, where it is compiled by a call; else the value itself."""
    if isinstance(value, ast.Call) and names_in(value.func) == {"jit_compile"}:
        return value.args[0]
    return value


def is_compiled(function: ast.FunctionDef) -> bool:
    marks = {one.id for one in function.decorator_list if isinstance(one, ast.Name)}
    return bool(marks & {"jit_compile", "compile_borrowing", "intrinsic"})


def names_in(node: ast.AST) -> set[str]:
    """Names read there, except in annotations, which are not compiled."""
    parts = node.body if isinstance(node, ast.FunctionDef) else [node]
    return {one.id for part in parts for one in ast.walk(part) if isinstance(one, ast.Name)}


def name_module(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def test_the_key_covers_all_that_compiled_functions_take_values_from() -> None:
    package, sources = ROOT / "sysid", jit.read_sources()
    known = {path: Names(path) for path in package.rglob("*.py")}
    frozen = {path: list_frozen(known, path) for path in known}
    assert {package / "kernels" / "layout.py", package / "search" / "state.py"} <= frozen[
        package / "search" / "evolution.py"
    ]
    compiled = [path for path, others in frozen.items() if others]
    assert len(compiled) > 15
    for path in compiled:
        assert name_module(path) in sources.modules
        needed = {name_module(other) for other in frozen[path]}
        assert needed <= sources.find_imported(name_module(path))


def test_imports_are_followed_and_a_package_stands_for_all_its_modules() -> None:
    def source(*imports: str) -> jit.Source:
        return jit.Source("digest", frozenset(imports))

    sources = jit.Sources(
        {
            "sysid.a": source(),
            "sysid.a.first": source("sysid.a.second", "sysid.core.types"),
            "sysid.a.second": source("sysid.b.first"),
            "sysid.a.secondary": source(),
            "sysid.b": source(),
            "sysid.b.first": source("sysid.a.first"),
            "sysid.b.package": source("sysid.a"),
            "sysid.b.all": source("sysid"),
        }
    )
    circle = {"sysid.a.first", "sysid.a.second", "sysid.b.first"}
    assert sources.find_imported("sysid.a.first") == circle
    assert sources.find_imported("sysid.a.secondary") == {"sysid.a.secondary"}
    package = circle | {"sysid.a", "sysid.a.secondary", "sysid.b.package"}
    assert sources.find_imported("sysid.b.package") == package
    assert sources.find_imported("sysid.b.all") == set(sources.modules)
    assert sources.find_imported("somewhere.else") == set(sources.modules)


def edit(monkeypatch: pytest.MonkeyPatch, module: str) -> None:
    """Go on as a process that was started after an edit of a module."""
    modules = dict(jit.read_sources().modules)
    modules[module] = modules[module]._replace(digest="of another version")
    monkeypatch.setattr(jit, "_SOURCES", jit.Sources(modules))
    monkeypatch.setattr(jit, "read_sources", lambda: jit.Sources(modules))


def test_an_edit_makes_the_code_of_importing_modules_invalid_and_no_other(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    multiply: Any = levenberg_marquardt.compute_inner_product

    def count_hits() -> int:
        copy: Any = jit.jit_compile(multiply.py_func)
        assert copy(np.ones(1), np.ones(1), 1) == 1.0
        return sum(copy.stats.cache_hits.values())

    assert [count_hits(), count_hits()] == [0, 1]
    edit(monkeypatch, "sysid.islands.evolve")
    assert count_hits() == 1
    edit(monkeypatch, "sysid.simulation.loss")
    assert [count_hits(), count_hits()] == [0, 1]


def test_another_fingerprint_compiles_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for fingerprint, found in (("a", 0), ("a", 1), ("b", 0)):
        monkeypatch.setattr(jit, "get_sources_digest", lambda module, told=fingerprint: told)
        assert hits() == found


UPDATED = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from sysid.search import operators
source = Path(operators.__file__)
source.write_text(source.read_text() + "\\n# another version\\n")
from module import doubled
print(doubled(2.0))
"""


def test_code_compiled_while_an_update_replaces_sources_is_not_kept(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "sysid", tmp_path / "sysid")
    (tmp_path / "module.py").write_text(MODULE)
    done = subprocess.run(
        [sys.executable, "-c", UPDATED, str(tmp_path)],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
    )
    assert done.stdout.strip() == "4.0"
    assert "sources have changed since this process began" in done.stderr
    assert not (tmp_path / "cache").exists()


def test_what_was_loaded_is_taken_into_what_is_compiled_with_it(folder: Path) -> None:
    def triple_value(x: float) -> Any:
        return 3.0 * x + inner(x)

    for loaded in (0, 1):
        inner: Any = jit.jit_compile(double_value)
        assert inner(2.0) == 4.0
        assert sum(inner.stats.cache_hits.values()) == loaded
        outer: Any = numba.njit(triple_value)
        assert outer(2.0) == 10.0
        code = outer.inspect_llvm(outer.signatures[0])
        assert not [
            one for one in code.splitlines() if one.startswith("declare") and "doubled" in one
        ]


@pytest.mark.parametrize("damage", ["empty", "cut", "cut late", "flipped", "longer"])
def test_a_damaged_loop_is_compiled_anew_and_replaced(folder: Path, damage: str) -> None:
    assert [hits(), hits()] == [0, 1]
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]
    path.write_bytes(
        {"empty": b"", "cut": whole[:100], "cut late": whole[:-2000], "longer": whole + b"x"}.get(
            damage, flipped
        )
    )
    assert [hits(), hits()] == [0, 1]
    assert os.listdir(folder) == [path.name]


def test_what_is_whole_but_no_compiled_function_is_replaced(folder: Path) -> None:
    hits()
    (path,) = folder.iterdir()
    for content in (b"", b"no pickle", b"\x80\x04]\x94."):
        code_cache.store_code(path.stem, content, "loop")
        assert [hits(), hits()] == [0, 1]


def test_loops_are_private_to_the_user(folder: Path) -> None:
    hits()
    (path,) = folder.iterdir()
    assert [folder.stat().st_mode & 0o777, path.stat().st_mode & 0o777] == [0o700, 0o600]


def test_what_another_user_owns_or_may_have_written_is_not_loaded(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert [hits(), hits()] == [0, 1]
    folder.chmod(0o777)
    assert hits() == 0
    folder.chmod(0o700)
    assert hits() == 1
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    assert hits() == 0
    assert len(caplog.records) == 1


@pytest.mark.parametrize("place", ["below a file", "no home"])
def test_without_a_folder_loops_work_and_one_warning_says_what_to_do(
    folder: Path, place: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    if place == "no home":
        for name in ("NUMBA_CACHE_DIR", "LAGID_CACHE_DIR", "XDG_CACHE_HOME"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr(Path, "home", no_home)
    else:
        folder.write_text("not a folder")
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder / "cache"))
    assert [hits(), hits()] == [0, 0]
    (told,) = caplog.records
    assert told.levelno == logging.WARNING
    assert "LAGID_CACHE_DIR" in told.getMessage()


def no_home() -> Path:
    raise RuntimeError("Could not determine home directory.")


@pytest.mark.parametrize(
    "absent",
    [(CompileResult, "_reduce"), (CompileResult, "_rebuild"), (nrt, "rtsys")],
    ids=lambda one: one[1],
)
def test_without_an_inside_of_numba_functions_are_compiled_as_without_a_cache(
    folder: Path,
    absent: tuple[Any, str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.delattr(*absent)
    assert [hits(), hits()] == [0, 0]
    assert len(caplog.records) == 1


def test_without_the_start_of_memory_management_numbas_own_is_used(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert hits() == 0
    monkeypatch.setattr(nrt, "rtsys", object())
    assert hits() == 1


def test_a_function_of_numba_that_has_no_cache_works(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Plain:
        __slots__ = ("call",)

        def __init__(self, function: Callable[[float], float]) -> None:
            self.call = function

        def __call__(self, x: float) -> float:
            return self.call(x)

    monkeypatch.setattr(code_cache, "_logged_reasons", [])
    monkeypatch.setattr(numba, "njit", lambda **_: Plain)
    assert jit.jit_compile(double_value)(2.0) == 4.0
    assert len(caplog.records) == 1


def test_the_newest_files_are_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(code_cache, "_MAX_FILES", 2)
    folder.mkdir(mode=0o700)
    (folder / "a letter.o").write_text("somebody else's")
    for number in range(4):
        code_cache.store_code(f"{number:064x}", b"code", "loop")
        os.utime(folder / f"{number:064x}.loop", ns=(number, number))
    kept = sorted(one.name for one in folder.iterdir())
    assert kept == [f"{2:064x}.loop", f"{3:064x}.loop", "a letter.o"]


def test_what_is_used_stays_longer_than_what_is_newer(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(code_cache, "_MAX_FILES", 2)
    for number in range(2):
        code_cache.store_code(f"{number:064x}", b"code", "loop")
        os.utime(folder / f"{number:064x}.loop", ns=(number, number))
    assert code_cache.load_code(f"{0:064x}", "loop") == b"code"
    code_cache.store_code(f"{2:064x}", b"code", "loop")
    assert sorted(one.name for one in folder.iterdir()) == [f"{0:064x}.loop", f"{2:064x}.loop"]


def test_many_kernels_do_not_push_out_the_search(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LAGID_CACHE_DIR", str(folder))
    monkeypatch.setattr(code_cache, "_MAX_FILES", 2)
    code_cache.store_code(f"{9:064x}", b"search", "loop")
    for number in range(4):
        code_cache.store_code(f"{number:064x}", b"kernel")
    assert code_cache.load_code(f"{9:064x}", "loop") == b"search"
    assert len(os.listdir(folder)) == 3


def test_files_that_another_process_removes_meanwhile_are_no_fault(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(code_cache, "_MAX_FILES", 1)
    monkeypatch.setattr(code_cache, "_logged_reasons", [])
    for number in range(2):
        code_cache.store_code(f"{number:064x}", b"code", "loop")
    listed = os.scandir

    def outrun(at: Path) -> list[os.DirEntry[str]]:
        found = list(listed(at))
        for one in found:
            os.unlink(one.path)
        return found

    monkeypatch.setattr(os, "scandir", outrun)
    code_cache.store_code(f"{2:064x}", b"code", "loop")
    assert not caplog.records


def test_processes_that_compile_at_once_leave_one_whole_file(tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(MODULE)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-c", PROGRAM, str(tmp_path), "a"]

    def start_process() -> subprocess.Popen[str]:
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)

    racing = [start_process() for _ in range(2)]
    assert {one.communicate()[0].split()[0] for one in racing} == {"4.0"}
    assert len(os.listdir(tmp_path / "cache")) == 1
    assert start_process().communicate()[0].split() == ["4.0", "1"]


def test_numba_is_bounded_where_its_insides_are_known() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = {one.name: one for one in map(Requirement, project["dependencies"])}["numba"]
    assert any(one.operator == "<" for one in wanted.specifier)
    assert metadata.version("numba") in wanted.specifier


WARM = """
import sys
from sysid.identification.warmup import compile_search
compile_search()
loaded = ("numba.np.arraymath", "numba.np.npyimpl", "scipy.linalg")
print([name for name in loaded if name in sys.modules])
"""


def test_what_was_compiled_before_is_loaded_without_the_compiler() -> None:
    def load() -> str:
        ran = subprocess.run(
            [sys.executable, "-c", WARM], check=True, capture_output=True, text=True
        )
        return ran.stdout.strip()

    assert load() == "[]" or load() == "[]"  # the first may have to compile


CALLING_MODULE = """
import numpy as np
from sysid.core.jit import jit_compile

@jit_compile
def count_up(n):
    return np.arange(float(n))

@jit_compile
def add_up(n):
    return count_up(n).sum()
"""
CALLING_PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
from sysid.core import jit
jit.get_sources_digest = lambda module: "a"
import module
print(*(getattr(module, name)(3) for name in sys.argv[2:]))
"""


def test_a_function_compiled_anew_does_not_meet_the_one_in_a_stored_caller(
    folder: Path, tmp_path: Path
) -> None:
    """By Numba's numbers from 1 the new function has the name of the one in its stored caller."""
    (tmp_path / "module.py").write_text(CALLING_MODULE)

    def call_functions(*names: str) -> str:
        command = [sys.executable, "-c", CALLING_PROGRAM, str(tmp_path), *names]
        return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout

    call_functions("count_up")
    (called,) = folder.iterdir()
    call_functions("add_up")
    called.unlink()
    for _ in range(2):  # compiled with the caller's constants present; loaded beside them
        assert call_functions("add_up", "count_up") == "3.0 [0. 1. 2.]\n"
