"""When searches agree enough for a run to end."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Migration, Stop
from sysid.identification.conclude import conclude_run
from sysid.identification.run import advance_run, begin_run, exchange_migrants
from sysid.islands.state import RunState
from sysid.models.catalogue.load import load_model
from sysid.simulation.problem import Problem
from tests.searching import DUFFING, example, noisy, record

ALONE = GeneticAlgorithm(islands=1, migration=Migration(every=1))


def found(again: int, tried: int, returned: int, hops: int, *, is_warm: bool = False) -> RunState:
    """A run at its second border, its searches as told."""
    start = begin_run(example(), ALONE, 1)
    state = advance_run(example(), replace(ALONE, generations=1), start)
    search = state.islands[0].search.copy()
    search["generation"], search["confirmed_starts"], search["random_starts"] = 2, again, tried
    search["returned_hops"], search["hop_count"] = returned, hops
    island = replace(state.islands[0], search=search)
    return exchange_migrants(ALONE, replace(state, has_ended=False, is_warm=is_warm), [island])


@pytest.mark.parametrize(
    ("again", "tried", "returned", "hops", "ends"),
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
    again: int, tried: int, returned: int, hops: int, ends: bool
) -> None:
    assert found(again, tried, returned, hops).has_ended is ends


def test_behind_an_earlier_result_few_searches_are_enough() -> None:
    assert not found(3, 7, 1, 1).has_ended
    assert found(3, 7, 1, 1, is_warm=True).has_ended


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
