"""What a driver learns from the slices and islands of one run."""

import numpy as np
import pytest

from sysid.islands.run_state import RunState
from sysid.search.archive import make_archive
from sysid.search.island import Island
from sysid.search.state import SEARCH_RECORD
from tests.support.cluster.small_runs import spec
from workers.active_run import ActiveRun
from workers.protocol import IslandProgress


def make_island(index: int, generation: int) -> Island:
    search = np.zeros((), SEARCH_RECORD)
    search["generation"] = generation
    return Island(
        index, 1, np.zeros((0, 1), np.uint64), np.zeros(0), search, np.zeros(1), make_archive(1)
    )


def make_state(*generations: int, seconds: float = 0.0) -> RunState:
    islands = tuple(make_island(index, count) for index, count in enumerate(generations))
    return RunState(1, islands, min(generations), seconds=seconds)


def test_the_cost_of_a_generation_is_that_of_the_last_slice() -> None:
    run = ActiveRun("r", spec(), None)
    run.absorb_slice(make_state(10, 10), 2.0)
    assert run.generation_seconds == pytest.approx(2.0 / 20)
    run.absorb_slice(make_state(15, 15), 3.0)
    assert run.generation_seconds == pytest.approx(3.0 / 10)
    run.absorb_slice(make_state(15, 15), 9.0)  # nothing was done: nothing is learnt
    assert run.generation_seconds == pytest.approx(3.0 / 10)
    assert run.slices == 3


def test_islands_that_are_computed_side_by_side_take_the_time_of_one() -> None:
    run = ActiveRun("r", spec(), make_state(10, 10, seconds=5.0))
    items = run.split_islands()
    assert [item.island.index for item in items] == [0, 1]
    evolved = IslandProgress(make_island(0, items[0].target), items[0].target)
    assert not run.absorb_island(evolved, 3.0)
    assert run.awaited_islands == {1}
    assert run.state is not None
    assert run.state.seconds == pytest.approx(5.0 + 3.0 / 2)


def test_only_islands_that_are_behind_the_border_are_sent() -> None:
    ahead = ActiveRun("r", spec(), make_state(10, 10)).split_islands()[0].target
    run = ActiveRun("r", spec(), make_state(ahead, 10))
    assert [item.island.index for item in run.split_islands()] == [1]
    assert run.awaited_islands == {1}
    run.restart_epoch()
    assert (run.islands, run.awaited_islands) == ({}, set())
