"""Generations of one island, all of them in one compiled call (Figures 4 to 6)."""

import numpy as np

from sysid.ga.chromosome import coded, decoded, located
from sysid.ga.development import adaptive_sequence, start_development
from sysid.ga.operators import cross, flip, rank, scheduled, stepped, two_of
from sysid.ga.random import CHILDREN, INITIAL, RESTART, STRATA, below, draws, unit
from sysid.ga.sequence import fixed_sequence
from sysid.ga.state import (
    AT_EVALUATIONS, AT_GENERATION, DEVELOPMENTS, EVALUATIONS, GENERATION, IMPROVED, PHASE, RMS,
    SEQUENCE, SETTLED, SIMPLE, STAGNATION, STEP, VALUES, Plan,
)  # fmt: skip
from sysid.kernels.calls import compiled
from sysid.kernels.evaluation import population_fitness
from sysid.kernels.evaluator import Evaluator
from sysid.types import FloatArray, IntArray, WordArray


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
            order[:] = np.arange(plan.total)
            for i in range(plan.total - 1, 0, -1):
                j = below(draws(plan.seed, STRATA, 0, d, i)[0], i + 1)
                order[i], order[j] = order[j], order[i]
        for p in range(individuals):
            places[p, d] = unit(draws(plan.seed, INITIAL, plan.island, d, p)[0])
            if plan.method >= IMPROVED:
                places[p, d] = (order[plan.first + p] + places[p, d]) / plan.total
    return places


@compiled
def _evaluate(evaluator: Evaluator, plan: Plan, words: WordArray, counters: IntArray) -> FloatArray:
    counters[EVALUATIONS] += words.shape[0]
    return population_fitness(evaluator, located(evaluator, decoded(words, plan.bits)))


@compiled
def simple_generation(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray, counters: IntArray
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
    fitness[plan.survivors :] = _evaluate(evaluator, plan, words[plan.survivors :], counters)
    rank(words, fitness)


@compiled
def _bred(plan: Plan, words: WordArray, generation: int) -> WordArray:
    """As many children as there are individuals, by crossover or by a difference of parents."""
    individuals, n = words.shape
    rate = scheduled(plan.starts, plan.rates, generation)
    places = decoded(words, plan.bits)
    children = np.empty_like(words)
    for p in range(individuals):
        word = draws(plan.seed, CHILDREN, plan.island, generation, 3 * p)
        more = draws(plan.seed, CHILDREN, plan.island, generation, 3 * p + 1)
        last = draws(plan.seed, CHILDREN, plan.island, generation, 3 * p + 2)
        first, second = two_of(word[0], word[1], plan.survivors)
        if more[0] & 1:
            length = n * plan.bits
            cross(
                children[p], words[first], words[second], 1 + below(word[2], length - 1), plan.bits
            )
            child = decoded(children[p : p + 1], plan.bits)
        else:
            third = below(more[1], individuals)
            child = places[p : p + 1] + (0.4 + 0.6 * unit(word[2])) * (
                places[first : first + 1] - places[third : third + 1]
            )
            child = np.abs(child)
            child = np.where(child > 1.0, np.maximum(2.0 - child, 0.0), child)
        if unit(word[3]) < rate:
            d = below(last[0], n)
            child[0, d] = stepped(child[0, d], last[1], last[2], plan.bits)
        children[p] = coded(child, plan.bits)[0]
    return children


@compiled
def improved_generation(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray, counters: IntArray
) -> None:
    """One population of children competes with the survivors."""
    children = _bred(plan, words, counters[GENERATION])
    reached = _evaluate(evaluator, plan, children, counters)
    all_words = np.concatenate((words, children))
    all_fitness = np.concatenate((fitness, reached))
    rank(all_words, all_fitness)
    words[:], fitness[:] = all_words[: fitness.size], all_fitness[: fitness.size]


@compiled
def restart(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray, counters: IntArray
) -> None:
    """All but the champion are drawn anew."""
    places = np.empty((fitness.size - 1, words.shape[1]))
    for p in range(places.shape[0]):
        for d in range(places.shape[1]):
            word = draws(
                plan.seed, RESTART, plan.island, counters[GENERATION], p * words.shape[1] + d
            )
            places[p, d] = unit(word[0])
    words[1:] = coded(places, plan.bits)
    fitness[1:] = _evaluate(evaluator, plan, words[1:], counters)
    rank(words, fitness)


@compiled
def _generation(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray,
    counters: IntArray, memory: FloatArray,
) -> None:  # fmt: skip
    if counters[SEQUENCE] and plan.method == IMPROVED:
        adaptive_sequence(evaluator, plan, words, fitness, counters, memory)
    elif counters[SEQUENCE]:
        fixed_sequence(evaluator, plan, words, fitness, counters)
    elif plan.method < IMPROVED:
        simple_generation(evaluator, plan, words, fitness, counters)
    elif counters[STAGNATION] >= plan.stagnation:
        counters[STAGNATION] = 0
        restart(evaluator, plan, words, fitness, counters)
    else:
        counters[STEP] += 1
        improved_generation(evaluator, plan, words, fitness, counters)


@compiled
def _turn(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray,
    counters: IntArray, memory: FloatArray,
) -> None:  # fmt: skip
    """GA ⇒ sequence: where the genetic search stands still, local search takes over."""
    if counters[SEQUENCE] or plan.method == SIMPLE:
        return
    if plan.method == IMPROVED:
        if counters[DEVELOPMENTS] == 0 or counters[STEP] >= max(1, plan.stagnation // 5):
            start_development(evaluator, plan, words, fitness, counters, memory)
    elif counters[STAGNATION] >= plan.stagnation:
        counters[SEQUENCE], counters[STAGNATION] = 1, 0


@compiled
def _note(evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray,
          counters: IntArray, phase: int, row: FloatArray) -> None:  # fmt: skip
    row[AT_GENERATION], row[AT_EVALUATIONS] = counters[GENERATION], counters[EVALUATIONS]
    row[RMS], row[PHASE] = fitness[0], phase
    row[VALUES:] = located(evaluator, decoded(words[:1], plan.bits))[0]


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
    if counters[EVALUATIONS] == 0:
        fitness[:] = _evaluate(evaluator, plan, words, counters)
        rank(words, fitness)
        _note(evaluator, plan, words, fitness, counters, 0, improvements[0])
        written = 1
    for _ in range(count):
        if counters[EVALUATIONS] >= plan.evaluations or fitness[0] <= plan.rms:
            break
        _turn(evaluator, plan, words, fitness, counters, memory)
        best, phase = fitness[0], 2 if counters[SEQUENCE] else 1
        _generation(evaluator, plan, words, fitness, counters, memory)
        counters[GENERATION] += 1
        counters[STAGNATION] += 1
        if fitness[0] < best:
            counters[STAGNATION] = 0
            if phase == 1:
                counters[SETTLED] = 0
            _note(evaluator, plan, words, fitness, counters, phase, improvements[written])
            written += 1
    return written
