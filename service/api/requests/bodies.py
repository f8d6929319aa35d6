"""Read JSON bodies within limits that hold before validation, and large ones in a thread.

A body of 4 MB may hold a million objects or faults. Each costs microseconds to make, to check and
to describe. Validation keeps Python's lock, so other requests wait meanwhile. So objects and fields
are counted in the bytes, before anything is made of them. The number of fields of one object and
the depth are limited too. A body with more faults than anybody reads is refused without a
description of each.
"""

import json
import re
from collections.abc import Callable, Coroutine
from functools import cache
from typing import Any

from fastapi import Request, Response
from fastapi.routing import APIRoute
from pydantic import TypeAdapter, ValidationError
from starlette.concurrency import run_in_threadpool

from service.core.bodies.validation import find_body_type
from service.core.errors import InvalidRequest

MAX_FIELDS = 10_000
"""Limit on the fields of one object, and on the faults of a body that are described."""
MAX_CONTAINERS = 100_000
"""Limit on the lists and objects of a body; a sweep over 40,000 labelled values has 80,000."""
MAX_TOTAL_FIELDS = 200_000
"""Limit on the fields of all objects of a body."""
MAX_DEPTH = 50
"""Depth of nested lists and objects in a body; a model document has five levels."""
SMALL_BODY_BYTES = 32_768
"""A body up to this size is read at once: a thread would cost more."""
_CONTAINERS = (dict, list)
_TEXT = re.compile(rb'"(?:[^"\\]|\\.)*+"?', re.DOTALL)
"""A text of JSON; one without an end is matched to the end, for else each quote starts a search."""


class JsonRoute(APIRoute):
    """A route whose JSON body is read as this module says."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the handler, which is given a request of our own."""
        handle = super().get_route_handler()

        async def handle_json(request: Request) -> Response:
            return await handle(_JsonRequest(request.scope, request.receive))

        return handle_json


class _JsonRequest(Request):
    async def json(self) -> Any:
        """Return the value of the body's wire type; the plain document if it has faults."""
        body, kind = await self.body(), find_body_type(self.scope.get("endpoint"))
        if len(body) <= SMALL_BODY_BYTES:
            return _read_body(body, kind)
        return await run_in_threadpool(_read_body, body, kind)


def _read_body(body: bytes, kind: Any) -> Any:
    check_counts(body)
    document = json.loads(body)
    check_shape(document)
    try:
        return _build_adapter(kind).validate_python(document)
    except ValidationError as error:
        if error.error_count() > MAX_FIELDS:
            raise InvalidRequest.from_fault(
                "",
                f"the body has {error.error_count()} faults: unknown fields, or values of the "
                "wrong type. Is it meant for this address?",
            ) from None
    except ValueError:
        pass
    return document  # FastAPI reports its faults with those of query and headers


@cache
def _build_adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def check_counts(body: bytes) -> None:
    """Check the number of lists, objects and fields of a JSON text that is not parsed yet.

    Raises
    ------
    InvalidRequest
        If there are too many.
    """
    if _is_within(body):  # texts may count too, so that nearly all bodies need no second look
        return
    bare = _TEXT.sub(b"", body)
    if not _is_within(bare):
        raise InvalidRequest.from_fault(
            "",
            f"the body has {_count_containers(bare)} lists and objects with {bare.count(b':')} "
            f"fields; at most {MAX_CONTAINERS} with {MAX_TOTAL_FIELDS} fields are read",
        )


def _is_within(text: bytes) -> bool:
    return _count_containers(text) <= MAX_CONTAINERS and text.count(b":") <= MAX_TOTAL_FIELDS


def _count_containers(text: bytes) -> int:
    return text.count(b"{") + text.count(b"[")


def check_shape(document: Any) -> None:
    """Check the depth of a document and the number of fields of its objects.

    Raises
    ------
    InvalidRequest
        If one of them exceeds its limit.
    """
    level = [document] if isinstance(document, _CONTAINERS) else []
    for _ in range(MAX_DEPTH):
        most = max((len(item) for item in level if isinstance(item, dict)), default=0)
        if most > MAX_FIELDS:
            raise InvalidRequest.from_fault(
                "", f"an object of the body has {most} fields; at most {MAX_FIELDS} are read"
            )
        level = [
            inner
            for item in level
            for inner in (item.values() if isinstance(item, dict) else item)
            if isinstance(inner, _CONTAINERS)
        ]
        if not level:
            return
    raise InvalidRequest.from_fault(
        "", f"the body is nested too deeply; need at most {MAX_DEPTH} levels"
    )
