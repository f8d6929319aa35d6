"""Packed history and migrants: what goes in comes out, whatever parts it went in."""

from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.repositories.history_rows import (
    PHASES,
    HistoryPoint,
    MigrantPoint,
    pack_history,
    pack_migrants,
    unpack_history,
    unpack_migrants,
)
from sysid.search.state import SearchPhase

numbers = st.floats(allow_nan=False, allow_infinity=False)
points = st.builds(
    lambda island, number, rms, phase, values: HistoryPoint(
        "run_a", island, number, 7 * number, 2**33 + number, rms, phase, values
    ),
    st.integers(0, 3),
    st.integers(0, 99),
    numbers,
    st.sampled_from(PHASES),
    st.lists(numbers, min_size=2, max_size=2),
)
many = st.lists(points, max_size=40, unique_by=lambda one: (one.island, one.number))


def read(rows):
    return unpack_history("run_a", [(row["points"], row["n_parameters"]) for row in rows])


def test_every_phase_of_a_search_can_be_stored():
    assert set(get_args(SearchPhase)) <= set(PHASES)


@given(many, st.integers(0, 40), st.integers(0, 40))
def test_parts_that_overlap_give_each_point_once_and_in_order(found, cut, other):
    rows = [*pack_history(found[cut:]), *pack_history(found[:other]), *pack_history(found[:cut])]
    assert read(rows) == sorted(found, key=lambda one: (one.island, one.number))


@given(many.filter(bool))
def test_a_part_is_known_by_its_content_and_tells_how_far_it_goes(found):
    (row,), (again,) = pack_history(found), pack_history(found)
    assert row == again
    assert row["generation"] == max(one.generation for one in found)
    assert row["rms"] == min(one.rms for one in found)
    changed = [found[0]._replace(rms=found[0].rms + 1.0 + abs(found[0].rms)), *found[1:]]
    assert next(iter(pack_history(changed)))["digest"] != row["digest"]


def test_points_of_several_runs_are_parts_of_their_own():
    both = [HistoryPoint(run, 0, 0, 0, 50, 0.5, "start", [1.0]) for run in ("run_a", "run_b")]
    assert [row["run_id"] for row in pack_history(both)] == ["run_a", "run_b"]


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 3), numbers), max_size=20))
def test_migrants_come_out_as_they_went_in(lines):
    log = [
        MigrantPoint("run_a", i, epoch, source, 1, rms)
        for i, (epoch, source, rms) in enumerate(lines)
    ]
    rows = [*pack_migrants(log[3:]), *pack_migrants(log[:7])]
    assert unpack_migrants("run_a", [row["migrants"] for row in rows]) == log


def test_a_phase_that_is_not_known_is_refused_before_it_is_written():
    with pytest.raises(KeyError):
        list(pack_history([HistoryPoint("run_a", 0, 0, 0, 0, 1.0, "guess", [])]))
