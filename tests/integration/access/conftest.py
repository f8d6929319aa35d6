"""A service that asks for keys, on both databases."""

from collections.abc import Iterator

import pytest

from tests.support.service.keyed_service import Guarded, guard
from tests.support.storage.databases import KINDS


@pytest.fixture(params=KINDS, scope="module")
def keyed_service(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Guarded]:
    """The service for the tests of a module."""
    with guard(request.param, tmp_path_factory.mktemp("guarded")) as service:
        yield service
