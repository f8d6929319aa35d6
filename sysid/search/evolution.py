"""Generations of one island, evolved in one compiled call (Figures 4 to 6)."""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray, IntArray, WordArray
from sysid.kernels.borrowing import compile_borrowing
from sysid.search.adaptive_search import N_TRIALS, run_adaptive_sequence, start_local_search
from sysid.search.known_fitness import recall_fitness, remember_fitness
from sysid.search.operators import (
    USE_CHILDREN,
    USE_INITIAL,
    USE_RESTART,
    USE_STRATA,
    cross_over,
    decode,
    draw_pair,
    draw_words,
    flip_bit,
    get_mutation_rate,
    mutate_by_step,
    reflect_at_bounds,
    sort_population,
    to_integer,
    to_uniform,
)
from sysid.search.schedule import EARLY_SEARCHES, has_scattered
from sysid.search.sequence_search import run_fixed_sequence
from sysid.search.state import (
    COLUMN_EVALUATIONS,
    COLUMN_GENERATION,
    COLUMN_PHASE,
    COLUMN_RMS,
    COLUMN_VALUES,
    METHOD_IMPROVED,
    METHOD_SIMPLE,
    PHASE_GENETIC,
    PHASE_LOCAL,
    PHASE_MIGRATION,
    PHASE_START,
    SAME_OPTIMUM,
    IslandArrays,
    IslandPlan,
    KnownFitness,
    SearchRecord,
)
from sysid.simulation.evaluator import Evaluator, evaluate_population
from sysid.simulation.scaling import from_unit


@jit_compile
def draw_initial_points(
    seed: int, population: int, methods: IntArray, sizes: IntArray, n: int
) -> FloatArray:
    """Draw random points (P, D) of all islands; the improved method stratifies them.

    Stratified (Latin hypercube): every parameter's range has as many equal parts as the
    archipelago has individuals, and each part holds one.

    Parameters
    ----------
    population : int
        Individuals of the archipelago, P.
    methods, sizes : IntArray, shape (I,)
        Method and number of individuals of each island.
    """
    points, order = np.empty((population, n)), np.arange(population)
    for d in range(n):
        if methods.max() >= METHOD_IMPROVED:
            for i in range(population - 1, 0, -1):
                j = to_integer(draw_words(seed, USE_STRATA, 0, d, i)[0], i + 1)
                order[i], order[j] = order[j], order[i]
        first = 0
        for island in range(sizes.size):
            for p in range(sizes[island]):
                position = to_uniform(draw_words(seed, USE_INITIAL, island, d, p)[0])
                if methods[island] >= METHOD_IMPROVED:
                    position = (order[first + p] + position) / population
                points[first + p, d] = position
            first += sizes[island]
    return points


@compile_borrowing
def breed_simple_children(plan: IslandPlan, island: IslandArrays) -> None:
    """Breed as in Figure 4: the survivors stay, their children replace the others."""
    chromosomes, fitness = island.chromosomes, island.fitness
    generation, length = island.search.generation, chromosomes.shape[1] * plan.bits
    rate = get_mutation_rate(plan.mutation_starts, plan.mutation_rates, generation)
    for p in range(plan.survivors, fitness.size):
        word = draw_words(plan.seed, USE_CHILDREN, plan.island, generation, 2 * p)
        first, second = draw_pair(word[0], word[1], plan.survivors)
        cross_over(
            chromosomes[p],
            chromosomes[first],
            chromosomes[second],
            1 + to_integer(word[2], length - 1),
            plan.bits,
        )
        if to_uniform(word[3]) < rate:
            next_word = draw_words(plan.seed, USE_CHILDREN, plan.island, generation, 2 * p + 1)
            flip_bit(chromosomes[p], to_integer(next_word[0], length), plan.bits)
        fitness[p] = np.nan


@compile_borrowing
def _breed_child(
    plan: IslandPlan,
    points: FloatArray,
    parents: WordArray,
    generation: int,
    p: int,
    word: WordArray,
) -> None:
    """Write child `p` by crossover or by differential evolution."""
    bits, n = plan.bits, word.size
    first_word = draw_words(plan.seed, USE_CHILDREN, plan.island, generation, 3 * p)
    next_word = draw_words(plan.seed, USE_CHILDREN, plan.island, generation, 3 * p + 1)
    first, second = draw_pair(first_word[0], first_word[1], plan.survivors)
    crossed, third = next_word[0] & 1, to_integer(next_word[1], points.shape[0])
    cross_over(
        word, parents[first], parents[second], 1 + to_integer(first_word[2], n * bits - 1), bits
    )
    rate = get_mutation_rate(plan.mutation_starts, plan.mutation_rates, generation)
    mutated, last_word = -1, first_word
    if to_uniform(first_word[3]) < rate:
        last_word = draw_words(plan.seed, USE_CHILDREN, plan.island, generation, 3 * p + 2)
        mutated = to_integer(last_word[0], n)
    for d in range(n):
        position = word[d] / float((1 << bits) - 1)
        if not crossed:
            length = 0.4 + 0.6 * to_uniform(first_word[2])
            position = reflect_at_bounds(
                points[p, d] + length * (points[first, d] - points[third, d])
            )
        if d == mutated:
            position = mutate_by_step(position, last_word[1], last_word[2], bits)
        word[d] = np.uint32(round(position * float((1 << bits) - 1)))


@compile_borrowing
def breed_improved_children(plan: IslandPlan, island: IslandArrays) -> WordArray:
    """Breed as many children as there are individuals; they compete with their parents."""
    parents = island.chromosomes
    children, points = np.empty_like(parents), decode(parents, plan.bits)
    for p in range(parents.shape[0]):
        _breed_child(plan, points, parents, island.search.generation, p, children[p])
    return children


@compile_borrowing
def redraw_population(plan: IslandPlan, island: IslandArrays) -> None:
    """Draw all individuals but the champion again."""
    chromosomes, fitness = island.chromosomes, island.fitness
    largest, n = float((1 << plan.bits) - 1), chromosomes.shape[1]
    for p in range(1, fitness.size):
        fitness[p] = np.nan
        for d in range(n):
            word = draw_words(
                plan.seed, USE_RESTART, plan.island, island.search.generation, p * n + d
            )
            chromosomes[p, d] = np.uint32(round(to_uniform(word[0]) * largest))


@compile_borrowing
def select_fittest(island: IslandArrays, children: WordArray, reached: FloatArray) -> None:
    """Select the fittest of parents and children; on equal fitness the parent stays."""
    chromosomes, fitness = island.chromosomes, island.fitness
    size, n = chromosomes.shape
    candidates, values = np.empty((2 * size, n), np.uint32), np.empty(2 * size)
    for p in range(size):
        values[p], values[size + p] = fitness[p], reached[p]
        for d in range(n):
            candidates[p, d], candidates[size + p, d] = chromosomes[p, d], children[p, d]
    sort_population(candidates, values)
    for p in range(size):
        fitness[p] = values[p]
        for d in range(n):
            chromosomes[p, d] = candidates[p, d]


@jit_compile
def repeats_chromosomes(method: int) -> bool:
    """Return whether a method breeds the same chromosomes often: those of the paper do."""
    return bool(method < METHOD_IMPROVED)


@compile_borrowing
def evaluate_new_individuals(
    evaluator: Evaluator,
    plan: IslandPlan,
    known: KnownFitness,
    chromosomes: WordArray,
    fitness: FloatArray,
) -> int:
    """Evaluate the individuals that are not evaluated yet (``nan``), and sort all.

    Those that are known are not simulated again. They count in the returned number of evaluations.
    """
    evaluated = 0
    for p in range(fitness.size):
        evaluated += np.isnan(fitness[p])
    if evaluated == 0:
        return 0
    recall_fitness(known, chromosomes, fitness)
    new = np.flatnonzero(np.isnan(fitness))
    if new.size:
        chosen = np.empty((new.size, chromosomes.shape[1]), np.uint32)
        for i in range(new.size):
            for d in range(chromosomes.shape[1]):
                chosen[i, d] = chromosomes[new[i], d]
        reached = evaluate_population(evaluator, from_unit(evaluator, decode(chosen, plan.bits)))
        for i in range(new.size):
            fitness[new[i]] = reached[i]
        remember_fitness(known, chosen, reached)
    sort_population(chromosomes, fitness)
    return evaluated


@compile_borrowing
def _run_generation(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> None:
    chromosomes, fitness, search = island.chromosomes, island.fitness, island.search
    if search.in_sequence_search and plan.method == METHOD_IMPROVED:
        run_adaptive_sequence(evaluator, plan, island)
        # Two steps of a hop take no more simulations than one generation of another kind.
        continues = search.in_sequence_search and search.probe_count == 0
        takes_second_step = continues and search.fitness_discontinuities > 0
        step = chromosomes.shape[1] + 1 + N_TRIALS
        if takes_second_step and search.evaluations + step <= plan.most_evaluations:
            run_adaptive_sequence(evaluator, plan, island)
    elif search.in_sequence_search:
        run_fixed_sequence(evaluator, plan, island)
    elif plan.method < METHOD_IMPROVED:
        breed_simple_children(plan, island)
    elif search.stagnation >= plan.stagnation:
        search.stagnation = 0
        redraw_population(plan, island)
    else:
        search.step_count += 1
        children = breed_improved_children(plan, island)
        reached = np.full(fitness.size, np.nan)
        search.evaluations += evaluate_new_individuals(
            evaluator, plan, island.known, children, reached
        )
        select_fittest(island, children, reached)
    search.evaluations += evaluate_new_individuals(
        evaluator, plan, island.known, chromosomes, fitness
    )


@compile_borrowing
def _switch_phase(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> None:
    """Switch to the local search when the genetic search stagnates."""
    search = island.search
    if search.in_sequence_search or plan.method == METHOD_SIMPLE:
        return
    if plan.method == METHOD_IMPROVED:
        is_early = search.local_searches < EARLY_SEARCHES
        hops_next = search.fitness_discontinuities > 0 and not has_scattered(search)
        if is_early or hops_next or search.step_count >= max(1, plan.stagnation // 10):
            start_local_search(evaluator, plan, island)
    elif search.stagnation >= plan.stagnation:
        search.in_sequence_search, search.stagnation = True, 0


@jit_compile
def _record_improvement(
    evaluator: Evaluator, plan: IslandPlan, island: IslandArrays, phase: int, row: FloatArray
) -> None:
    values = from_unit(evaluator, decode(island.chromosomes[:1], plan.bits))[0]
    write_improvement(island.search, island.fitness[0], phase, values, row)


@jit_compile
def write_improvement(
    search: SearchRecord, rms: float, phase: int, values: FloatArray, row: FloatArray
) -> None:
    """Write the row of a better champion with physical values (D,)."""
    row[COLUMN_GENERATION], row[COLUMN_EVALUATIONS] = search.generation, search.evaluations
    row[COLUMN_RMS], row[COLUMN_PHASE] = rms, phase
    for d in range(values.size):
        row[COLUMN_VALUES + d] = values[d]


@jit_compile
def reset_evidence(search: SearchRecord, rms: float, before: float) -> None:
    """Reset the evidence for the champion if the new one is another optimum."""
    if rms < before * (1.0 - SAME_OPTIMUM):
        search.confirmed_starts, search.champion_discontinuities = 0, 0
        search.hop_count, search.returned_hops, search.champion_explained = 0, 0, False


@jit_compile
def is_done(plan: IslandPlan, search: SearchRecord, rms: float) -> bool:
    """Return whether an island has used up its evaluations or reached the target RMS."""
    return bool(search.evaluations >= plan.most_evaluations or rms <= plan.target_rms)


@compile_borrowing
def run_generations(
    evaluator: Evaluator,
    plan: IslandPlan,
    count: int,
    island: IslandArrays,
    improvements: FloatArray,
) -> int:
    """Evolve in place by `count` generations; return the number of improvements written.

    An island that has used up its evaluations or reached the target rests. The initial population
    is evaluated before the first generation.
    """
    fitness, search, written = island.fitness, island.search, 0
    if np.any(np.isnan(fitness)):  # first generation, or migrants from an island of other bits
        # The count of evaluations does not tell: the starts of a polynomial may have taken some.
        begins = np.all(np.isnan(fitness))
        best = np.inf if begins else np.nanmin(fitness)
        phase = PHASE_START if begins else PHASE_MIGRATION
        search.evaluations += evaluate_new_individuals(
            evaluator, plan, island.known, island.chromosomes, fitness
        )
        if fitness[0] < best:
            _record_improvement(evaluator, plan, island, phase, improvements[0])
            written = 1
    for _ in range(count):
        if is_done(plan, search, fitness[0]):
            break
        _switch_phase(evaluator, plan, island)
        best, phase = fitness[0], PHASE_LOCAL if search.in_sequence_search else PHASE_GENETIC
        _run_generation(evaluator, plan, island)
        search.generation += 1
        search.stagnation += 1
        if fitness[0] < best:
            search.stagnation = 0
            reset_evidence(search, fitness[0], best)
            if phase == PHASE_GENETIC:
                search.champion_converged = False
            _record_improvement(evaluator, plan, island, phase, improvements[written])
            written += 1
    return written
