"""Errors of the OpenAPI document, and random requests along it; `make night` sends many more."""

import random
from typing import Any

import pytest
from starlette.testclient import TestClient

from benchmarks.fuzz import Requests
from tests.support.profiles import scale_examples
from tests.support.service.web_app import PROBLEM


@pytest.fixture(scope="module")
def document(server: TestClient) -> dict[str, Any]:
    answer: dict[str, Any] = server.get("/openapi.json").json()
    return answer


def test_every_answer_has_a_status_of_the_openapi_document(
    server: TestClient, dataset: str, document: dict[str, Any]
) -> None:
    requests = Requests(document, random.Random(4))
    requests.remember([dataset])
    statuses = set()
    for _ in range(2 * scale_examples(40)):
        method, path, arguments, operation = requests.make()
        if path.endswith("/events"):  # it has no end
            continue
        answer = server.request(method, **arguments)
        assert answer.status_code < 500 or path == "/readyz", (method, path, answer.text)
        if answer.is_error and operation:
            assert str(answer.status_code) in operation["responses"], (method, path, answer.text)
        statuses.add(answer.status_code)
    assert {200, 404, 422} <= statuses


@pytest.mark.parametrize(
    ("method", "path", "statuses"),
    [
        ("get", "/healthz", {421, 422, 503}),
        ("get", "/v1/jobs/{job_id}", {401, 403, 404, 409, 421, 422, 503}),
        ("post", "/v1/jobs", {401, 403, 404, 408, 409, 413, 415, 421, 422, 429, 503}),
        ("post", "/v1/jobs/{job_id}:cancel", {401, 403, 404, 409, 421, 422, 503}),
        ("post", "/v1/datasets", {401, 403, 404, 408, 409, 413, 415, 421, 422, 429, 503}),
        ("post", "/v1/models", {401, 403, 404, 408, 409, 413, 415, 421, 422, 429, 503}),
        ("post", "/v1/models:check", {401, 403, 404, 408, 409, 413, 415, 421, 422, 503}),
        ("get", "/v1/datasets/{dataset_id}/content", {401, 403, 404, 409, 412, 416, 421, 422, 503}),
    ],
)
def test_an_operation_has_the_errors_of_its_kind_as_problem_documents(
    document: dict[str, Any], method: str, path: str, statuses: set[int]
) -> None:
    answers = document["paths"][path][method]["responses"]
    errors = {int(code): answer for code, answer in answers.items() if int(code) >= 400}
    assert set(errors) == statuses
    for status, answer in errors.items():
        problem = document["components"]["responses"][answer["$ref"].rpartition("/")[2]]
        content = problem["content"][PROBLEM]
        assert content["schema"] == {"$ref": "#/components/schemas/ProblemOut"}
        assert content["example"]["status"] == status
    assert "errors" in document["components"]["schemas"]["ProblemOut"]["properties"]
    assert "HTTPValidationError" not in document["components"]["schemas"]
