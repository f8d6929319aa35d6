"""A whole service, web, dispatcher, Ray and all, broken in every way while it works.

How soon it recovers is measured by `benchmarks/torture.py`; here it must, and nothing may differ.
"""

from collections.abc import Callable, Iterator

import pytest
from sqlalchemy import func, select

from benchmarks.breaking import cancelling, faults
from benchmarks.breaking.faults import Bench
from benchmarks.breaking.stand import Stand, standing_service
from benchmarks.breaking.work import ALWAYS, Stream
from service.core.states import JobState
from service.storage.tables import Run

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(600)]

FAULTS = [
    faults.kill_worker,
    faults.kill_raylet,
    faults.kill_gcs,
    faults.kill_dispatcher,
    faults.kill_web,
    faults.step_clock_back,
    faults.step_clock_and_kill,
    faults.pause_dispatcher,
    cancelling.cancel_running,
    cancelling.cancel_finishing,
]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Bench, Stream]]:
    """A service at work on jobs whose undisturbed results are known."""
    folder = tmp_path_factory.mktemp("broken")
    clock = folder / "clock"
    clock.write_text("0")
    with standing_service(Stand(folder / "data", environment={"BREAK_CLOCK": str(clock)})) as stand:
        stream = Stream(stand, folder)
        stream.measure((*ALWAYS, "cancelled"))
        stream.start()
        yield Bench(stand, stream, clock=clock), stream


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_the_work_goes_on_after(
    fault: Callable[[Bench], float], bench: tuple[Bench, Stream]
) -> None:
    stand = bench[0].stand
    before = count_successes(stand)
    fault(bench[0])
    assert count_successes(stand) > before
    assert stand.answers() == 200


def count_successes(stand: Stand) -> int:
    """Number of runs of all jobs whose results are stored."""
    with stand.database.read_session() as session:
        ended = select(func.count()).where(Run.state == JobState.SUCCEEDED)
        return session.scalar(ended) or 0


def test_nothing_is_lost_doubled_stuck_different_or_left(bench: tuple[Bench, Stream]) -> None:
    (broken, stream), stand = bench, bench[0].stand
    assert stream.finish() == 0
    assert stream.counts["runs"] > 0
    assert (stream.counts["lost"], stream.counts["doubled"], stream.different) == (0, 0, [])
    assert stream.counts["given up"] == 0
    states = {job["state"] for job in stand.client.jobs()}
    assert states == {"succeeded"}
    assert broken.stream.jobs() == []
    stand.stop()
    assert stand.leftovers() == []
