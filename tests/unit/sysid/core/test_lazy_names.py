"""Imports that are put off until their names are used."""

import builtins
from textwrap import indent
from typing import Any

import pytest

import sysid
from sysid.core.lazy_names import load_on_first_use


def run_block(imports: str, **names: Any) -> dict[str, Any]:
    """A package whose block has these lines."""
    package = {"__name__": "package", "load_on_first_use": load_on_first_use, **names}
    exec(f"with load_on_first_use(globals()):\n{indent(imports, '    ')}", package)
    return package


def test_only_other_modules_import_during_the_block() -> None:
    other: dict[str, Any] = {"__name__": "other"}
    package = run_block("exec('from math import pi', other)\nfrom math import tau", other=other)
    assert package["__all__"] == ["tau"]
    assert "tau" not in package
    assert package["__getattr__"]("tau") == package["tau"] == 2 * other["pi"]


def test_a_star_stands_for_the_public_names_of_a_package() -> None:
    package = run_block("from sysid import *")
    assert "identify" in package["__all__"]
    assert package["__getattr__"]("SysidError") is sysid.SysidError
    with pytest.raises(AttributeError, match="module 'package' has no attribute 'identity'"):
        package["__getattr__"]("identity")


def test_imports_are_usual_after_the_block_and_after_its_error() -> None:
    usual = builtins.__import__
    with pytest.raises(KeyError), load_on_first_use({"__name__": "package"}):
        raise KeyError
    assert builtins.__import__ is usual
