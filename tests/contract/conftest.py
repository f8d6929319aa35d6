"""Fixtures of the contracts."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.cluster.dispatch_place import Place


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    """A place for what is computed, whichever database keeps it."""
    made = Place(tmp_path / "data")
    yield made
    made.database.dispose()
