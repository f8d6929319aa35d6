"""What a batch is compared with, and what it is not to be: of another model, otherwise made."""

from typing import Any

import httpx
import pytest
from typer.testing import CliRunner

from service.cli import common
from service.cli.main import build_program
from service.client.client import Client
from service.trends import batch_trend
from tests.integration.rest.test_rest_reidentify import find_quantity, read_trend, run_at
from tests.support.service.tube_batch import BODY, LENGTHS, ServedBatch, identify_batch
from tests.support.service.web_app import read_faults


@pytest.fixture(scope="module")
def compared_batch(served_batch: ServedBatch) -> ServedBatch:
    """The batch, whose run at 8 m is a reference."""
    reference = {"run": run_at(served_batch, served_batch.job, 8.0)}
    told = served_batch.server.put("/v1/references/tube", json=reference)
    assert told.status_code == 200, told.text
    return served_batch


def against(compared_batch: ServedBatch, **fields: Any) -> dict[str, Any]:
    """The trend of the second experiments, compared with the reference."""
    batch = [{"x": x, "datasets": compared_batch.datasets[x][1:]} for x in LENGTHS]
    body = {"batch": batch, "reference": "tube", **fields}
    return read_trend(compared_batch, identify_batch(compared_batch.server, **body))


def list_drifts(found: dict[str, Any], name: str) -> dict[tuple[float, str], dict[str, Any]]:
    return {
        (point["x"], one["kind"]): one
        for point in find_quantity(found, name)["points"]
        for one in point["drifts"]
    }


def test_a_file_of_another_length_is_told_as_drifted_in_every_quantity(
    compared_batch: ServedBatch,
) -> None:
    batch = [
        {"x": x, "datasets": compared_batch.datasets[4.0 if x == 8 else x][1:]}
        for x in LENGTHS
        if x != 4
    ]
    found = against(compared_batch, batch=batch)
    for name in ("L", "T", "onset delay"):
        told = list_drifts(found, name)
        assert told[8.0, "trend"]["drifted"], name
        assert told[8.0, "trend"]["limit"] < 6.5
        assert not any(one["drifted"] for (x, _), one in told.items() if x != 8), name


def test_the_onset_delay_is_compared_with_the_reference_run_too(
    compared_batch: ServedBatch,
) -> None:
    found = against(compared_batch)
    told = list_drifts(found, "onset delay")[8.0, "run"]
    first = find_quantity(read_trend(compared_batch, compared_batch.job), "onset delay")["points"][
        2
    ]
    assert told["expected"] == pytest.approx(first["value"])
    assert abs(told["z"]) < told["limit"]


def test_the_limit_of_drift_and_the_name_of_the_reference_are_told(
    compared_batch: ServedBatch,
) -> None:
    found = against(compared_batch)
    assert found["reference_names"] == ["tube"]
    page = compared_batch.server.get(f"/jobs/{found['job']}").text
    assert "Compared with &#39;tube&#39; (length_m = 8)" in page
    assert "drift is flagged where z, in standard errors, exceeds" in page


def test_what_the_reference_was_made_with_otherwise_is_told(compared_batch: ServedBatch) -> None:
    assert against(compared_batch)["notes"] == []
    other = against(
        compared_batch,
        hold={"u": "zero"},
        parameters={"K": {"fixed": 1.0}},
        loss={"kind": "soft-l1", "scale": 0.05},
        channels={"u": "y", "y": "u"},
    )
    (note,) = other["notes"]
    assert note.startswith("the reference was made with ")
    for told in (
        "hold of u = auto (here zero)",
        "K = none (here 1, fixed)",
        "u = u (here y)",
        "loss = squares (here soft-l1 of scale 0.05)",
    ):
        assert told in note


def test_why_there_is_nothing_to_compare_with_is_told(compared_batch: ServedBatch) -> None:
    found = against(compared_batch, label="bore_mm")
    (note,) = found["notes"]
    assert note == (
        "the reference run has no label 'bore_mm', and the trend of its job is over 'length_m'. "
        "The batch is compared with nothing"
    )


def fopdt_run(compared_batch: ServedBatch) -> str:
    """A run of a model that has the tube's parameters and another."""
    job = identify_batch(
        compared_batch.server,
        model="fopdt",
        trend_parameters=["L"],
        batch=[{"x": 8.0, "datasets": compared_batch.datasets[8.0][:1]}],
    )
    return run_at(compared_batch, job, 8.0)


def test_a_name_that_stands_for_a_model_takes_no_run_of_another(
    compared_batch: ServedBatch,
) -> None:
    run = fopdt_run(compared_batch)
    (fault,) = read_faults(
        compared_batch.server.put("/v1/references/tube", json={"run": run}), 422, "invalid"
    )
    assert fault["pointer"] == "/run"
    assert "'fopdt'" in fault["detail"]
    assert "'tube' stands for the model 'tube'" in fault["detail"]
    assert compared_batch.server.get("/v1/references/tube").json()["run"] != run
    assert compared_batch.server.put("/v1/references/lag", json={"run": run}).status_code == 200


def test_a_batch_is_not_begun_at_or_compared_with_a_run_of_another_model(
    compared_batch: ServedBatch,
) -> None:
    run = fopdt_run(compared_batch)
    batch = [{"x": 8.0, "datasets": compared_batch.datasets[8.0][:1]}]
    for warm in ("reference", "none"):
        answer = compared_batch.server.post(
            "/v1/recipes/reidentify",
            json={**BODY, "batch": batch, "reference": run, "warm_start": warm},
        )
        (fault,) = read_faults(answer, 422, "invalid")
        assert fault["pointer"] == "/reference"
        assert (
            "another model: the equations of 'fopdt' differ from those of 'tube'" in fault["detail"]
        )


def test_the_same_equations_under_another_name_with_other_bounds_are_the_same_model(
    compared_batch: ServedBatch,
) -> None:
    document = compared_batch.server.get("/v1/models/tube").json()["document"]
    document = {**document, "name": "my-tube", "description": "mine"}
    document["parameters"]["T"]["upper"] = 1.5
    batch = [{"x": 8.0, "datasets": compared_batch.datasets[8.0][:1]}]
    found = against(compared_batch, model=document, batch=batch)
    assert found["notes"] == ["the reference was made with model = tube (here my-tube)"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["5=ds_a", "6=ds_b", "--accept", "x", "--accept-run", "41"],
            "0 experiments have length_m = 41; there are 5, 6",
        ),
        (["5=ds_a", "6=ds_b", "--accept", "x"], "a value of length_m; there are 5, 6"),
        (["5=ds_a", "5=ds_b", "--accept", "x"], "2 experiments have length_m = 5"),
        (
            ["5=ds_a", "--accept", "x", "--accept-run", "run_1"],
            "For a run of another batch: lagid references accept",
        ),
        (["5=ds_a", "--accept-run", "5"], "--accept-run needs --accept NAME"),
    ],
)
def test_a_run_that_cannot_be_accepted_is_told_before_anything_is_sent(
    monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    def refuse_request(_: httpx.Request) -> httpx.Response:
        raise AssertionError("sent before it was checked")

    client = Client(transport=httpx.MockTransport(refuse_request))
    monkeypatch.setattr(common, "connect_client", lambda *_: client)
    told = CliRunner().invoke(
        build_program(), ["reidentify", "--model", "tube", "--label", "length_m", *words]
    )
    assert told.exit_code == 2
    assert said in " ".join(told.output.split())


def test_one_recording_under_two_labels_is_refused(compared_batch: ServedBatch) -> None:
    batch = [{"x": x, "datasets": compared_batch.datasets[x][:1]} for x in LENGTHS]
    batch[0]["datasets"] = ["tube-16-1-0"]  # by its name what the last entry gives by its id
    answer = compared_batch.server.post("/v1/recipes/reidentify", json={**BODY, "batch": batch})
    (fault,) = read_faults(answer, 422, "invalid")
    assert fault["pointer"] == "/batch/3/datasets"
    assert "is the same recording as 'tube-16-1-0' at length_m = 2.0" in fault["detail"]


def test_report_and_page_of_a_batch_name_every_dataset_and_no_best_rms(
    compared_batch: ServedBatch,
) -> None:
    report = compared_batch.server.get(f"/v1/jobs/{compared_batch.job}/report").text
    page = compared_batch.server.get(f"/jobs/{compared_batch.job}").text
    for x in LENGTHS:
        (dataset,) = compared_batch.datasets[x][:1]
        assert f"length_m = {x:g}: tube-{x:g}-1-0 (estimation, " in report
        assert f'length_m = {x:g}: <a href="/datasets/{dataset}">' in page
    assert "Best RMS" not in report + page


def test_the_run_at_the_reference_is_offered_under_its_name_else_the_one_in_the_middle(
    compared_batch: ServedBatch,
) -> None:
    for job, x, name in (
        (against(compared_batch)["job"], 8.0, "tube"),
        (compared_batch.job, 8.0, ""),
    ):
        page = compared_batch.server.get(f"/jobs/{job}").text
        assert f'<option value="{run_at(compared_batch, job, x)}" selected>' in page
        assert f'name="name" required maxlength="100" placeholder="name" value="{name}"' in page


def test_a_reference_batch_that_is_too_large_for_a_trend_is_a_note(
    compared_batch: ServedBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = [{"x": x, "datasets": compared_batch.datasets[x][:1]} for x in LENGTHS[:3]]
    reference = run_at(compared_batch, compared_batch.job, 2.0)
    job = identify_batch(compared_batch.server, batch=batch, reference=reference)
    monkeypatch.setattr(batch_trend, "MAX_RUNS", 3)
    found = read_trend(compared_batch, job)
    (note,) = found["notes"]
    assert "has 4 runs" in note
    assert "at most 3" in note
    kinds = {
        drift["kind"]
        for one in found["quantities"]
        for point in one["points"]
        for drift in point["drifts"]
    }
    assert kinds == {"run"}
