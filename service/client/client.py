"""The light client of the service: httpx only, without NumPy or Ray.

All methods take and return plain documents with the field names of the REST interface.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import Any, BinaryIO, Self

import httpx

from service.client import calls
from service.client.calls import Document, RestCall, ServerUnreachable


class Client:
    """Synchronous client of the service.

    Parameters
    ----------
    url : str
        Address of the server.
    key : str, optional
        API key, if the server requires one.
    retries : int
        How often a request is repeated after an answer 503 (temporarily unavailable). Only requests
        that may be sent twice are repeated: those that read or replace, and those with an
        idempotency key, such as the submission of a job. The pause is that of ``Retry-After``,
        30 s at most. Without this header it is 0.5 s, and doubles each time.
    transport : httpx.BaseTransport, optional
        Replacement of the network transport, for tests.

    Raises
    ------
    ProblemError
        From every method, if the server refuses the request; holds the problem document.
    ServerUnreachable
        From every method, if no server answers.
    NotFinite
        From every method that sends a body, if a number in it is infinite or NaN.
    """

    def __init__(
        self,
        url: str = calls.DEFAULT_URL,
        key: str | None = None,
        *,
        retries: int = calls.DEFAULT_RETRIES,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url, self._retries = url.rstrip("/"), retries
        self._http = httpx.Client(
            base_url=self.url,
            headers=calls.make_auth_header(key),
            timeout=calls.TIMEOUT_SECONDS,
            transport=transport,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def send(self, call: RestCall, *, stream: bool = False) -> httpx.Response:
        """Send one call and raise its errors. The caller reads and closes a stream."""
        pauses = calls.plan_pauses(call, self._retries)
        while True:
            response = self._send_once(call, stream)
            pause = calls.choose_pause(response, pauses)
            if pause is None:
                return calls.raise_for_problem(response)
            time.sleep(pause)

    def _send_once(self, call: RestCall, stream: bool) -> httpx.Response:
        source = call.content
        file: AbstractContextManager[BinaryIO | bytes | None]
        file = source.open("rb") if isinstance(source, Path) else nullcontext(source)
        with file as content:
            request = self._http.build_request(**call.request(content, stream=stream))
            try:
                response = self._http.send(request, stream=stream)
                if not response.is_success:
                    response.read()
            except httpx.TransportError as error:
                raise ServerUnreachable(self.url, error) from error
        return response

    def _fetch_document(self, call: RestCall) -> Document:
        document: Document = self.send(call).json()
        return document

    def _fetch_list(self, call: RestCall, at_most: int | None = None) -> list[Document]:
        pages, items = calls.Paginator(call, at_most), []
        while (page := pages.next_call()) is not None:
            items += pages.take_items(self._fetch_document(page))
        return items

    # ---- datasets
    def add_dataset(
        self,
        source: str | Path | bytes,
        name: str | None = None,
        *,
        segments: str | None = None,
        sample_time: float | None = None,
    ) -> Document:
        """Store a recording from a file of any kind that is read, or from its bytes."""
        return self._fetch_document(calls.build_upload(source, name, segments, sample_time))

    def simulate_dataset(self, body: Mapping[str, Any]) -> Document:
        """Make a dataset from a model, its true parameters, inputs and noise."""
        return self._fetch_document(calls.SIMULATE_DATASET(json=body))

    def derive(self, dataset: str, steps: list[Document], name: str | None = None) -> Document:
        """Make a dataset from another: noise, resample, trim, select, pool, and so on."""
        body = {"name": name, "steps": steps}
        return self._fetch_document(calls.DERIVE(dataset, json=body))

    def datasets(self, limit: int | None = None, **filters: Any) -> list[Document]:
        """List datasets, newest first: all, or at most `limit`; `name`, `tag` … are filters."""
        return self._fetch_list(calls.DATASETS(**filters), limit)

    def dataset(self, name: str) -> Document:
        """Fetch one dataset by its id."""
        return self._fetch_document(calls.DATASET(name))

    def signals(self, dataset: str, max_points: int = 1000) -> Document:
        """Fetch the signals of a dataset, reduced to at most `max_points` points per channel."""
        return self._fetch_document(calls.SIGNALS(dataset, max_points=max_points))

    def lineage(self, dataset: str) -> Document:
        """Fetch the lineage of a dataset: its sources, and everything made from it."""
        return self._fetch_document(calls.LINEAGE(dataset))

    def content(self, dataset: str) -> bytes:
        """Download a dataset as an MCAP file."""
        return self.send(calls.CONTENT(dataset)).content

    def download(self, dataset: str, format: str = "mcap") -> Iterator[bytes]:
        """Download a dataset piece by piece: mcap or csv."""
        with closing(self.send(calls.build_download(dataset, format), stream=True)) as stream:
            yield from stream.iter_bytes()

    def edit_dataset(
        self, dataset: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> Document:
        """Change name, note or tags of a dataset; `if_match` is the ETag that was read."""
        return self._fetch_document(
            calls.build_edit(calls.EDIT_DATASET, dataset, changes, if_match)
        )

    def delete_dataset(self, dataset: str, *, cascade: bool = False) -> Document:
        """Delete a dataset; `cascade` adds what was made from it."""
        return self._fetch_document(calls.build_deletion(calls.DELETE_DATASET, dataset, cascade))

    # ---- models
    def models(self, limit: int | None = None, **filters: Any) -> list[Document]:
        """List the built-in models and those of users: all, or at most `limit`."""
        return self._fetch_list(calls.MODELS(**filters), limit)

    def model(self, name: str) -> Document:
        """Fetch one model with its document."""
        return self._fetch_document(calls.MODEL(name))

    def add_model(self, document: Mapping[str, Any]) -> Document:
        """Store a user model; a changed document becomes its next version."""
        return self._fetch_document(calls.ADD_MODEL(json=document))

    def check_model(self, document: Mapping[str, Any]) -> Document:
        """Check a model document; every error has its column."""
        return self._fetch_document(calls.CHECK_MODEL(json=document))

    def edit_model(
        self, model: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> Document:
        """Change note or tags of a model; `if_match` is the ETag that was read."""
        return self._fetch_document(calls.build_edit(calls.EDIT_MODEL, model, changes, if_match))

    def delete_model(self, model: str, *, cascade: bool = False) -> Document:
        """Delete a model, all versions or ``name@version``; `cascade` adds what used it."""
        return self._fetch_document(calls.build_deletion(calls.DELETE_MODEL, model, cascade))

    # ---- jobs
    def submit(self, job: Mapping[str, Any], *, idempotency_key: str | None = None) -> Document:
        """Queue a job."""
        return self._fetch_document(calls.build_submission(calls.SUBMIT, job, idempotency_key))

    def noise_sweep(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> Document:
        """Queue a noise sweep: σ × replicates × methods as one job."""
        return self._fetch_document(
            calls.build_submission(calls.NOISE_SWEEP, body, idempotency_key)
        )

    def reidentify(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> Document:
        """Queue a batch re-identification: a run for each value of a label, with a trend."""
        return self._fetch_document(calls.build_submission(calls.REIDENTIFY, body, idempotency_key))

    def jobs(
        self, limit: int | None = None, state: Sequence[str] | None = None, **filters: Any
    ) -> list[Document]:
        """List jobs, newest first: all, at most `limit`, or those that filters select."""
        return self._fetch_list(calls.JOBS(state=state, **filters), limit)

    def job(self, name: str) -> Document:
        """Fetch one job with its state and progress."""
        return self._fetch_document(calls.JOB(name))

    def edit_job(
        self, job: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> Document:
        """Change name, note or tags of a job; `if_match` is the ETag that was read."""
        return self._fetch_document(calls.build_edit(calls.EDIT_JOB, job, changes, if_match))

    def delete_job(self, job: str, *, cascade: bool = False) -> Document:
        """Delete a job that has ended; `cascade` adds what was made from it."""
        return self._fetch_document(calls.build_deletion(calls.DELETE_JOB, job, cascade))

    def cancel(self, job: str) -> Document:
        """Cancel a job; its results so far stay."""
        return self._fetch_document(calls.CANCEL(job))

    def resume(self, job: str) -> Document:
        """Queue a failed or cancelled job again, from where it stopped."""
        return self._fetch_document(calls.RESUME(job))

    def clone(self, job: str) -> Document:
        """Queue the same request as a new job."""
        return self._fetch_document(calls.CLONE(job))

    def report(self, job: str) -> str:
        """Fetch the report of a job, as HTML."""
        return self.send(calls.REPORT(job)).text

    def wait(
        self,
        job: str,
        progress: Callable[[Document], object] | None = None,
        *,
        poll: float = calls.POLL_SECONDS,
    ) -> Document:
        """Wait until a job has ended; `progress` is called with its state at every poll."""
        while True:
            state = self.job(job)
            if progress is not None:
                progress(state)
            if state["state"] in calls.TERMINAL_STATES:
                return state
            time.sleep(poll)

    def events(self, job: str, after: str | None = None) -> Iterator[Document]:
        """Yield the events of a job until its end; `after` is the id of the last event received."""
        parser = calls.EventParser()
        with closing(self.send(calls.build_event_stream(job, after), stream=True)) as stream:
            for line in stream.iter_lines():
                yield from parser.feed_line(line)

    # ---- runs
    def runs(self, job: str, *, at_most: int | None = None, **filters: Any) -> list[Document]:
        """List all runs of a job, or the first `at_most` that pass the filters."""
        return self._fetch_list(calls.RUNS(job, **filters), at_most)

    def summary(self, job: str, by: Sequence[str] | None = None) -> Document:
        """Fetch quantiles over the values of axes or labels, by default over all axes but seeds."""
        return self._fetch_document(calls.SUMMARY(job, by=by))

    def trend(self, job: str) -> Document:
        """Fetch the trend of a batch over its label: law, band, predictions, outliers, drift."""
        return self._fetch_document(calls.TREND(job))

    def run(self, name: str) -> Document:
        """Fetch the result of one run."""
        return self._fetch_document(calls.RUN(name))

    def edit_run(
        self, run: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> Document:
        """Change note or tags of a run; `if_match` is the ETag that was read."""
        return self._fetch_document(calls.build_edit(calls.EDIT_RUN, run, changes, if_match))

    def delete_run(self, run: str, *, cascade: bool = False) -> Document:
        """Delete a run of a job that has ended; `cascade` adds what was made from it."""
        return self._fetch_document(calls.build_deletion(calls.DELETE_RUN, run, cascade))

    def history(self, run: str) -> Document:
        """Fetch the improvements of each island's champion."""
        return self._fetch_document(calls.HISTORY(run))

    def response(self, run: str, max_points: int = 1000) -> Document:
        """Fetch the measured and simulated outputs."""
        return self._fetch_document(calls.RESPONSE(run, max_points=max_points))

    def simulate_run(self, run: str, body: Mapping[str, Any], max_points: int = 1000) -> Document:
        """Simulate the identified model on a new input or under P, PI or PID control."""
        return self._fetch_document(calls.SIMULATE_RUN(run, json=body, max_points=max_points))

    def validate_run(
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
        return self._fetch_document(calls.VALIDATE_RUN(run, json=body, max_points=max_points))

    def migrations(self, run: str) -> Document:
        """Fetch the migration log."""
        return self._fetch_document(calls.MIGRATIONS(run))

    def profile(self, run: str, *parameters: str, points: int = 21) -> Document:
        """Compute the profile likelihood of some free parameters; of all if none is named."""
        body = {"parameters": parameters or None, "points": points}
        return self._fetch_document(calls.PROFILE(run, json=body))

    def residuals(self, run: str) -> Document:
        """Fetch the correlation functions of the residuals, their bands and tests."""
        return self._fetch_document(calls.RESIDUALS(run))

    def export(self, run: str, format: str = "json", pade_order: int = 3) -> str:
        """Export the identified model as text: json, python, c or control."""
        return self.send(calls.EXPORT(run, format=format, pade_order=pade_order)).text

    def compare(self, *runs: str) -> Document:
        """Compare runs on the same data, best first."""
        return self._fetch_document(calls.COMPARE(json={"runs": runs}))

    # ---- references
    def references(self, limit: int | None = None, **filters: Any) -> list[Document]:
        """List the references in use, by name: all, or at most `limit`."""
        return self._fetch_list(calls.REFERENCES(**filters), limit)

    def reference(self, name: str) -> Document:
        """Fetch one reference with its history."""
        return self._fetch_document(calls.REFERENCE(name))

    def accept_reference(
        self, name: str, run: str, *, by: str | None = None, note: str | None = None
    ) -> Document:
        """Make a run the reference of a name; the previous one stays in the history."""
        body = {"run": run, "by": by, "note": note}
        return self._fetch_document(calls.ACCEPT_REFERENCE(name, json=body))

    def edit_reference(
        self, reference: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> Document:
        """Change name, note or tags of a reference; `if_match` is the ETag that was read."""
        return self._fetch_document(
            calls.build_edit(calls.EDIT_REFERENCE, reference, changes, if_match)
        )

    def delete_reference(self, reference: str, *, cascade: bool = False) -> Document:
        """Delete a reference with its history; `cascade` adds what was made from it."""
        return self._fetch_document(
            calls.build_deletion(calls.DELETE_REFERENCE, reference, cascade)
        )
