"""The plan of a run: what its islands begin with, when they meet, and what each of them is told."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, IslandChange, Migration, Stop
from sysid.islands.archipelago import create_islands, make_plans
from sysid.islands.evolve import compute_next_border, make_search_plan, unpack_plan
from sysid.search.operators import decode, get_mutation_rate
from sysid.simulation.scaling import to_unit
from tests.support.library.search_problems import example

DIFFERENT = GeneticAlgorithm(
    population=26,
    islands=(
        IslandChange(mutation=((0, 0.9), (3, 0.1), (20, 0.5))),
        IslandChange(method="simple", bits=12),
        IslandChange(bits=20, mutation=((0, 0.3),)),
    ),
    stagnation=7,
    selection_rate=0.4,
    migration=Migration(every=5),
    stop=Stop(evaluations=5_000, rms=0.02),
)
SCHEDULE = ("mutation_starts", "mutation_rates")


def test_borders_are_at_every_migration_and_at_the_last_generation() -> None:
    generation, borders = 0, []
    while generation < 47:
        generation = compute_next_border(generation, 7, 20, 47)
        borders.append(generation)
    assert borders == [7, 14, 20, 27, 34, 40, 47]
    assert compute_next_border(3, 7, 20, 1000) == 10  # a run that was resumed between borders


def test_each_island_has_its_own_plan_in_the_packed_ones() -> None:
    problem = example(n=80)
    packed = make_search_plan(problem, DIFFERENT, 11, is_warm=False)
    for i, expected in enumerate(make_plans(problem, DIFFERENT, 11)):
        plan = unpack_plan(packed.plans, i)
        for name in set(plan._fields) - set(SCHEDULE):
            np.testing.assert_array_equal(getattr(plan, name), getattr(expected, name))
        for generation in (0, 2, 3, 19, 20, 100):
            assert get_mutation_rate(
                plan.mutation_starts, plan.mutation_rates, generation
            ) == get_mutation_rate(expected.mutation_starts, expected.mutation_rates, generation)


def test_islands_that_differ_have_different_plans() -> None:
    plans = make_plans(example(n=80), DIFFERENT, 11)
    assert [plan.bits for plan in plans] == [24, 12, 20]
    assert [plan.first_individual for plan in plans] == [0, 9, 18]
    assert [plan.survivors for plan in plans] == [4, 4, 3]  # of 9, 9 and 8 individuals
    assert len({plan.method for plan in plans}) == 2


def places(algorithm: GeneticAlgorithm, **starts: object) -> list[np.ndarray]:
    """Unit coordinates of each new island's individuals."""
    problem = example(n=80)
    created = create_islands(problem, algorithm, 1, **starts)  # type: ignore[arg-type]
    plans = make_plans(problem, algorithm, 1)
    return [
        np.asarray(decode(island.chromosomes, plan.bits))
        for island, plan in zip(created, plans, strict=True)
    ]


def to_place(values: dict[str, float]) -> np.ndarray:
    problem = example(n=80)
    theta = np.array([[values[p.name] for p in problem.free_parameters]])
    return np.asarray(to_unit(problem.evaluator, theta)[0])


ALGORITHM = GeneticAlgorithm(population=36, islands=3)
WARM = {"c": 0.31, "L": 0.42, "b": 3.0, "a": 2.0}


def test_a_quarter_of_every_island_comes_from_a_warm_start_and_its_neighbours() -> None:
    for warm, cold in zip(places(ALGORITHM, warm=(WARM,)), places(ALGORITHM), strict=True):
        np.testing.assert_allclose(warm[0], to_place(WARM), atol=1e-7)
        assert np.all(np.abs(warm[1:3] - to_place(WARM)) <= 0.1)
        assert np.all(np.any(np.abs(warm[1:3] - to_place(WARM)) > 1e-3, axis=1))
        assert np.array_equal(warm[3:], cold[3:])


def test_a_warm_start_of_some_parameters_leaves_the_others_where_they_were_drawn() -> None:
    names = [p.name for p in example(n=80).free_parameters]
    for warm, cold in zip(places(ALGORITHM, warm=({"b": 3.0},)), places(ALGORITHM), strict=True):
        changed = np.any(warm != cold, axis=0)
        assert [name for name, differs in zip(names, changed, strict=True) if differs] == ["b"]


@pytest.mark.parametrize("count", [3, 6, 2])
def test_starts_are_dealt_to_the_islands_of_the_improved_method_best_first(count: int) -> None:
    starts = tuple(WARM | {"b": 1.0 + i} for i in range(count))
    for i, island in enumerate(places(ALGORITHM, starts=starts)):
        np.testing.assert_allclose(island[0], to_place(starts[i % count]), atol=1e-7)
    if count == 6:
        np.testing.assert_allclose(
            places(ALGORITHM, starts=starts)[1][1], to_place(starts[4]), atol=1e-7
        )
    simple = replace(ALGORITHM, method="simple")
    for one, other in zip(places(simple, starts=starts), places(simple), strict=True):
        assert np.array_equal(one, other)
