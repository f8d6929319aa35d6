"""One local Ray for the whole session, started when first asked for."""

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.support.limits import LIMIT_SECONDS

if TYPE_CHECKING:  # most tests need no Ray, and its import takes its time
    from workers.ray_executor import RayExecutor

CPUS = 2


@pytest.fixture(scope="session")
def _ray() -> "Iterator[RayExecutor]":
    from workers import ray_executor as module

    executor = module.RayExecutor(module.ClusterSettings(cpus=CPUS))
    executor.warm_up_workers()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "ANSWER_SECONDS", LIMIT_SECONDS)  # a busy machine is no lost cluster
        yield executor
    executor.close()


@pytest.fixture
def ray_executor(_ray: "RayExecutor") -> "Iterator[RayExecutor]":
    """Two workers of a local Ray; each test must leave both free."""
    yield _ray
    limit = time.monotonic() + LIMIT_SECONDS
    while _ray._ray.available_resources().get("CPU", 0) < CPUS:
        assert time.monotonic() < limit, "the test left work behind on the cluster"
        time.sleep(0.05)
