"""Counting cells without making them equals making and counting them."""

from math import prod

from hypothesis import given
from hypothesis import strategies as st

from service.jobs.axes import locate_cell
from service.sweeps.groups import count_cells_below


@given(st.lists(st.integers(1, 4), max_size=4), st.data())
def test_cells_before_a_number_are_counted_as_if_they_were_made(
    lengths: list[int], data: st.DataObject
) -> None:
    end = data.draw(st.integers(0, prod(lengths)))
    fixed = {
        place: data.draw(st.integers(0, length - 1))
        for place, length in enumerate(lengths)
        if data.draw(st.booleans())
    }
    cells = [locate_cell(number, lengths) for number in range(end)]
    expected = sum(all(cell[place] == at for place, at in fixed.items()) for cell in cells)
    assert count_cells_below(end, lengths, fixed) == expected
