"""What is imported is declared, what is declared is imported, and each extra is enough."""

import ast
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from service.core import extras
from service.core.errors import Misconfigured
from tests.support.checkout import ROOT
from tests.support.service.commands import check_refusal, run_lagid
from tests.support.source_facts import list_modules

PRODUCT = ("lagid", "sysid", "workers", "service", "migrations")
# Modules that have another name than their distribution.
MODULES = {
    "pyyaml": "yaml",
    "markdown-it-py": "markdown_it",
    "protobuf": "google",
    "mat-io": "matio",
    "python-multipart": "python_multipart",
}
# Starlette needs it for forms. Of Plotly and Swagger UI files are sent to browsers.
NOT_IMPORTED = {"python_multipart", "plotly", "swagger_ui_py"}


def read_requirements(*extra_names: str) -> set[str]:
    """Modules of the declared dependencies, and of some extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [*project["dependencies"]]
    for name in extra_names:
        lines += project["optional-dependencies"][name]
    names = (Requirement(line).name for line in lines)
    return {MODULES.get(name, name.replace("-", "_")) for name in names}


def find_imports(paths: Iterable[Path]) -> set[str]:
    """Top-level names of the third-party modules that files import anywhere."""
    names: set[str] = set()
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names.add(str(node.module).partition(".")[0])
    return names - sys.stdlib_module_names - {*PRODUCT, "examples", "tests", "benchmarks"}


def test_what_the_product_imports_is_declared() -> None:
    declared = read_requirements("server", "postgres", "notebook")
    assert find_imports(list_modules(PRODUCT)) <= declared


def test_what_the_core_imports_is_declared_without_an_extra() -> None:
    assert find_imports(list_modules(("sysid",))) <= read_requirements("notebook")


def test_what_is_declared_is_imported() -> None:
    declared = read_requirements("server", "postgres")
    assert declared - find_imports(list_modules(PRODUCT)) <= NOT_IMPORTED


def test_what_tests_import_is_declared() -> None:
    declared = read_requirements("server", "postgres", "notebook", "test")
    names = {"pytest_timeout": "pytest_timeout", "pytest_xdist": "xdist", "moto": "moto"}
    imported = find_imports(list_modules(("tests", "examples")))
    assert imported - declared - {*names.values()} == set()


def read_lock(path: str) -> dict[str, str]:
    """Names and versions of a lock file."""
    text = (ROOT / path).read_text()
    return dict(re.findall(r"^([\w.-]+)==([\w.!+-]+)", text, re.MULTILINE))


def list_declared(*extra_names: str) -> set[str]:
    """Distributions of the declared dependencies, and of some extras; all of them without one."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    chosen = [extras[name] for name in extra_names or extras]
    lines = (line for one in (project["dependencies"], *chosen) for line in one)
    return {Requirement(line).name.lower() for line in lines}


def test_what_is_declared_is_in_the_lock() -> None:
    assert list_declared() - {*read_lock("requirements.lock")} == set()


def test_the_image_has_the_locked_versions_of_a_server_and_no_test_tools() -> None:
    whole, image = read_lock("requirements.lock"), read_lock("docker/requirements.lock")
    assert {*image.items()} < {*whole.items()}
    served = list_declared("server", "postgres")
    assert served - {*image} == set()
    assert (list_declared("test") - served) & {*image} == {
        *("jsonschema", "packaging"),  # for Ray
        "pandas",  # for mat-io
    }


# Without the libraries of a server: as after a plain `pip install lagid`.
PLAIN = """
import contextlib, io, json, sys
from importlib import metadata

absent, work, data = json.loads(sys.argv[1]), json.loads(sys.argv[2]), sys.argv[3]


class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in absent:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Refuse())
from service.core import extras
extras._is_installed = lambda name: name.replace("-", "_") not in absent
extras.requires = lambda _: [f"{name}; extra == 'server'" for name in absent]
from service.cli.main import main

ends = []
for words in work:
    sys.argv = ["lagid", *words]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            code = end.code
    ends.append([code, out.getvalue(), err.getvalue()])
print(json.dumps(ends))
"""


@pytest.mark.slow
def test_the_library_and_its_commands_need_no_extra(tmp_path: Path) -> None:
    absent = sorted(read_requirements("server", "postgres", "notebook") - read_requirements())
    assert {"ray", "fastapi", "sqlalchemy", "psycopg", "jinja2"} <= {*absent}
    data, model = tmp_path / "d.csv", tmp_path / "m.yaml"
    rows = [f"{0.1 * k:.1f},{int(k > 5)},{max(0.0, 1 - 0.8 ** (k - 9)):.4f}" for k in range(40)]
    data.write_text("\n".join(["t,u,y", *rows]))
    model.write_text("name: own\nform: differential\nstates: {x: m}\nequations: {x: -K*x}\n")
    fast = ("--set", "algorithm.generations=5", "--json")
    served = [["serve"], ["dispatcher"], ["demo"], ["db", "check"]]
    work = [
        ["identify", str(data), "--model", "fopdt", *fast],
        ["models", "--help"],
        ["models", "list", "--json"],
        ["models", "check", str(model)],
        ["models", "show", "fopd"],
        ["jobs", "--url", "http://127.0.0.1:1"],
        ["doctor", "--json"],
        *served,
    ]
    done = subprocess.run(
        [sys.executable, "-c", PLAIN, json.dumps(absent), json.dumps(work), str(data)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": str(Path.home())},
    )
    assert done.returncode == 0, done.stderr
    found, _, listed, checked, shown, jobs, doctor, *refused = json.loads(done.stdout)
    assert found[0] == 0, found
    assert {one["name"] for one in json.loads(found[1])["parameters"]} >= {"K", "T", "L"}
    assert "fopdt" in {one["name"] for one in json.loads(listed[1])}
    assert checked[0] == 1
    assert "outputs" in checked[2]
    assert "did you mean 'fopdt'?" in shown[2]
    assert "lagid serve" in jobs[2]
    checks = {one["check"]: one for one in json.loads(doctor[1])}
    assert doctor[0] == 0
    assert checks["server"]["detail"] == "not installed: pip install 'lagid[server]' adds it"
    for code, out, err in refused:
        assert (code, out) == (1, "")
        (line,) = err.strip().splitlines()
        assert re.fullmatch(
            r"lagid: this command needs \w+ and \d+ more, not installed here: "
            r"pip install 'lagid\[server\]'",
            line,
        )


def test_a_database_on_postgresql_needs_its_driver(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(extras, "requires", lambda _: ['psycopg[binary]>=3; extra == "postgres"'])
    monkeypatch.setattr(extras, "_is_installed", lambda name: name != "psycopg")
    address = "postgresql://lagid@127.0.0.1:1/lagid"
    words = ("db", "check", "--data-dir", tmp_path)
    line = check_refusal(run_lagid(*words, LAGID_DATABASE_URL=address))
    assert line.endswith(
        "on PostgreSQL needs psycopg, not installed here: pip install 'lagid[postgres]'"
    )


def test_only_absent_libraries_of_the_extra_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [
        "numpy>=2",
        "absent-everywhere>=1",
        'numpy>=2; extra == "server"',
        'absent-one[x]>=1; python_version > "3" and extra == "server"',
        "absent-two; extra == 'server'",
        'absent-three; extra == "test"',
    ]
    monkeypatch.setattr(extras, "requires", lambda _: lines)
    assert extras.list_missing("server") == ["absent-one", "absent-two"]
    with pytest.raises(Misconfigured, match=r"needs absent-one and 1 more, not .*lagid\[server\]"):
        extras.check_extra("server", "this")
