"""Laws of a run: it does not matter where it is cut, nor who evolves which island."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.dispatch.checkpoints import pack_state, unpack_state
from sysid.core.settings import (
    SEARCH_METHODS,
    GeneticAlgorithm,
    IslandChange,
    Migration,
    SearchMethod,
    SequenceSearch,
    Stop,
)
from sysid.identification import run
from sysid.identification.run import (
    advance_island,
    advance_run,
    begin_run,
    exchange_migrants,
    find_next_border,
    is_finished,
)
from sysid.islands.archipelago import create_islands, make_plans
from sysid.islands.evolve import is_island_resting
from sysid.islands.run_state import RunState
from sysid.islands.stopping import count_restarts
from sysid.search.island import Island, evolve
from sysid.search.operators import decode
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit
from tests.support.library.search_problems import bits, example
from tests.support.profiles import scale_examples

METHOD = st.sampled_from(SEARCH_METHODS)


def small(method: SearchMethod = "improved", **changes: object) -> GeneticAlgorithm:
    values: dict[str, object] = {
        "method": method,
        "population": 24,
        "generations": 40,
        "islands": 3,
        "stagnation": 5,
        "migration": Migration(every=10),
    }
    return GeneticAlgorithm(**(values | changes))  # type: ignore[arg-type]


def build_problem() -> Problem:
    return example(n=80)


def alone(method: SearchMethod, seed: int, **changes: object) -> tuple[Island, object]:
    algorithm = small(method, **changes)
    return create_islands(build_problem(), algorithm, seed)[1], make_plans(
        build_problem(), algorithm, seed
    )[1]


@settings(max_examples=scale_examples(25))
@given(METHOD, st.integers(0, 2**63 - 1), st.integers(0, 30), st.integers(0, 30))
def test_evolving_twice_is_evolving_the_sum(
    method: SearchMethod, seed: int, first: int, second: int
) -> None:
    island, plan = alone(method, seed)
    evaluator = build_problem().evaluator
    at_once = evolve(evaluator, plan, island, first + second)
    in_two = evolve(evaluator, plan, evolve(evaluator, plan, island, first), second)
    assert bits(at_once) == bits(in_two)


@pytest.mark.parametrize("kind", ["paper", "adaptive"])
def test_a_sequence_search_can_be_cut_anywhere(kind: str) -> None:
    island, plan = alone("improved", 5, stagnation=3, sequence=SequenceSearch(kind))  # type: ignore[arg-type]
    evaluator = build_problem().evaluator
    stepwise = island
    for _ in range(150):
        stepwise = evolve(evaluator, plan, stepwise, 1)
    assert bits(stepwise) == bits(evolve(evaluator, plan, island, 150))
    assert "sequence" in {step.phase for step in stepwise.history}


@settings(max_examples=scale_examples(25))
@given(METHOD, st.integers(0, 1000), st.integers(0, 60))
def test_the_fittest_survives_a_step(method: SearchMethod, seed: int, age: int) -> None:
    island, plan = alone(method, seed)
    before = evolve(build_problem().evaluator, plan, island, age)
    after = evolve(build_problem().evaluator, plan, before, 1)
    there = np.any(np.all(after.chromosomes == before.chromosomes[0], axis=1))
    assert there or after.fitness[0] < before.fitness[0]
    assert after.fitness[0] <= before.fitness[0]


@settings(max_examples=scale_examples(20))
@given(METHOD, st.integers(0, 1000), st.integers(0, 60))
def test_fitness_is_that_of_the_chromosome_and_ascends(
    method: SearchMethod, seed: int, age: int
) -> None:
    island, plan = alone(method, seed)
    after = evolve(build_problem().evaluator, plan, island, age)
    theta = from_unit(build_problem().evaluator, decode(after.chromosomes, plan.bits))  # type: ignore[attr-defined]
    assert np.array_equal(after.fitness, build_problem().evaluate_fitness(theta))
    assert np.all(np.diff(after.fitness) >= 0)
    assert after.history[-1].rms == after.fitness[0]
    assert after.history[-1].parameters == tuple(theta[0])


@pytest.mark.parametrize(("seconds", "most"), [(0.0, 1), (1e-9, 7)])
@pytest.mark.parametrize("method", SEARCH_METHODS)
def test_a_run_cut_after_every_call_gives_the_same_bits(
    method: SearchMethod, seconds: float, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm = small(method)
    whole = advance_run(build_problem(), algorithm, begin_run(build_problem(), algorithm, 3))
    monkeypatch.setattr(run, "FIRST_CALL_STEPS", most * 8 * build_problem().n_steps)
    cut, calls = begin_run(build_problem(), algorithm, 3), 0
    while not is_finished(algorithm, cut):
        cut = unpack_state(pack_state(advance_run(build_problem(), algorithm, cut, seconds)))
        calls += 1
    assert bits(cut) == bits(whole)
    assert calls >= sum(island.generation for island in cut.islands) / most


DIFFERENT = (
    IslandChange(mutation=((0, 0.9), (3, 0.1), (20, 0.5))),
    IslandChange(method="simple", bits=12),
    IslandChange(bits=20, mutation=((0, 0.3),)),
)


@pytest.mark.parametrize(
    "algorithm",
    [
        small(stop=Stop(evaluations=900)),
        small(stop=Stop(rms=0.03)),
        small(population=26, migration=Migration(every=10, topology="fully-connected")),
        small("simple", generations=230, migration=Migration(every=1)),  # many borders in a call
        small(islands=DIFFERENT, migration=Migration(every=5, topology="ring", migrants=50)),
    ],
    ids=["evaluations", "target", "uneven", "borders", "different"],
)
def test_islands_evolved_apart_and_exchanged_are_the_plain_loop(
    algorithm: GeneticAlgorithm,
) -> None:
    whole = advance_run(build_problem(), algorithm, begin_run(build_problem(), algorithm, 9))
    state = begin_run(build_problem(), algorithm, 9)
    while not is_finished(algorithm, state):
        target = find_next_border(algorithm, state)
        moved = [
            advance_island(build_problem(), algorithm, island, target - island.generation)
            for island in reversed(state.islands)
        ]
        state = exchange_migrants(algorithm, state, moved[::-1])
    assert bits(state) == bits(whole)


def test_the_same_seed_repeats_and_another_does_not() -> None:
    def search_with(seed: int) -> RunState:
        return advance_run(build_problem(), small(), begin_run(build_problem(), small(), seed))

    assert bits(search_with(1)) == bits(search_with(1))
    assert (
        search_with(1).islands[0].chromosomes.tobytes()
        != search_with(2).islands[0].chromosomes.tobytes()
    )


def test_islands_of_one_seed_begin_apart() -> None:
    islands = begin_run(build_problem(), small("simple"), 1).islands
    words = np.concatenate([island.chromosomes for island in islands])
    assert np.unique(words, axis=0).shape == words.shape


def test_first_individuals_of_the_improved_method_are_stratified() -> None:
    islands = begin_run(build_problem(), small(), 1).islands
    places = np.sort(np.concatenate([i.chromosomes for i in islands]) / (2**24 - 1), axis=0)
    strata = np.arange(24)[:, None]
    assert np.all((places * 24 >= strata - 1e-5) & (places * 24 <= strata + 1 + 1e-5))


def test_a_warm_start_begins_at_the_given_values() -> None:
    warm = {"c": 0.31, "L": 0.42, "b": 3.0, "a": 2.0, "unknown": 1.0}
    state = begin_run(build_problem(), small(), 1, warm)
    one = advance_island(build_problem(), small(), state.islands[2], 0)
    theta = np.array([[warm[p.name] for p in build_problem().free_parameters]])
    assert one.champion_rms <= build_problem().evaluate_fitness(theta)[0] * (1 + 1e-5)


def test_evaluations_end_a_run_and_all_are_counted() -> None:
    algorithm = small(generations=10**6, stop=Stop(evaluations=2000))
    state = advance_run(build_problem(), algorithm, begin_run(build_problem(), algorithm, 1))
    assert 1700 <= state.evaluations <= 2000
    assert state.evaluations == sum(island.evaluations for island in state.islands)


def test_a_simple_generation_simulates_its_children_only() -> None:
    algorithm = GeneticAlgorithm(method="simple", generations=10)
    state = advance_run(build_problem(), algorithm, begin_run(build_problem(), algorithm, 1))
    assert state.evaluations == 50 + 10 * 25


def test_the_target_rms_ends_a_run() -> None:
    algorithm = small(generations=10**6, stop=Stop(rms=0.05))
    state = advance_run(build_problem(), algorithm, begin_run(build_problem(), algorithm, 1))
    assert state.rms <= 0.05
    plan = make_plans(build_problem(), algorithm, 1)
    assert any(
        is_island_resting(p, i.arrays, i.champion_rms)
        for p, i in zip(plan, state.islands, strict=True)
    )


def test_seconds_end_a_run() -> None:
    algorithm = small(generations=10**9, stop=Stop(seconds=0.05, settled=None))
    state = advance_run(build_problem(), algorithm, begin_run(build_problem(), algorithm, 1))
    assert is_finished(algorithm, state)
    assert state.seconds >= 0.05


def test_should_stop_is_heard_between_calls() -> None:
    algorithm = small(generations=10**9, stop=Stop(settled=None))
    answers = iter([False, False, False, True])
    state = begin_run(build_problem(), algorithm, 1)
    state = advance_run(build_problem(), algorithm, state, None, lambda: next(answers))
    assert not is_finished(algorithm, state)
    assert state.evaluations > 0


def test_islands_may_differ_in_method_and_bits() -> None:
    changes = (IslandChange(), IslandChange(method="simple", bits=12), IslandChange(bits=20))
    algorithm = small(islands=changes)
    state = advance_run(build_problem(), algorithm, begin_run(build_problem(), algorithm, 1))
    assert int(state.islands[1].chromosomes.max()) < 2**12
    assert state.migrations
    cut = begin_run(build_problem(), algorithm, 1)
    while not is_finished(algorithm, cut):
        cut = advance_run(build_problem(), algorithm, cut, 0.0)
    assert bits(cut) == bits(state)


def test_a_run_settles_where_searches_from_anywhere_agree() -> None:
    once = GeneticAlgorithm(stop=Stop(settled=3))
    settled = advance_run(example(), once, begin_run(example(), once, 1))
    assert count_restarts(*settled.champions_and_counters).confirmed >= 3
    assert (
        3 * count_restarts(*settled.champions_and_counters).confirmed
        >= 2 * count_restarts(*settled.champions_and_counters).independent
    )
    assert settled.generation < once.generations
    twice = GeneticAlgorithm(
        stop=Stop(settled=2 * count_restarts(*settled.champions_and_counters).confirmed)
    )
    longer = advance_run(example(), twice, begin_run(example(), twice, 1))
    assert longer.generation > settled.generation
    assert longer.rms == pytest.approx(settled.rms, rel=1e-4)


@pytest.mark.parametrize("method", ["simple", "improved-paper"])
def test_the_papers_methods_and_those_told_so_never_settle(method: SearchMethod) -> None:
    algorithm = small(method, generations=60, stop=Stop(settled=1))
    state = advance_run(build_problem(), algorithm, begin_run(build_problem(), algorithm, 1))
    assert (state.generation, count_restarts(*state.champions_and_counters).independent) == (60, 0)
    never = small(generations=60, stop=Stop(settled=None))
    assert (
        advance_run(build_problem(), never, begin_run(build_problem(), never, 1)).generation == 60
    )
