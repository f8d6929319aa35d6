"""Which local search comes next."""

from collections import Counter

import numpy as np
import pytest

from sysid.search.operators import draw_words
from sysid.search.schedule import (
    AT_CHAMPION,
    EARLY_SEARCHES,
    FIRST_TURNS,
    FIRST_WARM_TURNS,
    FROM_CHAMPION,
    GROW_FAST_FROM_FAR,
    NO_HOP,
    ROUGH_CYCLE,
    SMOOTH_CYCLE,
    LocalSearch,
    Thirds,
    asks_residuals,
    begin_growth,
    choose_local_search,
)
from sysid.search.state import SEARCH_RECORD, SearchArray

SIZE = 12
ROWS = (*FIRST_TURNS, *FIRST_WARM_TURNS, *SMOOTH_CYCLE, *ROUGH_CYCLE)


def begin(number: int, **fields: object) -> SearchArray:
    """The search record of an island whose local search of that number begins."""
    search = np.zeros((), SEARCH_RECORD)
    search["local_searches"] = number
    for name, value in fields.items():
        search[name] = value
    return search[()]


def choose(number: int, draw: int, is_coloured: bool = False, **fields: object) -> LocalSearch:
    kind, individual = choose_local_search(
        SIZE, draw_words(1, 2, 3, 4, draw), is_coloured, begin(number, **fields)
    )
    assert 0 <= individual < SIZE
    return LocalSearch(*kind)


def find_row(number: int, jumps: int, is_warm: bool) -> tuple[Thirds, Thirds]:
    """The two columns for a search, from the tables."""
    if number <= EARLY_SEARCHES:
        row = (FIRST_WARM_TURNS if is_warm else FIRST_TURNS)[number - 1]
    else:
        row = ROUGH_CYCLE[number % 8] if jumps else SMOOTH_CYCLE[number % 4]
    return row.unsettled, row.settled


@pytest.mark.parametrize("jumps", [0, 3])
@pytest.mark.parametrize("is_warm", [False, True])
def test_a_search_is_drawn_from_the_row_of_its_number(jumps: int, is_warm: bool) -> None:
    for number in range(1, 21):
        for converged, entry in enumerate(find_row(number, jumps, is_warm)):
            drawn = Counter(
                choose(
                    number,
                    draw,
                    champion_converged=converged,
                    fitness_discontinuities=jumps,
                    is_warm_start=is_warm,
                )
                for draw in range(300)
            )
            assert set(drawn) == set(entry)
            for kind in entry:
                assert abs(drawn[kind] - 100 * entry.count(kind)) < 45


def test_behind_coloured_residuals_far_starts_have_the_turns_of_three_hops() -> None:
    asking = []
    for number in range(9, 17):
        fields = {"champion_converged": True, "fitness_discontinuities": 1}
        if asks_residuals(begin(number, **fields)):
            asking.append(number)
            assert choose(number, 0, True, **fields) == GROW_FAST_FROM_FAR
        else:
            kinds = {choose(number, draw, True, **fields) for draw in range(60)}
            assert kinds == set(ROUGH_CYCLE[number % 8].settled)
        assert not asks_residuals(begin(number, champion_converged=True))
        assert not asks_residuals(begin(number, fitness_discontinuities=1))
    assert asking == [11, 13, 15]


def test_the_part_that_is_fitted_first_is_drawn_within_the_limits_of_the_kind() -> None:
    for kind in {kind for row in ROWS for column in row[:3] for kind in column}:
        for draw in range(100):
            search = begin(9)
            begin_growth(kind, draw_words(1, 2, 3, 4, draw), search)
            doublings = -np.log2(search["horizon"])
            assert kind.least_doublings <= doublings <= kind.most_doublings
            assert (search["horizon_growth"] > 1.0) == (kind.growth > 0)
            assert search["horizon_growth"] <= 2.0


def test_only_searches_that_move_away_from_the_champion_are_evidence() -> None:
    for row in ROWS:
        for kind in (kind for column in row[:3] for kind in column):
            assert not (kind.is_evidence and kind.hop == NO_HOP)
            assert not (kind.hop != NO_HOP and kind.probes)
        if row in ROUGH_CYCLE:
            assert set(row.unsettled) == {FROM_CHAMPION}
    assert FROM_CHAMPION.begins == AT_CHAMPION
