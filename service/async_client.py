"""The asynchronous twin of the client; `service.client` gives both."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx

from service import calls
from service.calls import (
    DEFAULT_URL,
    PAGE,
    POLL_S,
    TERMINAL,
    Call,
    Document,
    ServerUnreachable,
    options,
)


class AsyncClient:
    """The service from an asynchronous program; methods as those of `Client`, with ``await``.

    Parameters and errors are those of `Client`.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        key: str | None = None,
        *,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self.url = url.rstrip("/")
        self._http = httpx.AsyncClient(**options(self.url, key), transport=transport)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self._http.aclose()

    async def send(self, call: Call) -> httpx.Response:
        """Send one call; errors are raised."""
        try:
            answer = await self._http.request(
                call.method, call.path, params=dict(call.params), json=call.json,
                content=calls.pieces(call.content), headers=dict(call.headers),
            )  # fmt: skip
        except httpx.TransportError as error:
            raise ServerUnreachable(self.url, str(error) or type(error).__name__) from error
        return calls.checked(answer)

    async def _json(self, call: Call) -> Document:
        document: Document = (await self.send(call)).json()
        return document

    async def add_dataset(
        self,
        source: str | Path | bytes,
        name: str | None = None,
        *,
        segments: str | None = None,
        sample_time: float | None = None,
    ) -> Document:
        """Store a recording, CSV or MCAP, from a file or from bytes."""
        return await self._json(calls.upload(source, name, segments, sample_time))

    async def submit(
        self, job: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> Document:
        """Queue a job."""
        headers = {"Idempotency-Key": idempotency_key} if idempotency_key else {}
        return await self._json(calls.create("jobs", job, headers))

    async def reidentify(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> Document:
        """Queue a batch re-identification: a run for each value of a label, with a trend."""
        return await self._json(calls.reidentify(body, idempotency_key))

    async def noise_sweep(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> Document:
        """Queue a noise sweep: σ × replicates × methods as one job."""
        return await self._json(calls.noise_sweep(body, idempotency_key))

    async def job(self, name: str) -> Document:
        """One job with its state and progress."""
        return await self._json(calls.read("jobs", name))

    async def cancel(self, job: str) -> Document:
        """Cancel a job; what it has found so far stays."""
        return await self._json(calls.act("jobs", job, "cancel"))

    async def wait(
        self,
        job: str,
        progress: Callable[[Document], object] | None = None,
        *,
        poll: float = POLL_S,
    ) -> Document:
        """Wait until a job has ended; `progress` hears its state at every look."""
        while True:
            state = await self.job(job)
            if progress is not None:
                progress(state)
            if state["state"] in TERMINAL:
                return state
            await asyncio.sleep(poll)

    async def simulate_run(self, run: str, body: Document, max_points: int = 1000) -> Document:
        """Simulate the identified model on a new input or under proportional control."""
        return await self._json(calls.act("runs", run, "simulate", body, max_points=max_points))

    async def validate_run(
        self,
        run: str,
        dataset: str,
        channels: Mapping[str, str] | None = None,
        *,
        skip: int = 0,
        max_points: int = 1000,
    ) -> Document:
        """Run the identified model freely over another recording: RMS and fit there."""
        body = {"dataset": dataset, "channels": dict(channels or {}), "skip": skip}
        return await self._json(calls.act("runs", run, "validate", body, max_points=max_points))

    async def runs(self, job: str) -> AsyncIterator[Document]:
        """Runs of a job, page by page."""
        async for item in self._items("jobs", job, "runs"):
            yield item

    async def _items(self, *parts: str) -> AsyncIterator[Document]:
        cursor: str | None = None
        while True:
            page = await self._json(calls.read(*parts, cursor=cursor, limit=PAGE))
            for item in page["items"]:
                yield item
            cursor = page["next"]
            if cursor is None:
                return

    async def summary(self, job: str, by: Sequence[str] | None = None) -> Document:
        """Quantiles over the values of axes or labels; by default over all axes but seeds."""
        chosen = None if by is None else list(by)
        return await self._json(calls.read("jobs", job, "summary", by=chosen))

    async def trend(self, job: str) -> Document:
        """Estimates over the label of a batch: law, band, predictions, outliers, drift."""
        return await self._json(calls.read("jobs", job, "trend"))

    async def references(self) -> list[Document]:
        """The references in use, by name."""
        return [one async for one in self._items("references")]

    async def reference(self, name: str) -> Document:
        """One reference with its history."""
        return await self._json(calls.read("references", name))

    async def accept_reference(
        self, name: str, run: str, *, by: str | None = None, note: str | None = None
    ) -> Document:
        """Make a run the reference of a name; the one before stays in the history."""
        return await self._json(calls.accept(name, run, by, note))

    async def run(self, name: str) -> Document:
        """One run's result."""
        return await self._json(calls.read("runs", name))

    async def history(self, run: str) -> Document:
        """Improvements of each island's champion."""
        return await self._json(calls.read("runs", run, "history"))

    async def profile(self, run: str, *parameters: str, points: int = 21) -> Document:
        """Profile likelihood of some free parameters, of all if none is named."""
        return await self._json(calls.profile(run, parameters, points))

    async def residuals(self, run: str) -> Document:
        """Correlation functions of the residuals with their bands and tests."""
        return await self._json(calls.read("runs", run, "residuals"))

    async def export(self, run: str, format: str = "json", pade_order: int = 3) -> str:
        """The identified model as text: json, python, c or control."""
        call = calls.read("runs", run, "export", format=format, pade_order=pade_order)
        return (await self.send(call)).text

    async def compare(self, *runs: str) -> Document:
        """Runs on the same data side by side, the best first."""
        return await self._json(calls.create("runs:compare", {"runs": runs}))
