"""Chains of a sweep: which run comes before which."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.jobs.axes import build_axis_groups, expand_values, group_axes, iterate_cells
from service.jobs.job_schemas import SweepAxisIn
from service.jobs.warm_start_order import ChainLayout

DATA = SweepAxisIn(path="/datasets", values=["a", "b", "c"])
SEEDS = SweepAxisIn(path="/seed", range=[0, 4])
LABELLED = SweepAxisIn(path="/noise/sigma", values=[0, 1], labels=[{"x": 1}, {"x": 2}])


def test_without_axes_there_is_no_chain() -> None:
    assert ChainLayout.from_axes([]) is None


@pytest.mark.parametrize(
    ("axes", "along"),
    [
        ([SEEDS, DATA], "/datasets"),
        ([DATA, SEEDS], "/datasets"),
        ([DATA, SEEDS, LABELLED], "/noise/sigma"),
        ([SEEDS], "/seed"),
    ],
)
def test_the_run_before_differs_in_that_axis_only_by_one_step(
    axes: list[SweepAxisIn], along: str
) -> None:
    chain = ChainLayout.from_axes(axes)
    assert chain is not None
    groups = build_axis_groups(axes, group_axes(axes))
    cells = [dict(cell.values) for cell in iterate_cells(groups)]
    order = expand_values(next(axis for axis in axes if axis.path == along))
    for number, cell in enumerate(cells):
        numbers = chain.list_runs(chain.find_chain(number))
        place = order.index(cell[along])
        assert numbers.index(number) == place
        if place > 0:
            assert cells[numbers[place - 1]] == {**cell, along: order[place - 1]}


@given(st.integers(1, 50), st.integers(1, 50), st.integers(0, 10_000))
def test_every_run_is_in_its_chain_once(stride: int, length: int, number: int) -> None:
    chain = ChainLayout(stride, length)
    numbers = chain.list_runs(chain.find_chain(number))
    assert len(numbers) == length
    assert numbers.index(number) == number // stride % length
