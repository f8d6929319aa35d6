"""When searches agree enough for a run to end."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Migration, Stop
from sysid.identification.conclude import conclude_run
from sysid.identification.run import advance_run, begin_run
from sysid.islands.archipelago import create_islands
from sysid.islands.run_state import RunState
from sysid.islands.stopping import count_restarts, has_search_ended, make_stopping_rule
from sysid.models.catalogue.load import load_model
from sysid.search.state import SEARCH_RECORD, Improvement, SearchArray
from sysid.simulation.problem import Problem
from tests.support.library.search_problems import DUFFING, example, noisy, record

ALONE = GeneticAlgorithm(islands=1, migration=Migration(every=1))


def make_search(islands: int = 1, generation: int = 2, **fields: object) -> SearchArray:
    """Search records of islands that have all passed a border."""
    search = np.zeros(islands, SEARCH_RECORD)
    search["generation"] = generation
    for name, values in fields.items():
        search[name] = values
    return search


def ends(
    again: int,
    tried: int,
    returned: int,
    hops: int,
    *,
    is_warm: bool = False,
    jumps: bool = False,
    is_explained: bool = False,
) -> bool:
    """Whether a run ends at its second border, its searches as told."""
    search = make_search(
        confirmed_starts=again,
        random_starts=tried,
        returned_hops=returned,
        hop_count=hops,
        champion_discontinuities=int(jumps),
        champion_explained=int(is_explained),
    )
    rule = make_stopping_rule(ALONE, is_warm=is_warm)
    return bool(has_search_ended(rule, 2, np.array([0.5]), search, False))


@pytest.mark.parametrize(
    ("again", "tried", "returned", "hops", "enough"),
    [
        (8, 8, 3, 3, True),
        (8, 16, 8, 10, True),
        (7, 12, 5, 5, False),  # half agree, but few
        (5, 14, 7, 7, False),  # all from beside it say nothing of minima far away
        (5, 19, 9, 9, False),
        (5, 20, 9, 9, True),  # so many would have found a better one
        (5, 20, 3, 9, False),  # fewer than a third of all
        (2, 20, 9, 9, False),
    ],
)
def test_where_searches_from_anywhere_disagree_more_of_them_are_needed(
    again: int, tried: int, returned: int, hops: int, enough: bool
) -> None:
    assert ends(again, tried, returned, hops) is enough


def test_behind_an_earlier_result_few_searches_are_enough() -> None:
    assert not ends(3, 7, 1, 1)
    assert ends(3, 7, 1, 1, is_warm=True)


@pytest.mark.parametrize(
    ("again", "tried", "returned", "hops", "enough"),
    [
        (6, 9, 9, 10, True),
        (6, 10, 9, 10, False),  # fewer than two thirds from anywhere
        (6, 9, 8, 10, False),  # fewer than nine tenths from near it
        (5, 5, 9, 9, False),  # all, but few
        (9, 9, 5, 5, False),
    ],
)
def test_where_the_fitness_jumps_nearly_all_searches_must_agree(
    again: int, tried: int, returned: int, hops: int, enough: bool
) -> None:
    assert ends(again, tried, returned, hops, jumps=True) is enough


@pytest.mark.parametrize(
    ("returned", "hops", "enough"), [(8, 24, True), (7, 7, False), (8, 25, False)]
)
def test_where_only_noise_is_left_searches_from_near_it_are_enough(
    returned: int, hops: int, enough: bool
) -> None:
    assert ends(0, 12, returned, hops, is_explained=True) is enough
    assert not ends(0, 12, returned, hops)
    assert not ends(0, 12, returned, hops, is_explained=True, jumps=True)


def test_searches_for_a_worse_champion_confirm_none_but_count_as_tried() -> None:
    search = make_search(
        3,
        random_starts=[5, 7, 2],
        confirmed_starts=[4, 6, 1],
        hop_count=[3, 9, 2],
        returned_hops=[2, 8, 1],
        champion_discontinuities=[0, 1, 0],
        champion_explained=[0, 1, 0],
    )
    found = count_restarts(np.array([0.5, 0.6, 0.5 * (1 + 5e-5)]), search)
    assert tuple(found) == (14, 5, 5, 3, False, False)


def test_the_best_champion_decides_whether_the_target_is_reached() -> None:
    rule = make_stopping_rule(GeneticAlgorithm(stop=Stop(rms=0.1)), is_warm=False)
    for best, reached in ((0.1, True), (0.11, False)):
        rms = np.array([0.5, best, 0.7])
        assert has_search_ended(rule, 2, rms, make_search(3), False) is reached


def test_a_run_ends_when_all_islands_rest_and_not_before() -> None:
    rule = make_stopping_rule(ALONE, is_warm=False)
    for generations, rest in (([3, 10], False), ([10, 10], False), ([3, 4], True)):
        search = make_search(2, generation=generations)  # type: ignore[arg-type]
        assert has_search_ended(rule, 10, np.ones(2), search, False) is rest
    for border, last in ((rule.most_generations - 1, False), (rule.most_generations, True)):
        search = make_search(2, generation=border)
        assert has_search_ended(rule, border, np.ones(2), search, False) is last


@pytest.mark.parametrize(
    ("first", "second", "is_old"),
    [
        ([(3, 1.0), (9, 0.5)], [(4, 0.8)], False),  # the others' early ones are worse
        ([(3, 0.5)], [(9, 0.4)], False),
        ([(3, 0.5)], [(9, 0.5 * (1 - 5e-5))], True),  # the same optimum again
        ([(3, 0.5)], [(4, 0.8), (9, 0.6)], True),
    ],
)
def test_a_run_is_unimproved_since_its_best_optimum_was_first_found(
    first: list[tuple[int, float]], second: list[tuple[int, float]], is_old: bool
) -> None:
    islands = create_islands(example(n=80), GeneticAlgorithm(islands=2), 1)
    found = [
        tuple(Improvement(generation, 0, rms, "genetic", ()) for generation, rms in history)
        for history in (first, second)
    ]
    state = RunState(
        1,
        tuple(replace(one, history=history) for one, history in zip(islands, found, strict=True)),
    )
    assert state.is_unimproved_since(5) is is_old


def test_a_false_optimum_that_a_third_of_the_searches_find_does_not_end_a_run() -> None:
    """5 of 14 searches from random places led to 2.2 times the least RMS, and 5 of 7 hops back."""
    problem = Problem.build(
        load_model("duffing-eq16"), [record(noisy(seed=55))], parameters={"L": {"upper": 5.0}}
    )
    settings = GeneticAlgorithm(stop=Stop(evaluations=20_000))
    truth = np.array([[DUFFING[p.name] for p in problem.free_parameters]])
    result = conclude_run(
        problem, settings, advance_run(problem, settings, begin_run(problem, settings, 135_022))
    )
    assert result.rms <= float(problem.evaluate_fitness(truth)[0])
