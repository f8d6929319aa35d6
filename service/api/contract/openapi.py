"""The OpenAPI document: errors, files, headers and examples of each operation.

What can go wrong follows from the shape of an operation: its method, body, parameters and content.
So no route lists its errors, and a new route has them all. The same holds for what is sent besides
JSON, and for headers. Examples are in `service.api.contract.examples`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from http import HTTPStatus
from threading import Lock
from typing import Any

from fastapi import FastAPI
from fastapi.routing import APIRoute
from pydantic import Field

from service.access.scopes import find_needed_scope
from service.api.content import FILE_TYPE, MCAP_TYPE
from service.api.contract import examples
from service.api.requests.access_check import COOKIE
from service.api.requests.problems import PROBLEM_TYPE
from service.core import errors
from service.core.bodies.wire import Answer, FaultOut
from service.core.errors import InvalidRequest, ServiceError
from service.items.item_schemas import ItemOut

Operation = Mapping[str, Any]
_Rule = Callable[[str, Operation], bool]
_SAFE_METHODS = ("get", "head", "options")
_FASTAPI_SCHEMAS = ("HTTPValidationError", "ValidationError")
_PROBLEM_SCHEMA = "ProblemOut"
_BINARY = {"type": "string", "format": "binary"}
_SUCCESS = "Successful Response"
"""FastAPI's description of an answer that has no other."""


SECURITY_SCHEMES: dict[str, Any] = {
    "key": {
        "type": "http",
        "scheme": "bearer",
        "description": "An API key, `lagid_…`, with the scope that the operation names. Nothing is "
        "needed where the service has keys off.",
    },
    "session": {
        "type": "apiKey",
        "in": "cookie",
        "name": COOKIE,
        "description": "The session of a browser that signed in at `/sign-in`.",
    },
}
"""How a request shows who sends it; one of them is enough."""


class ProblemOut(Answer):
    """A problem document (RFC 9457)."""

    type: str = Field(description="path of the service that explains this kind of problem")
    title: str = Field(description="kind of the problem in words")
    status: int = Field(description="HTTP status of the answer")
    detail: str = Field(description="what was wrong, what was found, and what would be right")
    instance: str = Field(description="path of the request")
    request_id: str = Field(description="id of the request, as in `X-Request-ID` and in the log")
    errors: tuple[FaultOut, ...] = Field(default=(), description="every fault of the request")
    dependents: tuple[ItemOut, ...] = Field(
        default=(), description="what was made from an item that was not deleted for it"
    )


def _is_any(_method: str, _operation: Operation) -> bool:
    return True


def _is_unsafe(method: str, _operation: Operation) -> bool:
    return method not in _SAFE_METHODS


def _has_body(_method: str, operation: Operation) -> bool:
    return "requestBody" in operation


def _has_file(_method: str, operation: Operation) -> bool:
    return FILE_TYPE in operation.get("requestBody", {}).get("content", {})


def _gives_file(_method: str, operation: Operation) -> bool:
    return any(MCAP_TYPE in response.get("content", {}) for response in _answers(operation))


def _has_precondition(method: str, operation: Operation) -> bool:
    named = {parameter["name"].lower() for parameter in operation.get("parameters", ())}
    return "if-match" in named or _gives_file(method, operation)


def _names_resource(method: str, operation: Operation) -> bool:
    return _has_body(method, operation) or any(
        parameter["in"] == "path" for parameter in operation.get("parameters", ())
    )


def _answers(operation: Operation) -> list[Mapping[str, Any]]:
    return list(operation["responses"].values())


def _needs_key(_method: str, operation: Operation) -> bool:
    return bool(operation["security"])


def _adds_rows(method: str, operation: Operation) -> bool:
    is_writing = {"key": ["write"]} in operation["security"]
    return is_writing and (_has_body(method, operation) or "202" in operation["responses"])


RULES: tuple[tuple[type[ServiceError], _Rule], ...] = (
    (errors.Unauthorized, _needs_key),
    (errors.ForeignOrigin, _is_unsafe),
    (errors.OutOfScope, _needs_key),
    (errors.NotFound, _names_resource),
    (errors.StalledRequest, _has_body),
    (errors.Conflict, _names_resource),
    (errors.StaleVersion, _has_precondition),
    (errors.TooLarge, _has_body),
    (errors.UnsupportedMediaType, _has_body),
    (errors.UnsatisfiableRange, _gives_file),
    (errors.MisdirectedRequest, _is_any),
    (errors.InvalidRequest, _is_any),  # each refuses unknown names in its query
    (errors.QuotaExceeded, _adds_rows),
    (errors.Unavailable, _is_any),
)
"""Each error, and which operations may answer with it."""

HEADERS: Mapping[int, tuple[str, str]] = {
    HTTPStatus.CREATED: ("Location", "path of what was stored"),
    HTTPStatus.ACCEPTED: ("Location", "path of the job"),
    HTTPStatus.TOO_MANY_REQUESTS: ("Retry-After", "when to try again, s"),
    HTTPStatus.SERVICE_UNAVAILABLE: ("Retry-After", "when to try again, s"),
}
"""Header that each answer of a status has, with its meaning."""


def get_route_name(route: APIRoute) -> str:
    """Return the identifier of an operation: the name of its function, short and stable."""
    return route.name


class DocumentedApp(FastAPI):
    """An application whose OpenAPI document is the contract that it keeps."""

    _lock = Lock()

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document, which is built once."""
        with self._lock:  # FastAPI publishes it before it is complete
            if self.openapi_schema is None:
                _complete_document(super().openapi())
        assert self.openapi_schema is not None
        return self.openapi_schema


def _complete_document(document: dict[str, Any]) -> None:
    """Add what FastAPI does not know to a document."""
    _add_problem_schema(document["components"]["schemas"])
    document["components"]["securitySchemes"] = SECURITY_SCHEMES
    shared: dict[str, Any] = {}
    document["components"]["responses"] = shared
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            operation["responses"].pop(str(InvalidRequest.status), None)  # FastAPI's own
            _describe_answers(operation)
            _describe_parameters(operation)
            _add_examples(operation)
            _add_security(method, path, operation)
            _add_errors(method, operation, shared)


def list_operations(document: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield method and operation of each operation of an OpenAPI document."""
    for methods in document["paths"].values():
        yield from methods.items()


def _add_problem_schema(schemas: dict[str, Any]) -> None:
    for name in _FASTAPI_SCHEMAS:  # lagid never answers with these
        schemas.pop(name, None)
    schema = ProblemOut.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas |= {**schema.pop("$defs"), _PROBLEM_SCHEMA: schema}


def _add_security(method: str, path: str, operation: dict[str, Any]) -> None:
    scope = find_needed_scope(method.upper(), path)
    operation["security"] = [{name: [scope]} for name in SECURITY_SCHEMES] if scope else []


def _add_errors(method: str, operation: dict[str, Any], shared: dict[str, Any]) -> None:
    """Add the answer of each error. Operations share it; errors of one status are one answer."""
    by_status: dict[int, list[type[ServiceError]]] = {}
    for error, applies in RULES:
        if applies(method, operation):
            by_status.setdefault(error.status, []).append(error)
    for status, errors_of_status in by_status.items():
        name = "Or".join(error.__name__ for error in errors_of_status)
        shared.setdefault(name, _build_problem_answer(errors_of_status))
        operation["responses"][str(int(status))] = {"$ref": f"#/components/responses/{name}"}


def _build_problem_answer(errors_of_status: Sequence[type[ServiceError]]) -> dict[str, Any]:
    first, title = errors_of_status[0], "; ".join(error.title for error in errors_of_status)
    example = {
        "type": f"/problems/{first.kind}",
        "title": first.title,
        "status": first.status,
        "detail": first.title,
        "instance": "/v1/jobs",
        "request_id": "5f1c2a7be04d4c0f9f6e6a1d2b3c4d5e",
    }
    reference = {"$ref": f"#/components/schemas/{_PROBLEM_SCHEMA}"}
    content = {PROBLEM_TYPE: {"schema": reference, "example": example}}
    return {"description": title, "content": content, **_describe_headers(first.status)}


def _describe_headers(status: int) -> dict[str, Any]:
    if status not in HEADERS:
        return {}
    name, meaning = HEADERS[status]
    return {"headers": {name: {"description": meaning, "schema": {"type": "string"}}}}


def _describe_answers(operation: dict[str, Any]) -> None:
    """Describe what the function says of its answer, with headers and files."""
    for code, answer in operation["responses"].items():
        if answer["description"] == _SUCCESS:
            answer["description"] = operation["summary"]
        if MCAP_TYPE in answer.get("content", {}):
            answer["content"][MCAP_TYPE]["schema"] = _BINARY
        for content in answer.get("content", {}).values():
            if "itemSchema" in content:  # of each event; FastAPI calls the whole a text
                content.pop("schema", None)
        answer |= _describe_headers(int(code))


def _describe_parameters(operation: dict[str, Any]) -> None:
    for parameter in operation.get("parameters", ()):
        name = parameter["name"]
        known = examples.PARAMETERS.get(name)
        if name == "name" and parameter["in"] == "path":
            known = examples.NAMES.get(operation["operationId"])
        if known is not None:
            parameter["description"], parameter["example"] = known


def _add_examples(operation: dict[str, Any]) -> None:
    for kind, example in examples.BODIES.get(operation["operationId"], {}).items():
        operation["requestBody"]["content"][kind]["example"] = example
