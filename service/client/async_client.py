"""The asynchronous client of the service; the counterpart of `Client`."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import aclosing
from pathlib import Path
from typing import Any, Self

import httpx

from service.client import calls
from service.client.calls import Document, RestCall, ServerUnreachable

BLOCK_BYTES = 1 << 20
"""Size of the blocks in which a file is read."""


class AsyncClient:
    """Asynchronous client of the service; its methods are those of `Client`, with ``await``.

    Parameters and errors are those of `Client`. `runs` and `events` are iterated with ``async
    for``.
    """

    def __init__(
        self,
        url: str = calls.DEFAULT_URL,
        key: str | None = None,
        *,
        retries: int = calls.DEFAULT_RETRIES,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self.url, self._retries = url.rstrip("/"), retries
        self._http = httpx.AsyncClient(
            base_url=self.url,
            headers=calls.make_auth_header(key),
            timeout=calls.TIMEOUT_SECONDS,
            transport=transport,
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def send(self, call: RestCall, *, stream: bool = False) -> httpx.Response:
        """Send one call and raise its errors. The caller reads and closes a stream."""
        pauses = calls.plan_pauses(call, self._retries)
        while True:
            response = await self._send_once(call, stream)
            pause = calls.choose_pause(response, pauses)
            if pause is None:
                return calls.raise_for_problem(response)
            await asyncio.sleep(pause)

    async def _send_once(self, call: RestCall, stream: bool) -> httpx.Response:
        content = _read_blocks(call.content) if isinstance(call.content, Path) else call.content
        request = self._http.build_request(**call.request(content, stream=stream))
        try:
            response = await self._http.send(request, stream=stream)
            if not response.is_success:
                await response.aread()
        except httpx.TransportError as error:
            raise ServerUnreachable(self.url, error) from error
        return response

    async def _fetch_document(self, call: RestCall) -> Document:
        document: Document = (await self.send(call)).json()
        return document

    async def _iterate_items(
        self, call: RestCall, at_most: int | None = None
    ) -> AsyncIterator[Document]:
        pages = calls.Paginator(call, at_most)
        while (page := pages.next_call()) is not None:
            for item in pages.take_items(await self._fetch_document(page)):
                yield item

    async def _fetch_list(self, call: RestCall, at_most: int | None = None) -> list[Document]:
        return [item async for item in self._iterate_items(call, at_most)]

    # ---- datasets
    async def add_dataset(
        self,
        source: str | Path | bytes,
        name: str | None = None,
        *,
        segments: str | None = None,
        sample_time: float | None = None,
    ) -> Document:
        """Store a recording from a file of any kind that is read, or from its bytes."""
        return await self._fetch_document(calls.build_upload(source, name, segments, sample_time))

    async def simulate_dataset(self, body: Mapping[str, Any]) -> Document:
        """Make a dataset from a model, its true parameters, inputs and noise."""
        return await self._fetch_document(calls.SIMULATE_DATASET(json=body))

    async def derive(
        self, dataset: str, steps: list[Document], name: str | None = None
    ) -> Document:
        """Make a dataset from another: noise, resample, trim, select, pool, and so on."""
        body = {"name": name, "steps": steps}
        return await self._fetch_document(calls.DERIVE(dataset, json=body))

    async def datasets(self, limit: int | None = None, **filters: Any) -> list[Document]:
        """List datasets, newest first: all, or at most `limit`; `name`, `tag` … are filters."""
        return await self._fetch_list(calls.DATASETS(**filters), limit)

    async def dataset(self, name: str) -> Document:
        """Fetch one dataset by its id."""
        return await self._fetch_document(calls.DATASET(name))

    async def signals(self, dataset: str, max_points: int = 1000) -> Document:
        """Fetch the signals of a dataset, reduced to at most `max_points` points per channel."""
        return await self._fetch_document(calls.SIGNALS(dataset, max_points=max_points))

    async def lineage(self, dataset: str) -> Document:
        """Fetch the lineage of a dataset: its sources, and everything made from it."""
        return await self._fetch_document(calls.LINEAGE(dataset))

    async def content(self, dataset: str) -> bytes:
        """Download a dataset as an MCAP file."""
        return (await self.send(calls.CONTENT(dataset))).content

    async def download(self, dataset: str, format: str = "mcap") -> AsyncIterator[bytes]:
        """Download a dataset piece by piece: mcap or csv."""
        stream = await self.send(calls.build_download(dataset, format), stream=True)
        async with aclosing(stream):
            async for piece in stream.aiter_bytes():
                yield piece

    async def edit_dataset(
        self, dataset: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> Document:
        """Change name, note or tags of a dataset; `if_match` is the ETag that was read."""
        return await self._fetch_document(
            calls.build_edit(calls.EDIT_DATASET, dataset, changes, if_match)
        )

    async def delete_dataset(self, dataset: str, *, cascade: bool = False) -> Document:
        """Delete a dataset; `cascade` adds what was made from it."""
        return await self._fetch_document(
            calls.build_deletion(calls.DELETE_DATASET, dataset, cascade)
        )

    # ---- models
    async def models(self, limit: int | None = None, **filters: Any) -> list[Document]:
        """List the built-in models and those of users: all, or at most `limit`."""
        return await self._fetch_list(calls.MODELS(**filters), limit)

    async def model(self, name: str) -> Document:
        """Fetch one model with its document."""
        return await self._fetch_document(calls.MODEL(name))

    async def add_model(self, document: Mapping[str, Any]) -> Document:
        """Store a user model; a changed document becomes its next version."""
        return await self._fetch_document(calls.ADD_MODEL(json=document))

    async def check_model(self, document: Mapping[str, Any]) -> Document:
        """Check a model document; every error has its column."""
        return await self._fetch_document(calls.CHECK_MODEL(json=document))

    async def edit_model(
        self, model: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> Document:
        """Change note or tags of a model; `if_match` is the ETag that was read."""
        return await self._fetch_document(
            calls.build_edit(calls.EDIT_MODEL, model, changes, if_match)
        )

    async def delete_model(self, model: str, *, cascade: bool = False) -> Document:
        """Delete a model, all versions or ``name@version``; `cascade` adds what used it."""
        return await self._fetch_document(calls.build_deletion(calls.DELETE_MODEL, model, cascade))

    # ---- jobs
    async def submit(
        self, job: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> Document:
        """Queue a job."""
        return await self._fetch_document(
            calls.build_submission(calls.SUBMIT, job, idempotency_key)
        )

    async def noise_sweep(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> Document:
        """Queue a noise sweep: σ × replicates × methods as one job."""
        return await self._fetch_document(
            calls.build_submission(calls.NOISE_SWEEP, body, idempotency_key)
        )

    async def reidentify(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> Document:
        """Queue a batch re-identification: a run for each value of a label, with a trend."""
        return await self._fetch_document(
            calls.build_submission(calls.REIDENTIFY, body, idempotency_key)
        )

    async def jobs(
        self, limit: int | None = None, state: Sequence[str] | None = None, **filters: Any
    ) -> list[Document]:
        """List jobs, newest first: all, at most `limit`, or those that filters select."""
        return await self._fetch_list(calls.JOBS(state=state, **filters), limit)

    async def job(self, name: str) -> Document:
        """Fetch one job with its state and progress."""
        return await self._fetch_document(calls.JOB(name))

    async def edit_job(
        self, job: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> Document:
        """Change name, note or tags of a job; `if_match` is the ETag that was read."""
        return await self._fetch_document(calls.build_edit(calls.EDIT_JOB, job, changes, if_match))

    async def delete_job(self, job: str, *, cascade: bool = False) -> Document:
        """Delete a job that has ended; `cascade` adds what was made from it."""
        return await self._fetch_document(calls.build_deletion(calls.DELETE_JOB, job, cascade))

    async def cancel(self, job: str) -> Document:
        """Cancel a job; its results so far stay."""
        return await self._fetch_document(calls.CANCEL(job))

    async def resume(self, job: str) -> Document:
        """Queue a failed or cancelled job again, from where it stopped."""
        return await self._fetch_document(calls.RESUME(job))

    async def clone(self, job: str) -> Document:
        """Queue the same request as a new job."""
        return await self._fetch_document(calls.CLONE(job))

    async def report(self, job: str) -> str:
        """Fetch the report of a job, as HTML."""
        return (await self.send(calls.REPORT(job))).text

    async def wait(
        self,
        job: str,
        progress: Callable[[Document], object] | None = None,
        *,
        poll: float = calls.POLL_SECONDS,
    ) -> Document:
        """Wait until a job has ended; `progress` is called with its state at every poll."""
        while True:
            state = await self.job(job)
            if progress is not None:
                progress(state)
            if state["state"] in calls.TERMINAL_STATES:
                return state
            await asyncio.sleep(poll)

    async def events(self, job: str, after: str | None = None) -> AsyncIterator[Document]:
        """Yield the events of a job until its end; `after` is the id of the last event received."""
        parser = calls.EventParser()
        stream = await self.send(calls.build_event_stream(job, after), stream=True)
        async with aclosing(stream):
            async for line in stream.aiter_lines():
                for event in parser.feed_line(line):
                    yield event

    # ---- runs
    def runs(
        self, job: str, *, at_most: int | None = None, **filters: Any
    ) -> AsyncIterator[Document]:
        """List all runs of a job, or the first `at_most` that pass the filters."""
        return self._iterate_items(calls.RUNS(job, **filters), at_most)

    async def summary(self, job: str, by: Sequence[str] | None = None) -> Document:
        """Fetch quantiles over the values of axes or labels, by default over all axes but seeds."""
        return await self._fetch_document(calls.SUMMARY(job, by=by))

    async def trend(self, job: str) -> Document:
        """Fetch the trend of a batch over its label: law, band, predictions, outliers, drift."""
        return await self._fetch_document(calls.TREND(job))

    async def run(self, name: str) -> Document:
        """Fetch the result of one run."""
        return await self._fetch_document(calls.RUN(name))

    async def edit_run(
        self, run: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> Document:
        """Change note or tags of a run; `if_match` is the ETag that was read."""
        return await self._fetch_document(calls.build_edit(calls.EDIT_RUN, run, changes, if_match))

    async def delete_run(self, run: str, *, cascade: bool = False) -> Document:
        """Delete a run of a job that has ended; `cascade` adds what was made from it."""
        return await self._fetch_document(calls.build_deletion(calls.DELETE_RUN, run, cascade))

    async def history(self, run: str) -> Document:
        """Fetch the improvements of each island's champion."""
        return await self._fetch_document(calls.HISTORY(run))

    async def response(self, run: str, max_points: int = 1000) -> Document:
        """Fetch the measured and simulated outputs."""
        return await self._fetch_document(calls.RESPONSE(run, max_points=max_points))

    async def simulate_run(
        self, run: str, body: Mapping[str, Any], max_points: int = 1000
    ) -> Document:
        """Simulate the identified model on a new input or under P, PI or PID control."""
        return await self._fetch_document(calls.SIMULATE_RUN(run, json=body, max_points=max_points))

    async def validate_run(
        self,
        run: str,
        dataset: str,
        channels: Mapping[str, str] | None = None,
        *,
        skip: int = 0,
        max_points: int = 1000,
    ) -> Document:
        """Simulate the identified model on another recording: RMS and fit."""
        body = {"dataset": dataset, "channels": dict(channels or {}), "skip": skip}
        return await self._fetch_document(calls.VALIDATE_RUN(run, json=body, max_points=max_points))

    async def migrations(self, run: str) -> Document:
        """Fetch the migration log."""
        return await self._fetch_document(calls.MIGRATIONS(run))

    async def profile(self, run: str, *parameters: str, points: int = 21) -> Document:
        """Compute the profile likelihood of some free parameters; of all if none is named."""
        body = {"parameters": parameters or None, "points": points}
        return await self._fetch_document(calls.PROFILE(run, json=body))

    async def residuals(self, run: str) -> Document:
        """Fetch the correlation functions of the residuals, their bands and tests."""
        return await self._fetch_document(calls.RESIDUALS(run))

    async def export(self, run: str, format: str = "json", pade_order: int = 3) -> str:
        """Export the identified model as text: json, python, c or control."""
        return (await self.send(calls.EXPORT(run, format=format, pade_order=pade_order))).text

    async def compare(self, *runs: str) -> Document:
        """Compare runs on the same data, best first."""
        return await self._fetch_document(calls.COMPARE(json={"runs": runs}))

    # ---- references
    async def references(self, limit: int | None = None, **filters: Any) -> list[Document]:
        """List the references in use, by name: all, or at most `limit`."""
        return await self._fetch_list(calls.REFERENCES(**filters), limit)

    async def reference(self, name: str) -> Document:
        """Fetch one reference with its history."""
        return await self._fetch_document(calls.REFERENCE(name))

    async def accept_reference(
        self, name: str, run: str, *, by: str | None = None, note: str | None = None
    ) -> Document:
        """Make a run the reference of a name; the previous one stays in the history."""
        body = {"run": run, "by": by, "note": note}
        return await self._fetch_document(calls.ACCEPT_REFERENCE(name, json=body))

    async def edit_reference(
        self, reference: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> Document:
        """Change name, note or tags of a reference; `if_match` is the ETag that was read."""
        return await self._fetch_document(
            calls.build_edit(calls.EDIT_REFERENCE, reference, changes, if_match)
        )

    async def delete_reference(self, reference: str, *, cascade: bool = False) -> Document:
        """Delete a reference with its history; `cascade` adds what was made from it."""
        return await self._fetch_document(
            calls.build_deletion(calls.DELETE_REFERENCE, reference, cascade)
        )


async def _read_blocks(path: Path) -> AsyncIterator[bytes]:
    with path.open("rb") as file:
        while block := await asyncio.to_thread(file.read, BLOCK_BYTES):
            yield block
