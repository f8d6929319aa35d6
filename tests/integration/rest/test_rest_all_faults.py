"""One answer has every fault of types; if there is none, every fault of what the fields mean."""

from itertools import product
from typing import Any

import pytest
from starlette.testclient import TestClient

from tests.support.service.web_app import read_faults, store_csv

SWEEP = {"sigma": [0.1], "replicates": 2}
TRUTH = {
    "parameters": {"K": 2, "T": 1, "L": 0.5, "y0": 0},
    "samples": 80,
    "sample_time": 0.1,
    "inputs": {"u": {"kind": "step"}},
}
TWO_OUTPUTS = {
    "name": "two",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {"T": {"lower": 1, "upper": 9}},
    "equations": {"x": "(u - x)/T"},
    "outputs": {"y": "x", "z": "2*x"},
}


def list_faults(answer: Any) -> dict[str, str]:
    return {one["pointer"]: one["detail"] for one in read_faults(answer, 422, "invalid")}


@pytest.mark.parametrize(
    ("changes", "pointers"),
    [
        (
            {"seed": "x", "parameters": {"LL": {"upper": 1}, "K": {"upper": "x"}}},
            {"/seed", "/parameters/K/upper"},
        ),
        ({"model": 3, "datasets": ["none"], "algoritm": {}}, {"/model", "/algoritm"}),
        (
            {"sweep": {"axes": [{"values": [1]}]}, "trend": {"x": "n", "parameters": ["LL"]}},
            {"/sweep/axes/0/path"},
        ),
        ({"channels": {"u": 3}, "hold": {"y": "zero", "u": "held"}}, {"/channels/u", "/hold/u"}),
    ],
)
def test_a_job_with_faults_of_types_is_told_all_of_these_and_no_others(
    server: TestClient, dataset: str, changes: dict[str, Any], pointers: set[str]
) -> None:
    body = {"model": "fopdt", "datasets": [dataset], **changes}
    assert set(list_faults(server.post("/v1/jobs", json=body))) == pointers


@pytest.mark.parametrize(
    ("changes", "pointers"),
    [
        (
            {"parameters": {"LL": {"upper": 1}, "KK": {"upper": 1}, "T": {"lower": 9, "upper": 1}}},
            {"/parameters/LL", "/parameters/KK", "/parameters/T"},
        ),
        ({"model": "fopd", "datasets": ["none"]}, {"/model", "/datasets/0"}),
        (
            {
                "channels": {"w": "u"},
                "sweep": {"axes": [{"path": "/sed", "range": [0, 2]}]},
                "parameters": {"LL": {"upper": 1}},
            },
            {"/channels/w", "/sweep/axes/0/path", "/parameters/LL"},
        ),
        (
            {"sweep": {"axes": [{"path": "/seed", "range": [0, 900_000]}]}, "hold": {"y": "zero"}},
            {"/sweep/axes", "/hold/y"},
        ),
        (
            {"channels": {"u": "volts"}, "parameters": {"L": {"lower": 9, "upper": 5}}},
            {"/channels/u", "/parameters/L"},
        ),
        (
            {
                "parameters": {"LL": {"upper": 1}},
                "sweep": {
                    "axes": [
                        {"path": "/noise/sigma", "values": [0, -1]},
                        {"path": "/parameters/K/fixed", "values": [1, 7]},
                        {"path": "/algorithm/population", "values": [50, 2]},
                    ]
                },
            },
            {"/parameters/LL", "/sweep/axes/0/values/1", "/sweep/axes/2/values/1"},
        ),
        (
            {"datasets": ["none"], "parameters": {"x(0)[2]": {"fixed": 0}, "x[2]": {"fixed": 0}}},
            {"/datasets/0", "/parameters/x[2]"},
        ),
    ],
)
def test_a_job_of_right_types_is_told_all_its_faults_and_none_that_follows_from_another(
    server: TestClient, dataset: str, changes: dict[str, Any], pointers: set[str]
) -> None:
    body = {"model": "fopdt", "datasets": [dataset], **changes}
    assert set(list_faults(server.post("/v1/jobs", json=body))) == pointers


@pytest.mark.parametrize(
    ("changes", "pointers"),
    [
        (
            {"datasets": True, "sigma": [-1], "replicates": 0, "parameters": {"LL": {"upper": 1}}},
            {"/sigma/0", "/replicates"},
        ),
        (
            {"truth": {**TRUTH, "inputs": {}}, "hold": {"y": "zero"}, "replicates": 100_001},
            {"/truth/inputs/u", "/replicates", "/hold/y"},
        ),
        (
            {
                "truth": {**TRUTH, "samples": 50},
                "parameters": {"LL": {"upper": 1}, "L": {"upper": 5}},
            },
            {"/truth", "/parameters/LL"},
        ),
        (
            {"truth": TRUTH, "model": "fopd", "algorithm": {"method": "simple"}},
            {"/model", "/algorithm/method"},
        ),
        (
            {"datasets": True, "relative": True, "model": TWO_OUTPUTS, "hold": {"y": "zero"}},
            {"/relative", "/hold/y", "/channels"},
        ),
    ],
)
def test_a_noise_sweep_is_told_its_faults_of_types_else_all_others(
    server: TestClient, dataset: str, changes: dict[str, Any], pointers: set[str]
) -> None:
    body = {**SWEEP, "model": "fopdt", **changes}
    if "datasets" in changes:
        body["datasets"] = [dataset]
    assert set(list_faults(server.post("/v1/recipes/noise-sweep", json=body))) == pointers


def test_faults_of_a_model_document_in_a_noise_sweep_are_told_once_at_the_model(
    server: TestClient,
) -> None:
    wrong = {**TWO_OUTPUTS, "equations": {"x": "(u - z)/T"}}
    body = {**SWEEP, "model": wrong, "truth": TRUTH}
    answer = server.post("/v1/recipes/noise-sweep", json=body)
    assert [one["pointer"] for one in read_faults(answer, 422, "invalid")] == ["/model/equations/x"]


def test_units_and_missing_channels_are_told_in_one_answer(server: TestClient) -> None:
    text = b"t,u [V],x [K]\n" + b"".join(b"%d,%d,%d\n" % (n, n % 3, n % 5) for n in range(60))
    name = store_csv(server, text)
    own = {
        "name": "own",
        "form": "differential",
        "inputs": {"u": "Pa"},
        "states": {"x": "m"},
        "parameters": {"T": {"lower": 1, "upper": 9}},
        "equations": {"x": "(u - x)/T"},
        "outputs": {"y": "x"},
    }
    body = {"model": own, "datasets": [name]}
    found = list_faults(server.post("/v1/jobs", json=body))
    assert set(found) == {"/channels", "/datasets/0"}
    assert "no channel 'y'" in found["/channels"]
    assert "'u' is in V" in found["/datasets/0"]
    batch = {"model": own, "label": "n", "batch": [{"x": 1, "datasets": [name]}]}
    assert set(list_faults(server.post("/v1/recipes/reidentify", json=batch))) >= {"/channels"}


def test_a_batch_is_told_its_faults_of_types_else_all_others(
    server: TestClient, dataset: str
) -> None:
    batch = [{"x": 5, "datasets": [dataset]}]
    body = {"model": "fopdt", "label": "n", "batch": batch, "trend_parameters": ["LL"], "seed": "x"}
    assert set(list_faults(server.post("/v1/recipes/reidentify", json=body))) == {"/seed"}
    body = {"model": "fopdt", "batch": 3, "trend_parameters": ["LL"], "warm_start": "reference"}
    found = list_faults(server.post("/v1/recipes/reidentify", json=body))
    assert set(found) == {"/label", "/batch"}
    body = {
        "model": "fopdt",
        "label": "n",
        "batch": batch,
        "warm_start": "reference",
        "trend_parameters": ["LL"],
        "parameters": {"LL": {"upper": 1}},
    }
    found = list_faults(server.post("/v1/recipes/reidentify", json=body))
    assert set(found) == {"/warm_start", "/trend_parameters/0", "/parameters/LL"}


@pytest.mark.parametrize(
    ("path", "others"),
    [
        ("/v1/jobs", ""),
        ("/v1/jobs", '"seed": "x", "skip": -1,'),
        ("/v1/recipes/noise-sweep", ""),
        ("/v1/datasets:simulate", ""),
    ],
)
@pytest.mark.parametrize("nested", [("[", "]"), ('{"a":', "}")])
def test_a_body_that_is_nested_too_deeply_is_refused_wherever_that_is(
    server: TestClient, path: str, others: str, nested: tuple[str, str]
) -> None:
    start, end = nested
    for depth, field in product((60, 600, 960, 990), ("model", "parameters", "sweep", "unknown")):
        body = f'{{"datasets": ["d"], {others} "{field}": {start * depth}1{end * depth}}}'
        answer = server.post(path, content=body, headers={"content-type": "application/json"})
        assert read_faults(answer, 422, "invalid")


def test_of_very_many_unknown_fields_the_first_are_told_and_how_many_more_there_are(
    server: TestClient, dataset: str
) -> None:
    many = {f"x{number}": 1 for number in range(2500)}
    answer = server.post("/v1/jobs", json={"model": "fopdt", "datasets": [dataset], **many})
    found = read_faults(answer, 422, "invalid")
    assert len(found) == 1001
    assert found[-1] == {"pointer": "", "detail": "1500 more faults are not listed"}


@pytest.mark.parametrize("changes", [{}, {"seed": "x"}])
def test_a_header_that_cannot_be_used_is_told_with_the_faults_of_types(
    server: TestClient, dataset: str, changes: dict[str, Any]
) -> None:
    body = {"model": "fopdt", "datasets": [dataset], "parameters": {"LL": {"upper": 1}}, **changes}
    answer = server.post("/v1/jobs", json=body, headers={"Idempotency-Key": "k" * 201})
    assert set(list_faults(answer)) == {"?idempotency-key", *(f"/{name}" for name in changes)}
