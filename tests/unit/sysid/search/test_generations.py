"""One generation of each kind by itself: who is bred, who stays, and what is evaluated."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, SequenceSearch
from sysid.islands.archipelago import create_islands, make_plans
from sysid.search.evolution import (
    breed_improved_children,
    breed_simple_children,
    evaluate_new_individuals,
    redraw_population,
    reset_evidence,
    select_fittest,
)
from sysid.search.island import Island
from sysid.search.operators import decode
from sysid.search.sequence_search import run_fixed_sequence
from sysid.search.state import IslandPlan
from sysid.simulation.scaling import from_unit
from tests.searching import example, with_search

PROBLEM = example(n=80)


def begin(method: str = "simple", size: int = 20) -> tuple[Island, IslandPlan]:
    """An evaluated island in its seventh generation, and its plan."""
    algorithm = GeneticAlgorithm(method=method, population=size, islands=1)  # type: ignore[arg-type]
    (plan,) = make_plans(PROBLEM, algorithm, 5)
    (island,) = create_islands(PROBLEM, algorithm, 5)
    spent = evaluate_new_individuals(PROBLEM.evaluator, plan, island.chromosomes, island.fitness)
    assert spent == size
    return with_search(island, generation=7), plan


def test_new_individuals_are_evaluated_and_all_are_ranked() -> None:
    island, plan = begin()
    words, fitness = island.chromosomes[::-1].copy(), island.fitness[::-1].copy()
    fitness[[3, 11]] = np.nan
    assert evaluate_new_individuals(PROBLEM.evaluator, plan, words, fitness) == 2
    assert np.array_equal(fitness, island.fitness)
    assert np.array_equal(words, island.chromosomes)
    assert evaluate_new_individuals(PROBLEM.evaluator, plan, words, fitness) == 0


def test_survivors_of_the_simple_method_stay_and_their_children_replace_the_others() -> None:
    island, plan = begin()
    before, kept = island.chromosomes.copy(), plan.survivors
    assert kept == 10
    breed_simple_children(plan, island.arrays)
    assert np.array_equal(island.chromosomes[:kept], before[:kept])
    assert np.flatnonzero(np.isnan(island.fitness)).tolist() == list(range(kept, 20))
    parents = [join_words(word, plan.bits) for word in before[:kept]]
    pairs = [(a, b) for a in parents for b in parents if a != b]
    lows = [(1 << cut) - 1 for cut in range(1, 4 * plan.bits)]
    for word in island.chromosomes[kept:]:
        child = join_words(word, plan.bits)
        joined = ((a & ~low) | (b & low) for a, b in pairs for low in lows)
        assert min((child ^ one).bit_count() for one in joined) <= 1  # one bit may be mutated


def join_words(words: np.ndarray, bits: int) -> int:
    """The whole bit string as one number."""
    return int("".join(f"{int(word):0{bits}b}" for word in words), 2)


def test_the_improved_method_breeds_as_many_children_as_there_are_individuals() -> None:
    island, plan = begin("improved")
    before = island.chromosomes.copy()
    children = breed_improved_children(plan, island.arrays)
    assert children.shape == before.shape
    assert np.array_equal(island.chromosomes, before)
    assert int(children.max()) < 2**plan.bits
    assert np.mean(np.all(children == before, axis=1)) < 0.2


def test_the_fittest_of_parents_and_children_live_and_a_parent_stays_on_a_tie() -> None:
    island, _ = begin("improved", 8)
    island.fitness[:] = np.arange(8.0)
    island.chromosomes[:] = np.arange(8)[:, None]
    children = np.full((8, 4), 100, dtype=np.uint32) + np.arange(8, dtype=np.uint32)[:, None]
    reached = np.array([2.0, 0.5, 9.0, np.inf, 2.5, 9.0, 9.0, 9.0])
    select_fittest(island.arrays, children, reached)
    assert island.fitness.tolist() == [0, 0.5, 1, 2, 2, 2.5, 3, 4]
    assert island.chromosomes[:, 0].tolist() == [0, 101, 1, 2, 100, 104, 3, 4]


def test_a_restart_keeps_the_champion_and_draws_all_others_again() -> None:
    island, plan = begin("improved")
    before, best = island.chromosomes.copy(), island.fitness[0]
    redraw_population(plan, island.arrays)
    assert np.array_equal(island.chromosomes[0], before[0])
    assert island.fitness[0] == best
    assert np.all(np.isnan(island.fitness[1:]))
    assert not np.any(np.all(island.chromosomes[1:] == before[1:], axis=1))
    places = decode(island.chromosomes[1:], plan.bits)
    assert np.max(places) > 0.8
    assert np.min(places) < 0.2


@pytest.mark.parametrize(("gain", "left"), [(2e-4, 0), (5e-5, 3), (0.0, 3)])
def test_evidence_is_kept_for_the_same_optimum_only(gain: float, left: int) -> None:
    fields = (
        "confirmed_starts",
        "champion_discontinuities",
        "champion_explained",
        "hop_count",
        "returned_hops",
    )
    island = with_search(begin()[0], random_starts=5, **dict.fromkeys(fields, 3))
    reset_evidence(island.arrays.search, 0.5 * (1.0 - gain), 0.5)
    assert [int(island.search[name]) for name in fields] == [left] * 5
    assert island.search["random_starts"] == 5


@pytest.mark.parametrize("relative", [False, True])
def test_a_fixed_sequence_moves_parameters_of_the_champion_by_beta(relative: bool) -> None:
    algorithm = GeneticAlgorithm(
        method="improved-paper",
        population=20,
        islands=1,
        sequence=SequenceSearch("paper", beta=0.05, relative=relative),
    )
    (plan,) = make_plans(PROBLEM, algorithm, 5)
    island, _ = begin()
    evaluator, gains, failures = PROBLEM.evaluator, 0, 0
    for generation in range(30):
        island = with_search(island, generation=generation, in_sequence_search=1)
        before = replace(
            island, chromosomes=island.chromosomes.copy(), fitness=island.fitness.copy()
        )
        failed, spent = int(island.search["failed_steps"]), island.evaluations
        run_fixed_sequence(evaluator, plan, island.arrays)
        assert island.evaluations == spent + 20
        old, new = from_unit(
            evaluator,
            decode(np.vstack([before.chromosomes[:1], island.chromosomes[:1]]), plan.bits),
        )
        if island.fitness[0] == before.fitness[0]:
            failures += 1
            assert np.array_equal(island.chromosomes, before.chromosomes)
            assert island.search["failed_steps"] == (0 if failed else 1)
            assert island.search["in_sequence_search"] == (0 if failed else 1)
            continue
        gains += 1
        size = np.abs(old) if relative else evaluator.upper - evaluator.lower
        inside = (new > evaluator.lower) & (new < evaluator.upper)
        moves = (
            (new - old) / (0.05 * np.maximum(size, 0.01 * (evaluator.upper - evaluator.lower)))
        )[inside]
        assert np.all(np.abs(moves - np.round(moves)) < 1e-3)
        assert np.all(np.abs(moves) < 1.5)
        assert island.search["failed_steps"] == 0
        assert island.fitness[0] == PROBLEM.evaluate_fitness(new[None])[0]
        assert np.array_equal(island.fitness[1:], before.fitness[:-1])  # the worst is replaced
    assert min(gains, failures) >= 2
