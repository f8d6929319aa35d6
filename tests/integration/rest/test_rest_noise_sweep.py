"""The noise sweep over REST: what job it makes, what its runs give, and what is refused."""

import math
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from service.datasets.stored_recordings import load_recording
from service.sweeps import output_spread
from tests.support.service.local_runs import carry_out_job
from tests.support.service.web_app import parts_of, read_faults, recording, settings_of, store_csv

URL = "/v1/recipes/noise-sweep"
TRUE = {"K": 2.0, "T": 1.0, "L": 0.5, "y0": 0.0}
TRUTH = {
    "parameters": TRUE,
    "inputs": {"u": {"kind": "binary", "period": 2}},
    "samples": 150,
    "sample_time": 0.1,
}
SMALL = {"population": 12, "generations": 12, "islands": 1}
BOUNDS = {"T": {"upper": 5.0}, "L": {"upper": 1.0}}
BODY: dict[str, Any] = {
    "model": "fopdt",
    "truth": TRUTH,
    "sigma": [0, 0.1],
    "replicates": 2,
    "algorithm": SMALL,
    "parameters": BOUNDS,
}


def submit_sweep(server: TestClient, **changes: Any) -> dict[str, Any]:
    answer = server.post(URL, json={**BODY, **changes})
    assert answer.status_code == 202, answer.text
    job: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    return job


def carry_out_sweep(server: TestClient, **changes: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """A sweep that was carried out: the job, and its summary."""
    job = submit_sweep(server, **changes)["id"]
    carry_out_job(parts_of(server), job)
    return (server.get(f"/v1/jobs/{job}").json(), server.get(f"/v1/jobs/{job}/summary").json())


def read_numbers(summary: dict[str, Any]) -> dict[str, Any]:
    """A summary without what belongs to one job and one computer."""
    groups = [{**group, "seconds": None} for group in summary["groups"]]
    return {**summary, "job": None, "reused": None, "groups": groups}


def test_the_job_has_a_run_for_each_deviation_replicate_and_method(server: TestClient) -> None:
    job = submit_sweep(server, name="mine", replicates=3)
    assert job["name"] == "mine"
    assert job["progress"]["runs"] == 12
    runs = server.get(f"/v1/jobs/{job['id']}/runs").json()["items"]
    cells = [run["cell"] for run in runs]
    assert [cell["/noise/sigma"] for cell in cells] == [0] * 6 + [0.1] * 6
    assert {cell["/algorithm/method"] for cell in cells} == {"simple", "improved"}
    seeds = [(cell["/noise/seed"], cell["/seed"]) for cell in cells]
    assert seeds == [(1_000_000 + n // 2, 1_000_000 + n // 2) for n in range(6)] * 2


def test_the_draws_of_a_replicate_do_not_depend_on_the_grid(server: TestClient) -> None:
    def draws(**changes: Any) -> set[tuple[Any, ...]]:
        job = submit_sweep(server, **changes)["id"]
        runs = server.get(f"/v1/jobs/{job}/runs", params={"limit": 100}).json()["items"]
        return {tuple(run["cell"].values()) for run in runs}

    small = draws()
    assert small < draws(replicates=5)
    assert small < draws(sigma=[0.05, 0.1, 0.7, 0])
    assert small < draws(methods=["improved", "improved-paper", "simple"])
    assert not small & draws(seed=2)


def test_a_run_without_noise_is_added_only_where_the_truth_is_unknown(
    server: TestClient, dataset: str
) -> None:
    def sigmas(**changes: Any) -> list[float]:
        job = submit_sweep(server, sigma=[0.1], replicates=1, methods=["simple"], **changes)["id"]
        runs = server.get(f"/v1/jobs/{job}/runs").json()["items"]
        return [run["cell"]["/noise/sigma"] for run in runs]

    assert sigmas() == [0.1]
    assert sigmas(truth=None, datasets=[dataset]) == [0.0, 0.1]


def test_the_same_key_gives_the_same_job(server: TestClient) -> None:
    key = {"Idempotency-Key": "noise once"}
    first, again = (server.post(URL, json=BODY, headers=key).json() for _ in range(2))
    assert first["id"] == again["id"]
    other = server.post(URL, json={**BODY, "replicates": 9}, headers=key)
    read_faults(other, 422, "invalid")


def datasets_of(server: TestClient) -> list[str]:
    return [one["id"] for one in server.get("/v1/datasets").json()["items"]]


@pytest.mark.parametrize(
    "fields",
    [
        {"parameters": {"Q": {"fixed": 1}}},
        {"skip": 1000},
        {"algorithm": {"method": "simple"}},
        {"relative": True, "truth": {**TRUTH, "parameters": {**TRUE, "K": 0.0}}},
        {"weights": {"nobody": 1.0}},
    ],
)
def test_a_body_that_is_refused_leaves_no_dataset_behind(
    server: TestClient, fields: dict[str, Any]
) -> None:
    body = {**BODY, "truth": {**TRUTH, "samples": 149}, **fields}  # of no other test
    before = datasets_of(server)
    read_faults(server.post(URL, json=body), 422, "invalid")
    assert datasets_of(server) == before


def test_a_key_that_was_used_with_another_body_leaves_no_dataset_behind(own: TestClient) -> None:
    key = {"Idempotency-Key": "once"}
    body = {**BODY, "relative": True}
    first = own.post(URL, json=body, headers=key).json()["id"]
    (dataset,) = datasets_of(own)
    other = own.post(URL, json={**body, "truth": {**TRUTH, "samples": 151}}, headers=key)
    read_faults(other, 422, "invalid")
    assert datasets_of(own) == [dataset]
    # The second time σ comes from the stored record, the first time from the one in memory.
    assert own.post(URL, json=body, headers=key).json()["id"] == first


def test_a_relative_deviation_reads_no_more_than_a_request_may(
    server: TestClient, dataset: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = {**BODY, "truth": None, "datasets": [dataset], "relative": True}
    assert server.post(URL, json=body).status_code == 202
    # 300 samples of two channels
    monkeypatch.setattr(output_spread, "MAX_READ_VALUES", 599)
    monkeypatch.setattr(output_spread, "load_recording", None)
    (fault,) = read_faults(server.post(URL, json=body), 422, "invalid")
    assert fault["pointer"] == "/relative"
    assert "the datasets have 600 values; at most 599" in fault["detail"]


def test_recordings_are_read_while_no_session_is_open(
    server: TestClient, dataset: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    pool: Any = parts_of(server).database.engine.pool

    def note_and_load(*given: Any) -> Any:
        seen.append(pool.checkedout())
        return load_recording(*given)

    monkeypatch.setattr(output_spread, "load_recording", note_and_load)
    body = {**BODY, "truth": None, "datasets": [dataset], "relative": True}
    assert server.post(URL, json=body).status_code == 202
    assert seen == [0]


def test_the_same_sweep_twice_gives_the_same_numbers(server: TestClient) -> None:
    _, first = carry_out_sweep(server)
    job, again = carry_out_sweep(server, reuse=False)
    assert job["progress"]["reused"] == 0
    assert read_numbers(first) == read_numbers(again)
    assert first["groups"][2]["rms_noise_free"][2] > 0


def test_more_replicates_compute_only_the_new_runs_and_say_so(own: TestClient) -> None:
    _, first = carry_out_sweep(own)
    job, more = carry_out_sweep(own, replicates=3)
    assert (first["reused"], first["runs"]) == (0, 8)
    assert (more["reused"], more["runs"]) == (8, 12)
    assert job["progress"]["reused"] == 8
    assert "8 of 12 reused" in own.get(f"/jobs/{job['id']}").text
    _, other = carry_out_sweep(own, replicates=3, sigma=[0.1, 0.2])
    assert (other["reused"], other["runs"]) == (6, 12)


def test_errors_are_from_the_truth_and_the_bound_grows_in_proportion(server: TestClient) -> None:
    _, found = carry_out_sweep(server, sigma=[0, 0.1, 0.2])
    (reference,) = found["references"]
    assert (reference["kind"], reference["note"]) == ("truth", "")
    assert {name: reference["parameters"][name] for name in TRUE} == TRUE
    assert any("true values" in note for note in found["notes"])
    assert any("finite simulation" in note for note in found["notes"])
    quiet, _, noisy, _, loud, _ = found["groups"]
    assert (quiet["sigma"], noisy["sigma"], loud["sigma"]) == (0.0, 0.1, 0.2)
    assert quiet["rms_cramer_rao_bound"] == 0
    # Four parameters and the start of y, of 150 samples, all of them told by the data.
    assert noisy["rms_cramer_rao_bound"] == pytest.approx(0.1 * math.sqrt(5 / 150))
    assert len(noisy["parameters"]) == 5
    for place, one in enumerate(noisy["parameters"]):
        assert one["reference"] == TRUE.get(one["name"], 0.0)  # y starts at zero
        assert one["error"] == [value - one["reference"] for value in one["value"]]
        assert quiet["parameters"][place]["cramer_rao_bound"] == 0
        assert loud["parameters"][place]["cramer_rao_bound"] == pytest.approx(
            2 * one["cramer_rao_bound"]
        )
        assert one["cramer_rao_bound"] > 0


def test_without_truth_errors_are_from_the_best_run_without_noise(server: TestClient) -> None:
    stored = store_csv(server, recording())
    job, found = carry_out_sweep(server, truth=None, datasets=[stored], sigma=[0.1], replicates=1)
    assert job["progress"]["runs"] == 4  # σ = 0 was added
    (reference,) = found["references"]
    runs = server.get(f"/v1/jobs/{job['id']}/runs").json()["items"]
    silent = [run for run in runs if run["cell"]["/noise/sigma"] == 0]
    best = min(silent, key=lambda run: run["rms"])
    assert (reference["kind"], reference["run"]) == ("estimate", best["id"])
    assert reference["parameters"] == {one["name"]: one["value"] for one in best["parameters"]}
    assert any("true values are unknown" in note for note in found["notes"])
    assert all(one["cramer_rao_bound"] > 0 for one in found["groups"][-1]["parameters"])


def test_a_truth_of_another_model_is_no_truth(server: TestClient) -> None:
    body = {"name": "s", "model": "fopdt", **TRUTH}
    stored = server.post("/v1/datasets:simulate", json=body).json()["id"]
    document = server.get("/v1/models/fopdt").json()["document"]
    other = {**document, "name": "other"}
    changes = {"truth": None, "datasets": [stored], "sigma": [0], "replicates": 1}
    _, same = carry_out_sweep(server, **changes)
    _, apart = carry_out_sweep(server, **changes, model=other)
    assert [one["kind"] for one in same["references"]] == ["truth"]
    assert [one["kind"] for one in apart["references"]] == ["estimate"]


def test_each_problem_of_a_sweep_has_a_truth_and_a_bound_of_its_own(server: TestClient) -> None:
    names = []
    for gain in (2.0, 3.0):
        body = {"name": f"{gain}", "model": "fopdt", **TRUTH, "parameters": {**TRUE, "K": gain}}
        names.append(server.post("/v1/datasets:simulate", json=body).json()["id"])
    axes = [{"path": "/datasets", "values": names}, {"path": "/noise/sigma", "values": [0, 0.1]}]
    body = {
        "model": "fopdt",
        "datasets": names[:1],
        "algorithm": SMALL,
        "parameters": BOUNDS,
        "sweep": {"axes": axes},
    }
    job = server.post("/v1/jobs", json=body).json()["id"]
    carry_out_job(parts_of(server), job)
    found = server.get(f"/v1/jobs/{job}/summary").json()
    gains = [
        next(one for one in group["parameters"] if one["name"] == "K") for group in found["groups"]
    ]
    assert [one["reference"] for one in gains] == [2.0, 2.0, 3.0, 3.0]
    assert gains[1]["cramer_rao_bound"] > 0
    together = server.get(f"/v1/jobs/{job}/summary", params={"by": "/noise/sigma"}).json()
    assert all(one["error"] is None for group in together["groups"] for one in group["parameters"])


def test_a_job_without_noise_tells_no_bound(server: TestClient) -> None:
    body = {"name": "s", "model": "fopdt", **TRUTH}
    stored = server.post("/v1/datasets:simulate", json=body).json()["id"]
    job = server.post(
        "/v1/jobs",
        json={"model": "fopdt", "datasets": [stored], "algorithm": SMALL, "parameters": BOUNDS},
    ).json()["id"]
    carry_out_job(parts_of(server), job)
    found = server.get(f"/v1/jobs/{job}/summary").json()
    assert found["references"] == []
    assert found["groups"][0]["rms_cramer_rao_bound"] is None


def test_relative_deviations_are_in_those_of_the_output(server: TestClient) -> None:
    stored = store_csv(server, recording())
    lines = recording().decode().splitlines()[1:]
    y = [float(line.split(",")[2]) for line in lines]
    mean = sum(y) / len(y)
    spread = math.sqrt(sum((one - mean) ** 2 for one in y) / len(y))
    job = submit_sweep(server, truth=None, datasets=[stored], sigma=[0, 0.5], relative=True)
    runs = server.get(f"/v1/jobs/{job['id']}/runs").json()["items"]
    assert runs[-1]["cell"]["/noise/sigma"] == pytest.approx(0.5 * spread)
    assert runs[-1]["labels"] == {"relative": 0.5}


def test_the_figure_has_a_line_a_method_in_each_plot_and_the_bound(server: TestClient) -> None:
    job, found = carry_out_sweep(server)
    figure = server.get(f"/v1/jobs/{job['id']}/figures/summary").json()
    lines = [one for one in figure["data"] if one["mode"] == "lines+markers"]
    names = [one["name"] for one in found["groups"][0]["parameters"]]
    assert len(lines) == 2 * (1 + len(names))
    medians = [
        group["rms_noise_free"][2]
        for group in found["groups"]
        if group["key"]["/algorithm/method"] == "improved"
    ]
    drawn = next(one for one in lines if one["name"] == "improved")
    assert drawn["x"] == [0, 0.1]
    assert drawn["y"] == pytest.approx(medians, rel=1e-6)
    bounds = [one for one in figure["data"] if one.get("line", {}).get("dash") == "dash"]
    assert len(bounds) == 1 + 2 * len(names)
    rows = server.get(f"/v1/jobs/{job['id']}/figures/summary?format=csv").text.splitlines()
    assert rows[0] == "series,x,y"
    assert any(row.startswith("improved,0.1,") for row in rows)
    assert "overview-1" in server.get(f"/v1/jobs/{job['id']}/report").text


def test_the_figure_of_a_sweep_without_noise_is_empty(server: TestClient) -> None:
    dataset = store_csv(server, recording())
    axes = [{"path": "/seed", "range": [0, 2]}]
    body = {"model": "fopdt", "datasets": [dataset], "sweep": {"axes": axes}}
    job = server.post("/v1/jobs", json=body).json()["id"]
    assert server.get(f"/v1/jobs/{job}/figures/summary").json()["data"] == []


@pytest.mark.parametrize(
    ("changes", "pointer", "detail"),
    [
        ({"replicates": 0}, "/replicates", "need 1 or more"),
        ({"sigma": [0.1, -0.5]}, "/sigma/1", "need 0 or more"),
        ({"sigma": []}, "/sigma", "at least 1"),
        ({"sigma": [0.1, 0.2, 0.1]}, "/sigma", "twice"),
        ({"methods": ["simple", "best"]}, "/methods/1", "'improved'"),
        ({"methods": []}, "/methods", "at least 1"),
        (
            {"replicates": 25_001},
            "/replicates",
            "2 σ × 25001 replicates × 2 methods are 100004 runs; a job may have at most 100000",
        ),
        ({"datasets": ["steps"]}, "", "either 'truth'"),
        ({"truth": None}, "", "either 'truth'"),
        ({"model": "fopdd"}, "/model", "fopdt"),
        ({"truth": {**TRUTH, "parameters": {"K": 1}}}, "/truth/parameters/T", "true value"),
        ({"truth": {**TRUTH, "inputs": {}}}, "/truth/inputs/u", "give input 'u'"),
        ({"truth": {**TRUTH, "samples": 1}}, "/truth/samples", "2"),
        ({"truth": {**TRUTH, "sample_time": 0.001}}, "/truth", "delay"),
        ({"truth": None, "datasets": ["nowhere"]}, "/datasets/0", "nowhere"),
        ({"algorithm": {"method": "simple"}}, "/algorithm/method", "'methods'"),
        ({"parameters": {"Q": {"upper": 1}}}, "/parameters/Q", "Q"),
        ({"sigmas": [1]}, "/sigmas", "unknown field"),
    ],
)
def test_what_cannot_be_swept_is_refused_at_its_place(
    server: TestClient, changes: dict[str, Any], pointer: str, detail: str
) -> None:
    answer = server.post(URL, json={**BODY, **changes})
    faults = read_faults(answer, 422, "invalid")
    assert pointer in [fault["pointer"] for fault in faults], faults
    assert any(detail in fault["detail"] for fault in faults), faults


def test_a_deviation_relative_to_an_output_that_does_not_vary_is_refused(
    server: TestClient,
) -> None:
    still = {
        **TRUTH,
        "parameters": {**TRUE, "K": 1.0},
        "inputs": {"u": {"kind": "step", "amplitude": 0.0}},
    }
    (fault,) = read_faults(
        server.post(URL, json={**BODY, "truth": still, "relative": True}), 422, "invalid"
    )
    assert fault["pointer"] == "/relative"
    assert "does not vary" in fault["detail"]


def test_a_deviation_relative_to_several_outputs_is_refused(server: TestClient) -> None:
    document = server.get("/v1/models/fopdt").json()["document"]
    twice = {**document, "name": "two", "outputs": {**document["outputs"], "z": "2*x"}}
    answer = server.post(URL, json={**BODY, "model": twice, "relative": True})
    (fault,) = read_faults(answer, 422, "invalid")
    assert fault["pointer"] == "/relative"
    assert "outputs" in fault["detail"]


def test_the_limit_of_the_settings_is_that_of_the_sweep(tmp_path: Path) -> None:
    app = create_app(settings_of(tmp_path, max_runs_per_job=7))
    with TestClient(app, raise_server_exceptions=False) as server:
        (fault,) = read_faults(server.post(URL, json=BODY), 422, "invalid")
    assert "8 runs; a job may have at most 7" in fault["detail"]


OSCILLATOR: dict[str, Any] = {
    "model": "duffing-eq16",
    "truth": {
        "parameters": {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0},
        "inputs": {"q": {"kind": "expression", "expression": "10*cos(5*t)"}},
        "samples": 300,
        "sample_time": 0.02,
    },
    "sigma": [0, 1e-4],
    "place": "plant",
    "prediction": "one-step",
    "methods": ["improved"],
}


def test_noise_enters_the_recursion_and_has_its_own_bound(server: TestClient) -> None:
    body = {**OSCILLATOR, "replicates": 3}
    job = server.post(URL, json=body).json()["id"]
    carry_out_job(parts_of(server), job)
    summary = server.get(f"/v1/jobs/{job}/summary").json()
    quiet, noisy = summary["groups"]
    # The bounds of `benchmarks.noisy_recursion`, to first order in the noise.
    for name, bound in {"c": 0.0113, "L": 0.0101, "b": 0.0632, "a": 0.0741}.items():
        (one,) = [p for p in noisy["parameters"] if p["name"] == name]
        assert one["cramer_rao_bound"] == pytest.approx(bound, rel=0.03)
        assert 0 < abs(one["error"][2]) < 3 * bound
    assert noisy["rms_cramer_rao_bound"] is None
    assert quiet["parameters"][0]["error"][2] == pytest.approx(0, abs=1e-6)
    (stored,) = [
        run
        for run in server.get(f"/v1/jobs/{job}/runs").json()["items"]
        if run["cell"]["/noise/sigma"] and run["cell"]["/seed"] == 1_000_001
    ]
    found = server.get(f"/v1/runs/{stored['id']}").json()
    assert found["rms"] == pytest.approx(1e-4, rel=0.1)


def test_noise_inside_the_plant_needs_its_place_and_its_truth(server: TestClient) -> None:
    truth = {**OSCILLATOR["truth"], "parameters": {"c": 0.2, "L": 0.5, "b": 5.0}}
    assert [
        fault["pointer"]
        for fault in read_faults(
            server.post(URL, json={**OSCILLATOR, "truth": truth}), 422, "invalid"
        )
    ] == ["/truth/parameters/a"]
    (fault,) = read_faults(server.post(URL, json={**BODY, "place": "plant"}), 422, "invalid")
    assert fault["pointer"] == "/place"
    assert "Write noise: {plant: {x: estimate}} there" in fault["detail"]
    body = {key: value for key, value in OSCILLATOR.items() if key != "truth"}
    (fault,) = read_faults(server.post(URL, json={**body, "datasets": ["x"]}), 422, "invalid")
    assert "needs 'truth'" in fault["detail"]
    hidden = {**BODY, "model": "coulomb-delay", "place": "plant", "parameters": {}}
    hidden["truth"] = {**OSCILLATOR["truth"], "parameters": {"c": 0.2, "L": 0.5, "b": 5, "mu": 0.5}}
    _, summary = carry_out_sweep(server, **hidden)
    assert summary["groups"][-1]["parameters"][0]["cramer_rao_bound"] is None
    assert any("of one state that is measured" in note for note in summary["notes"])
