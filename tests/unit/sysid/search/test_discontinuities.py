"""Jumps of the fitness beside an estimate are told from slopes, however steep."""

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm
from sysid.identification.run import advance_run, begin_run
from sysid.islands.stopping import count_restarts
from sysid.search.basin_hopping import find_odd_increment
from tests.support.library.search_problems import example


def test_nothing_is_unlike_its_neighbours_on_a_parabola() -> None:
    t = np.linspace(-5.0, 5.0, 16)
    assert find_odd_increment(1.0 + 0.3 * t + 2.0 * t * t)[1] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("at", [2, 7, 12])
def test_a_jump_is_unlike_its_neighbours_by_its_height(at: int) -> None:
    t = np.linspace(-5.0, 5.0, 16)
    jump = np.where(np.arange(16) > at, 3.0, 0.0)
    place, height = find_odd_increment(0.1 * t * t + jump)
    assert (place, height) == (at, pytest.approx(3.0))


@pytest.mark.parametrize(("model", "jumps"), [("duffing-eq16", False), ("coulomb-eq16", True)])
@pytest.mark.parametrize("sd", [0.01, 0.5])
def test_the_fitness_jumps_where_friction_switches_and_only_there(
    model: str, jumps: bool, sd: float
) -> None:
    problem = example(model, sd=sd)
    state = advance_run(problem, GeneticAlgorithm(), begin_run(problem, GeneticAlgorithm(), 1))
    assert count_restarts(*state.champions_and_counters).hops > 0
    assert count_restarts(*state.champions_and_counters).has_discontinuities is jumps
