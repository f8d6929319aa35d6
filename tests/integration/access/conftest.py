"""A service that asks for keys, on both databases."""

from collections.abc import Iterator

import pytest

from tests.database import KINDS
from tests.guarded import Guarded, guard


@pytest.fixture(params=KINDS, scope="module")
def guarded(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Guarded]:
    """The service for the tests of a module."""
    with guard(request.param, tmp_path_factory.mktemp("guarded")) as service:
        yield service
