"""Groups of a sweep: told by its axes alone, as if every cell had been made and looked at."""

from itertools import product
from math import prod
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from service.jobs.axes import iterate_cells, locate_cell
from service.jobs.stored_cells import read_axis_groups
from service.sweeps.groups import GroupKey, SweepGroups

LENGTHS = st.lists(st.integers(1, 4), max_size=4)
VALUES = st.lists(st.sampled_from([0, 0.0, 1, True, "a", None, [1], {"b": 2}]), min_size=1)
NAMES = ("x", "y")


@st.composite
def sweeps(draw: st.DrawFn) -> dict[str, Any]:
    """A stored job with up to three axes; some step together, and have labels."""
    axes: list[dict[str, Any]] = []
    for number in range(draw(st.integers(0, 3))):
        values = draw(VALUES.filter(lambda given: len(given) <= 4))
        zipped = [axis for axis in axes if len(axis["values"]) == len(values)]
        axis = {"path": f"/{number}", "values": values}
        if zipped and draw(st.booleans()):
            axis["zip"] = zipped[0]["zip"] = "together"
        if draw(st.booleans()):
            one = st.dictionaries(st.sampled_from(NAMES), st.integers(0, 1))
            axis["labels"] = draw(st.lists(one, min_size=len(values), max_size=len(values)))
        axes.append(axis)
    lengths: dict[str, int] = {}
    for axis in axes:  # all axes of one zip have one length
        if "zip" in axis and lengths.setdefault(axis["zip"], len(axis["values"])) != len(
            axis["values"]
        ):
            del axis["zip"]
    return {"sweep": {"axes": axes}}


def describe(value: Any) -> Any:
    """What two equal values share: 0 is 0.0, but not false."""
    return (isinstance(value, bool), repr(float(value) if isinstance(value, int) else value))


@given(sweeps(), st.data())
def test_the_group_of_a_run_is_that_of_its_cell(spec: dict[str, Any], data: st.DataObject) -> None:
    paths = [axis["path"] for axis in spec["sweep"]["axes"]]
    keys = [GroupKey("axis", path) for path in paths if data.draw(st.booleans())]
    keys += [GroupKey("label", name) for name in NAMES if data.draw(st.booleans())]
    cells = list(iterate_cells(read_axis_groups(spec)))
    expected: dict[Any, list[int]] = {}
    for number, cell in enumerate(cells):
        values = [
            (cell.values if key.kind == "axis" else cell.labels).get(key.name) for key in keys
        ]
        expected.setdefault(tuple(map(describe, values)), []).append(number)
    groups = SweepGroups(spec, keys, 1000)
    assert not groups.is_cut
    assert [tuple(map(describe, key)) for key in groups.keys] == list(expected)
    assert groups.first_numbers == [numbers[0] for numbers in expected.values()]
    located = groups.locate_runs(np.arange(len(cells)))
    assert [np.flatnonzero(located == group).tolist() for group in range(len(expected))] == list(
        expected.values()
    )


@given(sweeps(), st.integers(1, 5), st.data())
def test_a_limit_keeps_the_first_groups(
    spec: dict[str, Any], limit: int, data: st.DataObject
) -> None:
    paths = [axis["path"] for axis in spec["sweep"]["axes"]]
    keys = [GroupKey("axis", path) for path in paths if data.draw(st.booleans())]
    whole, cut = SweepGroups(spec, keys, 1000), SweepGroups(spec, keys, limit)
    assert cut.is_cut == (len(whole.keys) > limit)
    assert cut.first_numbers == whole.first_numbers[:limit]
    numbers = np.arange(whole.n_runs)
    located = whole.locate_runs(numbers)
    expected = np.where(located < limit, located, -1)
    np.testing.assert_array_equal(cut.locate_runs(numbers), expected)


@given(LENGTHS)
def test_cells_are_numbered_with_the_last_axis_fastest(lengths: list[int]) -> None:
    cells = [tuple(locate_cell(number, lengths)) for number in range(prod(lengths))]
    assert cells == list(product(*map(range, lengths)))
