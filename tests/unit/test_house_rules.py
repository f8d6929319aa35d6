"""The house rules that no linter knows, as small tests over the source tree."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.support.checkout import ROOT
from tests.support.limits import LIMIT_SECONDS
from tests.support.source_facts import list_modules, read_facts

CODE = ("lagid", "sysid", "workers", "service", "migrations", "examples", "tests", "benchmarks")
MACHINE = re.compile(
    r"py[p]i\.org|python[h]osted|npm[j]s\.|deb\.[d]ebian|/wor[k]/|/far[m]/|/roo[t]/"
)


def _list_tracked() -> list[Path]:
    listing = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / line for line in listing.stdout.splitlines() if (ROOT / line).is_file()]


def test_the_top_level_has_nothing_but_the_house() -> None:
    folders = {"service", "workers", "sysid", "lagid", "migrations", "tests", "docker", "docs"}
    files = {
        "pyproject.toml",
        "requirements.lock",
        "alembic.ini",
        "Makefile",
        "LICENSE",
        "CITATION.cff",
    }
    others = {"benchmarks", "examples", ".ci", ".gitignore", ".dockerignore"}
    entries = {path.relative_to(ROOT).parts[0] for path in _list_tracked()}
    assert {one for one in entries if not one.endswith(".md")} <= folders | files | others


def test_the_formatter_has_no_exceptions() -> None:
    mark = re.compile(r"#\s*fmt:\s*(?:skip|off)")
    marked = [str(p.relative_to(ROOT)) for p in list_modules(CODE) if mark.search(p.read_text())]
    assert marked == []


# A function says what it does: a verb first, no participle. Verbs in -eed are none. Properties and
# fixtures are values: such may be called by one and a noun (`scored_rows`), never by one alone.
PARTICIPLE = re.compile(
    r"^_*(?:told|kept|found|known|given|dealt|held|made|built|sent|[a-z]{2,}(?<!e)ed)(?:_|$)"
)
PRODUCT = ("lagid", "sysid", "workers", "service", "migrations")
READ_BY_USERS = (*PRODUCT, "examples")


def test_no_function_is_named_by_a_participle() -> None:
    named = []
    for path in list_modules((*READ_BY_USERS, "tests")):
        facts = read_facts(path)
        values = [line for line in facts.values if "_" not in line.text.strip("_")]
        named += [
            f"{path.relative_to(ROOT)}:{line} {name}"
            for name, line in (*facts.functions, *values)
            if PARTICIPLE.match(name)
        ]
    assert named == []


def test_no_test_replaces_a_name_by_its_dotted_text() -> None:
    """The object that has the name: its absence is an error of types, not of the run."""
    dotted = re.compile(r"setattr\(\s*[\"']")
    found = [str(p.relative_to(ROOT)) for p in list_modules(CODE) if dotted.search(p.read_text())]
    assert found == []


def test_two_waits_of_a_test_end_before_the_limit_of_pytest() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    limit = settings["tool"]["pytest"]["ini_options"]["timeout"]
    assert limit >= 2 * LIMIT_SECONDS + 100.0


@pytest.mark.parametrize("parts", [READ_BY_USERS, ("tests",)], ids=["product", "tests"])
def test_no_class_name_is_used_twice(parts: tuple[str, ...]) -> None:
    places: dict[str, list[str]] = {}
    for path in list_modules(parts):
        for name, line in read_facts(path).classes:
            places.setdefault(name, []).append(f"{path.relative_to(ROOT)}:{line}")
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


def test_nothing_names_a_registry_or_a_path_of_the_developers_machine() -> None:
    named = []
    for path in _list_tracked():
        try:
            text = path.read_text()
        except UnicodeDecodeError:
            continue
        named += [
            f"{path.relative_to(ROOT)}:{number}"
            for number, line in enumerate(text.splitlines(), 1)
            if MACHINE.search(line)
        ]
    assert named == []


@pytest.mark.parametrize("lock", ["requirements.lock", "docker/requirements.lock"])
def test_every_locked_dependency_carries_a_hash(lock: str) -> None:
    text = (ROOT / lock).read_text().replace("\\\n", " ")
    bare = [line for line in text.splitlines() if "==" in line and "--hash=sha256:" not in line]
    assert bare == []


def test_every_package_on_disk_is_listed_for_installation() -> None:
    listed = re.search(r"packages = \[(.*?)\n\]", (ROOT / "pyproject.toml").read_text(), re.DOTALL)
    assert listed
    names = set(re.findall(r'"([\w.]+)"', listed[1]))
    on_disk = {
        ".".join(init.parent.relative_to(ROOT).parts)
        for part in PRODUCT
        for init in (ROOT / part).rglob("__init__.py")
    }
    assert names - {"service.guides"} == on_disk  # that one is the folder `docs`


def test_examples_use_what_a_user_has() -> None:
    """The public face, arrays and figures: whatever else an example needs is missing there."""
    allowed = {*sys.stdlib_module_names, "examples", "lagid", "numpy", "plotly"}
    imported = re.compile(r"^\s*(?:from|import) ((\w+)[\w.]*)", re.MULTILINE)
    others = {
        (str(path.relative_to(ROOT)), module)
        for path in list_modules(("examples",))
        for module, package in imported.findall(path.read_text())
        if package not in allowed or module.startswith("lagid.")
    }
    assert others == set()


def users_of(text: str) -> list[str]:
    pattern = re.compile(rf"(?<![\w.]){re.escape(text)}")
    return [
        str(path.relative_to(ROOT))
        for path in (ROOT / "sysid").rglob("*.py")
        if pattern.search(path.read_text())
    ]


@pytest.mark.parametrize("call", ["eval(", "exec("])
def test_the_core_never_runs_text_as_code(call: str) -> None:
    assert users_of(call) == []


UNPICKLING = re.compile(
    r"^\s*(?:import|from) (?:pickle|cloudpickle|dill|joblib|marshal|shelve|torch)\b"
    r"|\bnp\.load\(|allow_pickle",
    re.MULTILINE,
)


def test_nothing_of_database_store_and_users_is_unpickled() -> None:
    users = [
        str(path.relative_to(ROOT))
        for path in list_modules(PRODUCT)
        if UNPICKLING.search(path.read_text())
    ]
    assert users == ["sysid/core/jit.py"]  # for `pickle.PickleError` only; see the next test
    assert users_of("pickle.load") == []


def test_pickles_are_read_only_from_the_private_cache_of_compiled_code() -> None:
    """Numba's form of machine code holds pickles; only files of this user are read back."""
    assert users_of("numba.core.serialize import loads") == ["sysid/core/jit.py"]
