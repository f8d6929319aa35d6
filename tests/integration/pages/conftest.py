"""A filled data folder for the tests of a module."""

from pathlib import Path

import pytest

from tests.support.service.filled_folder import FilledFolder, copy_filled


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module")
def filled_folder(folder: Path) -> FilledFolder:
    return copy_filled(folder)
