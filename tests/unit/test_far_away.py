"""When a search looks far from its champion, and when it gives up a start from far away."""

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Migration, Stop
from sysid.core.types import WordArray
from sysid.identification.run import advance, begin
from sysid.islands.archipelago import found, plans
from sysid.islands.migration import migrate
from sysid.search.adaptive_search import start_development
from sysid.search.basin_hopping import is_behind, is_coloured
from sysid.search.operators import coded
from sysid.search.slopes import partial_fitness
from sysid.search.state import DEVELOPMENTS, EVALUATIONS, FRESH, HOP, HORIZON, JUMPS, SETTLED, Plan
from sysid.simulation.evaluator import partial_predictions
from tests.searching import COULOMB, example

ALONE = GeneticAlgorithm(population=12, islands=1, stop=Stop(evaluations=6_000))
PROBLEM = example("coulomb-eq16")
FALSE = COULOMB | {"b": 3.0}


def plan() -> Plan:
    return plans(PROBLEM, ALONE, 3)[0]


def words(values: dict[str, float]) -> WordArray:
    """Individuals that all have these values."""
    place = [(values[p.name] - p.lower) / (p.upper - p.lower) for p in PROBLEM.space]
    return np.asarray(coded(np.array([place] * 12), plan().bits))


def counters() -> np.ndarray:  # type: ignore[type-arg]
    return found(PROBLEM, ALONE, 3)[0].counters.copy()


@pytest.mark.parametrize(("values", "wanted"), [(COULOMB, False), (FALSE, True)])
def test_errors_are_coloured_where_the_response_is_wrong(
    values: dict[str, float], wanted: bool
) -> None:
    count = counters()
    before = count[EVALUATIONS]
    assert is_coloured(PROBLEM.evaluator, plan(), words(values), count) == wanted
    assert count[EVALUATIONS] == before + 1


def test_a_part_is_lost_where_the_champion_fits_it_better() -> None:
    theta = np.array([[FALSE[p.name] for p in PROBLEM.space]])
    predicted = partial_predictions(PROBLEM.evaluator, theta, 0.25)
    loss = partial_fitness(PROBLEM.evaluator, plan(), predicted, 0.25)[0]
    count = counters()
    for share, wanted in ((1.001, True), (0.999, False)):
        reached = share * loss
        found_behind = is_behind(PROBLEM.evaluator, plan(), words(FALSE), count, 0.25, reached)
        assert found_behind == wanted
    count[EVALUATIONS] = plan().evaluations
    assert not is_behind(PROBLEM.evaluator, plan(), words(FALSE), count, 0.25, 2.0 * loss)
    assert count[EVALUATIONS] == plan().evaluations


@pytest.mark.parametrize(("values", "kinds"), [(COULOMB, "hhhh"), (FALSE, "hfff")])
def test_a_champion_whose_errors_are_no_noise_lets_fresh_starts_have_the_turns_of_hops(
    values: dict[str, float], kinds: str
) -> None:
    island = found(PROBLEM, ALONE, 3)[0]
    seen = ""
    for turn in (9, 11, 13, 15):
        count, memory = counters(), island.memory.copy()
        count[[JUMPS, SETTLED]], count[DEVELOPMENTS] = 1, turn - 1
        everyone = words(values)
        fitness = np.full(12, 1.0)
        start_development(PROBLEM.evaluator, plan(), everyone, fitness, count, memory)
        seen += "f" if count[FRESH] else "h" if count[HOP] else "?"
        assert (memory[HORIZON] <= 0.25) == bool(count[FRESH])
    assert seen == kinds


def test_jumps_that_one_island_has_met_its_neighbour_knows_after_the_exchange() -> None:
    shared = GeneticAlgorithm(population=26, islands=4, generations=3)
    islands = advance(PROBLEM, shared, begin(PROBLEM, shared, 4)).islands
    for island in islands:
        island.counters[JUMPS] = 0
    islands[1].counters[JUMPS] = 5
    for known in ([0, 5, 5, 0], [0, 5, 5, 5], [5, 5, 5, 5]):
        islands, _ = migrate(islands, (24,) * 4, Migration(), 0)
        assert [int(island.counters[JUMPS]) for island in islands] == known
    alone, _ = migrate(islands[:1], (24,), Migration(topology="unconnected"), 0)
    assert alone[0].counters[JUMPS] == 5
