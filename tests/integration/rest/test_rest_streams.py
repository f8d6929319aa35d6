"""Many event streams: one look for news serves them all, and there are at most so many."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import httpx
import pytest
from sqlalchemy import event
from starlette.testclient import TestClient

from service.api import event_feed
from service.api.app import create_app
from service.api.event_feed import EventFeed
from service.api.requests.dependencies import Parts
from service.repositories.event_rows import JobHead
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.web_app import (
    await_in_thread,
    parts_of,
    read_faults,
    recording,
    settings_of,
    store_csv,
)
from tests.support.service.web_server import serve_in_thread

STREAMS = 30


@pytest.fixture
def stream_server(tmp_path: Path) -> Iterator[tuple[httpx.Client, str, Parts]]:
    """A service on a port with room for 30 streams, and a queued job."""
    app = create_app(settings_of(tmp_path, max_streams=STREAMS, poll_seconds=0.05))
    with serve_in_thread(app) as url, httpx.Client(base_url=url, timeout=LIMIT_SECONDS) as client:
        steps = store_csv(_AppOf(app), recording())
        job = client.post("/v1/jobs", json={"model": "fopdt", "datasets": [steps]}).json()["id"]
        yield client, job, app.state.parts


class _AppOf:
    """What `store_csv` needs of a test client."""

    def __init__(self, app: object) -> None:
        self.app = app


async def read_stream(client: httpx.AsyncClient, path: str, opened: asyncio.Queue[int]) -> str:
    async with client.stream("GET", path) as answer:
        await opened.put(answer.status_code)
        return (await answer.aread()).decode()


@asynccontextmanager
async def open_streams(
    client: httpx.AsyncClient, path: str
) -> AsyncIterator[list[asyncio.Task[str]]]:
    opened: asyncio.Queue[int] = asyncio.Queue()
    tasks = [asyncio.create_task(read_stream(client, path, opened)) for _ in range(STREAMS)]
    assert {await opened.get() for _ in tasks} == {200}
    yield tasks


def test_streams_that_are_opened_at_once_do_not_pass_the_limit_together(
    stream_server: tuple[httpx.Client, str, Parts],
) -> None:
    plain, job, _ = stream_server

    async def play() -> list[int]:
        limits = httpx.Limits(max_connections=2 * STREAMS)
        async with httpx.AsyncClient(
            base_url=plain.base_url, timeout=LIMIT_SECONDS, limits=limits
        ) as client:
            opened: asyncio.Queue[int] = asyncio.Queue()
            path = f"/v1/jobs/{job}/events"
            tasks = [
                asyncio.create_task(read_stream(client, path, opened)) for _ in range(2 * STREAMS)
            ]
            statuses = [await opened.get() for _ in tasks]
            await client.post(f"/v1/jobs/{job}:cancel")
            await asyncio.gather(*tasks)
            return statuses

    assert sorted(await_in_thread(play)) == [200] * STREAMS + [503] * STREAMS


def test_streams_share_their_readings_and_one_beyond_the_limit_is_refused(
    stream_server: tuple[httpx.Client, str, Parts],
) -> None:
    plain, job, parts = stream_server
    path, statements, looks = f"/v1/jobs/{job}/events", [], []
    read_heads = parts.feed._read_heads

    def look(jobs: list[str]) -> object:
        looks.append(jobs)
        return read_heads(jobs)

    async def wait_for_looks(count: int) -> None:
        while len(looks) < count:
            await asyncio.sleep(0.01)

    parts.feed._read_heads = look  # type: ignore[method-assign,assignment]

    async def play() -> list[str]:
        limits = httpx.Limits(max_connections=2 * STREAMS)
        async with httpx.AsyncClient(
            base_url=plain.base_url, timeout=LIMIT_SECONDS, limits=limits
        ) as client:
            async with open_streams(client, path) as tasks:
                await wait_for_looks(3)
                async with client.stream("GET", path) as answer:
                    assert answer.status_code == 503
                    await answer.aread()
                read_faults(answer, 503, "unavailable")
                assert int(answer.headers["retry-after"]) > 0
                statements.clear()
                looks.clear()
                await wait_for_looks(10)
                idle = sum("events" in statement for statement in statements)
                most = 1.5 * len(looks)
                await client.post(f"/v1/jobs/{job}:cancel")
                texts = await asyncio.gather(*tasks)
            assert 0 < idle <= most  # of each stream alone 30 times as many
            return texts

    event.listen(
        parts.database.engine, "before_cursor_execute", lambda *call: statements.append(call[2])
    )
    texts = await_in_thread(play)
    assert len(set(texts)) == 1
    assert texts[0].count("event: end") == 1
    assert plain.get(path).text == texts[0]  # the places of the streams are free again


def test_readings_of_one_event_are_shared_and_a_reader_that_leaves_stops_nobody(
    own: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_feed, "SHARE_SECONDS", LIMIT_SECONDS)  # also on a busy machine
    parts = parts_of(own)
    body = {"model": "fopdt", "datasets": [store_csv(own, recording())]}
    job = own.post("/v1/jobs", json=body).json()["id"]
    feed, reads = EventFeed(parts.database, parts.stopping, 0.01, 1), []
    read = feed._read_batch

    def count(job_id: str, last: int) -> object:
        reads.append(last)
        return read(job_id, last)

    feed._read_batch = count  # type: ignore[method-assign,assignment]

    async def play() -> None:
        tasks = [asyncio.create_task(feed.read_after(job, 0)) for _ in range(5)]
        await asyncio.sleep(0)
        tasks[0].cancel()
        batches = await asyncio.gather(*tasks[1:])
        assert {batch.text.count("event: state") for batch in batches} == {1}
        assert reads == [0]
        assert await feed.read_after(job, 0) == batches[0]  # a stream that comes a little later
        last = batches[0].last
        for _ in range(2):  # what had no events is read again
            assert not (await feed.read_after(job, last)).text
        assert reads == [0, last, last]
        async with feed.watch_job(job):
            assert await feed.wait_for_news(job, 0, 60)
            assert not await feed.wait_for_news(job, batches[0].last, 0.1)

    await_in_thread(play)


def test_many_streams_are_woken_in_turns_and_those_of_other_jobs_not_at_all(
    own: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts, woken, seen, sleep = parts_of(own), [], [], asyncio.sleep
    monkeypatch.setattr(event_feed, "WOKEN_STREAMS", 3)
    feed = EventFeed(parts.database, parts.stopping, 60, 20)

    async def wait(job: str) -> None:
        assert await feed.wait_for_news(job, 0, 60)
        woken.append(job)

    async def run_others(_seconds: float = 0.0) -> None:
        for _ in range(10):
            await sleep(0)
        seen.append(len(woken))

    async def play() -> None:
        async with feed.watch_job("a"), feed.watch_job("b"):
            tasks = [asyncio.create_task(wait(job)) for job in "abaaaaaa"]
            await run_others()
            monkeypatch.setattr(asyncio, "sleep", run_others)
            feed._heads = {"a": JobHead(1, is_over=False), "b": JobHead(0, is_over=False)}
            await feed._wake_streams(["a"])
            await run_others()
            assert seen == [0, 3, 6, 7]  # others had their turns between them
            assert woken == ["a"] * 7
            for task in tasks:
                task.cancel()
            await run_others()
        assert not feed._waiting

    await_in_thread(play)
