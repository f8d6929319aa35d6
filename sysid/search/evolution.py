"""Generations of one island, all of them in one compiled call (Figures 4 to 6)."""

import numpy as np

from sysid.core.jit import compiled
from sysid.core.types import FloatArray, IntArray, WordArray
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
    CLIFFS,
    CONFIRMED,
    DEVELOPMENTS,
    EVALUATIONS,
    GENERATION,
    GENETIC,
    HOPS,
    IMPROVED,
    JUMPS,
    LOCAL,
    MIGRATION,
    PHASE,
    PROBES,
    RETURNED,
    RMS,
    SAME,
    SEQUENCE,
    SETTLED,
    SIMPLE,
    STAGNATION,
    START,
    STEP,
    VALUES,
    Plan,
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
def simple_generation(
    plan: Plan, words: WordArray, fitness: FloatArray, counters: IntArray
) -> None:
    """Figure 4: the survivors stay unchanged, their children take the places of the others."""
    generation, length = counters[GENERATION], words.shape[1] * plan.bits
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
def improved_generation(plan: Plan, words: WordArray, counters: IntArray) -> WordArray:
    """As many children as there are individuals, to compete with their parents."""
    children, places = np.empty_like(words), decoded(words, plan.bits)
    for p in range(words.shape[0]):
        _breed(plan, places, words, counters[GENERATION], p, children[p])
    return children


@compiled
def restart(plan: Plan, words: WordArray, fitness: FloatArray, counters: IntArray) -> None:
    """All but the champion are drawn anew."""
    largest, n = float((1 << plan.bits) - 1), words.shape[1]
    for p in range(1, fitness.size):
        fitness[p] = np.nan
        for d in range(n):
            word = draws(plan.seed, RESTART, plan.island, counters[GENERATION], p * n + d)
            words[p, d] = np.uint32(round(unit(word[0]) * largest))


@compiled
def compete(
    words: WordArray, fitness: FloatArray, children: WordArray, reached: FloatArray
) -> None:
    """Of parents and children the fittest stay; on equal fitness the parent does."""
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
def evaluate(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray, counters: IntArray
) -> None:
    """Simulate the individuals that are not evaluated yet (``nan``), and rank all."""
    waiting = np.flatnonzero(np.isnan(fitness))
    if waiting.size == 0:
        return
    chosen = np.empty((waiting.size, words.shape[1]), np.uint32)
    for i in range(waiting.size):
        for d in range(words.shape[1]):
            chosen[i, d] = words[waiting[i], d]
    reached = population_fitness(evaluator, located(evaluator, decoded(chosen, plan.bits)))
    counters[EVALUATIONS] += waiting.size
    for i in range(waiting.size):
        fitness[waiting[i]] = reached[i]
    rank(words, fitness)


@compiled
def _generation(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray,
    counters: IntArray, memory: FloatArray,
) -> None:  # fmt: skip
    if counters[SEQUENCE] and plan.method == IMPROVED:
        adaptive_sequence(evaluator, plan, words, fitness, counters, memory)
        # Two steps of a hop simulate no more than one generation of another kind.
        again = counters[JUMPS] > 0 and counters[SEQUENCE] and counters[PROBES] == 0
        step = words.shape[1] + 1 + TRIALS
        if again and counters[EVALUATIONS] + step <= plan.evaluations:
            adaptive_sequence(evaluator, plan, words, fitness, counters, memory)
    elif counters[SEQUENCE]:
        fixed_sequence(evaluator, plan, words, fitness, counters)
    elif plan.method < IMPROVED:
        simple_generation(plan, words, fitness, counters)
    elif counters[STAGNATION] >= plan.stagnation:
        counters[STAGNATION] = 0
        restart(plan, words, fitness, counters)
    else:
        counters[STEP] += 1
        children = improved_generation(plan, words, counters)
        reached = np.full(fitness.size, np.nan)
        evaluate(evaluator, plan, children, reached, counters)
        compete(words, fitness, children, reached)
    evaluate(evaluator, plan, words, fitness, counters)


@compiled
def _turn(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray,
    counters: IntArray, memory: FloatArray,
) -> None:  # fmt: skip
    """GA ⇒ sequence: where the genetic search stands still, local search takes over."""
    if counters[SEQUENCE] or plan.method == SIMPLE:
        return
    if plan.method == IMPROVED:
        early = counters[DEVELOPMENTS] < EARLY
        beside = counters[JUMPS] > 0 and not scatters(counters)
        if early or beside or counters[STEP] >= max(1, plan.stagnation // 10):
            start_development(evaluator, plan, words, fitness, counters, memory)
    elif counters[STAGNATION] >= plan.stagnation:
        counters[SEQUENCE], counters[STAGNATION] = 1, 0


@compiled
def _note(evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray,
          counters: IntArray, phase: int, row: FloatArray) -> None:  # fmt: skip
    row[AT_GENERATION], row[AT_EVALUATIONS] = counters[GENERATION], counters[EVALUATIONS]
    row[RMS], row[PHASE] = fitness[0], phase
    values = located(evaluator, decoded(words[:1], plan.bits))
    for d in range(words.shape[1]):
        row[VALUES + d] = values[0, d]


@compiled
def generations(
    evaluator: Evaluator, plan: Plan, count: int, words: WordArray, fitness: FloatArray,
    counters: IntArray, memory: FloatArray, improvements: FloatArray,
) -> int:  # fmt: skip
    """Evolve in place by `count` generations; gives the number of improvements written.

    An island that has used up its evaluations, or reached the target, rests. Before the first
    generation the initial population is evaluated.
    """
    written = 0
    if np.any(np.isnan(fitness)):  # the beginning, or migrants from an island of other bits
        # Not by the evaluations: finding the starts of a polynomial may have taken some.
        begins = np.all(np.isnan(fitness))
        best = np.inf if begins else np.nanmin(fitness)
        phase = START if begins else MIGRATION
        evaluate(evaluator, plan, words, fitness, counters)
        if fitness[0] < best:
            _note(evaluator, plan, words, fitness, counters, phase, improvements[0])
            written = 1
    for _ in range(count):
        if counters[EVALUATIONS] >= plan.evaluations or fitness[0] <= plan.rms:
            break
        _turn(evaluator, plan, words, fitness, counters, memory)
        best, phase = fitness[0], LOCAL if counters[SEQUENCE] else GENETIC
        _generation(evaluator, plan, words, fitness, counters, memory)
        counters[GENERATION] += 1
        counters[STAGNATION] += 1
        if fitness[0] < best:
            counters[STAGNATION] = 0
            if fitness[0] < best * (1.0 - SAME):
                counters[CONFIRMED], counters[CLIFFS] = 0, 0
                counters[HOPS], counters[RETURNED] = 0, 0
            if phase == GENETIC:
                counters[SETTLED] = 0
            _note(evaluator, plan, words, fitness, counters, phase, improvements[written])
            written += 1
    return written
