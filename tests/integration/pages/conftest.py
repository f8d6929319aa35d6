"""A filled data folder for the tests of a module."""

from pathlib import Path

import pytest

from tests.e2e.filled import Filled, copy_filled


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module")
def filled(folder: Path) -> Filled:
    return copy_filled(folder)
