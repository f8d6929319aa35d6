"""What can be asked of a service: every method once, for the client and its asynchronous twin."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from service.client import calls
from service.client.calls import Call, Document

One = TypeVar("One", covariant=True)
Listed = TypeVar("Listed", covariant=True)
Text = TypeVar("Text", covariant=True)
Content = TypeVar("Content", covariant=True)


class Methods(ABC, Generic[One, Listed, Text, Content]):
    """Methods of both clients.

    They give a document (`One`), a list of documents (`Listed`), a text or bytes: the client these
    themselves, its asynchronous twin what is awaited for them.
    """

    @abstractmethod
    def _one(self, call: Call) -> One:
        """The document that answers a call."""

    @abstractmethod
    def _all(self, *parts: str, at_most: int | None = None, **filters: Any) -> Listed:
        """What is listed under a path, page by page."""

    @abstractmethod
    def _text(self, call: Call) -> Text:
        """The text that answers a call."""

    @abstractmethod
    def _content(self, call: Call) -> Content:
        """The bytes that answer a call."""

    # ---- datasets
    def add_dataset(
        self,
        source: str | Path | bytes,
        name: str | None = None,
        *,
        segments: str | None = None,
        sample_time: float | None = None,
    ) -> One:
        """Store a recording, CSV or MCAP, from a file or from bytes."""
        return self._one(calls.upload(source, name, segments, sample_time))

    def simulate_dataset(self, body: Mapping[str, Any]) -> One:
        """Make a dataset from a model, its true parameters, inputs and noise."""
        return self._one(calls.create("datasets:simulate", body))

    def derive(self, dataset: str, steps: list[Document], name: str | None = None) -> One:
        """Make a dataset from another: noise, resample, trim, select, pool, and so on."""
        return self._one(calls.act("datasets", dataset, "derive", {"name": name, "steps": steps}))

    def datasets(self) -> Listed:
        """All datasets, newest first."""
        return self._all("datasets")

    def dataset(self, name: str) -> One:
        """One dataset by id."""
        return self._one(calls.read("datasets", name))

    def signals(self, dataset: str, max_points: int = 1000) -> One:
        """Signals of a dataset, reduced to at most so many points a channel."""
        return self._one(calls.read("datasets", dataset, "signals", max_points=max_points))

    def lineage(self, dataset: str) -> One:
        """What a dataset was made from, and what was made from it."""
        return self._one(calls.read("datasets", dataset, "lineage"))

    def content(self, dataset: str) -> Content:
        """A dataset as an MCAP file."""
        return self._content(calls.read("datasets", dataset, "content"))

    # ---- models
    def models(self) -> Listed:
        """Catalogue and own models."""
        return self._all("models")

    def model(self, name: str) -> One:
        """One model with its document."""
        return self._one(calls.read("models", name))

    def add_model(self, document: Mapping[str, Any]) -> One:
        """Store an own model; a changed document becomes its next version."""
        return self._one(calls.create("models", document))

    def check_model(self, document: Mapping[str, Any]) -> One:
        """Whether a model document can be used, with every error and its column."""
        return self._one(calls.create("models:check", document))

    # ---- jobs
    def submit(self, job: Mapping[str, Any], *, idempotency_key: str | None = None) -> One:
        """Queue a job."""
        return self._one(calls.queue("jobs", job, idempotency_key))

    def noise_sweep(self, body: Mapping[str, Any], *, idempotency_key: str | None = None) -> One:
        """Queue a noise sweep: σ × replicates × methods as one job."""
        return self._one(calls.queue("recipes/noise-sweep", body, idempotency_key))

    def reidentify(self, body: Mapping[str, Any], *, idempotency_key: str | None = None) -> One:
        """Queue a batch re-identification: a run for each value of a label, with a trend."""
        return self._one(calls.queue("recipes/reidentify", body, idempotency_key))

    def jobs(self, limit: int | None = None, state: Sequence[str] | None = None) -> Listed:
        """Jobs, newest first: all, or at most `limit`, or those in some states."""
        return self._all("jobs", at_most=limit, state=None if state is None else list(state))

    def job(self, name: str) -> One:
        """One job with its state and progress."""
        return self._one(calls.read("jobs", name))

    def cancel(self, job: str) -> One:
        """Cancel a job; what it has found so far stays."""
        return self._one(calls.act("jobs", job, "cancel"))

    def resume(self, job: str) -> One:
        """Queue a failed or cancelled job again, from where it stopped."""
        return self._one(calls.act("jobs", job, "resume"))

    def clone(self, job: str) -> One:
        """Queue the same request as a new job."""
        return self._one(calls.act("jobs", job, "clone"))

    def report(self, job: str) -> Text:
        """The report of a job, as HTML."""
        return self._text(calls.read("jobs", job, "report"))

    # ---- runs
    def summary(self, job: str, by: Sequence[str] | None = None) -> One:
        """Quantiles over the values of axes or labels; by default over all axes but seeds."""
        return self._one(calls.read("jobs", job, "summary", by=None if by is None else list(by)))

    def trend(self, job: str) -> One:
        """Estimates over the label of a batch: law, band, predictions, outliers, drift."""
        return self._one(calls.read("jobs", job, "trend"))

    def run(self, name: str) -> One:
        """One run's result."""
        return self._one(calls.read("runs", name))

    def history(self, run: str) -> One:
        """Improvements of each island's champion."""
        return self._one(calls.read("runs", run, "history"))

    def response(self, run: str, max_points: int = 1000) -> One:
        """Measured and simulated outputs."""
        return self._one(calls.read("runs", run, "response", max_points=max_points))

    def simulate_run(self, run: str, body: Mapping[str, Any], max_points: int = 1000) -> One:
        """Simulate the identified model on a new input or under P, PI or PID control."""
        return self._one(calls.act("runs", run, "simulate", body, max_points=max_points))

    def validate_run(
        self,
        run: str,
        dataset: str,
        channels: Mapping[str, str] | None = None,
        *,
        skip: int = 0,
        max_points: int = 1000,
    ) -> One:
        """Run the identified model freely over another recording: RMS and fit there."""
        body = {"dataset": dataset, "channels": dict(channels or {}), "skip": skip}
        return self._one(calls.act("runs", run, "validate", body, max_points=max_points))

    def migrations(self, run: str) -> One:
        """The migration log."""
        return self._one(calls.read("runs", run, "migrations"))

    def profile(self, run: str, *parameters: str, points: int = 21) -> One:
        """Profile likelihood of some free parameters, of all if none is named."""
        return self._one(calls.profile(run, parameters, points))

    def residuals(self, run: str) -> One:
        """Correlation functions of the residuals with their bands and tests."""
        return self._one(calls.read("runs", run, "residuals"))

    def export(self, run: str, format: str = "json", pade_order: int = 3) -> Text:
        """The identified model as text: json, python, c or control."""
        call = calls.read("runs", run, "export", format=format, pade_order=pade_order)
        return self._text(call)

    def compare(self, *runs: str) -> One:
        """Runs on the same data side by side, the best first."""
        return self._one(calls.create("runs:compare", {"runs": runs}))

    # ---- references
    def references(self) -> Listed:
        """The references in use, by name."""
        return self._all("references")

    def reference(self, name: str) -> One:
        """One reference with its history."""
        return self._one(calls.read("references", name))

    def accept_reference(
        self, name: str, run: str, *, by: str | None = None, note: str | None = None
    ) -> One:
        """Make a run the reference of a name; the one before stays in the history."""
        return self._one(calls.accept(name, run, by, note))
