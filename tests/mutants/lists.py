"""The lists of mutants: one TOML file for each package beside this module.

A file names its package, the tests of its part and whether every mutant has to be killed. A mutant
replaces a text that occurs exactly once in a file. `equivalent` says why a mutant changes nothing
that can be seen; `survives` says why a real survivor is left.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path

from tests.support.checkout import ROOT

FOLDER = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Mutant:
    """One fault: `old` becomes `new` in `file`; `tests` are those of its part."""

    id: str
    file: str
    old: str
    new: str
    why: str
    tests: tuple[str, ...]
    equivalent: str = ""
    survives: str = ""

    def apply(self, root: Path) -> str:
        """Write the mutated file below `root`; return its content before."""
        path = root / self.file
        content = path.read_text(encoding="utf-8")
        count = content.count(self.old)
        if count != 1:
            raise ValueError(f"{self.id}: `old` occurs {count} times in {self.file}. Need once")
        mutated = content.replace(self.old, self.new)
        compile(mutated, self.file, "exec")  # a fault of syntax is no mutant
        path.write_text(mutated, encoding="utf-8")
        return content


@dataclass(frozen=True, slots=True)
class MutantList:
    """The mutants of a package; with `strict` every one has to be killed."""

    package: str
    strict: bool
    mutants: tuple[Mutant, ...]


def read_lists() -> list[MutantList]:
    """Read all lists, in the order of their file names."""
    return [_read_list(path) for path in sorted(FOLDER.glob("*.toml"))]


def _read_list(path: Path) -> MutantList:
    document = tomllib.loads(path.read_text(encoding="utf-8"))
    part = document["tests"]
    mutants = tuple(
        Mutant(**{**entry, "tests": tuple(entry.get("tests", part))})
        for entry in document["mutant"]
    )
    return MutantList(path.stem, document.get("strict", False), mutants)


def check_lists(lists: list[MutantList], root: Path = ROOT) -> list[str]:
    """List what is wrong with the lists: ids used twice, texts or tests that do not exist."""
    faults, seen = [], set()
    for mutant in (mutant for part in lists for mutant in part.mutants):
        if mutant.id in seen:
            faults.append(f"{mutant.id}: two mutants have this id")
        seen.add(mutant.id)
        path = root / mutant.file
        count = path.read_text(encoding="utf-8").count(mutant.old) if path.is_file() else 0
        if count != 1:
            faults.append(f"{mutant.id}: `old` occurs {count} times in {mutant.file}. Need once")
        elif mutant.new == mutant.old:
            faults.append(f"{mutant.id}: `new` equals `old`")
        faults += [
            f"{mutant.id}: {test} does not exist"
            for test in mutant.tests
            if not (root / test.partition("::")[0]).exists()
        ]
    return faults
