"""Batch re-identification over REST: trend, drift from a reference, acceptance, bad input."""

import json
from typing import Any
from urllib.parse import quote

import pytest
from typer.testing import CliRunner

from service.cli import common, reidentify_command
from service.cli.main import build_program
from service.client.client import Client
from tests.support.service.local_runs import carry_out_job
from tests.support.service.tube_batch import (
    BODY,
    LENGTHS,
    ServedBatch,
    identify_batch,
    make_recording,
    store_tube,
)
from tests.support.service.web_app import Through, read_faults


def read_trend(served_batch: ServedBatch, job: str) -> dict[str, Any]:
    answer = served_batch.server.get(f"/v1/jobs/{job}/trend")
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def find_quantity(found: dict[str, Any], name: str) -> dict[str, Any]:
    return next(dict(one) for one in found["quantities"] if one["name"] == name)


def chosen(one: dict[str, Any]) -> dict[str, Any]:
    return next(dict(law) for law in one["laws"] if law["is_chosen"])


def run_at(served_batch: ServedBatch, job: str, x: float) -> str:
    place = next(one for one in read_trend(served_batch, job)["labels"] if one["x"] == x)
    return str(place["runs"][0])


def test_a_batch_gives_each_length_in_order_with_errors_onset_and_span(
    served_batch: ServedBatch,
) -> None:
    found = read_trend(served_batch, served_batch.job)
    assert [one["x"] for one in found["labels"]] == list(LENGTHS)
    assert [one["name"] for one in found["quantities"]] == ["L", "T", "onset delay"]
    for point in find_quantity(found, "L")["points"]:
        true = 0.02 + 0.01 * point["x"]
        assert abs(point["value"] - true) < 5 * point["stderr"]
        assert point["stderr"] > 0
        assert point["status"] == "identified"
    for place in found["labels"]:
        (span,) = place["spans"]
        assert (span["channel"], span["unit"]) == ("y", "bar")
        assert span["lower"] == pytest.approx(1, abs=0.1)
        assert span["upper"] == pytest.approx(5, abs=0.1)
    assert found["missing"] == 0


def test_runs_begin_at_their_neighbours(served_batch: ServedBatch) -> None:
    request = served_batch.server.get(f"/v1/jobs/{served_batch.job}").json()["request"]
    assert request["warm_start"] == "previous"
    labels = request["sweep"]["axes"][0]["labels"]
    assert [one["length_m"] for one in labels] == list(LENGTHS)


def test_the_laws_are_those_of_the_tube_and_predictions_hold(served_batch: ServedBatch) -> None:
    found = read_trend(served_batch, served_batch.job)
    delay, constant = find_quantity(found, "L"), find_quantity(found, "T")
    assert chosen(delay)["law"] == "line"
    slope = chosen(delay)["coefficients"][1]
    assert slope["value"] == pytest.approx(0.01, abs=4 * slope["stderr"])
    assert chosen(constant)["law"] == "power"
    assert chosen(constant)["coefficients"][1]["value"] == pytest.approx(0.5, abs=0.03)
    inside, outside = delay["predictions"]
    assert inside["lower"] <= 0.12 <= inside["upper"]
    assert (inside["is_outside"], outside["is_outside"]) == (False, True)
    assert any("extrapolation" in note for note in delay["notes"])
    assert all(place["lower"] <= place["value"] <= place["upper"] for place in delay["band"])


def test_experiments_of_one_length_are_fitted_together_or_pooled(served_batch: ServedBatch) -> None:
    both = [{"x": x, "datasets": served_batch.datasets[x]} for x in LENGTHS]
    jointly = read_trend(served_batch, identify_batch(served_batch.server, batch=both))
    assert find_quantity(jointly, "L")["between_runs"] is None
    apart = [{"x": x, "datasets": [one]} for x in LENGTHS for one in served_batch.datasets[x]]
    pooled = read_trend(served_batch, identify_batch(served_batch.server, batch=apart))
    assert find_quantity(pooled, "L")["between_runs"] > 0
    for one, two in zip(
        find_quantity(jointly, "L")["points"], find_quantity(pooled, "L")["points"], strict=True
    ):
        assert len(two["runs"]) == 2
        assert one["value"] == pytest.approx(two["value"], abs=4 * two["stderr"])


def test_an_unchanged_batch_does_not_drift_and_a_changed_length_does(
    served_batch: ServedBatch,
) -> None:
    reference = run_at(served_batch, served_batch.job, 8.0)
    accepted = served_batch.server.put("/v1/references/tube", json={"run": reference, "by": "me"})
    assert accepted.status_code == 200, accepted.text
    changed = store_tube(served_batch.server, 8.0, 3, longer=0.05)
    batch = [{"x": x, "datasets": served_batch.datasets[x][1:]} for x in LENGTHS if x != 8.0]
    job = identify_batch(
        served_batch.server,
        reference="tube",
        batch=[*batch, {"x": 8.0, "datasets": [changed]}],
    )
    found = read_trend(served_batch, job)
    assert (found["reference"], found["reference_x"]) == (reference, 8.0)
    drifted = {
        (point["x"], drift["kind"])
        for point in find_quantity(found, "L")["points"]
        for drift in point["drifts"]
        if drift["drifted"]
    }
    assert drifted == {(8.0, "run"), (8.0, "trend")}
    (against_run,) = (
        one
        for point in find_quantity(found, "L")["points"]
        for one in point["drifts"]
        if one["kind"] == "run"
    )
    assert against_run["difference"] == pytest.approx(0.05, abs=0.005)
    request = served_batch.server.get(f"/v1/jobs/{job}").json()["request"]
    assert request["warm_start"] == request["trend"]["reference"] == reference


def test_references_keep_their_history_and_say_what_is_wrong(served_batch: ServedBatch) -> None:
    first, second = (run_at(served_batch, served_batch.job, x) for x in (2.0, 4.0))
    for run in (first, second, second):
        answer = served_batch.server.put("/v1/references/kept", json={"run": run})
        assert answer.status_code == 200
    told = served_batch.server.get("/v1/references/kept").json()
    assert (told["run"], [one["run"] for one in told["history"]]) == (second, [first])
    assert told["labels"] == {"length_m": 4.0}
    assert set(told["estimates"]) == {"K", "T", "L"}
    assert "kept" in [
        one["name"] for one in served_batch.server.get("/v1/references").json()["items"]
    ]
    wrong = served_batch.server.put("/v1/references/kept", json={"run": "run_none"})
    assert read_faults(wrong, 422, "invalid")[0]["pointer"] == "/run"
    missing = served_batch.server.get("/v1/references/kep")
    assert missing.status_code == 404
    assert "did you mean 'kept'" in missing.json()["detail"]


def test_every_unknown_dataset_of_a_batch_is_told_at_its_entry(served_batch: ServedBatch) -> None:
    batch = [
        {"x": 3, "datasets": ["ds_c"]},
        {"x": 1, "datasets": ["ds_a"]},
        {"x": 2, "datasets": served_batch.datasets[2.0][:1]},
        {"x": 4, "datasets": ["ds_d"]},
    ]
    answer = served_batch.server.post("/v1/recipes/reidentify", json={**BODY, "batch": batch})
    faults = read_faults(answer, 422, "invalid")
    assert {
        (one["pointer"][:17], named)
        for one in faults
        for named in ("ds_a", "ds_c", "ds_d")
        if named in one["detail"]
    } == {
        ("/batch/0/datasets", "ds_c"),
        ("/batch/1/datasets", "ds_a"),
        ("/batch/3/datasets", "ds_d"),
    }
    assert len(faults) == 3


def test_a_warm_start_that_was_asked_for_is_told_also_for_a_batch_of_one(
    served_batch: ServedBatch,
) -> None:
    batch = [{"x": 2.0, "datasets": served_batch.datasets[2.0][:1]}]
    job = identify_batch(served_batch.server, batch=batch, warm_start="previous")
    told = served_batch.server.get(f"/v1/jobs/{job}").json()
    assert (told["state"], told["request"]["warm_start"]) == ("succeeded", "previous")


@pytest.mark.parametrize("name", ["run_mine", "reference:x", "a/b", "..", " blank", "n" * 101])
def test_a_name_that_means_something_else_is_refused_at_the_path(
    served_batch: ServedBatch, name: str
) -> None:
    run = run_at(served_batch, served_batch.job, 2.0)
    path = f"/v1/references/{quote(name, safe='')}".replace("..", "%2E%2E")
    (fault,) = read_faults(served_batch.server.put(path, json={"run": run}), 422, "invalid")
    assert fault["pointer"] == "{name}"
    assert "the name in the path is" in fault["detail"]
    assert "need" in fault["detail"]


def test_references_are_paged_and_a_new_note_is_kept(served_batch: ServedBatch) -> None:
    run = run_at(served_batch, served_batch.job, 2.0)
    for name in ("p1", "p2", "p3"):
        for note in ("first", "second"):
            body = {"run": run, "note": note}
            assert served_batch.server.put(f"/v1/references/{name}", json=body).status_code == 200
    pages = served_batch.server.get("/v1/references?limit=1&cursor=p1").json()
    assert ([one["name"] for one in pages["items"]], pages["next"]) == (["p2"], "p2")
    assert pages["items"][0]["note"] == "second"
    assert set(pages["items"][0]["estimates"]) == {"K", "T", "L"}
    told = served_batch.server.get("/v1/references/p3").json()
    assert [one["note"] for one in told["history"]] == ["first"]
    client = Client("http://testserver", transport=Through(served_batch.server))
    assert {"p1", "p2", "p3"} <= {one["name"] for one in client.references()}
    read_faults(served_batch.server.get("/v1/references?limit=0"), 422, "invalid")


@pytest.mark.parametrize(
    ("fields", "pointer", "said"),
    [
        ({"batch": []}, "/batch", "at least 1"),
        ({"reference": "nobody"}, "/reference", "there is no reference 'nobody'"),
        ({"warm_start": "reference"}, "/warm_start", "needs the field 'reference'"),
        ({"trend_parameters": ["Q"]}, "/trend_parameters/0", "no parameter 'Q'"),
        ({"batch": [{"x": 5, "datasets": ["ds_none"]}]}, "/batch/0/datasets/0", "ds_none"),
        ({"label": 'a"b'}, "/label", "quotation marks"),
        ({"batch": [{"x": 1e300, "datasets": ["ds_none"]}]}, "/batch/0/x", "1e-100 to 1e100"),
        ({"predict": [1.0, 1e-300]}, "/predict/1", "1e-100 to 1e100"),
    ],
)
def test_a_fault_is_told_at_its_place_in_the_recipe(
    served_batch: ServedBatch, fields: dict[str, Any], pointer: str, said: str
) -> None:
    batch = [{"x": x, "datasets": served_batch.datasets[x]} for x in LENGTHS]
    answer = served_batch.server.post(
        "/v1/recipes/reidentify", json={**BODY, "batch": batch, **fields}
    )
    faults = read_faults(answer, 422, "invalid")
    assert pointer in faults[0]["pointer"]
    assert said in json.dumps(faults)


@pytest.mark.parametrize(
    ("labels", "pointer", "said"),
    [
        (None, "/trend/x", "No axis has labels"),
        ([{"width": 1}, {"width": 2}], "/trend/x", "no run has a label 'length_m'"),
        ([{"length_m": 1}, {}], "/sweep/axes/0/labels/1", "it is missing"),
        ([{"length_m": 1}, {"length_m": "two"}], "/sweep/axes/0/labels/1", "found 'two'"),
        ([{"length_m": 1}, {"length_m": 1e300}], "/sweep/axes/0/labels/1", "1e-100 to 1e+100"),
    ],
)
def test_labels_missing_for_a_trend_are_told(
    served_batch: ServedBatch, labels: Any, pointer: str, said: str
) -> None:
    values = [served_batch.datasets[2.0][:1], served_batch.datasets[4.0][:1]]
    axis = {"path": "/datasets", "values": values, "labels": labels}
    body = {
        "model": "tube",
        "datasets": values[0],
        "sweep": {"axes": [axis]},
        "trend": {"x": "length_m"},
    }
    (fault,) = read_faults(served_batch.server.post("/v1/jobs", json=body), 422, "invalid")
    assert fault["pointer"] == pointer
    assert said in fault["detail"]


def test_a_trend_of_too_few_lengths_says_how_many_it_needs(served_batch: ServedBatch) -> None:
    batch = [{"x": x, "datasets": served_batch.datasets[x][:1]} for x in LENGTHS[:2]]
    found = read_trend(served_batch, identify_batch(served_batch.server, batch=batch))
    assert find_quantity(found, "L")["laws"] == []
    assert "needs 3" in find_quantity(found, "L")["reason"]


def test_lengths_that_no_law_can_hold_are_told_and_the_page_is_shown(
    served_batch: ServedBatch,
) -> None:
    sizes = (-1e99, 1.0, 2.0, 1e99)
    recordings = [served_batch.datasets[x][:1] for x in LENGTHS]
    batch = [{"x": x, "datasets": one} for x, one in zip(sizes, recordings, strict=True)]
    job = identify_batch(served_batch.server, batch=batch)
    assert [one["x"] for one in read_trend(served_batch, job)["labels"]] == list(sizes)
    assert served_batch.server.get(f"/jobs/{job}").status_code == 200


def test_a_job_without_a_trend_says_so(served_batch: ServedBatch) -> None:
    body = {"model": "tube", "datasets": served_batch.datasets[2.0]}
    job = served_batch.server.post("/v1/jobs", json=body).json()["id"]
    read_faults(served_batch.server.get(f"/v1/jobs/{job}/trend"), 409, "conflict")
    figure = served_batch.server.get(f"/v1/jobs/{job}/figures/trend").json()
    assert figure["data"] == []


def test_figure_page_and_report_show_the_trend(served_batch: ServedBatch) -> None:
    figure = served_batch.server.get(f"/v1/jobs/{served_batch.job}/figures/trend").json()
    points = [one for one in figure["data"] if one["name"].endswith("estimate ± standard error")]
    assert [one["x"] for one in points] == [list(LENGTHS)] * 3
    assert all(len(one["error_y"]["array"]) == 4 for one in points)
    assert json.dumps(figure, allow_nan=False)
    query = {"outliers": "include"}
    for path in ("figures/trend", "trend"):
        assert served_batch.server.get(
            f"/v1/jobs/{served_batch.job}/{path}", params=query
        ).is_success
        read_faults(
            served_batch.server.get(f"/v1/jobs/{served_batch.job}/{path}?outliers=some"),
            422,
            "invalid",
        )
    page = served_batch.server.get(f"/jobs/{served_batch.job}").text
    assert "Trend over length [m]" in page
    assert "L = (0.0" in page
    report = served_batch.server.get(f"/v1/jobs/{served_batch.job}/report").text
    assert 'id="figure-trend"' in report


@pytest.fixture
def command(served_batch: ServedBatch, monkeypatch: pytest.MonkeyPatch) -> CliRunner:
    """The command line against this server; jobs are carried out while it waits."""

    def connect_in_process(*_: object) -> Client:
        return Client("http://testserver", transport=Through(served_batch.server))

    def follow(opened: Client, job: str, *, quiet: bool = False) -> dict[str, Any]:
        carry_out_job(served_batch.parts, job)
        return opened.job(job)

    monkeypatch.setattr(common, "connect_client", connect_in_process)
    monkeypatch.setattr(f"{reidentify_command.__name__}.follow_job", follow)
    return CliRunner()


def test_the_command_uploads_prints_and_accepts(
    served_batch: ServedBatch, command: CliRunner, tmp_path: Any
) -> None:
    words = [
        "reidentify",
        "--model",
        "tube",
        "--label",
        "length_m",
        "--parameters",
        "L,T",
        "--predict",
        "10",
        "--set",
        "algorithm.population=20",
        "--set",
        "algorithm.islands=2",
    ]
    for x in LENGTHS[:3]:
        file = tmp_path / f"{x:g}.csv"
        file.write_bytes(make_recording(x, 5))
        words.append(f"{x:g}={file}")
    out = tmp_path / "trend.json"
    told = command.invoke(
        build_program(),
        [
            *words,
            "--output",
            str(out),
            "--accept",
            "own",
            "--accept-run",
            "4",
            "--keep-outliers",
        ],
    )
    assert told.exit_code == 0, told.output
    assert "L = (" in told.output
    assert "predicted" in told.output
    trend = json.loads(out.read_text())
    assert trend["outliers"] == "include"
    accepted = next(one["runs"][0] for one in trend["labels"] if one["x"] == 4)
    assert f"own: {accepted}" in told.output
    shown = command.invoke(build_program(), ["references", "show", "own"])
    assert accepted in shown.output
    listed = command.invoke(build_program(), ["references", "list", "--json"])
    assert accepted in listed.output


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a.csv"], "need X=DATA"),
        (["long=a.csv"], "need a number"),
        (["5=nowhere.csv"], "there is no file nowhere.csv"),
        (["5=ds_a", "6=ds_b", "--accept", "x"], "--accept needs --accept-run"),
        (["5=ds_a", "--predict", "inf"], "need a number"),
        (["5=ds_a", "--channels", "u"], "need signal=channel"),
    ],
)
def test_a_mistake_in_the_command_is_one_line(
    command: CliRunner, words: list[str], said: str
) -> None:
    told = command.invoke(
        build_program(), ["reidentify", "--model", "tube", "--label", "length_m", *words]
    )
    assert told.exit_code in (1, 2)
    assert said in " ".join(told.output.split())
