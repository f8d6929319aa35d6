"""Read the events of jobs once for all streams of this process.

A stream that asks the database by itself costs a thread and a connection, several times a second.
Here one query asks for the news of all jobs that have a stream. Streams of one job that stand at
the same event share what is read. Many streams are woken in turns, so that other requests are
answered between them.
"""

import asyncio
import json
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from threading import Event as Flag

from starlette.concurrency import run_in_threadpool

from service.core.errors import ServiceBusy
from service.repositories.event_rows import EventRepository, JobHead
from service.storage.retry import TRANSIENT_ERRORS, is_transient
from service.storage.sessions import Database
from service.storage.storage_errors import RowNotFound
from service.storage.tables import Event

MAX_BATCH_EVENTS = 500
SHARE_SECONDS = 1.0
"""How long events that were read are there for other streams at the same event."""
WOKEN_STREAMS = 5
"""Streams that are woken at once: about a millisecond of work."""
PAUSE_SECONDS = 0.003


@dataclass(frozen=True, slots=True)
class EventBatch:
    """Events of a job as the text of a stream.

    Attributes
    ----------
    last : int
        Number of the last event that was sent.
    is_full : bool
        More events may be there already.
    is_over : bool
        The job has ended.
    """

    text: str
    last: int
    is_full: bool
    is_over: bool


class EventFeed:
    """Events for the streams of one event loop; `stopping` ends all of them."""

    def __init__(
        self, database: Database, stopping: Flag, poll_seconds: float, max_streams: int
    ) -> None:
        self._database, self._stopping = database, stopping
        self._poll_seconds, self._max_streams = poll_seconds, max_streams
        self._streams: Counter[str] = Counter()
        self._heads: dict[str, JobHead] = {}
        self._reads: dict[tuple[str, int], asyncio.Task[EventBatch]] = {}
        self._poller: asyncio.Task[None] | None = None
        self._waiting: defaultdict[str, set[asyncio.Future[None]]] = defaultdict(set)

    @asynccontextmanager
    async def watch_job(self, job_id: str) -> AsyncIterator[None]:
        """Look for news of a job during the block.

        Raises
        ------
        ServiceBusy
            If there are as many streams as this process allows.
        """
        if self._streams.total() >= self._max_streams:
            raise ServiceBusy(
                f"{self._max_streams} event streams are open; at most so many are allowed "
                "(LAGID_MAX_STREAMS). Ask for the job instead, or try again."
            )
        self._streams[job_id] += 1
        try:
            yield
        finally:
            self._streams[job_id] -= 1
            if not self._streams[job_id]:
                del self._streams[job_id]
                self._heads.pop(job_id, None)

    async def read_after(self, job_id: str, last: int) -> EventBatch:
        """Read the events after a number; streams that ask for the same share one reading.

        The caller checks who may see the job.

        Raises
        ------
        RowNotFound
            If there is no such job.
        """
        key = (job_id, last)
        if key not in self._reads:
            reading = run_in_threadpool(self._read_batch, job_id, last)
            self._reads[key] = task = asyncio.ensure_future(reading)
            task.add_done_callback(lambda _: self._share_for_a_while(key, task))
        return await asyncio.shield(self._reads[key])  # a client that leaves does not stop it

    def _share_for_a_while(self, key: tuple[str, int], task: asyncio.Task[EventBatch]) -> None:
        """Keep events that were read; what had none may be read again at once."""
        if task.cancelled() or task.exception() is not None or not task.result().text:
            del self._reads[key]
        else:
            asyncio.get_running_loop().call_later(SHARE_SECONDS, self._reads.pop, key)

    async def wait_for_news(self, job_id: str, last: int, seconds: float) -> bool:
        """Wait until a job has events after a number, or has ended; False if nothing came."""
        self._start_poller()
        before = self._heads.get(job_id)
        try:
            async with asyncio.timeout(seconds):
                while not self._has_news(job_id, last, before):
                    await self._wait_for_turn(job_id)
        except TimeoutError:
            return False
        return True

    async def _wait_for_turn(self, job_id: str) -> None:
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting[job_id].add(turn)
        try:
            await turn
        finally:
            self._waiting[job_id].discard(turn)
            if not self._waiting[job_id]:
                del self._waiting[job_id]

    def _has_news(self, job_id: str, last: int, before: JobHead | None) -> bool:
        if self._stopping.is_set() or self._poller is None or self._poller.done():
            return True
        head = self._heads.get(job_id)
        # A head that was there before may be older than what the stream has read.
        return head is not None and (head.last > last or (head.is_over and head is not before))

    def _start_poller(self) -> None:
        if self._poller is None or self._poller.done():
            self._poller = asyncio.create_task(self._poll())
            self._poller.add_done_callback(lambda _: self._wake_all())

    async def _poll(self) -> None:
        """Look for news until there is no stream. If this fails, streams read by themselves."""
        while self._streams and not self._stopping.is_set():
            await asyncio.sleep(self._poll_seconds)
            try:
                heads = await run_in_threadpool(self._read_heads, list(self._streams))
            except TRANSIENT_ERRORS as error:
                if not is_transient(error):
                    raise
                continue  # the database may come back; the streams wait for it
            before, self._heads = self._heads, heads
            await self._wake_streams(job for job in heads if heads[job] != before.get(job))

    async def _wake_streams(self, jobs: Iterable[str]) -> None:
        turns = [turn for job in list(jobs) for turn in self._waiting.get(job, ())]
        for start in range(0, len(turns), WOKEN_STREAMS):
            for turn in turns[start : start + WOKEN_STREAMS]:
                _end_turn(turn)
            if start + WOKEN_STREAMS < len(turns):
                await asyncio.sleep(PAUSE_SECONDS)

    def _wake_all(self) -> None:
        for turns in self._waiting.values():
            for turn in turns:
                _end_turn(turn)

    def _read_heads(self, job_ids: list[str]) -> dict[str, JobHead]:
        with self._database.read_session() as session:
            return EventRepository(session).read_heads(job_ids)

    def _read_batch(self, job_id: str, last: int) -> EventBatch:
        """Read newer events, and whether the job has ended, in one transaction."""
        with self._database.read_session() as session:
            head = EventRepository(session).read_heads([job_id]).get(job_id)
            if head is None:
                raise RowNotFound("job", job_id)
            events = EventRepository(session).list_after(job_id, last, MAX_BATCH_EVENTS)
        return EventBatch(
            "".join(map(_format_event, events)),
            events[-1].id if events else last,
            len(events) == MAX_BATCH_EVENTS,
            head.is_over,
        )


def _end_turn(turn: asyncio.Future[None]) -> None:
    if not turn.done():
        turn.set_result(None)


def _format_event(event: Event) -> str:
    data = {**event.data, "at": event.created_at.isoformat()}
    return f"id: {event.id}\nevent: {event.kind}\ndata: {json.dumps(data)}\n\n"
