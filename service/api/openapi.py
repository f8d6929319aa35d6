"""Errors in the OpenAPI document: each operation has the statuses that its kind can answer.

What can go wrong follows from the shape of an operation: its method, body, parameters and content.
So no route lists its errors, and a new route has them all.
"""

from collections.abc import Callable, Mapping
from typing import Any

from fastapi import FastAPI

from service.api.problems import PROBLEM_TYPE
from service.core import errors
from service.core.errors import ServiceError
from service.core.wire import Answer, FaultOut

Operation = Mapping[str, Any]
_Rule = Callable[[str, Operation], bool]
_SAFE_METHODS = ("get", "head", "options")
_FASTAPI_SCHEMAS = ("HTTPValidationError", "ValidationError")
_PROBLEM_SCHEMA = "ProblemOut"
_BINARY_TYPE = "application/x-mcap"


class ProblemOut(Answer):
    """A problem document (RFC 9457). `type` is a path of the service that explains it."""

    type: str
    title: str
    status: int
    detail: str
    instance: str
    request_id: str
    errors: tuple[FaultOut, ...] = ()


def _is_any(_method: str, _operation: Operation) -> bool:
    return True


def _is_unsafe(method: str, _operation: Operation) -> bool:
    return method not in _SAFE_METHODS


def _has_body(_method: str, operation: Operation) -> bool:
    return "requestBody" in operation


def _has_file(_method: str, operation: Operation) -> bool:
    return _BINARY_TYPE in operation.get("requestBody", {}).get("content", {})


def _gives_file(_method: str, operation: Operation) -> bool:
    return any(_BINARY_TYPE in response.get("content", {}) for response in _answers(operation))


def _creates_job(_method: str, operation: Operation) -> bool:
    return "202" in operation["responses"]


def _has_input(method: str, operation: Operation) -> bool:
    return _has_body(method, operation) or bool(operation.get("parameters"))


def _names_resource(method: str, operation: Operation) -> bool:
    return _has_body(method, operation) or any(
        parameter["in"] == "path" for parameter in operation.get("parameters", ())
    )


def _answers(operation: Operation) -> list[Mapping[str, Any]]:
    return list(operation["responses"].values())


RULES: tuple[tuple[type[ServiceError], _Rule], ...] = (
    (errors.ForeignOrigin, _is_unsafe),
    (errors.NotFound, _names_resource),
    (errors.StalledRequest, _has_file),
    (errors.Conflict, _names_resource),
    (errors.StaleVersion, _gives_file),
    (errors.TooLarge, _has_body),
    (errors.UnsupportedMediaType, _has_body),
    (errors.UnsatisfiableRange, _gives_file),
    (errors.MisdirectedRequest, _is_any),
    (errors.InvalidRequest, _has_input),
    (errors.QuotaExceeded, _creates_job),
    (errors.Unavailable, _is_any),
)
"""Each error, and which operations may answer with it."""


class DocumentedApp(FastAPI):
    """An application whose OpenAPI document has its errors."""

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document."""
        if self.openapi_schema is None:
            document = super().openapi()
            _add_problem_schema(document["components"]["schemas"])
            for methods in document["paths"].values():
                for method, operation in methods.items():
                    _add_errors(method, operation)
        assert self.openapi_schema is not None
        return self.openapi_schema


def _add_problem_schema(schemas: dict[str, Any]) -> None:
    for name in _FASTAPI_SCHEMAS:  # lagid never answers with these
        schemas.pop(name, None)
    schema = ProblemOut.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas |= {**schema.pop("$defs"), _PROBLEM_SCHEMA: schema}


def _add_errors(method: str, operation: dict[str, Any]) -> None:
    reference = {"$ref": f"#/components/schemas/{_PROBLEM_SCHEMA}"}
    for error, applies in RULES:
        code = str(error.status)
        operation["responses"].pop(code, None)  # FastAPI's own 422 has another form
        if applies(method, operation):
            operation["responses"][code] = {
                "description": error.title,
                "content": {PROBLEM_TYPE: {"schema": reference}},
            }
