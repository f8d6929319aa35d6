"""The lists of mutants fit the code: each text occurs once, each test exists."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.mutants.lists import Mutant, MutantList, check_lists, read_lists

MUTANT = Mutant("A1", "code.py", "a < b", "a <= b", "an example", ())


def test_every_mutant_can_be_applied() -> None:
    assert check_lists(read_lists()) == []


def test_a_mutant_changes_its_place_and_returns_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "code.py").write_text("c = a < b\n")
    assert MUTANT.apply(tmp_path) == "c = a < b\n"
    assert (tmp_path / "code.py").read_text() == "c = a <= b\n"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"old": "a"}, "occurs 2 times"),
        ({"old": "gone"}, "occurs 0 times"),
        ({"file": "absent.py"}, "occurs 0 times"),
        ({"new": "a < b"}, "`new` equals `old`"),
        ({"tests": ("tests/absent.py::test_a",)}, "tests/absent.py::test_a does not exist"),
    ],
)
def test_a_wrong_entry_is_reported(tmp_path: Path, change: dict[str, object], message: str) -> None:
    (tmp_path / "code.py").write_text("c = a < b; d = a\n")
    wrong = replace(MUTANT, **change)  # type: ignore[arg-type]
    (fault,) = check_lists([MutantList("example", False, (wrong,))], tmp_path)
    assert message in fault


def test_an_id_used_twice_is_reported(tmp_path: Path) -> None:
    (tmp_path / "code.py").write_text("c = a < b\n")
    lists = [MutantList("one", False, (MUTANT,)), MutantList("two", False, (MUTANT,))]
    assert check_lists(lists, tmp_path) == ["A1: two mutants have this id"]
