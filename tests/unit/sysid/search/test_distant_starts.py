"""When a search looks far from its champion, and when it gives up a start from far away."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Migration, Stop
from sysid.identification.run import advance_run, begin_run
from sysid.islands.archipelago import create_islands, make_plans
from sysid.islands.migration import migrate
from sysid.models.catalogue.load import load_model
from sysid.search.adaptive_search import start_local_search
from sysid.search.basin_hopping import (
    is_behind_champion,
    is_champion_coloured,
    is_champion_explained,
)
from sysid.search.island import Island
from sysid.search.operators import encode
from sysid.search.slopes import evaluate_partial_fitness
from sysid.search.state import IslandPlan
from sysid.simulation.evaluator import predict_partially
from sysid.simulation.problem import Problem
from tests.support.library.search_problems import COULOMB, example, noisy, record

ALONE = GeneticAlgorithm(population=12, islands=1, stop=Stop(evaluations=6_000))
PROBLEM = example("coulomb-eq16")
FALSE = COULOMB | {"b": 3.0}


def read_plan() -> IslandPlan:
    return make_plans(PROBLEM, ALONE, 3)[0]


def island_at(values: dict[str, float]) -> Island:
    """A new island whose individuals all have these values."""
    place = [(values[p.name] - p.lower) / (p.upper - p.lower) for p in PROBLEM.free_parameters]
    words = np.asarray(encode(np.array([place] * 12), read_plan().bits))
    return replace(
        create_islands(PROBLEM, ALONE, 3)[0], chromosomes=words, fitness=np.full(12, 1.0)
    )


@pytest.mark.parametrize(("values", "wanted"), [(COULOMB, False), (FALSE, True)])
def test_errors_are_coloured_where_the_response_is_wrong(
    values: dict[str, float], wanted: bool
) -> None:
    island = island_at(values)
    before = island.evaluations
    assert is_champion_coloured(PROBLEM.evaluator, read_plan(), island.arrays) == wanted
    assert island.evaluations == before + 1


@pytest.mark.parametrize(("values", "wanted"), [(COULOMB, True), (FALSE, False)])
def test_only_noise_is_left_where_the_response_is_right(
    values: dict[str, float], wanted: bool
) -> None:
    island = island_at(values)
    before = island.evaluations
    assert is_champion_explained(PROBLEM.evaluator, read_plan(), island.arrays) == wanted
    assert island.evaluations == before + 1
    island.search["evaluations"] = read_plan().most_evaluations
    assert not is_champion_explained(PROBLEM.evaluator, read_plan(), island.arrays)


@pytest.mark.parametrize("coloured", [False, True])
def test_a_hop_that_returns_finds_out_whether_only_noise_is_left(coloured: bool) -> None:
    values = noisy(n=200) + (0.05 * np.sin(np.arange(200)) if coloured else 0.0)
    problem = Problem.build(load_model("duffing-eq16"), [record(values)])
    algorithm = GeneticAlgorithm(generations=60, stop=Stop(settled=None))
    state = advance_run(problem, algorithm, begin_run(problem, algorithm, 1))
    returned = [island for island in state.islands if island.search["returned_hops"] > 0]
    assert returned
    assert {int(island.search["champion_explained"]) for island in returned} == {int(not coloured)}


def test_a_part_is_lost_where_the_champion_fits_it_better() -> None:
    theta = np.array([[FALSE[p.name] for p in PROBLEM.free_parameters]])
    predicted = predict_partially(PROBLEM.evaluator, theta, 0.25)
    loss = evaluate_partial_fitness(PROBLEM.evaluator, read_plan(), predicted, 0.25)[0]
    island = island_at(FALSE)
    for share, wanted in ((1.001, True), (0.999, False)):
        reached = share * loss
        assert (
            is_behind_champion(PROBLEM.evaluator, read_plan(), island.arrays, 0.25, reached)
            == wanted
        )
    island.search["evaluations"] = read_plan().most_evaluations
    assert not is_behind_champion(PROBLEM.evaluator, read_plan(), island.arrays, 0.25, 2.0 * loss)
    assert island.evaluations == read_plan().most_evaluations


@pytest.mark.parametrize(("values", "kinds"), [(COULOMB, "hhhh"), (FALSE, "hfff")])
def test_a_champion_whose_errors_are_no_noise_lets_fresh_starts_have_the_turns_of_hops(
    values: dict[str, float], kinds: str
) -> None:
    seen = ""
    for turn in (9, 11, 13, 15):
        island = island_at(values)
        search = island.search
        search["fitness_discontinuities"] = search["champion_converged"] = 1
        search["local_searches"] = turn - 1
        start_local_search(PROBLEM.evaluator, read_plan(), island.arrays)
        seen += "f" if search["from_random_start"] else "h" if search["hop"] else "?"
        assert (search["horizon"] <= 0.25) == bool(search["from_random_start"])
    assert seen == kinds


def test_jumps_that_one_island_has_met_its_neighbour_knows_after_the_exchange() -> None:
    shared = GeneticAlgorithm(population=26, islands=4, generations=3)
    islands = advance_run(PROBLEM, shared, begin_run(PROBLEM, shared, 4)).islands
    for island in islands:
        island.search["fitness_discontinuities"] = 0
    islands[1].search["fitness_discontinuities"] = 5
    for known in ([0, 5, 5, 0], [0, 5, 5, 5], [5, 5, 5, 5]):
        islands, _ = migrate(islands, (24,) * 4, Migration(), 0)
        assert [int(island.search["fitness_discontinuities"]) for island in islands] == known
    alone, _ = migrate(islands[:1], (24,), Migration(topology="unconnected"), 0)
    assert alone[0].search["fitness_discontinuities"] == 5
