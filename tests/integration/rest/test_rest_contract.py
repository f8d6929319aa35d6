"""The OpenAPI document: complete, committed, and kept by the server."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from jsonschema import Draft202012Validator
from starlette.testclient import TestClient

from service.api.app import create_app
from service.api.contract import examples
from service.api.contract.openapi import list_operations
from service.api.contract.write_contract import (
    DOCUMENT_FILE,
    TYPES_FILE,
    write_document,
    write_types,
)
from service.core.bodies.value_schemas import describe_value
from sysid.core.value_documents import list_fields
from sysid.results.result import Result
from sysid.uncertainty.estimates import Estimate
from tests.support.checkout import ROOT
from tests.support.service.local_runs import carry_out_job
from tests.support.service.web_app import parts_of, read_faults, settings_of

SMALL = {"population": 20, "generations": 30, "islands": 1, "stop": {"evaluations": 3000}}
STREAMED = ("stream_events",)
# What an example refers to is there only after these; all others come in the document's order.
FIRST = ("simulate_dataset", "derive_dataset", "add_model", "accept_reference")
LAST = ("cancel_job", "resume_job")
DELETIONS = ("delete_reference", "delete_model", "delete_run", "delete_job", "delete_dataset")


class World(NamedTuple):
    """An application in which every example of the document has what it refers to."""

    server: TestClient
    document: dict[str, Any]
    names: dict[str, str]
    doomed: dict[str, str]
    """What the deletions delete."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with TestClient(create_app(settings_of(tmp_path_factory.mktemp("contract")))) as server:
        document = server.get("/openapi.json").json()

        def post(path: str, example: str, **changes: Any) -> str:
            body = {**examples.BODIES[example]["application/json"], **changes}
            answer = server.post(path, json=body)
            assert answer.is_success, answer.text
            return str(answer.json()["id"])

        dataset = post("/v1/datasets:simulate", "simulate_dataset")
        post(f"/v1/datasets/{dataset}:derive", "derive_dataset")
        room = "t,room [degC]\n0.5,20\n1.5,20.5\n3.5,21\n"
        other = f"/v1/datasets?name={examples.OTHER_LOGGER}"
        assert server.post(other, content=room, headers={"content-type": "text/csv"}).is_success
        batch = post("/v1/recipes/reidentify", "submit_reidentification", algorithm=SMALL)
        twice = {"axes": [{"path": "/seed", "values": [1, 2]}]}
        pair = post("/v1/jobs", "submit_job", algorithm=SMALL, sweep=twice)
        parts = parts_of(server)
        carry_out_job(parts, batch)
        runs = carry_out_job(parts, pair)
        doomed_job = post("/v1/jobs", "submit_job", algorithm=SMALL, sweep=twice)
        doomed = {
            examples.RUN: carry_out_job(parts, doomed_job)[0],
            examples.JOB: doomed_job,
            examples.DATASET_ID: post(
                "/v1/datasets:simulate", "simulate_dataset", name="doomed", samples=50
            ),
        }
        names = {
            examples.DATASET_ID: dataset,
            examples.RUN: runs[0],
            examples.OTHER_RUN: runs[1],
            examples.JOB: batch,
            "waiting": post("/v1/jobs", "submit_job"),
        }
        yield World(server, document, names, doomed)


def list_examples(world: World) -> list[tuple[str, str, dict[str, Any]]]:
    """Method, path and operation of each example, those first that others refer to."""
    all_of_them = [
        (method, path, operation)
        for path, methods in world.document["paths"].items()
        for method, operation in methods.items()
    ]
    rank = {name: n - len(FIRST) for n, name in enumerate(FIRST)}
    rank |= {name: n + 1 for n, name in enumerate(LAST + DELETIONS)}
    return sorted(all_of_them, key=lambda entry: rank.get(entry[2]["operationId"], 0))


def fill_path(world: World, path: str, operation: dict[str, Any]) -> str:
    for parameter in operation.get("parameters", ()):
        if parameter["in"] == "path":
            path = path.replace(f"{{{parameter['name']}}}", parameter["example"])
    names = world.names
    if operation["operationId"] in LAST:
        names = {**names, examples.JOB: names["waiting"]}
    if operation["operationId"] in DELETIONS:
        names = {**names, **world.doomed}
    for name, real in names.items():
        path = path.replace(name, real)
    return path


def follow(document: dict[str, Any], value: dict[str, Any]) -> dict[str, Any]:
    if "$ref" not in value:
        return value
    _, _, kind, name = value["$ref"].split("/")
    target: dict[str, Any] = document["components"][kind][name]
    return target


def build_validator(document: dict[str, Any], schema: dict[str, Any]) -> Draft202012Validator:
    return Draft202012Validator({**schema, "components": document["components"]})


def test_every_example_works_when_sent_and_its_answer_has_the_documented_form(
    world: World,
) -> None:
    sent = 0
    for method, path, operation in list_examples(world):
        if operation["operationId"] in STREAMED:
            continue
        for kind, example in bodies_of(operation):
            content = example if isinstance(example, str) else json.dumps(example)
            for name, real in world.names.items():
                content = content.replace(name, real)
            answer = world.server.request(
                method,
                fill_path(world, path, operation),
                content=content if kind else None,
                headers={"content-type": kind} if kind else {},
            )
            sent += 1
            if operation["operationId"] == "check_ready":
                assert answer.status_code == 503  # no dispatcher is alive here
                continue
            assert answer.is_success, (operation["operationId"], answer.text)
            check_answer(world.document, operation, answer)
    assert sent >= len(list_examples(world))


def bodies_of(operation: dict[str, Any]) -> list[tuple[str | None, Any]]:
    """Media type and example of each documented body that has an example."""
    content = operation.get("requestBody", {}).get("content", {})
    found = [(kind, entry["example"]) for kind, entry in content.items() if "example" in entry]
    assert found or not content, operation["operationId"]
    return found or [(None, "")]


def check_answer(document: dict[str, Any], operation: dict[str, Any], answer: Any) -> None:
    where = operation["operationId"], answer.status_code
    documented = follow(document, operation["responses"][str(answer.status_code)])
    kind = answer.headers.get("content-type", "").partition(";")[0]
    assert kind in documented["content"], (where, kind)
    if kind == "application/json":
        schema = documented["content"][kind]["schema"]
        faults = list(build_validator(document, schema).iter_errors(answer.json()))
        assert not faults, (where, faults[0].message, list(faults[0].absolute_path))
    for name in documented.get("headers", {}):
        assert name in answer.headers, (where, name)


def test_a_result_has_exactly_the_documented_fields(world: World) -> None:
    run = world.server.get(f"/v1/runs/{world.names[examples.RUN]}").json()
    schemas = world.document["components"]["schemas"]
    parts = {"parameters": "EstimateOut", "search": "SearchEvidenceOut", "criteria": "CriteriaOut"}
    parts |= {"agreement": "AgreementsOut", "identifiability": "IdentifiabilityOut"}
    parts |= {"residual_tests": "ResidualTestsOut", "islands": "IslandSummaryOut"}
    parts |= {"onset_delays": "OnsetDelayOut", "input_hold": "InputHoldOut"}
    for field, name in parts.items():
        values = run[field] if isinstance(run[field], list) else [run[field]]
        assert values, field
        for value in values:
            assert set(value) == set(schemas[name]["properties"]), field
    assert set(run) == set(schemas["RunOut"]["properties"])
    assert describe_value(Estimate).model_validate(run["parameters"][0])
    assert {field.name for field in list_fields(Result)} <= set(run)


def test_every_field_and_parameter_has_a_description(world: World) -> None:
    for name, schema in world.document["components"]["schemas"].items():
        for field, about in schema.get("properties", {}).items():
            assert about.get("description"), f"{name}.{field}"
    for _, operation in list_operations(world.document):
        for parameter in operation.get("parameters", ()):
            assert parameter.get("description"), (operation["operationId"], parameter["name"])


def test_every_json_answer_names_its_fields(world: World) -> None:
    for _, operation in list_operations(world.document):
        for code, response in operation["responses"].items():
            content = follow(world.document, response).get("content", {})
            for kind in content.keys() & {"application/json", "application/problem+json"}:
                schema = follow(world.document, content[kind]["schema"])
                assert schema.get("properties"), (operation["operationId"], code)


def test_operations_and_schemas_have_one_short_name_each(world: World) -> None:
    names = [operation["operationId"] for _, operation in list_operations(world.document)]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch("[a-z]+(_[a-z]+){1,3}", name) for name in names), names
    schemas = world.document["components"]["schemas"]
    assert all(re.fullmatch("[A-Z][A-Za-z]+", name) for name in schemas), sorted(schemas)


@pytest.mark.parametrize("file", [DOCUMENT_FILE, TYPES_FILE])
def test_the_committed_contract_is_that_of_the_application(world: World, file: Path) -> None:
    write = write_document if file is DOCUMENT_FILE else write_types
    committed = (ROOT / file).read_text(encoding="utf-8")
    assert committed == write(world.document), f"{file} is not up to date: run `make openapi`"


@pytest.mark.parametrize(
    ("path", "name", "words"),
    [
        ("/v1/jobs?stat=failed", "stat", "did you mean 'state'"),
        ("/v1/datasets?limits=3", "limits", "did you mean 'limit'"),
        ("/v1/models/fopdt?x=1", "x", "nothing is read"),
        ("/v1/datasets/none/figures/signals?x=red", "x", "known are abscissa"),
        ("/healthz?verbose=1", "verbose", "nothing is read"),
    ],
)
def test_an_unknown_name_in_a_query_is_refused(
    world: World, path: str, name: str, words: str
) -> None:
    (fault,) = read_faults(world.server.get(path), 422, "invalid")
    assert fault["pointer"] == f"?{name}"
    assert words in fault["detail"]


def test_pages_read_names_of_their_own(world: World) -> None:
    assert world.server.get("/?clone=x&dataset=y").status_code == 200


@pytest.mark.parametrize(
    ("path", "cursor"),
    [
        ("/v1/jobs", "zzz"),
        ("/v1/jobs", "ds_01kb3v8x4m7q2r9s5t6w0y1z2a"),
        ("/v1/datasets", ""),
        ("/v1/models", "mdl_"),
        ("/v1/models", "mdl_%"),
        ("/v1/references", "a/b"),
        ("/v1/references", " x"),
    ],
)
def test_a_cursor_that_no_page_has_given_is_refused(world: World, path: str, cursor: str) -> None:
    (fault,) = read_faults(world.server.get(path, params={"cursor": cursor}), 422, "invalid")
    assert fault["pointer"] == "?cursor"
    assert "use the `next` of the previous page" in fault["detail"]


def test_a_form_that_cannot_be_read_is_refused_like_other_bodies(world: World) -> None:
    kind = {"content-type": "multipart/form-data; boundary=x"}
    (fault,) = read_faults(
        world.server.post("/v1/datasets", content=b"no form", headers=kind), 422, "invalid"
    )
    assert "the form cannot be read" in fault["detail"]


@pytest.mark.parametrize("path", ["/healthz", "/metrics"])
def test_the_head_of_health_is_answered_without_a_body(world: World, path: str) -> None:
    answer = world.server.head(path)
    assert answer.status_code == 200
    assert answer.content == b""


def test_tables_and_pages_are_compressed_and_recordings_are_not(world: World) -> None:
    def encoding(path: str, accepted: str = "gzip") -> str:
        answer = world.server.get(path, headers={"accept-encoding": accepted})
        assert answer.status_code == 200, path
        return str(answer.headers.get("content-encoding", ""))

    data = f"/v1/datasets/{world.names[examples.DATASET_ID]}/content"
    for path in ("/openapi.json", "/", f"{data}.csv"):
        assert encoding(path) == "gzip", path
        assert encoding(path, "identity") == "", path
    assert encoding(data) == ""
    part = world.server.get(data, headers={"accept-encoding": "gzip", "range": "bytes=0-99"})
    assert (part.status_code, len(part.content)) == (206, 100)
    assert encoding(f"/v1/jobs/{world.names[examples.JOB]}/events") == ""
