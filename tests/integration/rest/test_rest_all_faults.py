"""One answer has every fault: of fields that cannot be read, and of what the others mean."""

from collections.abc import Set
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.core.errors import FieldError
from service.core.partial_bodies import beside
from service.jobs.schemas import JobIn
from tests.rest import refused

SWEEP = {"sigma": [0.1], "replicates": 2}
TRUTH = {"parameters": {"K": 2, "T": 1, "L": 0.5, "y0": 0}, "samples": 50, "sample_time": 0.1,
         "inputs": {"u": {"kind": "step"}}}  # fmt: skip


def faults(answer: Any) -> dict[str, str]:
    return {one["pointer"]: one["detail"] for one in refused(answer, 422, "invalid")}


@pytest.mark.parametrize(
    ("changes", "pointers"),
    [
        ({"seed": "x", "parameters": {"LL": {"upper": 1}, "K": {"upper": "x"}}},
         {"/seed", "/parameters/LL", "/parameters/K/upper"}),
        ({"parameters": {"LL": {"upper": 1}, "KK": {"upper": 1}, "T": {"lower": 9, "upper": 1}}},
         {"/parameters/LL", "/parameters/KK", "/parameters/T"}),
        ({"model": "fopd", "seed": "x"}, {"/model", "/seed"}),
        ({"model": "fopd", "datasets": ["none"], "algoritm": {}},
         {"/model", "/datasets/0", "/algoritm"}),
        ({"algorithm": {"populaton": 3, "mutation": [[5, 0.2]]}, "hold": {"y": "zero"}},
         {"/algorithm/populaton", "/algorithm/mutation", "/hold/y"}),
        ({"datasets": 3, "parameters": {"LL": {"upper": 1}}}, {"/datasets", "/parameters/LL"}),
        ({"channels": {"w": "u"}, "sweep": {"axes": [{"path": "/sed", "range": [0, 2]}]},
          "parameters": {"LL": {"upper": 1}}},
         {"/channels/w", "/sweep/axes/0/path", "/parameters/LL"}),
        ({"sweep": {"axes": [{"path": "/seed", "range": [0, 900_000]}]}, "hold": {"y": "zero"}},
         {"/sweep/axes", "/hold/y"}),
        ({"trend": {"x": "n", "parameters": ["LL"]}, "weights": {"z": 1}},
         {"/trend/x", "/trend/parameters/0", "/weights/z"}),
        ({"sweep": {"axes": [{"values": [1]}]}, "trend": {"x": "n", "parameters": ["LL"]}},
         {"/sweep/axes/0/path", "/trend/parameters/0"}),
        ({"validation": {"fraction": 2}, "skip": 10_000}, {"/validation/fraction"}),
        ({"seed": "x", "skip": 10_000}, {"/seed", "/datasets/0"}),
        ({"seed": "x", "channels": {"u": "volts"}, "parameters": {"L": {"lower": 9}}},
         {"/seed", "/channels/u", "/parameters/L"}),
        ({"priority": "high", "sweep": {"axes": [{"path": "/noise/sigma", "values": [0, -1]}]}},
         {"/priority", "/sweep/axes/0/values/1"}),
        ({"priority": "high", "parameters": {"K": {"upper": "x"}}, "sweep": {"axes": [
            {"path": "/parameters/K/fixed", "values": [1, 7]},
            {"path": "/algorithm/population", "values": [50, 2]}]}},
         {"/priority", "/parameters/K/upper", "/sweep/axes/1/values/1"}),
        ({"channels": {"u": 3}, "hold": {"y": "zero"}}, {"/channels/u", "/hold/y"}),
        ({"seed": [], "sweep": {"axes": [{"path": "/seed", "range": [0, 900_000]}]}},
         {"/seed", "/sweep/axes"}),
        ({"chanels": {"u": "volts"}, "skip": 10_000}, {"/chanels"}),
        ({"datasets": 3, "parameters": {one: {"fixed": 1} for one in ("K", "T", "L", "y0")}},
         {"/datasets"}),
        ({"datasets": 3, "parameters": {"x(0)[2]": {"fixed": 0}}}, {"/datasets"}),
        ({"datasets": ["none"], "parameters": {"x(0)[2]": {"fixed": 0}, "x[2]": {"fixed": 0}}},
         {"/datasets/0", "/parameters/x[2]"}),
    ],
)  # fmt: skip
def test_a_job_is_told_all_its_faults_and_none_that_follows_from_another(
    server: TestClient, dataset: str, changes: dict[str, Any], pointers: set[str]
) -> None:
    body = {"model": "fopdt", "datasets": [dataset], **changes}
    assert set(faults(server.post("/v1/jobs", json=body))) == pointers


def test_a_noise_sweep_is_told_all_its_faults(server: TestClient, dataset: str) -> None:
    body = {**SWEEP, "model": "fopdt", "datasets": [dataset], "sigma": [-1], "replicates": 0,
            "parameters": {"LL": {"upper": 1}}}  # fmt: skip
    found = faults(server.post("/v1/recipes/noise-sweep", json=body))
    assert set(found) == {"/sigma/0", "/replicates", "/parameters/LL"}
    body = {**SWEEP, "model": "fopdt", "truth": {**TRUTH, "samples": "x"}, "hold": {"y": "zero"}}
    found = faults(server.post("/v1/recipes/noise-sweep", json=body))
    assert set(found) == {"/truth/samples", "/hold/y"}
    body = {**SWEEP, "model": "fopdt", "truth": TRUTH, "hold": {"y": "zero"},
            "algorithm": {"method": "simple"}}  # fmt: skip
    found = faults(server.post("/v1/recipes/noise-sweep", json=body))
    assert set(found) == {"/algorithm/method", "/hold/y"}


def test_units_and_missing_channels_are_told_beside_what_cannot_be_read(server: TestClient) -> None:
    text = b"t,u [V],x [K]\n" + b"".join(b"%d,%d,%d\n" % (n, n % 3, n % 5) for n in range(60))
    stored = server.post("/v1/datasets", content=text, headers={"content-type": "text/csv"})
    name = stored.json()["id"]
    own = {"name": "own", "form": "differential", "inputs": {"u": "Pa"}, "states": {"x": "m"},
           "parameters": {"T": {"lower": 1, "upper": 9}}, "equations": {"x": "(u - x)/T"},
           "outputs": {"y": "x"}}  # fmt: skip
    body = {"model": own, "datasets": [name], "seed": "x"}
    found = faults(server.post("/v1/jobs", json=body))
    assert set(found) == {"/seed", "/channels", "/datasets/0"}
    assert "no channel 'y'" in found["/channels"]
    assert "'u' is in V" in found["/datasets/0"]
    batch = {"model": own, "label": "n", "batch": [{"x": 1, "datasets": [name]}], "seed": "x"}
    assert set(faults(server.post("/v1/recipes/reidentify", json=batch))) >= {"/seed", "/channels"}


def test_a_batch_is_told_all_its_faults(server: TestClient, dataset: str) -> None:
    batch = [{"x": 5, "datasets": [dataset]}]
    body = {"model": "fopdt", "label": "n", "batch": batch, "look_at": ["LL"], "seed": "x"}
    assert set(faults(server.post("/v1/recipes/reidentify", json=body))) == {"/look_at/0", "/seed"}
    body = {"model": "fopdt", "batch": 3, "look_at": ["LL"], "warm_start": "reference"}
    found = faults(server.post("/v1/recipes/reidentify", json=body))
    assert set(found) == {"/label", "/batch", "/look_at/0", "/warm_start"}
    body = {"model": "fopdt", "label": "n", "batch": batch, "warm_start": "reference",
            "parameters": {"LL": {"upper": 1}}}  # fmt: skip
    found = faults(server.post("/v1/recipes/reidentify", json=body))
    assert set(found) == {"/warm_start", "/parameters/LL"}


@pytest.mark.parametrize(
    "body", [[], 3, None, {"model": "m"}, {"model": "m", "datasets": ["d"], "seed": []}]
)
def test_of_what_is_no_body_nothing_more_is_told(body: Any) -> None:
    def everything(job: JobIn, unread: Set[str]) -> list[FieldError]:
        return [FieldError("", "of the whole"), FieldError("/seed", "of the seed")]

    told = beside(JobIn, body, [FieldError("/seed", "x")], everything)
    assert told == []


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/recipes/noise-sweep", "/v1/datasets:simulate"])
@pytest.mark.parametrize("others", ["", '"seed": "x", "skip": -1,'])
@pytest.mark.parametrize("depth", [60, 300, 600, 900, 960, 990])
@pytest.mark.parametrize("nested", [("[", "]"), ('{"a":', "}")])
def test_a_body_that_is_nested_too_deeply_is_refused_wherever_that_is(
    server: TestClient, path: str, others: str, depth: int, nested: tuple[str, str]
) -> None:
    start, end = nested
    deep = f"{start * depth}1{end * depth}"
    for field in ("model", "parameters", "sweep", "unknown"):
        body = f'{{"datasets": ["d"], {others} "{field}": {deep}}}'
        answer = server.post(path, content=body, headers={"content-type": "application/json"})
        assert refused(answer, 422, "invalid")


def test_of_very_many_unknown_fields_the_first_are_told_and_how_many_more_there_are(
    server: TestClient, dataset: str
) -> None:
    many = {f"x{number}": 1 for number in range(2500)}
    answer = server.post("/v1/jobs", json={"model": "fopdt", "datasets": [dataset], **many})
    found = refused(answer, 422, "invalid")
    assert len(found) == 1001
    assert found[-1] == {"pointer": "", "detail": "and 1500 more faults, not told here"}


def test_what_follows_from_a_fault_is_not_told_above_or_below_it() -> None:
    silent = ["/a/b", "/seed"]
    told = ["", "/a", "/a/b", "/a/b/c", "/a/bc", "/b", "/seed/0", "/seeds"]
    body = {"model": "m", "datasets": ["d"]}

    def everything(_job: JobIn, _unread: Set[str]) -> list[FieldError]:
        return [FieldError(one, "of it") for one in told]

    found = beside(JobIn, body, [FieldError(one, "x") for one in silent], everything)
    assert [one.pointer for one in found] == ["/a/bc", "/b", "/seeds"]


@pytest.mark.parametrize("changes", [{}, {"seed": "x"}, {"parameters": {"LL": {"upper": 1}}}])
def test_a_header_that_cannot_be_used_is_told_beside_the_faults_of_the_body(
    server: TestClient, dataset: str, changes: dict[str, Any]
) -> None:
    body = {"model": "fopdt", "datasets": [dataset], **changes}
    answer = server.post("/v1/jobs", json=body, headers={"Idempotency-Key": "k" * 201})
    parts = {f"/{name}/LL" if name == "parameters" else f"/{name}" for name in changes}
    assert set(faults(answer)) == {"?idempotency-key", *parts}
