"""Groups of runs that are not created yet: counted, not listed."""

from itertools import product
from math import prod

from hypothesis import given
from hypothesis import strategies as st

from service.jobs.axes import locate_cell
from service.sweeps.groups import count_cells_below

LENGTHS = st.lists(st.integers(1, 4), max_size=4)


@given(LENGTHS, st.data())
def test_cells_below_a_number_are_counted_as_if_they_were_listed(
    lengths: list[int], data: st.DataObject
) -> None:
    axes = data.draw(st.sets(st.integers(0, len(lengths) - 1))) if lengths else set()
    fixed = {axis: data.draw(st.integers(0, lengths[axis] - 1)) for axis in sorted(axes)}
    end = data.draw(st.integers(0, prod(lengths)))
    cells = [locate_cell(number, lengths) for number in range(end)]
    expected = sum(all(cell[axis] == at for axis, at in fixed.items()) for cell in cells)
    assert count_cells_below(end, lengths, fixed) == expected


@given(LENGTHS)
def test_cells_are_numbered_with_the_last_axis_fastest(lengths: list[int]) -> None:
    cells = [tuple(locate_cell(number, lengths)) for number in range(prod(lengths))]
    assert cells == list(product(*map(range, lengths)))
