"""One generation of each kind by itself: who is bred, who stays, and what is evaluated."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, SequenceSearch
from sysid.core.types import FloatArray, WordArray
from sysid.islands.archipelago import create_islands, make_plans
from sysid.search.evolution import (
    breed_improved_children,
    breed_simple_children,
    evaluate_new_individuals,
    redraw_population,
    reset_evidence,
    run_generations,
    select_fittest,
)
from sysid.search.island import Island, evolve
from sysid.search.known_fitness import make_known_fitness, recall_fitness, remember_fitness
from sysid.search.operators import decode
from sysid.search.sequence_search import run_fixed_sequence
from sysid.search.state import COLUMN_VALUES, IslandPlan
from sysid.simulation.scaling import from_unit
from tests.support.library.search_problems import example, with_search

PROBLEM = example(n=80)


def evaluate(plan: IslandPlan, words: WordArray, fitness: FloatArray) -> int:
    """Evaluate new individuals without a memory."""
    known = make_known_fitness(0, words.shape[1])
    return evaluate_new_individuals(PROBLEM.evaluator, plan, known, words, fitness)


def begin(method: str = "simple", size: int = 20) -> tuple[Island, IslandPlan]:
    """An evaluated island in its seventh generation, and its plan."""
    algorithm = GeneticAlgorithm(method=method, population=size, islands=1)  # type: ignore[arg-type]
    (plan,) = make_plans(PROBLEM, algorithm, 5)
    (island,) = create_islands(PROBLEM, algorithm, 5)
    assert evaluate(plan, island.chromosomes, island.fitness) == size
    return with_search(island, generation=7), plan


def test_new_individuals_are_evaluated_and_all_are_ranked() -> None:
    island, plan = begin()
    words, fitness = island.chromosomes[::-1].copy(), island.fitness[::-1].copy()
    fitness[[3, 11]] = np.nan
    assert evaluate(plan, words, fitness) == 2
    assert np.array_equal(fitness, island.fitness)
    assert np.array_equal(words, island.chromosomes)
    assert evaluate(plan, words, fitness) == 0


def test_known_individuals_count_and_are_not_simulated_again() -> None:
    island, plan = begin()
    known = make_known_fitness(1, 4)
    words, fitness = island.chromosomes.copy(), np.full(20, np.nan)
    assert evaluate_new_individuals(PROBLEM.evaluator, plan, known, words, fitness) == 20
    assert np.array_equal(fitness, island.fitness)
    known.fitness[:] += 1.0  # what no simulation gives
    others = np.concatenate([words[:5], words[:3] ^ np.uint32(1)])
    found = np.full(8, np.nan)
    assert evaluate_new_individuals(PROBLEM.evaluator, plan, known, others, found) == 8
    assert np.isin(fitness[:5] + 1.0, found).all()
    assert np.count_nonzero(found < fitness[:5].max() + 0.5) == 3


def test_a_chromosome_in_the_place_of_another_is_not_taken_for_it() -> None:
    known = make_known_fitness(1, 2)
    words = np.random.default_rng(1).integers(0, 2**24, (4000, 2), np.uint32)
    remember_fitness(known, words, np.arange(4000.0))
    recalled = np.full(4000, np.nan)
    recall_fitness(known, words, recalled)
    is_kept = np.isfinite(recalled)
    assert np.array_equal(recalled[is_kept], np.flatnonzero(is_kept))
    assert 900 < np.count_nonzero(is_kept) <= 1024


def test_an_island_evolves_the_same_with_a_memory() -> None:
    island, plan = begin()
    evolved, plain = evolve(PROBLEM.evaluator, plan, island, 60), begin()[0]
    rows = np.empty((61, COLUMN_VALUES + 4))
    arrays = plain.arrays
    run_generations(PROBLEM.evaluator, plan, 60, arrays, rows)
    assert np.array_equal(evolved.chromosomes, arrays.chromosomes)
    assert np.array_equal(evolved.fitness, arrays.fitness)
    assert evolved.evaluations == plain.evaluations == 60 * 10


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
    fields = ("confirmed_starts", "champion_discontinuities", "hop_count", "returned_hops")
    counts = dict.fromkeys(fields, 3)
    island = with_search(begin()[0], random_starts=5, champion_explained=True, **counts)
    reset_evidence(island.arrays.search, 0.5 * (1.0 - gain), 0.5)
    assert [int(island.search[name]) for name in fields] == [left] * 4
    assert island.search["champion_explained"] == (left > 0)
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
