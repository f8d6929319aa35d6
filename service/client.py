"""The light client of the service: httpx only, without NumPy or Ray.

All methods take and return plain documents with the names of the REST interface.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx

from service import calls
from service.async_client import AsyncClient
from service.calls import (
    DEFAULT_URL,
    PAGE,
    POLL_S,
    TERMINAL,
    Call,
    ClientError,
    Document,
    NotFinite,
    ProblemError,
    ServerUnreachable,
    options,
)

__all__ = ["AsyncClient", "Client", "ClientError", "NotFinite", "ProblemError", "ServerUnreachable"]


class Client:
    """The service from a program.

    Parameters
    ----------
    url : str
        Address of the server.
    key : str, optional
        API key, where the server asks for one.
    transport : httpx.BaseTransport, optional
        Another way to the server, for tests.

    Raises
    ------
    ProblemError
        From every method, if the server refuses; it carries the problem document.
    ServerUnreachable
        From every method, if no server answers.
    NotFinite
        From every method that sends a body, if a number in it is infinite or not a number.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        key: str | None = None,
        *,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url = url.rstrip("/")
        self._http = httpx.Client(**options(self.url, key), transport=transport)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def send(self, call: Call) -> httpx.Response:
        """Send one call; errors are raised."""
        try:
            with calls.opened(call.content) as content:
                answer = self._http.request(
                    call.method, call.path, params=dict(call.params), json=call.json,
                    content=content, headers=dict(call.headers),
                )  # fmt: skip
        except httpx.TransportError as error:
            raise ServerUnreachable(self.url, str(error) or type(error).__name__) from error
        return calls.checked(answer)

    def _json(self, call: Call) -> Document:
        document: Document = self.send(call).json()
        return document

    def _all(self, *parts: str, at_most: int | None = None, **filters: Any) -> list[Document]:
        items: list[Document] = []
        cursor: str | None = None
        limit = min(at_most or PAGE, PAGE)
        while True:
            page = self._json(calls.read(*parts, cursor=cursor, limit=limit, **filters))
            items += page["items"]
            cursor = page["next"]
            if cursor is None or (at_most is not None and len(items) >= at_most):
                return items[:at_most]

    # ---- datasets
    def add_dataset(
        self,
        source: str | Path | bytes,
        name: str | None = None,
        *,
        segments: str | None = None,
        sample_time: float | None = None,
    ) -> Document:
        """Store a recording, CSV or MCAP, from a file or from bytes."""
        return self._json(calls.upload(source, name, segments, sample_time))

    def simulate_dataset(self, body: Mapping[str, Any]) -> Document:
        """Make a dataset from a model, its true parameters, inputs and noise."""
        return self._json(calls.create("datasets:simulate", body))

    def derive(self, dataset: str, steps: list[Document], name: str | None = None) -> Document:
        """Make a dataset from another: noise, resample, trim, select, pool, and so on."""
        return self._json(calls.act("datasets", dataset, "derive", {"name": name, "steps": steps}))

    def datasets(self) -> list[Document]:
        """All datasets, newest first."""
        return self._all("datasets")

    def dataset(self, name: str) -> Document:
        """One dataset by id."""
        return self._json(calls.read("datasets", name))

    def signals(self, dataset: str, max_points: int = 1000) -> Document:
        """Signals of a dataset, reduced to at most so many points a channel."""
        return self._json(calls.read("datasets", dataset, "signals", max_points=max_points))

    def lineage(self, dataset: str) -> Document:
        """What a dataset was made from, and what was made from it."""
        return self._json(calls.read("datasets", dataset, "lineage"))

    def content(self, dataset: str) -> bytes:
        """A dataset as an MCAP file."""
        return self.send(calls.read("datasets", dataset, "content")).content

    # ---- models
    def models(self) -> list[Document]:
        """Catalogue and own models."""
        return self._all("models")

    def model(self, name: str) -> Document:
        """One model with its document."""
        return self._json(calls.read("models", name))

    def add_model(self, document: Mapping[str, Any]) -> Document:
        """Store an own model; a changed document becomes its next version."""
        return self._json(calls.create("models", document))

    def check_model(self, document: Mapping[str, Any]) -> Document:
        """Whether a model document can be used, with every error and its column."""
        return self._json(calls.create("models:check", document))

    # ---- jobs
    def submit(self, job: Mapping[str, Any], *, idempotency_key: str | None = None) -> Document:
        """Queue a job."""
        headers = {"Idempotency-Key": idempotency_key} if idempotency_key else {}
        return self._json(calls.create("jobs", job, headers))

    def noise_sweep(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> Document:
        """Queue a noise sweep: σ × replicates × methods as one job."""
        return self._json(calls.noise_sweep(body, idempotency_key))

    def reidentify(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> Document:
        """Queue a batch re-identification: a run for each value of a label, with a trend."""
        return self._json(calls.reidentify(body, idempotency_key))

    def jobs(self, limit: int | None = None, state: Sequence[str] | None = None) -> list[Document]:
        """Jobs, newest first: all, or at most `limit`, or those in some states."""
        return self._all("jobs", at_most=limit, state=None if state is None else list(state))

    def job(self, name: str) -> Document:
        """One job with its state and progress."""
        return self._json(calls.read("jobs", name))

    def cancel(self, job: str) -> Document:
        """Cancel a job; what it has found so far stays."""
        return self._json(calls.act("jobs", job, "cancel"))

    def resume(self, job: str) -> Document:
        """Queue a failed or cancelled job again, from where it stopped."""
        return self._json(calls.act("jobs", job, "resume"))

    def clone(self, job: str) -> Document:
        """Queue the same request as a new job."""
        return self._json(calls.act("jobs", job, "clone"))

    def report(self, job: str) -> str:
        """The report of a job, as HTML."""
        return self.send(calls.read("jobs", job, "report")).text

    def wait(
        self,
        job: str,
        progress: Callable[[Document], object] | None = None,
        *,
        poll: float = POLL_S,
    ) -> Document:
        """Wait until a job has ended; `progress` hears its state at every look."""
        while True:
            state = self.job(job)
            if progress is not None:
                progress(state)
            if state["state"] in TERMINAL:
                return state
            time.sleep(poll)

    def events(self, job: str, after: str | None = None) -> Iterator[Document]:
        """Events of a job as they come, until its end; `after` is the id of the last one known."""
        call, parser = calls.read("jobs", job, "events"), calls.EventParser()
        headers = {"Last-Event-ID": after} if after else {}
        with self._http.stream("GET", call.path, headers=headers, timeout=None) as stream:
            if not stream.is_success:
                stream.read()
                calls.checked(stream)
            for line in stream.iter_lines():
                yield from parser.feed(line)

    # ---- runs
    def runs(self, job: str, **filters: Any) -> list[Document]:
        """All runs of a job."""
        return self._all("jobs", job, "runs", **filters)

    def summary(self, job: str, by: Sequence[str] | None = None) -> Document:
        """Quantiles over the values of axes or labels; by default over all axes but seeds."""
        return self._json(calls.read("jobs", job, "summary", by=None if by is None else list(by)))

    def trend(self, job: str) -> Document:
        """Estimates over the label of a batch: law, band, predictions, outliers, drift."""
        return self._json(calls.read("jobs", job, "trend"))

    def run(self, name: str) -> Document:
        """One run's result."""
        return self._json(calls.read("runs", name))

    def history(self, run: str) -> Document:
        """Improvements of each island's champion."""
        return self._json(calls.read("runs", run, "history"))

    def response(self, run: str, max_points: int = 1000) -> Document:
        """Measured and simulated outputs."""
        return self._json(calls.read("runs", run, "response", max_points=max_points))

    def simulate_run(self, run: str, body: Mapping[str, Any], max_points: int = 1000) -> Document:
        """Simulate the identified model on a new input or under proportional control."""
        return self._json(calls.act("runs", run, "simulate", body, max_points=max_points))

    def validate_run(
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
        return self._json(calls.act("runs", run, "validate", body, max_points=max_points))

    def migrations(self, run: str) -> Document:
        """The migration log."""
        return self._json(calls.read("runs", run, "migrations"))

    def profile(self, run: str, *parameters: str, points: int = 21) -> Document:
        """Profile likelihood of some free parameters, of all if none is named."""
        return self._json(calls.profile(run, parameters, points))

    def residuals(self, run: str) -> Document:
        """Correlation functions of the residuals with their bands and tests."""
        return self._json(calls.read("runs", run, "residuals"))

    def export(self, run: str, format: str = "json", pade_order: int = 3) -> str:
        """The identified model as text: json, python, c or control."""
        call = calls.read("runs", run, "export", format=format, pade_order=pade_order)
        return self.send(call).text

    def compare(self, *runs: str) -> Document:
        """Runs on the same data side by side, the best first."""
        return self._json(calls.create("runs:compare", {"runs": runs}))

    # ---- references
    def references(self) -> list[Document]:
        """The references in use, by name."""
        return self._all("references")

    def reference(self, name: str) -> Document:
        """One reference with its history."""
        return self._json(calls.read("references", name))

    def accept_reference(
        self, name: str, run: str, *, by: str | None = None, note: str | None = None
    ) -> Document:
        """Make a run the reference of a name; the one before stays in the history."""
        return self._json(calls.accept(name, run, by, note))
