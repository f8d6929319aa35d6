"""Comparison of stored results: best first, and only on the same data."""

from typing import Any

import pytest

from service.core.errors import InvalidRequest
from service.runs.comparison import compare_runs
from service.runs.run_schemas import ComparisonOut
from tests.support.cluster.dispatch_place import Place
from tests.support.storage.run_results import claim_job, conclude, write_results


def add_identified_run(
    place: Place, rms: float, changes: dict[str, Any] | None = None, **result: Any
) -> str:
    """A run with this RMS, of a job with these changes."""
    job = place.submit(**(changes or {}))
    (run,) = place.runs(job)
    lease = claim_job(place.database, job)
    write_results(place.database, lease, {run.id: conclude(rms, **result)})
    return run.id


def compare(place: Place, *runs: str) -> ComparisonOut:
    with place.database.read_session() as session:
        return compare_runs(session, runs)


def test_runs_come_by_their_rms_whatever_the_order_they_are_named_in(place: Place) -> None:
    runs = [add_identified_run(place, rms) for rms in (0.3, 0.1, 0.2)]
    assert [one.run for one in compare(place, *runs).runs] == [runs[1], runs[2], runs[0]]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"noise": {"sigma": 0.1}}, "other added noise"),
        ({"noise": {"seed": 7}}, "other added noise"),
        ({"skip": 3}, "another number of skipped samples"),
        ({"validation": {"fraction": 0.3}}, "other validation data"),
        ({"channels": {"u": "y", "y": "u"}}, "other measured channels as outputs"),
    ],
)
def test_a_run_on_other_data_is_refused_by_its_place(
    place: Place, changes: dict[str, Any], said: str
) -> None:
    first, same, other = (
        add_identified_run(place, 0.3),
        add_identified_run(place, 0.2),
        add_identified_run(place, 0.1, changes),
    )
    with pytest.raises(InvalidRequest) as refused:
        compare(place, first, same, other)
    (fault,) = refused.value.errors
    assert fault.pointer == "/runs/2"
    assert said in fault.detail


def test_a_parameter_that_depends_on_the_run_is_told_with_the_two_furthest_apart(
    place: Place,
) -> None:
    runs = [
        add_identified_run(place, 0.1, L=(1.2, 0.01), T=(2.0, 0.1)),
        add_identified_run(place, 0.2, L=(1.0, 0.01), T=(2.1, 0.1)),
        add_identified_run(place, 0.3, L=(1.5, 0.01), T=(2.0, None)),
    ]
    found = compare(place, *runs)
    told = {one.name: (one.differs, one.note) for one in found.parameters}
    assert told["T"] == (False, "")
    differs, note = told["L"]
    assert differs
    assert note.startswith("L depends on the run: 1.000 ± 0.010 s with ")
    assert "1.500 ± 0.010 s" in note
    assert found.notes == [note]


def test_losses_and_numbers_of_samples_that_differ_are_noted(place: Place) -> None:
    plain = add_identified_run(place, 0.1)
    robust = add_identified_run(place, 0.2, {"loss": {"kind": "soft-l1", "scale": 0.5}})
    short = add_identified_run(place, 0.3, samples=90)
    assert any("different losses" in note for note in compare(place, plain, robust).notes)
    assert any("numbers of samples" in note for note in compare(place, plain, short).notes)
