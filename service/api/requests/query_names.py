"""Refuse query names that an operation of the interface does not have.

An unknown name is nearly always a mistake, such as ``?stat=failed``. If it were ignored, the answer
would look like a result of the filter.
"""

from typing import Any

from fastapi import FastAPI, Request
from fastapi.concurrency import run_in_threadpool

from service.core.errors import FieldError, InvalidRequest
from sysid.core.errors import suggest_name


async def check_query_names(request: Request) -> None:
    """Check the names of a request's query against those of the OpenAPI document.

    Pages are not part of the document: their scripts read names of their own.

    Raises
    ------
    InvalidRequest
        If there is an unknown name; the message has the nearest one.
    """
    if not request.url.query:
        return
    names = (await _list_query_names(request.app)).get(request.scope["route"].name)
    if names is None:
        return
    unknown = [name for name in dict.fromkeys(request.query_params) if name not in names]
    if unknown:
        raise InvalidRequest(
            FieldError(f"?{name}", _describe_name(name, names)) for name in unknown
        )


def _describe_name(name: str, names: frozenset[str]) -> str:
    if not names:
        return "unknown name; nothing is read from the query of this address"
    return f"unknown name{suggest_name(name, names)}"


async def _list_query_names(app: FastAPI) -> dict[str, frozenset[str]]:
    """List the query names of each operation by the name of its route, once per application."""
    names: dict[str, frozenset[str]] | None = getattr(app.state, "query_names", None)
    if names is None:
        document = await run_in_threadpool(app.openapi)  # a third of a second
        names = app.state.query_names = _read_query_names(document)
    return names


def _read_query_names(document: dict[str, Any]) -> dict[str, frozenset[str]]:
    return {
        operation["operationId"]: frozenset(
            parameter["name"]
            for parameter in operation.get("parameters", ())
            if parameter["in"] == "query"
        )
        for methods in document["paths"].values()
        for operation in methods.values()
    }
