"""Stream the events of a job (server-sent events), read from the events table."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager
from functools import partial
from typing import Annotated, Any, get_args

from fastapi import APIRouter, Header, Request
from fastapi.responses import Response, StreamingResponse
from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from service.api.event_feed import EventBatch
from service.api.requests.access_check import is_still_admitted
from service.api.requests.dependencies import Parts, PartsDep
from service.core.bodies.text_checks import MANY, parse_digits
from service.core.errors import InvalidRequest
from service.repositories.event_rows import EventKind
from service.repositories.job_rows import JobRepository
from service.storage.retry import TRANSIENT_ERRORS, is_transient

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

KEEP_ALIVE_S = 15.0
EVENTS_TYPE = "text/event-stream"
NO_BUFFER = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}


class EventStreamResponse(StreamingResponse):
    """Events of a job, as they happen.

    Its place among the streams is taken before its head is sent, and held to its end. So streams
    that are opened at once cannot pass the limit together.
    """

    media_type = EVENTS_TYPE

    def __init__(
        self,
        events: AsyncIterator[str],
        watching: AbstractAsyncContextManager[None],
        status_code: int = 200,  # FastAPI looks for it
    ) -> None:
        super().__init__(events, status_code, NO_BUFFER)
        self._watching = watching

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the events."""
        async with self._watching:
            await super().__call__(scope, receive, send)


EVENT_SCHEMA: dict[str, Any] = {
    "type": "object",
    "description": "one event; its data is a JSON object",
    "properties": {
        "id": {"type": "string", "description": "number of the event, for `Last-Event-ID`"},
        "event": {"enum": list(get_args(EventKind)), "description": "kind of the event"},
        "data": {
            "type": "string",
            "contentMediaType": "application/json",
            "description": "what happened; `at` is when, UTC",
        },
    },
    "required": ["id", "event", "data"],
}
ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"content": {EVENTS_TYPE: {"itemSchema": EVENT_SCHEMA}}},
    204: {"description": "The job has ended, and there is no further event"},
}
LastEventId = Annotated[
    str | None, Header(description="id of the last event that was received; then the next follow")
]


@router.get("/{job_id}/events", response_class=EventStreamResponse, responses=ANSWERS)
async def stream_events(
    job_id: str, request: Request, parts: PartsDep, last_event_id: LastEventId = None
) -> Response:
    """Stream events as they happen: state, progress, log, end. Continues after `Last-Event-ID`."""
    last = _parse_event_id(last_event_id)
    await run_in_threadpool(_check_job, parts, job_id)
    batch = await parts.feed.read_after(job_id, last)
    if batch.is_over and not batch.text:
        return Response(status_code=204)  # an EventSource then does not reconnect
    check = partial(is_still_admitted, request, parts)
    return EventStreamResponse(
        _stream_events(parts, job_id, last, check), parts.feed.watch_job(job_id)
    )


def _check_job(parts: Parts, job_id: str) -> None:
    """Check that the caller may see a job: the feed serves those of all projects."""
    with parts.database.read_session() as session:
        JobRepository(session).get_state(job_id)


async def _stream_events(
    parts: Parts, job_id: str, last: int, is_admitted: Callable[[], bool]
) -> AsyncIterator[str]:
    yield "retry: 1000\n\n"
    checked_at = time.monotonic()
    while not parts.stopping.is_set():
        if time.monotonic() - checked_at >= KEEP_ALIVE_S:  # its key may have been revoked
            if not await run_in_threadpool(is_admitted):
                return
            checked_at = time.monotonic()
        batch = await _read_if_possible(parts, job_id, last)
        last = batch.last
        if batch.text:
            yield batch.text
        if batch.is_over and not batch.is_full:
            return
        if not batch.is_full and not await parts.feed.wait_for_news(job_id, last, KEEP_ALIVE_S):
            yield ": still here\n\n"


async def _read_if_possible(parts: Parts, job_id: str, last: int) -> EventBatch:
    """Read newer events; none while the database is away, for it may come back."""
    try:
        return await parts.feed.read_after(job_id, last)
    except TRANSIENT_ERRORS as error:
        if not is_transient(error):
            raise
    await asyncio.sleep(parts.settings.poll_seconds)
    return EventBatch("", last, is_full=False, is_over=False)


def _parse_event_id(text: str | None) -> int:
    if not text:
        return 0
    if not text.isdecimal() or parse_digits(text) == MANY:
        raise InvalidRequest.from_fault(
            "?Last-Event-ID", f"found {text!r}; need the id of an event"
        )
    return parse_digits(text)
