"""The sequence search as printed in the paper (Eq. 11, 12): fixed steps around the champion.

Every proposal moves a subset of the parameters by ±β. A generation evaluates one population of
proposals, keeps the best, and the search goes on while it gains.
"""

import numpy as np

from sysid.core.jit import compiled
from sysid.core.types import FloatArray, IntArray
from sysid.search.operators import DEVELOPMENT, below, coded, decoded, draws, rank
from sysid.search.state import IslandArrays, Plan
from sysid.simulation.evaluator import Evaluator, population_fitness
from sysid.simulation.scaling import located, placed

_FLOOR = 0.01  # of the range: a relative step can leave zero


@compiled
def _signs(plan: Plan, generation: int, proposal: int, signs: IntArray) -> None:
    """Which parameters move, and which way: each stays, rises or falls, and one moves at least."""
    moves = 0
    for d in range(signs.size):
        word = draws(plan.seed, DEVELOPMENT, plan.island, generation, proposal * signs.size + d)
        signs[d] = below(word[0], 3) - 1
        moves += abs(signs[d])
        if d == signs.size - 1 and moves == 0:
            signs[below(word[1], signs.size)] = 1 if word[2] & 1 else -1


@compiled
def _proposals(evaluator: Evaluator, plan: Plan, champion: FloatArray, n: int,
               generation: int) -> FloatArray:  # fmt: skip
    """Physical values of `n` neighbours of the champion."""
    theta = np.empty((n, champion.size))
    signs = np.zeros(champion.size, np.int64)
    for p in range(n):
        _signs(plan, generation, p, signs)
        for d in range(champion.size):
            span = evaluator.upper[d] - evaluator.lower[d]
            size = max(abs(champion[d]), _FLOOR * span) if plan.relative else span
            theta[p, d] = champion[d] + signs[d] * plan.beta * size
    return theta


@compiled
def fixed_sequence(evaluator: Evaluator, plan: Plan, island: IslandArrays) -> None:
    """One generation of the fixed sequence search; two without a gain end the phase."""
    chromosomes, fitness, search = island.chromosomes, island.fitness, island.search
    champion = located(evaluator, decoded(chromosomes[:1], plan.bits))[0]
    theta = _proposals(evaluator, plan, champion, fitness.size, search.generation)
    proposals = coded(placed(evaluator, theta), plan.bits)
    reached = population_fitness(evaluator, located(evaluator, decoded(proposals, plan.bits)))
    search.evaluations += fitness.size
    best = np.argmin(reached)
    if reached[best] < fitness[0]:
        fitness[-1] = reached[best]
        for d in range(champion.size):
            chromosomes[-1, d] = proposals[best, d]
        rank(chromosomes, fitness)
        search.failed_steps = 0
        return
    search.failed_steps += 1
    if search.failed_steps == 2:
        search.in_sequence_search, search.failed_steps = 0, 0
