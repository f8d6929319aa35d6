"""Imports that are put off until their names are used."""

from importlib.util import spec_from_file_location
from pathlib import Path
from typing import Any

import pytest

import sysid
from sysid.core.lazy_names import put_off_imports


def make_package(folder: Path, *imports: str) -> dict[str, Any]:
    """A package whose block has these lines."""
    path = folder / "package.py"
    path.write_text("\n    ".join(["if TYPE_CHECKING:", *imports]) + "\n")
    spec = spec_from_file_location("package", path)
    package: dict[str, Any] = {"__name__": "package", "__spec__": spec}
    put_off_imports(package)
    return package


def test_a_name_is_imported_from_its_module_when_it_is_used(tmp_path: Path) -> None:
    package = make_package(tmp_path, "from math import tau as tau", "from math import pi as pi")
    assert package["__all__"] == ["pi", "tau"]
    assert "tau" not in package
    assert package["__getattr__"]("tau") == package["tau"] == 2 * package["__getattr__"]("pi")


def test_a_star_stands_for_the_public_names_of_a_package(tmp_path: Path) -> None:
    package = make_package(tmp_path, "from sysid import *")
    assert "identify" in package["__all__"]
    assert package["__getattr__"]("SysidError") is sysid.SysidError
    with pytest.raises(AttributeError, match="module 'package' has no attribute 'identity'"):
        package["__getattr__"]("identity")
