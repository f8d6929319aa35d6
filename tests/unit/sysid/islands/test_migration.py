"""Topologies, and what migration may and may not do."""

import numpy as np
import pytest

from sysid.core.settings import TOPOLOGIES, GeneticAlgorithm, Migration, TopologyName
from sysid.identification.run import advance_run, begin_run
from sysid.islands.migration import migrate
from sysid.islands.topology import CONNECTIONS, list_edges
from sysid.search.island import split_population
from tests.searching import bits, example

ALGORITHM = GeneticAlgorithm(
    method="simple", population=26, islands=4, generations=3, migration=Migration(every=100)
)


def islands() -> tuple:  # type: ignore[type-arg]
    problem = example(n=80)
    return advance_run(problem, ALGORITHM, begin_run(problem, ALGORITHM, 4)).islands


def test_topologies_connect_as_named() -> None:
    assert list_edges("one-way-ring", 3) == ((0, 1), (1, 2), (2, 0))
    assert list_edges("ring", 4) == ((0, 1), (0, 3), (1, 0), (1, 2), (2, 1), (2, 3), (3, 0), (3, 2))
    assert list_edges("star", 3) == ((0, 1), (0, 2), (1, 0), (2, 0))
    assert len(list_edges("fully-connected", 5)) == 20
    assert list_edges("unconnected", 5) == ()


def test_every_topology_has_its_connections() -> None:
    assert set(CONNECTIONS) == set(TOPOLOGIES)


@pytest.mark.parametrize("name", TOPOLOGIES)
def test_no_topology_sends_an_island_its_own(name: TopologyName) -> None:
    assert list_edges(name, 1) == ()
    assert all(a != b for a, b in list_edges(name, 6))


@pytest.mark.parametrize("name", TOPOLOGIES)
@pytest.mark.parametrize("migrants", [0, 1, 2, 50])
def test_migration_keeps_sizes_and_worsens_nobody(name: TopologyName, migrants: int) -> None:
    before = islands()
    after, _ = migrate(before, (24,) * 4, Migration(topology=name, migrants=migrants), 0)
    for old, new in zip(before, after, strict=True):
        assert new.chromosomes.shape == old.chromosomes.shape
        assert np.all(new.fitness <= old.fitness)
        assert np.all(np.diff(new.fitness) >= 0)
        there = any(np.array_equal(old.chromosomes[0], word) for word in new.chromosomes)
        assert there or new.fitness[-1] <= old.fitness[0]  # all of it are better ones


def test_unconnected_migration_is_the_identity() -> None:
    before = islands()
    after, log = migrate(before, (24,) * 4, Migration(topology="unconnected"), 0)
    assert [bits(i) for i in after] == [bits(i) for i in before]
    assert log == ()


def test_migrants_are_copies_of_the_best_before_the_exchange() -> None:
    before = islands()
    after, log = migrate(before, (24,) * 4, Migration(migrants=2), 7)
    assert log
    for line in log:
        assert line.epoch == 7
        assert line.destination == (line.source + 1) % 4
        assert line.fitness in before[line.source].fitness[:2]
        assert line.fitness in after[line.destination].fitness


def test_a_better_champion_by_migration_is_in_the_history() -> None:
    before = islands()
    after, _ = migrate(before, (24,) * 4, Migration(topology="fully-connected"), 0)
    best = min(island.champion_rms for island in before)
    assert all(island.champion_rms == best == island.fitness[0] for island in after)
    gained = [i for i, j in zip(after, before, strict=True) if j.champion_rms > best]
    assert all(island.history[-1].phase == "migration" for island in gained)


def test_a_migrant_that_is_there_already_does_not_arrive_again() -> None:
    once, _ = migrate(islands(), (24,) * 4, Migration(topology="fully-connected", migrants=1), 0)
    twice, log = migrate(once, (24,) * 4, Migration(topology="fully-connected", migrants=1), 1)
    assert log == ()
    assert [bits(i) for i in once] == [bits(i) for i in twice]


def test_the_population_is_dealt_as_evenly_as_possible() -> None:
    assert split_population(GeneticAlgorithm(population=50, islands=4)) == (13, 13, 12, 12)
    assert split_population(GeneticAlgorithm(method="simple")) == (50,)
