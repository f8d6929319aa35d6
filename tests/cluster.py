"""One local Ray for the whole session, started when first asked for."""

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:  # most tests need no Ray, and its import takes its time
    from workers.ray_executor import RayExecutor

CPUS = 2
FREE_SECONDS = 60.0


@pytest.fixture(scope="session")
def _ray() -> "Iterator[RayExecutor]":
    from workers.ray_executor import ClusterSettings, RayExecutor

    executor = RayExecutor(ClusterSettings(cpus=CPUS))
    executor.warm_up_workers()
    yield executor
    executor.close()


@pytest.fixture
def ray_executor(_ray: "RayExecutor") -> "Iterator[RayExecutor]":
    """Two workers of a local Ray; each test must leave both free."""
    yield _ray
    limit = time.monotonic() + FREE_SECONDS
    while _ray._ray.available_resources().get("CPU", 0) < CPUS:
        assert time.monotonic() < limit, "the test left work behind on the cluster"
        time.sleep(0.05)
