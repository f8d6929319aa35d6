"""Stream the events of a job (server-sent events), read from the events table."""

import json
from collections.abc import AsyncIterator
from typing import Annotated

import anyio
from fastapi import APIRouter, Header
from fastapi.responses import Response, StreamingResponse
from starlette.concurrency import run_in_threadpool

from service.api.dependencies import Parts, PartsDep
from service.core.errors import InvalidRequest
from service.core.text_checks import MANY, parse_digits
from service.repositories.events import EventRepository
from service.repositories.jobs import JobRepository
from service.storage.retry import TRANSIENT_ERRORS, is_transient
from service.storage.tables import Event

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

KEEP_ALIVE_S = 15.0
MAX_BATCH_EVENTS = 500
NO_BUFFER = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}


@router.get("/{job_id}/events", response_class=StreamingResponse)
async def stream_events(
    job_id: str, parts: PartsDep, last_event_id: Annotated[str | None, Header()] = None
) -> Response:
    """Stream events as they happen: state, progress, log, end. Continues after `Last-Event-ID`."""
    last = _parse_event_id(last_event_id)
    batch, is_over = await run_in_threadpool(_read_events, parts, job_id, last)
    if is_over and not batch:
        return Response(status_code=204)  # an EventSource then does not reconnect
    stream = _stream_events(parts, job_id, last)
    return StreamingResponse(stream, media_type="text/event-stream", headers=NO_BUFFER)


async def _stream_events(parts: Parts, job_id: str, last: int) -> AsyncIterator[str]:
    poll, quiet = parts.settings.poll_seconds, 0.0
    yield "retry: 1000\n\n"
    while not parts.stopping.is_set():
        try:
            batch, is_over = await run_in_threadpool(_read_events, parts, job_id, last)
        except TRANSIENT_ERRORS as error:
            if not is_transient(error):
                raise
            batch, is_over = [], False  # the database may come back; the stream waits for it
        for event in batch:
            last, quiet = event.id, 0.0
            yield _format_event(event)
        if is_over and len(batch) < MAX_BATCH_EVENTS:
            return
        if quiet >= KEEP_ALIVE_S:
            yield ": still here\n\n"
            quiet = 0.0
        await anyio.sleep(poll)
        quiet += poll


def _read_events(parts: Parts, job_id: str, last: int) -> tuple[list[Event], bool]:
    """Read newer events, and whether the job has ended, in one transaction."""
    with parts.database.read_session() as session:
        state = JobRepository(session).get_state(job_id)
        return EventRepository(session).list_after(
            job_id, last, MAX_BATCH_EVENTS
        ), state.is_terminal


def _format_event(event: Event) -> str:
    data = {**event.data, "at": event.created_at.isoformat()}
    return f"id: {event.id}\nevent: {event.kind}\ndata: {json.dumps(data)}\n\n"


def _parse_event_id(text: str | None) -> int:
    if not text:
        return 0
    if not text.isdecimal() or parse_digits(text) == MANY:
        raise InvalidRequest.from_fault(
            "?Last-Event-ID", f"found {text!r}; need the id of an event"
        )
    return parse_digits(text)
