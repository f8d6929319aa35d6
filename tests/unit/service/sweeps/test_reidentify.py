"""A batch as a job: runs in the order of the label, whatever the order of the entries."""

from typing import Any

import pytest

from service.sweeps.reidentification import build_job, sort_batch
from service.sweeps.sweep_schemas import ReidentifyIn

ENTRIES = [{"x": x, "datasets": [f"ds_{x:g}"]} for x in (8.0, 2.0, 4.0)]


def job_of(**fields: Any) -> Any:
    body = ReidentifyIn.model_validate(
        {"model": "tube", "label": "length_m", "batch": ENTRIES, **fields}
    )
    return build_job(body, sort_batch(body))


def test_runs_come_in_the_order_of_the_label_each_with_its_own_data() -> None:
    job = job_of()
    (axis,) = job.sweep.axes
    assert axis.values == [["ds_2"], ["ds_4"], ["ds_8"]]
    assert axis.labels == [{"length_m": 2.0}, {"length_m": 4.0}, {"length_m": 8.0}]
    assert job.datasets == ["ds_2"]


@pytest.mark.parametrize(
    ("fields", "warm", "reference"),
    [
        ({}, "previous", None),
        ({"reference": "tube"}, "reference:tube", "reference:tube"),
        ({"reference": "run_1"}, "run_1", "run_1"),
        ({"reference": "tube", "warm_start": "previous"}, "previous", "reference:tube"),
        ({"reference": "tube", "warm_start": "none"}, None, "reference:tube"),
        ({"warm_start": "none"}, None, None),
    ],
)
def test_runs_begin_at_the_reference_if_there_is_one_and_nothing_else_is_said(
    fields: dict[str, Any], warm: str | None, reference: str | None
) -> None:
    job = job_of(**fields)
    assert (job.warm_start, job.trend.reference) == (warm, reference)
