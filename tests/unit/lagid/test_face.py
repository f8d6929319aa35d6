"""`import lagid`: one face of library and client, fast, and no other package in its place."""

import doctest
import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import lagid
import sysid
from tests.support.checkout import ROOT


def run_python(code: str, *folders: Path, name: str = "-c") -> "subprocess.CompletedProcess[str]":
    """Run code in a process of its own; modules of `folders` come before the checkout's."""
    search = [str(folder) for folder in (*folders, ROOT)]
    program = f"import sys; sys.path[:0] = {search}; sys.argv = [{name!r}]\n{code}"
    return subprocess.run(
        [sys.executable, "-P", "-c", program], capture_output=True, text=True, check=False
    )


def make_package(folder: Path, name: str, code: str = "") -> Path:
    (folder / name).mkdir(parents=True)
    (folder / name / "__init__.py").write_text(code)
    return folder


LIBRARY, FACE = vars(sysid)["__all__"], vars(lagid)["__all__"]
CLIENT = {"AsyncClient", "Client", "ClientError", "NotFinite", "ProblemError"}
CLIENT |= {"ServerUnreachable", "ServiceDidNotStart", "WaitTimeout", "run_embedded_service"}


def test_all_names_of_the_library_and_of_the_client_are_there() -> None:
    assert {*LIBRARY, *CLIENT, "read_recording"} == {*FACE}
    assert len({*FACE}) == len(FACE)
    for name in LIBRARY:
        assert getattr(lagid, name) is getattr(sysid, name)
    assert all(getattr(lagid, name).__name__ == name for name in FACE)
    assert {*FACE, "__version__"} == {*dir(lagid)}


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'identity'"):
        lagid.identity  # type: ignore[attr-defined]  # noqa: B018


def test_the_version_is_that_of_the_installation() -> None:
    assert lagid.__version__ == version("lagid")


def test_nothing_heavy_is_loaded_before_a_name_is_used() -> None:
    done = run_python(
        "import json, lagid\n"
        "before = set(sys.modules)\n"
        "lagid.Client\n"
        "print(json.dumps([sorted(before), sorted(sys.modules)]))"
    )
    before, after = (set(names) for names in json.loads(done.stdout))
    assert not {"numpy", "httpx", "service.client", "sysid.core.errors"} & before
    assert "service.client.client" in after
    assert not {"numpy", "pydantic", "ray"} & after


def test_a_command_seldom_looks_for_garbage() -> None:
    """A short command makes many values that live as long as it does."""
    done = run_python(
        "import atexit, gc, lagid\n"
        "usual, *others = gc.get_threshold()\n"
        "check = lambda: print(gc.isenabled(), gc.get_threshold()[0] > 10 * usual)\n"
        "atexit.register(check)\n"
        "sys.argv.append('--version')\n"
        "lagid.main()"
    )
    assert done.stdout.splitlines()[-1] == "True True"


def test_the_example_of_the_module_holds() -> None:
    assert doctest.testmod(lagid) == (0, 7)


@pytest.mark.parametrize("package", ["sysid", "service"])
def test_a_foreign_package_of_the_same_name_is_told_at_import(package: str, tmp_path: Path) -> None:
    folder = make_package(tmp_path, package)
    done = run_python("import lagid", folder)
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(f"ImportError: {folder / package / '__init__.py'} is not the package")
    assert last.endswith("Rename or move what is there, or start Python in another folder.")


def test_a_foreign_package_that_does_not_load_is_told_too(tmp_path: Path) -> None:
    folder = make_package(tmp_path, "sysid", "import a_library_that_is_absent")
    done = run_python("import lagid", folder)
    assert "cannot load its package 'sysid' (No module named 'a_library" in done.stderr


def test_the_distribution_of_a_foreign_package_is_named_with_what_to_do(tmp_path: Path) -> None:
    folder = make_package(tmp_path, "sysid")
    information = folder / "other_sysid-2.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: other-sysid\nVersion: 2.0\n"
    )
    (information / "top_level.txt").write_text("sysid\n")
    done = run_python("import lagid", folder)
    assert "It comes from other-sysid. Run `pip uninstall other-sysid`, then" in done.stderr


def test_a_command_tells_the_clash_in_one_line(tmp_path: Path) -> None:
    folder = make_package(tmp_path, "sysid")
    done = run_python("import lagid", folder, name="/usr/local/bin/lagid")
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("lagid: ")
    assert "is not the package 'sysid' of lagid" in line
