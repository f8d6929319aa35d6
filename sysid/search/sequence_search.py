"""Sequence search as printed in the paper (Eq. 11, 12): fixed steps around the champion.

Every proposal moves a subset of the parameters by ±β. A generation evaluates one population of
proposals and keeps the best. The search continues while it gains.
"""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray, IntArray
from sysid.search.operators import (
    USE_LOCAL_SEARCH,
    decode,
    draw_words,
    encode,
    sort_population,
    to_integer,
)
from sysid.search.state import IslandArrays, IslandPlan
from sysid.simulation.evaluator import Evaluator, evaluate_population
from sysid.simulation.scaling import from_unit, to_unit

_MIN_STEP_SIZE = 0.01  # of the range: a relative step can leave zero


@jit_compile
def _draw_signs(plan: IslandPlan, generation: int, proposal: int, signs: IntArray) -> None:
    """Draw for each parameter whether it stays, rises or falls; at least one moves."""
    moves = 0
    for d in range(signs.size):
        word = draw_words(
            plan.seed, USE_LOCAL_SEARCH, plan.island, generation, proposal * signs.size + d
        )
        signs[d] = to_integer(word[0], 3) - 1
        moves += abs(signs[d])
        if d == signs.size - 1 and moves == 0:
            signs[to_integer(word[1], signs.size)] = 1 if word[2] & 1 else -1


@jit_compile
def _propose_neighbours(
    evaluator: Evaluator, plan: IslandPlan, champion: FloatArray, n: int, generation: int
) -> FloatArray:
    """Propose physical values of `n` neighbours of the champion."""
    theta = np.empty((n, champion.size))
    signs = np.zeros(champion.size, np.int64)
    for p in range(n):
        _draw_signs(plan, generation, p, signs)
        for d in range(champion.size):
            span = evaluator.upper[d] - evaluator.lower[d]
            size = max(abs(champion[d]), _MIN_STEP_SIZE * span) if plan.is_relative else span
            theta[p, d] = champion[d] + signs[d] * plan.beta * size
    return theta


@jit_compile
def run_fixed_sequence(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> None:
    """Run one generation of the fixed sequence search; two without gain end the phase."""
    chromosomes, fitness, search = island.chromosomes, island.fitness, island.search
    champion = from_unit(evaluator, decode(chromosomes[:1], plan.bits))[0]
    theta = _propose_neighbours(evaluator, plan, champion, fitness.size, search.generation)
    proposals = encode(to_unit(evaluator, theta), plan.bits)
    reached = evaluate_population(evaluator, from_unit(evaluator, decode(proposals, plan.bits)))
    search.evaluations += fitness.size
    best = np.argmin(reached)
    if reached[best] < fitness[0]:
        fitness[-1] = reached[best]
        for d in range(champion.size):
            chromosomes[-1, d] = proposals[best, d]
        sort_population(chromosomes, fitness)
        search.failed_steps = 0
        return
    search.failed_steps += 1
    if search.failed_steps == 2:
        search.in_sequence_search, search.failed_steps = False, 0
