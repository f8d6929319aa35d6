"""Generations of one island, all of them in one compiled call (Figures 4 to 6)."""

import numpy as np

from sysid.core.jit import compiled
from sysid.core.types import FloatArray, WordArray
from sysid.search.adaptive_search import (
    EARLY,
    TRIALS,
    adaptive_sequence,
    scatters,
    start_development,
)
from sysid.search.operators import (
    CHILDREN,
    INITIAL,
    RESTART,
    STRATA,
    below,
    cross,
    decoded,
    draws,
    flip,
    rank,
    reflected,
    scheduled,
    stepped,
    two_of,
    unit,
)
from sysid.search.sequence_search import fixed_sequence
from sysid.search.state import (
    AT_EVALUATIONS,
    AT_GENERATION,
    GENETIC,
    IMPROVED,
    LOCAL,
    MIGRATION,
    PHASE,
    RMS,
    SAME,
    SIMPLE,
    START,
    VALUES,
    IslandArrays,
    Plan,
    SearchRecord,
)
from sysid.simulation.evaluator import Evaluator, population_fitness
from sysid.simulation.scaling import located


@compiled
def initial_places(plan: Plan, individuals: int, n: int) -> FloatArray:
    """Random places; for the improved method stratified over the whole archipelago.

    Stratified (Latin hypercube): each of the archipelago's `total` equal parts of every
    parameter's range holds one individual. All islands derive the same permutations.
    """
    places = np.empty((individuals, n))
    order = np.arange(plan.total)
    for d in range(n):
        if plan.method >= IMPROVED:
            for i in range(plan.total - 1, 0, -1):
                j = below(draws(plan.seed, STRATA, 0, d, i)[0], i + 1)
                order[i], order[j] = order[j], order[i]
        for p in range(individuals):
            places[p, d] = unit(draws(plan.seed, INITIAL, plan.island, d, p)[0])
            if plan.method >= IMPROVED:
                places[p, d] = (order[plan.first + p] + places[p, d]) / plan.total
    return places


@compiled
def simple_generation(plan: Plan, island: IslandArrays) -> None:
    """Figure 4: the survivors stay unchanged, their children take the places of the others."""
    words, fitness = island.chromosomes, island.fitness
    generation, length = island.search.generation, words.shape[1] * plan.bits
    rate = scheduled(plan.starts, plan.rates, generation)
    for p in range(plan.survivors, fitness.size):
        word = draws(plan.seed, CHILDREN, plan.island, generation, 2 * p)
        more = draws(plan.seed, CHILDREN, plan.island, generation, 2 * p + 1)
        first, second = two_of(word[0], word[1], plan.survivors)
        cross(words[p], words[first], words[second], 1 + below(word[2], length - 1), plan.bits)
        if unit(word[3]) < rate:
            flip(words[p], below(more[0], length), plan.bits)
        fitness[p] = np.nan


@compiled
def _breed(plan: Plan, places: FloatArray, parents: WordArray, generation: int, p: int,
           word: WordArray) -> None:  # fmt: skip
    """Write child `p`: by crossover, or by a difference of parents (differential evolution)."""
    bits, n = plan.bits, word.size
    drawn = draws(plan.seed, CHILDREN, plan.island, generation, 3 * p)
    more = draws(plan.seed, CHILDREN, plan.island, generation, 3 * p + 1)
    last = draws(plan.seed, CHILDREN, plan.island, generation, 3 * p + 2)
    first, second = two_of(drawn[0], drawn[1], plan.survivors)
    crossed, third = more[0] & 1, below(more[1], places.shape[0])
    cross(word, parents[first], parents[second], 1 + below(drawn[2], n * bits - 1), bits)
    rate = scheduled(plan.starts, plan.rates, generation)
    mutated = below(last[0], n) if unit(drawn[3]) < rate else -1
    for d in range(n):
        place = word[d] / float((1 << bits) - 1)
        if not crossed:
            length = 0.4 + 0.6 * unit(drawn[2])
            place = reflected(places[p, d] + length * (places[first, d] - places[third, d]))
        if d == mutated:
            place = stepped(place, last[1], last[2], bits)
        word[d] = np.uint32(round(place * float((1 << bits) - 1)))


@compiled
def improved_generation(plan: Plan, island: IslandArrays) -> WordArray:
    """As many children as there are individuals, to compete with their parents."""
    parents = island.chromosomes
    children, places = np.empty_like(parents), decoded(parents, plan.bits)
    for p in range(parents.shape[0]):
        _breed(plan, places, parents, island.search.generation, p, children[p])
    return children


@compiled
def restart(plan: Plan, island: IslandArrays) -> None:
    """All but the champion are drawn anew."""
    words, fitness = island.chromosomes, island.fitness
    largest, n = float((1 << plan.bits) - 1), words.shape[1]
    for p in range(1, fitness.size):
        fitness[p] = np.nan
        for d in range(n):
            word = draws(plan.seed, RESTART, plan.island, island.search.generation, p * n + d)
            words[p, d] = np.uint32(round(unit(word[0]) * largest))


@compiled
def compete(island: IslandArrays, children: WordArray, reached: FloatArray) -> None:
    """Of parents and children the fittest stay; on equal fitness the parent does."""
    words, fitness = island.chromosomes, island.fitness
    size, n = words.shape
    everyone, values = np.empty((2 * size, n), np.uint32), np.empty(2 * size)
    for p in range(size):
        values[p], values[size + p] = fitness[p], reached[p]
        for d in range(n):
            everyone[p, d], everyone[size + p, d] = words[p, d], children[p, d]
    rank(everyone, values)
    for p in range(size):
        fitness[p] = values[p]
        for d in range(n):
            words[p, d] = everyone[p, d]


@compiled
def evaluate(evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray) -> int:
    """Simulate the individuals that are not evaluated yet (``nan``), and rank all.

    Gives the number of simulations.
    """
    waiting = np.flatnonzero(np.isnan(fitness))
    if waiting.size == 0:
        return 0
    chosen = np.empty((waiting.size, words.shape[1]), np.uint32)
    for i in range(waiting.size):
        for d in range(words.shape[1]):
            chosen[i, d] = words[waiting[i], d]
    reached = population_fitness(evaluator, located(evaluator, decoded(chosen, plan.bits)))
    for i in range(waiting.size):
        fitness[waiting[i]] = reached[i]
    rank(words, fitness)
    return waiting.size


@compiled
def _generation(evaluator: Evaluator, plan: Plan, island: IslandArrays) -> None:
    chromosomes, fitness, search = island.chromosomes, island.fitness, island.search
    if search.in_sequence_search and plan.method == IMPROVED:
        adaptive_sequence(evaluator, plan, island)
        # Two steps of a hop simulate no more than one generation of another kind.
        goes_on = search.in_sequence_search and search.probe_count == 0
        again = goes_on and search.fitness_discontinuities > 0
        step = chromosomes.shape[1] + 1 + TRIALS
        if again and search.evaluations + step <= plan.evaluations:
            adaptive_sequence(evaluator, plan, island)
    elif search.in_sequence_search:
        fixed_sequence(evaluator, plan, island)
    elif plan.method < IMPROVED:
        simple_generation(plan, island)
    elif search.stagnation >= plan.stagnation:
        search.stagnation = 0
        restart(plan, island)
    else:
        search.step_count += 1
        children = improved_generation(plan, island)
        reached = np.full(fitness.size, np.nan)
        search.evaluations += evaluate(evaluator, plan, children, reached)
        compete(island, children, reached)
    search.evaluations += evaluate(evaluator, plan, chromosomes, fitness)


@compiled
def _turn(evaluator: Evaluator, plan: Plan, island: IslandArrays) -> None:
    """GA ⇒ sequence: where the genetic search stands still, local search takes over."""
    search = island.search
    if search.in_sequence_search or plan.method == SIMPLE:
        return
    if plan.method == IMPROVED:
        early = search.local_searches < EARLY
        beside = search.fitness_discontinuities > 0 and not scatters(search)
        if early or beside or search.step_count >= max(1, plan.stagnation // 10):
            start_development(evaluator, plan, island)
    elif search.stagnation >= plan.stagnation:
        search.in_sequence_search, search.stagnation = 1, 0


@compiled
def _note(
    evaluator: Evaluator, plan: Plan, island: IslandArrays, phase: int, row: FloatArray
) -> None:
    values = located(evaluator, decoded(island.chromosomes[:1], plan.bits))[0]
    write_improvement(island.search, island.fitness[0], phase, values, row)


@compiled
def write_improvement(
    search: SearchRecord, rms: float, phase: int, values: FloatArray, row: FloatArray
) -> None:
    """Write the row of a better champion with these physical values (D,)."""
    row[AT_GENERATION], row[AT_EVALUATIONS] = search.generation, search.evaluations
    row[RMS], row[PHASE] = rms, phase
    for d in range(values.size):
        row[VALUES + d] = values[d]


@compiled
def reset_evidence(search: SearchRecord, rms: float, before: float) -> None:
    """Forget what spoke for the champion before, where the new one is another optimum."""
    if rms < before * (1.0 - SAME):
        search.confirmed_starts, search.champion_discontinuities = 0, 0
        search.hop_count, search.returned_hops = 0, 0


@compiled
def is_done(plan: Plan, search: SearchRecord, rms: float) -> bool:
    """Whether an island has used up its evaluations or reached the target RMS."""
    return bool(search.evaluations >= plan.evaluations or rms <= plan.rms)


@compiled
def generations(
    evaluator: Evaluator, plan: Plan, count: int, island: IslandArrays, improvements: FloatArray
) -> int:
    """Evolve in place by `count` generations; gives the number of improvements written.

    An island that has used up its evaluations, or reached the target, rests. Before the first
    generation the initial population is evaluated.
    """
    fitness, search, written = island.fitness, island.search, 0
    if np.any(np.isnan(fitness)):  # the beginning, or migrants from an island of other bits
        # Not by the evaluations: finding the starts of a polynomial may have taken some.
        begins = np.all(np.isnan(fitness))
        best = np.inf if begins else np.nanmin(fitness)
        phase = START if begins else MIGRATION
        search.evaluations += evaluate(evaluator, plan, island.chromosomes, fitness)
        if fitness[0] < best:
            _note(evaluator, plan, island, phase, improvements[0])
            written = 1
    for _ in range(count):
        if is_done(plan, search, fitness[0]):
            break
        _turn(evaluator, plan, island)
        best, phase = fitness[0], LOCAL if search.in_sequence_search else GENETIC
        _generation(evaluator, plan, island)
        search.generation += 1
        search.stagnation += 1
        if fitness[0] < best:
            search.stagnation = 0
            reset_evidence(search, fitness[0], best)
            if phase == GENETIC:
                search.champion_converged = 0
            _note(evaluator, plan, island, phase, improvements[written])
            written += 1
    return written
