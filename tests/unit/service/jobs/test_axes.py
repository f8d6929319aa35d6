"""Sweeps: from axes to cells, and from a cell to the body of a run."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.core.bodies.json_pointer import build_run_body
from service.jobs.axes import (
    SweepCell,
    build_axis_groups,
    count_runs,
    find_axis_faults,
    group_axes,
    iterate_cells,
)
from service.jobs.job_schemas import JobIn


def job(*axes: dict[str, Any], **fields: Any) -> JobIn:
    body = {"model": "m", "datasets": ["ds_1", "ds_2"], "sweep": {"axes": list(axes)}}
    return JobIn.model_validate({**body, **fields})


def list_cells(body: JobIn) -> list[SweepCell]:
    return list(iterate_cells(build_axis_groups(body.sweep.axes, group_axes(body.sweep.axes))))


def test_without_axes_there_is_one_cell_that_changes_nothing() -> None:
    body = job()
    assert list_cells(body) == [SweepCell()]
    whole = body.to_normal_form()
    assert build_run_body(whole, {}) == {
        name: value for name, value in whole.items() if name != "sweep"
    }


@given(st.lists(st.integers(1, 4), max_size=3))
def test_the_number_of_cells_is_the_product_of_the_axes(lengths: list[int]) -> None:
    paths = ["/seed", "/noise/sigma", "/algorithm/generations"]
    body = job(
        *(
            {"path": path, "values": list(range(1, n + 1))}
            for path, n in zip(paths, lengths, strict=False)
        )
    )
    found = list_cells(body)
    assert len(found) == count_runs(body, group_axes(body.sweep.axes))
    assert len({tuple(cell.values.items()) for cell in found}) == len(found)
    groups = build_axis_groups(body.sweep.axes, group_axes(body.sweep.axes))
    for start in range(len(found) + 1):
        assert list(iterate_cells(groups, start)) == found[start:]


def test_crossed_axes_give_the_last_one_fastest_and_zipped_ones_step_together() -> None:
    body = job(
        {"path": "/noise/sigma", "values": [0.1, 0.2], "labels": [{"s": 1}, {"s": 2}]},
        {"path": "/seed", "range": [3, 9, 3], "zip": "z"},
        {"path": "/skip", "values": [1, 2]},
        {"path": "/noise/seed", "values": [7, 8], "zip": "z"},
    )
    found = list_cells(body)
    assert count_runs(body, group_axes(body.sweep.axes)) == len(found) == 8
    paths = ("/noise/sigma", "/seed", "/noise/seed", "/skip")
    assert [tuple(cell.values[path] for path in paths) for cell in found[:5]] == [
        (0.1, 3, 7, 1),
        (0.1, 3, 7, 2),
        (0.1, 6, 8, 1),
        (0.1, 6, 8, 2),
        (0.2, 3, 7, 1),
    ]
    assert [cell.labels["s"] for cell in found] == [1] * 4 + [2] * 4


def test_a_cell_changes_its_fields_and_nothing_else() -> None:
    whole = job().to_normal_form()
    changed = build_run_body(
        whole, {"/noise/sigma": 0.5, "/parameters/L/upper": 2.0, "/datasets/1": "x"}
    )
    assert changed["noise"] == {**whole["noise"], "sigma": 0.5}
    assert changed["parameters"] == {"L": {"upper": 2.0}}
    assert changed["datasets"] == ["ds_1", "x"]
    assert whole == job().to_normal_form()
    assert build_run_body(whole, {"/datasets": "ds_9"})["datasets"] == ["ds_9"]


def test_a_logarithmic_axis_has_both_ends_and_equal_ratios() -> None:
    body = job({"path": "/noise/sigma", "log": [0.001, 1, 4]})
    values = [cell.values["/noise/sigma"] for cell in list_cells(body)]
    assert values == pytest.approx([0.001, 0.01, 0.1, 1])
    assert values[-1] == 1


def test_a_pointer_with_a_slash_in_a_name_is_read_as_written() -> None:
    changed = build_run_body(job().to_normal_form(), {"/parameters/a~1b/fixed": 1.0})
    assert changed["parameters"] == {"a/b": {"fixed": 1.0}}


def test_zipped_axes_of_different_lengths_are_refused_at_the_second() -> None:
    body = job(
        {"path": "/seed", "range": [0, 3], "zip": "z"},
        {"path": "/noise/seed", "range": [0, 2], "zip": "z"},
    )
    assert [fault.pointer for fault in find_axis_faults(body)] == ["/sweep/axes/1/zip"]


def test_an_axis_that_is_there_twice_is_refused() -> None:
    body = job({"path": "/seed", "range": [0, 3]}, {"path": "/seed", "values": [7]})
    [fault] = find_axis_faults(body)
    assert "already an axis" in fault.detail
