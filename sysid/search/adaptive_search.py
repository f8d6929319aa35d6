"""The development operator of the improved algorithm: an adaptive sequence search.

Like the paper's sequence search it proposes neighbours of one individual, keeps the best and goes
on while it gains; but direction and size of its steps come from the output's sensitivities (one
Levenberg–Marquardt step a generation, several dampings tried at once).

A lag makes the fitness over a whole record a comb of local minima, the denser the longer the
record. Hence some developments begin with the first part of the record, where the comb is wide,
from the best of fresh individuals, and take in the rest by and by.
"""

import numpy as np

from sysid.core.jit import compiled
from sysid.core.types import FloatArray, IntArray, WordArray
from sysid.search.basin_hopping import COUNTED, SINGLE, UNCOUNTED, hop, is_behind, is_coloured
from sysid.search.levenberg_marquardt import damped_step, factored, spread
from sysid.search.operators import (
    DEVELOPMENT,
    Draws,
    below,
    coded,
    decoded,
    draws,
    normal,
    rank,
    unit,
)
from sysid.search.slopes import normal_equations, partial_fitness, slope_distance
from sysid.search.state import (
    CONFIRMED,
    DAMPING,
    DEVELOPMENTS,
    EVALUATIONS,
    FAILED,
    FRESH,
    GENERATION,
    GROWTH,
    HOP,
    HOPS,
    HORIZON,
    JUMPS,
    OLD,
    POINT,
    PROBES,
    REACHED,
    RETURNED,
    ROUGH,
    SAME,
    SEQUENCE,
    SETTLED,
    STAGNATION,
    STEP,
    TRIED,
    WARMED,
    Plan,
)
from sysid.simulation.evaluator import Evaluator, partial_predictions, population_fitness
from sysid.simulation.scaling import located

TRIALS = 3
FACTOR = 10.0  # between the dampings of two trials
FIRST_DAMPING = 1e-2
EARLY_DAMPING = 1.0  # far from a minimum: a full step would leave the box
EARLY_PLACES = 4  # of which an early fresh development begins with the best
LONGEST_GROWTH = 4.0  # doublings
N_GROWTHS = 3
MOST_STEPS = 12
ENOUGH = 1e-4  # relative gain of a step below which a full-record search ends
ENOUGH_PART = 1e-2
EARLY = 4  # developments that follow each other at once and are cheap, before the long ones
FAR = 1.1  # of the champion's fitness: above, a search ends at the first small gain
TURNS = 8  # developments after which the kinds repeat where the fitness jumps
SCATTERS, GROWS_BESIDE = 2, 4  # of four the one that spreads, of eight that grows from beside
SHORT_GROWTH = 1.5  # doublings: beside the champion the later signs of velocities are right


@compiled
def _fresh(
    evaluator: Evaluator, plan: Plan, shape: tuple[int, int], counters: IntArray, horizon: float
) -> FloatArray:
    """The best of a population of random places, judged by the record up to `horizon`."""
    places = np.empty(shape)
    for p in range(shape[0]):
        for d in range(shape[1]):
            draw = 1 + p * shape[1] + d
            word = draws(plan.seed, DEVELOPMENT, plan.island, counters[GENERATION], draw)
            places[p, d] = unit(word[0])
    counters[EVALUATIONS] += shape[0]
    predicted = partial_predictions(evaluator, located(evaluator, places), horizon)
    reached = partial_fitness(evaluator, plan, predicted, horizon)
    return np.asarray(places[np.argmin(reached[: shape[0]])])


@compiled
def scatters(counters: IntArray) -> bool:
    """Whether the last development spread the population around the champion."""
    return bool(counters[DEVELOPMENTS] % (TURNS // 2) == SCATTERS)


@compiled
def _is_lost(evaluator: Evaluator, plan: Plan, words: WordArray, counters: IntArray) -> bool:
    """Whether this is a hop's turn that is better spent far away. Not where a budget ends."""
    turn = counters[DEVELOPMENTS] % TURNS
    if turn % 2 == 0 or turn == 1 or counters[SETTLED] == 0 or counters[JUMPS] == 0:
        return False
    if counters[EVALUATIONS] + max(words.shape) + 2 > plan.evaluations:
        return False
    return is_coloured(evaluator, plan, words, counters)


@compiled
def _choose_beside(
    size: int, word: Draws, is_lost: bool, counters: IntArray, memory: FloatArray
) -> int:
    """The same where the fitness jumps: there most that is better lies beside the champion.

    Of eight developments four are hops, two of them of one parameter, two scatter, one grows from
    beside the champion (one parameter moved, too) and one from far away: in two of three from
    fresh individuals. Both grow so fast that it costs little. Where the champion's errors are no
    noise, three of the hops give their turns to fresh individuals.
    """
    turn = counters[DEVELOPMENTS] % TURNS
    memory[ROUGH] = 1.0
    if counters[SETTLED] == 0:  # the champion first, whole: what follows is drawn around it
        return 0
    if is_lost:
        memory[HORIZON] = 0.5 ** (LONGEST_GROWTH * (1.0 + unit(word[0])) / 2.0)
        memory[GROWTH] = 2.0
        return -1
    if turn % 2 == 1:
        counters[HOP] = COUNTED + SINGLE if turn % 4 == 3 else COUNTED
        return 0
    if scatters(counters):
        counters[PROBES] = size
        return 0
    memory[GROWTH] = 2.0
    if turn == GROWS_BESIDE:
        counters[HOP] = UNCOUNTED + SINGLE
        memory[HORIZON] = 0.5 ** (SHORT_GROWTH * unit(word[0]))
        return 0
    memory[HORIZON] = 0.5 ** (LONGEST_GROWTH * unit(word[0]))
    if below(word[1], 3) > 0:
        return -1
    memory[GROWTH] = 2.0 ** (0.5 ** (1 + below(word[3], N_GROWTHS)))
    counters[PROBES] = size // 3
    return below(word[2], size)


@compiled
def _choose(plan: Plan, size: int, is_lost: bool, counters: IntArray, memory: FloatArray) -> int:
    """What kind of development comes next; gives the individual it begins with, -1: a fresh one."""
    number = counters[DEVELOPMENTS]
    word = draws(plan.seed, DEVELOPMENT, plan.island, counters[GENERATION], 0)
    if counters[JUMPS] > 0 and number > EARLY:
        return _choose_beside(size, word, is_lost, counters, memory)
    grows = number == EARLY or (number > EARLY and number % 2 == 0)
    last_early = EARLY - counters[WARMED]  # behind an earlier result, the last of them is a hop
    settled = counters[SETTLED] == 1 and number > last_early
    chosen = below(word[1], 3 * size) - size if grows else 0
    memory[ROUGH] = counters[SETTLED] == 1 or grows
    if settled and (chosen >= size or number % 4 == 1 or number == EARLY):
        counters[HOP] = COUNTED
    elif grows:
        memory[HORIZON] = 0.5 ** (LONGEST_GROWTH * unit(word[0]))
        memory[GROWTH] = 2.0 if number == EARLY else 2.0 ** (0.5 ** (1 + below(word[3], N_GROWTHS)))
        counters[PROBES] = 0 if number == EARLY else size // 3  # in lanes that would idle
    elif settled:
        counters[PROBES] = size
    if 1 < number <= EARLY and not counters[HOP]:
        chosen = -1
    return chosen if chosen < size else 0


@compiled
def start_development(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray,
    counters: IntArray, memory: FloatArray,
) -> None:  # fmt: skip
    """Choose the point to begin with, and how much of the record counts at first."""
    counters[DEVELOPMENTS] += 1
    counters[SEQUENCE], counters[STEP], counters[FAILED] = 1, 0, 0
    counters[PROBES], counters[FRESH], counters[HOP] = 0, 0, 0
    early = counters[DEVELOPMENTS] <= EARLY
    memory[DAMPING] = EARLY_DAMPING if early else FIRST_DAMPING
    memory[HORIZON], memory[REACHED] = 1.0, np.inf
    is_lost = _is_lost(evaluator, plan, words, counters)
    chosen = _choose(plan, words.shape[0], is_lost, counters, memory)
    # The places of a fresh start, or the slopes of a hop, would pass the budget.
    if counters[EVALUATIONS] + max(words.shape) + 1 > plan.evaluations:
        chosen, counters[HOP] = max(chosen, 0), 0
    if chosen >= 0:
        memory[OLD] = np.inf if counters[HOP] else fitness[chosen]
        begin = decoded(words[chosen : chosen + 1], plan.bits)[0]
    else:
        memory[OLD], counters[FRESH] = np.inf, 1
        drawn = min(EARLY_PLACES, words.shape[0]) if early else words.shape[0]
        begin = _fresh(evaluator, plan, (drawn, words.shape[1]), counters, memory[HORIZON])
    for d in range(begin.size):
        memory[POINT + d] = begin[d]
    if counters[HOP]:
        hop(evaluator, plan, counters, memory)


@compiled
def _keep(words: WordArray, fitness: FloatArray, memory: FloatArray, word: WordArray,
          reached: float) -> None:  # fmt: skip
    """Put a developed individual in the place of its former self, else of the worst."""
    place = fitness.size - 1
    for p in range(fitness.size - 1, -1, -1):
        if fitness[p] == memory[OLD]:
            place = p
    if reached < fitness[place]:
        for d in range(word.size):
            words[place, d] = word[d]
        fitness[place] = reached
        rank(words, fitness)
        memory[OLD] = reached


@compiled
def _scatter(
    words: WordArray, fitness: FloatArray, counters: IntArray, proposals: WordArray,
    reached: FloatArray, best: int,
) -> None:  # fmt: skip
    """Let the probes take the places of all but the champion: the genetic search goes on there."""
    if counters[PROBES] < fitness.size:  # those of a growing record go on with each step
        return
    counters[PROBES], counters[STAGNATION] = 0, 0
    for p in range(1, min(fitness.size, reached.size - TRIALS + 1)):
        t = TRIALS + p - 1
        if t != best:
            fitness[p] = reached[t]
            for d in range(words.shape[1]):
                words[p, d] = proposals[t, d]
    rank(words, fitness)


@compiled
def _next_part(counters: IntArray, memory: FloatArray, fitness: FloatArray) -> None:
    """Take in more of the record; at its end, the development ends."""
    counters[FAILED] = 0
    memory[DAMPING] = FIRST_DAMPING
    if memory[HORIZON] < 1.0:
        memory[HORIZON] = min(memory[HORIZON] * memory[GROWTH], 1.0)
        return
    counters[SEQUENCE], counters[STEP] = 0, 0
    if memory[OLD] == fitness[0] and counters[DEVELOPMENTS] > 1:
        counters[SETTLED] = 1
    if counters[HOP] & COUNTED:
        counters[HOPS] += 1
        counters[RETURNED] += abs(memory[REACHED] - fitness[0]) <= fitness[0] * SAME
    if counters[FRESH]:
        counters[TRIED] += 1
        counters[CONFIRMED] += memory[REACHED] <= fitness[0] * (1.0 + SAME)


@compiled
def _end_part(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray, reached: float,
    counters: IntArray, memory: FloatArray,
) -> None:  # fmt: skip
    """Go on to the next part; a growth from far away, beside jumps, not if it is behind already."""
    races = memory[HORIZON] < 1.0 and counters[JUMPS] > 0 and counters[HOP] == 0
    if races and is_behind(evaluator, plan, words, counters, memory[HORIZON], reached):
        memory[HORIZON] = 1.0
    _next_part(counters, memory, fitness)


@compiled
def _trials(plan: Plan, counters: IntArray, memory: FloatArray, matrix: FloatArray,
            gradient: FloatArray, base: float) -> FloatArray:  # fmt: skip
    """Places to try: steps of several dampings, and probes spread as the estimate's covariance."""
    point = memory[POINT:]
    places = np.empty((TRIALS + counters[PROBES], point.size))
    for t in range(TRIALS):
        damping = memory[DAMPING] * FACTOR ** (t - 1)
        damped_step(matrix, gradient, point, damping, places[t])
    deviation, factor = np.empty(point.size), factored(matrix, gradient, point, 0.0)
    for t in range(TRIALS, places.shape[0]):
        for d in range(point.size):
            draw = 1 + t * point.size + d
            word = draws(plan.seed, DEVELOPMENT, plan.island, counters[GENERATION], draw)
            deviation[d] = base * 10.0 ** (1.5 - 2.5 * unit(word[2])) * normal(word)
        spread(factor, point, deviation, places[t])
    return places


@compiled
def adaptive_sequence(
    evaluator: Evaluator, plan: Plan, words: WordArray, fitness: FloatArray,
    counters: IntArray, memory: FloatArray,
) -> None:  # fmt: skip
    """One generation of the adaptive search: sensitivities, then several steps at once."""
    point, horizon = memory[POINT:], memory[HORIZON]
    counters[STEP] += 1
    counters[EVALUATIONS] += point.size + 1 + TRIALS + counters[PROBES]
    difference = slope_distance(plan, counters, memory)
    matrix, gradient, base = normal_equations(evaluator, plan, point, horizon, difference)
    proposals = coded(_trials(plan, counters, memory, matrix, gradient, base), plan.bits)
    places = decoded(proposals, plan.bits)
    if horizon < 1.0:
        predicted = partial_predictions(evaluator, located(evaluator, places), horizon)
        reached = partial_fitness(evaluator, plan, predicted, horizon)[: places.shape[0]]
    else:
        reached = population_fitness(evaluator, located(evaluator, places))
    best = np.argmin(reached)
    _scatter(words, fitness, counters, proposals, reached, int(best))
    strict = horizon == 1.0 and counters[DEVELOPMENTS] > 1 and reached[best] < FAR * fitness[0]
    enough = ENOUGH if strict else ENOUGH_PART
    if reached[best] < base:
        for d in range(point.size):
            point[d] = places[best, d]
        memory[DAMPING] *= FACTOR ** float(min(int(best), TRIALS) - 2)
        if horizon == 1.0:
            memory[REACHED] = reached[best]
            _keep(words, fitness, memory, proposals[best], reached[best])
        if reached[best] > base * (1.0 - enough) or counters[STEP] >= MOST_STEPS:
            _end_part(evaluator, plan, words, fitness, reached[best], counters, memory)
        return
    memory[DAMPING] *= FACTOR**TRIALS
    counters[FAILED] += 1
    if counters[FAILED] == 2 or not np.isfinite(base):
        _end_part(evaluator, plan, words, fitness, base, counters, memory)
