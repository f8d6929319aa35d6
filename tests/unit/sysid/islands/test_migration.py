"""Topologies, and what migration may and may not do."""

from dataclasses import replace
from itertools import groupby
from typing import get_args

import numpy as np
import pytest

from sysid.core.settings import (
    GeneticAlgorithm,
    IslandChange,
    Migration,
    TopologyName,
)
from sysid.islands.archipelago import create_islands, make_plans
from sysid.islands.migration import migrate
from sysid.islands.topology import CONNECTIONS, list_edges
from sysid.search.island import Island, evolve, split_population
from sysid.search.operators import decode
from sysid.search.state import IslandPlan
from sysid.simulation.scaling import from_unit
from tests.support.library.search_problems import bits, example, with_search

ALGORITHM = GeneticAlgorithm(
    method="simple", population=26, islands=4, generations=3, migration=Migration(every=100)
)
UNEQUAL = replace(ALGORITHM, islands=tuple(IslandChange(bits=count) for count in (24, 12, 20, 12)))


def evolve_islands(
    algorithm: GeneticAlgorithm,
) -> tuple[tuple[Island, ...], tuple[IslandPlan, ...]]:
    """Islands after some generations without migration, and their plans."""
    problem = example(n=80)
    plans = make_plans(problem, algorithm, 4)
    created = create_islands(problem, algorithm, 4)
    return tuple(
        evolve(problem.evaluator, plan, island, algorithm.generations)
        for plan, island in zip(plans, created, strict=True)
    ), plans


def make_islands() -> tuple[Island, ...]:
    return evolve_islands(ALGORITHM)[0]


def test_topologies_connect_as_named() -> None:
    assert list_edges("one-way-ring", 3) == ((0, 1), (1, 2), (2, 0))
    assert list_edges("ring", 4) == ((0, 1), (0, 3), (1, 0), (1, 2), (2, 1), (2, 3), (3, 0), (3, 2))
    assert list_edges("star", 3) == ((0, 1), (0, 2), (1, 0), (2, 0))
    assert len(list_edges("fully-connected", 5)) == 20
    assert list_edges("unconnected", 5) == ()


def test_every_topology_has_its_connections() -> None:
    assert set(CONNECTIONS) == set(get_args(TopologyName))


@pytest.mark.parametrize("name", get_args(TopologyName))
def test_no_topology_sends_an_island_its_own(name: TopologyName) -> None:
    assert list_edges(name, 1) == ()
    assert all(a != b for a, b in list_edges(name, 6))


@pytest.mark.parametrize("name", get_args(TopologyName))
@pytest.mark.parametrize("migrants", [0, 1, 2, 50])
def test_migration_keeps_sizes_and_worsens_nobody(name: TopologyName, migrants: int) -> None:
    before = make_islands()
    after, _ = migrate(before, (24,) * 4, Migration(topology=name, migrants=migrants), 0)
    for old, new in zip(before, after, strict=True):
        assert new.chromosomes.shape == old.chromosomes.shape
        assert np.all(new.fitness <= old.fitness)
        assert np.all(np.diff(new.fitness) >= 0)
        there = any(np.array_equal(old.chromosomes[0], word) for word in new.chromosomes)
        assert there or new.fitness[-1] <= old.fitness[0]  # all of it are better ones


def test_unconnected_migration_is_the_identity() -> None:
    before = make_islands()
    after, log = migrate(before, (24,) * 4, Migration(topology="unconnected"), 0)
    assert [bits(i) for i in after] == [bits(i) for i in before]
    assert log == ()


def test_migrants_are_copies_of_the_best_before_the_exchange() -> None:
    before = make_islands()
    after, log = migrate(before, (24,) * 4, Migration(migrants=2), 7)
    assert len(log) >= 3
    for source, lines in groupby(log, key=lambda line: line.source):
        sent = list(lines)
        assert {(line.epoch, line.destination) for line in sent} == {(7, (source + 1) % 4)}
        best = before[source].fitness[:2].tolist()
        assert [line.fitness for line in sent] in (best, best[:1], best[1:])
        for line in sent:
            word = before[source].chromosomes[before[source].fitness.tolist().index(line.fitness)]
            arrived = after[line.destination]
            here = np.all(arrived.chromosomes == word, axis=1)
            assert arrived.fitness[here].tolist() == [line.fitness]


def test_a_champion_travels_one_connection_in_an_exchange() -> None:
    before = sorted(make_islands(), key=lambda island: island.champion_rms)
    assert len({island.champion_rms for island in before}) == 4
    after, _ = migrate(before, (24,) * 4, Migration(migrants=1), 0)
    for source, destination in zip(before[:-1], after[1:], strict=True):
        assert np.array_equal(destination.chromosomes[0], source.chromosomes[0])
        assert destination.champion_rms == source.champion_rms
        assert destination.history[-1].parameters == source.history[-1].parameters
    assert after[0].history == before[0].history


@pytest.mark.parametrize("algorithm", [ALGORITHM, UNEQUAL], ids=["equal", "unequal"])
@pytest.mark.parametrize("name", sorted(set(get_args(TopologyName)) - {"unconnected"}))
def test_after_an_exchange_fitness_is_that_of_the_chromosome(
    algorithm: GeneticAlgorithm, name: TopologyName
) -> None:
    """Islands of unequal bits round migrants, so these are evaluated where they arrive."""
    problem = example(n=80)
    before, plans = evolve_islands(algorithm)
    after, log = migrate(
        before, [plan.bits for plan in plans], Migration(topology=name, migrants=2), 0
    )
    assert log
    waiting = 0
    for island, plan in zip(after, plans, strict=True):
        theta = from_unit(problem.evaluator, decode(island.chromosomes, plan.bits))
        known = np.isfinite(island.fitness)
        waiting += np.count_nonzero(~known)
        assert np.array_equal(island.fitness[known], problem.evaluate_fitness(theta)[known])
        assert island.champion_rms == island.fitness[0]  # what waits is no champion yet
        assert island.history[-1].parameters == tuple(theta[0])
        arrived = evolve(problem.evaluator, plan, island, 0)
        theta = from_unit(problem.evaluator, decode(arrived.chromosomes, plan.bits))
        assert np.array_equal(arrived.fitness, problem.evaluate_fitness(theta))
        assert np.all(np.diff(arrived.fitness) >= 0)
        assert arrived.champion_rms == arrived.fitness[0]
        assert arrived.history[-1].parameters == tuple(theta[0])
    assert (waiting > 0) == (algorithm is UNEQUAL)


def test_a_migrant_as_fit_as_the_worst_individual_does_not_arrive() -> None:
    before = tuple(
        replace(island, fitness=np.ones_like(island.fitness)) for island in make_islands()
    )
    after, log = migrate(before, (24,) * 4, Migration(topology="fully-connected"), 0)
    assert log == ()
    assert [bits(i) for i in after] == [bits(i) for i in before]


def test_a_better_champion_has_to_be_confirmed_again_and_another_one_stays_confirmed() -> None:
    evidence = {
        "champion_converged": 1,
        "stagnation": 9,
        "confirmed_starts": 3,
        "hop_count": 2,
        "returned_hops": 1,
        "champion_discontinuities": 1,
        "champion_explained": 1,
    }
    before = tuple(with_search(island, **evidence) for island in make_islands())
    after, _ = migrate(before, (24,) * 4, Migration(topology="fully-connected"), 0)
    changed = [new.champion_rms < old.champion_rms for old, new in zip(before, after, strict=True)]
    assert sorted(changed) == [False, True, True, True]
    for island, is_new in zip(after, changed, strict=True):
        found = {name: int(island.search[name]) for name in evidence}
        assert found == (dict.fromkeys(evidence, 0) if is_new else evidence)


def test_a_better_champion_by_migration_is_in_the_history() -> None:
    before = make_islands()
    after, _ = migrate(before, (24,) * 4, Migration(topology="fully-connected"), 0)
    best = min(island.champion_rms for island in before)
    assert all(island.champion_rms == best == island.fitness[0] for island in after)
    gained = [i for i, j in zip(after, before, strict=True) if j.champion_rms > best]
    assert all(island.history[-1].phase == "migration" for island in gained)


def test_a_migrant_that_is_there_already_does_not_arrive_again() -> None:
    once, _ = migrate(
        make_islands(), (24,) * 4, Migration(topology="fully-connected", migrants=1), 0
    )
    twice, log = migrate(once, (24,) * 4, Migration(topology="fully-connected", migrants=1), 1)
    assert log == ()
    assert [bits(i) for i in once] == [bits(i) for i in twice]


def test_the_population_is_dealt_as_evenly_as_possible() -> None:
    assert split_population(GeneticAlgorithm(population=50, islands=4)) == (13, 13, 12, 12)
    assert split_population(GeneticAlgorithm(method="simple")) == (50,)
