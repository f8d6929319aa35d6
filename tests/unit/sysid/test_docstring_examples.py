"""Every public name of the library has an example, and the examples hold."""

import doctest
from pathlib import Path

import pytest

import sysid

NAMES = {name: getattr(sysid, name) for name in vars(sysid)["__all__"]}


@pytest.mark.parametrize("name", NAMES)
def test_the_example_of_a_public_name_holds(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # an example may write a file
    text = NAMES[name].__doc__
    example = doctest.DocTestParser().get_doctest(text, dict(NAMES), name, None, None)
    assert example.examples
    told: list[str] = []
    doctest.DocTestRunner().run(example, out=told.append)
    assert "".join(told) == ""
