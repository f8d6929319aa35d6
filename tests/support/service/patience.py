"""A time of the service that depends on how fast the machine is, made long for all tests.

A test of this time sets it itself.
"""

from collections.abc import Iterator

import pytest

from service.core import computed
from tests.support.limits import LIMIT_SECONDS


@pytest.fixture(scope="session", autouse=True)
def _patient_service() -> Iterator[None]:
    """Let values of open jobs be computed anew each time, however long that takes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(computed, "FRESH_SECONDS", LIMIT_SECONDS)
        yield
