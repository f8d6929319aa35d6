"""Where the fitness jumps, most developments begin beside the champion."""

from functools import cache
from itertools import pairwise

import pytest

from sysid.core.settings import GeneticAlgorithm, Stop
from sysid.islands.archipelago import create_islands, make_plans
from sysid.search.island import Island, evolve
from sysid.search.schedule import GROW_NEARBY, HOP, NO_HOP, SINGLE_HOP
from sysid.search.state import SAME_OPTIMUM, SearchArray
from tests.support.library.search_problems import bits, example

ALONE = GeneticAlgorithm(population=12, islands=1, stop=Stop(evaluations=6_000))
GENERATIONS = 400
NO_EVIDENCE = (NO_HOP, False)
HOPS = [(kind.hop, kind.is_evidence) for kind in (HOP, SINGLE_HOP, GROW_NEARBY)]


@cache
def list_generations(model: str) -> tuple[Island, ...]:
    """An island after every one of its generations, each evolved by itself."""
    problem = example(model)
    (plan,) = make_plans(problem, ALONE, 3)
    states = [create_islands(problem, ALONE, 3)[0]]
    for _ in range(GENERATIONS):
        states.append(evolve(problem.evaluator, plan, states[-1], 1))
    return tuple(states)


def begun(model: str) -> list[SearchArray]:
    """Each development as it was begun after jumps had been met, or any."""
    return [
        after.search
        for before, after in pairwise(list_generations(model))
        if after.search["local_searches"] > before.search["local_searches"] > 4
        and (before.search["fitness_discontinuities"] > 0 or model == "duffing-eq16")
    ]


def test_jumps_once_met_stay_known_when_a_better_champion_comes() -> None:
    problem = example("coulomb-eq16")
    (plan,) = make_plans(problem, ALONE, 3)
    start = create_islands(problem, ALONE, 3)[0]
    start.search["fitness_discontinuities"] = start.search["champion_discontinuities"] = 1
    later = evolve(problem.evaluator, plan, start, 8)
    assert later.champion_rms < 0.9 * evolve(problem.evaluator, plan, start, 1).champion_rms
    known = later.search
    assert (known["fitness_discontinuities"], known["champion_discontinuities"]) == (1, 0)
    assert list_generations("coulomb-eq16")[-1].search["fitness_discontinuities"] > 0
    assert list_generations("duffing-eq16")[-1].search["fitness_discontinuities"] == 0


def test_there_most_developments_are_hops_and_some_still_begin_anywhere() -> None:
    hops = [get_hop(search) for search in begun("coulomb-eq16")]
    assert len(hops) > 30
    assert sum(hop != NO_EVIDENCE for hop in hops) >= 0.4 * len(hops)
    assert set(HOPS) <= set(hops)
    assert sum(bool(search["from_random_start"]) for search in begun("coulomb-eq16")) >= 2
    smooth = [get_hop(search) for search in begun("duffing-eq16")]
    assert set(smooth) == {NO_EVIDENCE, HOPS[0]}
    assert sum(hop != NO_EVIDENCE for hop in smooth) < 0.6 * len(smooth)


def get_hop(search: SearchArray) -> tuple[int, bool]:
    """Get the kind of hop of a search, and whether it counts as evidence."""
    return int(search["hop"]), bool(search["hop_is_evidence"])


def test_growing_from_beside_the_champion_is_no_evidence_for_it() -> None:
    """It need not lead back where a better one lies near, so it tells nothing of the champion."""
    states = list_generations("coulomb-eq16")
    ends = dict.fromkeys(HOPS, 0)
    for before, after in pairwise(states):
        hop = get_hop(before.search)
        ended = before.search["in_sequence_search"] == 1 and after.search["in_sequence_search"] == 0
        if ended and hop != NO_EVIDENCE and after.champion_rms == before.champion_rms:
            ends[hop] += 1
            assert after.search["hop_count"] - before.search["hop_count"] == hop[1]
            assert after.search["step_count"] == 0
    assert min(ends.values()) > 0


def test_it_can_be_cut_anywhere_there_too() -> None:
    problem = example("coulomb-eq16")
    (plan,) = make_plans(problem, ALONE, 3)
    at_once = evolve(problem.evaluator, plan, create_islands(problem, ALONE, 3)[0], GENERATIONS)
    assert at_once.search["fitness_discontinuities"] > 0
    assert bits(at_once) == bits(list_generations("coulomb-eq16")[-1])


@pytest.mark.parametrize("model", ["duffing-eq16", "coulomb-eq16"])
def test_a_local_search_that_leads_to_the_champion_confirms_it_and_another_does_not(
    model: str,
) -> None:
    ended = []
    for before, after in pairwise(list_generations(model)):
        old, new = before.search, after.search
        ends = new["in_sequence_search"] == 0 and (
            old["in_sequence_search"] == 1 or new["local_searches"] > old["local_searches"]
        )
        if not ends or after.champion_rms < before.champion_rms:
            continue
        is_random, is_hop = bool(new["from_random_start"]), bool(new["hop_is_evidence"])
        relative = new["reached_fitness"] / after.champion_rms - 1.0
        led_back = bool(abs(relative) <= SAME_OPTIMUM)
        ended.append((is_random, is_hop, led_back))
        counted = ("random_starts", "confirmed_starts", "hop_count", "returned_hops")
        grown = [int(new[name] - old[name]) for name in counted]
        assert grown == [is_random, is_random and led_back, is_hop, is_hop and led_back]
        is_of_champion = new["replaced_fitness"] == after.champion_rms
        assert new["champion_converged"] == (old["champion_converged"] or is_of_champion)
    other = (False, True, False) if model == "coulomb-eq16" else (True, False, True)
    assert {(True, False, False), (False, True, True), other} <= set(ended)
