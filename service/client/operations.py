"""The operations of the REST interface, each once: its call, and how both clients give its answer.

An operation returns the call of a route and the type of its answer. The decorator makes a method
of it: for `Client` one that waits, for `AsyncClient` one that is awaited. A list has two methods:
one collects it, one iterates over it. Types are those of `service.client.documents`, for editors
and type checkers. A slash after `self` leaves all names to the filters.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from math import inf
from pathlib import Path
from typing import Any, Literal

import httpx

from service.client import documents
from service.client.calls import (
    FIRST_PAUSE_SECONDS,
    POLL_SECONDS,
    TERMINAL_STATES,
    ClientError,
    Document,
    EventParser,
    RestCall,
    ServerUnreachable,
    WaitTimeout,
    build_edit,
    build_event_stream,
    build_submission,
    build_upload,
    call,
)
from service.client.exchange import Exchange
from service.client.methods import (
    Method,
    answer,
    collect,
    fetch,
    fetch_pieces,
    give_each,
    iterate,
)
from service.client.progress import show_progress
from service.client.steps import AnswerItem, Steps


class Operations(Exchange):
    """All operations."""

    @answer
    def send(self, call: RestCall[Any], *, stream: bool = False) -> Steps[httpx.Response]:
        """Send one call and raise its errors. The caller reads and closes a stream."""
        yield AnswerItem((yield from self._send(call, stream)))

    # ---- the server
    @fetch
    def health(self) -> RestCall[documents.HealthDocument]:
        """Check that the web process answers."""
        return call("GET /healthz")

    @fetch
    def readiness(self) -> RestCall[documents.ReadyDocument]:
        """Check database, store and dispatcher; `ProblemError` says which of them is away."""
        return call("GET /readyz")

    @fetch
    def metrics(self) -> RestCall[str]:
        """Fetch the gauges in Prometheus' text format."""
        return call("GET /metrics")

    # ---- datasets
    @fetch
    def add_dataset(
        self,
        source: str | Path | bytes,
        name: str | None = None,
        *,
        segments: str | None = None,
        sample_time: float | None = None,
        columns: str | None = None,
        missing: str | None = None,
        exclude: str | None = None,
        clock: str | None = None,
    ) -> RestCall[documents.DatasetDocument]:
        """Store a recording from a file of any kind that is read, or from its bytes."""
        if not (isinstance(source, bytes) or Path(source).exists()):
            raise FileNotFoundError(f"there is no file {source}")
        options = {
            "segments": segments,
            "sample_time": sample_time,
            "columns": columns,
            "missing": missing,
            "exclude": exclude,
            "clock": clock,
        }
        return build_upload(source, name, options)

    @fetch
    def simulate_dataset(self, body: Mapping[str, Any]) -> RestCall[documents.DatasetDocument]:
        """Make a dataset from a model, its true parameters, inputs and noise."""
        return call("POST /v1/datasets:simulate", json=body)

    @fetch
    def join(
        self, datasets: list[str], name: str | None = None
    ) -> RestCall[documents.DatasetDocument]:
        """Make a dataset of several recordings on one clock; nothing is resampled."""
        return call("POST /v1/datasets:join", json={"name": name, "datasets": datasets})

    @fetch
    def derive(
        self, dataset: str, steps: list[Document], name: str | None = None
    ) -> RestCall[documents.DatasetDocument]:
        """Make a dataset from another: noise, resample, trim, select, pool, and so on."""
        body = {"name": name, "steps": steps}
        return call("POST /v1/datasets/{}:derive", dataset, json=body)

    def _list_datasets(
        self, /, limit: int | None = None, **filters: Any
    ) -> RestCall[documents.DatasetDocument]:
        """Give datasets, latest first: all, or at most `limit`; `name`, `tag` … are filters."""
        return call("GET /v1/datasets", **filters).limit_to(limit)

    datasets, iterate_datasets = collect(_list_datasets), iterate(_list_datasets)

    @fetch
    def dataset(self, name: str) -> RestCall[documents.DatasetDocument]:
        """Fetch one dataset by its id."""
        return call("GET /v1/datasets/{}", name)

    @fetch
    def signals(self, dataset: str, max_points: int = 1000) -> RestCall[documents.SignalsDocument]:
        """Fetch the signals of a dataset, reduced to at most `max_points` points per channel."""
        return call("GET /v1/datasets/{}/signals", dataset, max_points=max_points)

    @fetch
    def check_dataset(self, dataset: str) -> RestCall[documents.DatasetCheckDocument]:
        """Fetch what happened to the recording of a dataset."""
        return call("GET /v1/datasets/{}/check", dataset)

    @fetch
    def lineage(self, dataset: str) -> RestCall[documents.LineageDocument]:
        """Fetch the lineage of a dataset: its sources, and everything made from it."""
        return call("GET /v1/datasets/{}/lineage", dataset)

    @fetch
    def content(self, dataset: str) -> RestCall[bytes]:
        """Download a dataset as an MCAP file."""
        return call("GET /v1/datasets/{}/content", dataset)

    @fetch_pieces
    def download(self, dataset: str, format: Literal["mcap", "csv"] = "mcap") -> RestCall[bytes]:
        """Download a dataset piece by piece: mcap or csv."""
        if format not in ("mcap", "csv"):
            raise ClientError(f"format: found {format!r}; need mcap or csv")
        return call(f"GET /v1/datasets/{{}}/content{'.csv' if format == 'csv' else ''}", dataset)

    @fetch
    def dataset_figure(self, /, dataset: str, **options: Any) -> RestCall[documents.FigureDocument]:
        """Draw the signals of a dataset, as Plotly JSON; `options` are those of the interface."""
        return call("GET /v1/datasets/{}/figures/signals", dataset, **options)

    @fetch
    def edit_dataset(
        self, dataset: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> RestCall[documents.DatasetDocument]:
        """Change name, note or tags of a dataset; `if_match` is the ETag that was read."""
        return build_edit("PATCH /v1/datasets/{}", dataset, changes, if_match)

    @fetch
    def delete_dataset(
        self, dataset: str, *, cascade: bool = False
    ) -> RestCall[documents.DeletedDocument]:
        """Delete a dataset; `cascade` adds what was made from it."""
        return call("DELETE /v1/datasets/{}", dataset, cascade=cascade or None)

    # ---- access
    @fetch
    def access(self) -> RestCall[documents.AccessDocument]:
        """Fetch who asks: project and scopes, with the project's limits and use."""
        return call("GET /v1/access")

    def _list_audit(self, limit: int | None = None) -> RestCall[documents.AuditEntryDocument]:
        """Give who did what in the project, latest first: all, or at most `limit`."""
        return call("GET /v1/audit").limit_to(limit)

    audit, iterate_audit = collect(_list_audit), iterate(_list_audit)

    # ---- models
    def _list_models(
        self, /, limit: int | None = None, **filters: Any
    ) -> RestCall[documents.ModelDocument]:
        """Give the built-in models and those of users: all, or at most `limit`."""
        return call("GET /v1/models", **filters).limit_to(limit)

    models, iterate_models = collect(_list_models), iterate(_list_models)

    @fetch
    def model(self, name: str) -> RestCall[documents.ModelDocument]:
        """Fetch one model with its document."""
        return call("GET /v1/models/{}", name)

    @fetch
    def add_model(self, document: Mapping[str, Any]) -> RestCall[documents.ModelDocument]:
        """Store a user model; a changed document becomes its next version."""
        return call("POST /v1/models", json=document)

    @fetch
    def check_model(self, document: Mapping[str, Any]) -> RestCall[documents.CheckDocument]:
        """Check a model document; every error has its column."""
        return call("POST /v1/models:check", json=document)

    @fetch
    def edit_model(
        self, model: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> RestCall[documents.ModelDocument]:
        """Change note or tags of a model; `if_match` is the ETag that was read."""
        return build_edit("PATCH /v1/models/{}", model, changes, if_match)

    @fetch
    def delete_model(
        self, model: str, *, cascade: bool = False
    ) -> RestCall[documents.DeletedDocument]:
        """Delete a model, all versions or ``name@version``; `cascade` adds what used it."""
        return call("DELETE /v1/models/{}", model, cascade=cascade or None)

    # ---- jobs
    @fetch
    def submit(
        self, job: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> RestCall[documents.JobDocument]:
        """Queue a job."""
        return build_submission("POST /v1/jobs", job, idempotency_key)

    @fetch
    def noise_sweep(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> RestCall[documents.JobDocument]:
        """Queue a noise sweep: σ × replicates × methods as one job."""
        return build_submission("POST /v1/recipes/noise-sweep", body, idempotency_key)

    @fetch
    def reidentify(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> RestCall[documents.JobDocument]:
        """Queue a batch re-identification: a run for each value of a label, with a trend."""
        return build_submission("POST /v1/recipes/reidentify", body, idempotency_key)

    def _list_jobs(
        self, /, limit: int | None = None, state: Sequence[str] | None = None, **filters: Any
    ) -> RestCall[documents.JobDocument]:
        """Give the jobs that pass the filters, latest first: all, or at most `limit`."""
        return call("GET /v1/jobs", state=state, **filters).limit_to(limit)

    jobs, iterate_jobs = collect(_list_jobs), iterate(_list_jobs)

    def _call_job(self, name: str) -> RestCall[documents.JobDocument]:
        """Fetch one job with its state and progress."""
        return call("GET /v1/jobs/{}", name)

    job = fetch(_call_job)

    @fetch
    def edit_job(
        self, job: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> RestCall[documents.JobDocument]:
        """Change name, note or tags of a job; `if_match` is the ETag that was read."""
        return build_edit("PATCH /v1/jobs/{}", job, changes, if_match)

    @fetch
    def delete_job(self, job: str, *, cascade: bool = False) -> RestCall[documents.DeletedDocument]:
        """Delete a job that has ended; `cascade` adds what was made from it."""
        return call("DELETE /v1/jobs/{}", job, cascade=cascade or None)

    @fetch
    def cancel(self, job: str) -> RestCall[documents.JobDocument]:
        """Cancel a job; its results so far stay."""
        return call("POST /v1/jobs/{}:cancel", job)

    @fetch
    def resume(self, job: str, *, failed: bool = False) -> RestCall[documents.JobDocument]:
        """Queue a failed or cancelled job again, from where it stopped.

        With `failed`, the failed runs alone of a job that has ended.
        """
        return call("POST /v1/jobs/{}:resume", job, failed=failed or None)

    @fetch
    def clone(self, job: str) -> RestCall[documents.JobDocument]:
        """Queue the same request as a new job."""
        return call("POST /v1/jobs/{}:clone", job)

    @fetch
    def report(self, job: str) -> RestCall[str]:
        """Fetch the report of a job, as HTML."""
        return call("GET /v1/jobs/{}/report", job)

    @answer
    def wait(
        self,
        job: str,
        progress: Callable[[documents.JobDocument], object] | None = None,
        *,
        poll: float = POLL_SECONDS,
        timeout: float | None = None,
        bar: bool = False,
    ) -> Steps[documents.JobDocument]:
        """Wait until a job has ended; `progress` is called with its state at every poll.

        Parameters
        ----------
        poll : float
            Time between two polls, s.
        timeout : float, optional
            Longest time to wait, s; by default without limit.
        bar : bool
            Whether a progress bar is shown on stderr.

        Raises
        ------
        WaitTimeout
            If the job has not ended in time.
        """
        start, limit = time.monotonic(), inf if timeout is None else timeout
        with show_progress(job, is_shown=bar) as advance:
            while True:
                response = yield from self._send(self._call_job(job))
                state: documents.JobDocument = response.json()
                advance(state)
                if progress is not None:
                    progress(state)
                if state["state"] in TERMINAL_STATES:
                    yield AnswerItem(state)
                    return
                left = start + limit - time.monotonic()
                if left <= 0:
                    raise WaitTimeout(state, limit)
                yield self._pause(min(poll, left))

    @give_each
    def events(self, job: str, after: str | None = None) -> Steps[Document]:
        """Yield the events of a job until its end; `after` is the id of the last event received.

        After a lost connection, or 45 s without a sign of life, the stream is opened again. It
        continues with the next event.

        Raises
        ------
        ServerUnreachable
            If the server stays silent, or too many streams break in succession.
        """
        losses, is_over = 0, False
        while not is_over:
            parser = EventParser()
            stream = yield from self._send(build_event_stream(job, after), stream=True)
            lines = self._read_lines(stream)
            try:
                while (line := (yield self._read_next(lines))) is not None:
                    if event := parser.feed_line(line):
                        after, losses, is_over = event["id"], 0, event["event"] == "end"
                        yield AnswerItem(event)
            except httpx.TransportError as error:
                if losses >= self._retries:
                    raise ServerUnreachable(self.url, error) from error
            finally:
                yield self._end_stream(stream, lines)
            losses += 1
            is_closed = stream.status_code == HTTPStatus.NO_CONTENT  # there is no further event
            is_over = is_over or is_closed or losses > self._retries
            if not is_over:
                yield self._pause(FIRST_PAUSE_SECONDS)

    # ---- runs
    def _list_runs(
        self, /, job: str, *, at_most: int | None = None, **filters: Any
    ) -> RestCall[documents.RunDocument]:
        """Give all runs of a job, or the first `at_most` that pass the filters."""
        return call("GET /v1/jobs/{}/runs", job, **filters).limit_to(at_most)

    iterate_runs = iterate(_list_runs)
    runs = Method(collect(_list_runs).sync, iterate(_list_runs).awaited)

    @fetch
    def summary(
        self, job: str, by: Sequence[str] | None = None
    ) -> RestCall[documents.SummaryDocument]:
        """Fetch quantiles over the values of axes or labels, by default over all axes but seeds."""
        return call("GET /v1/jobs/{}/summary", job, by=by)

    @fetch
    def trend(self, job: str, outliers: str | None = None) -> RestCall[documents.TrendDocument]:
        """Fetch the trend of a batch over its label: law, band, predictions, outliers, drift.

        Its laws leave outliers out, or count them with ``outliers="include"``.
        """
        return call("GET /v1/jobs/{}/trend", job, outliers=outliers)

    @fetch
    def summary_figure(self, /, job: str, **options: Any) -> RestCall[documents.FigureDocument]:
        """Draw errors against the noise, as Plotly JSON; `options` are those of the interface."""
        return call("GET /v1/jobs/{}/figures/summary", job, **options)

    @fetch
    def trend_figure(self, /, job: str, **options: Any) -> RestCall[documents.FigureDocument]:
        """Draw the estimates over the label, as Plotly JSON."""
        return call("GET /v1/jobs/{}/figures/trend", job, **options)

    @fetch_pieces
    def download_runs(self, job: str) -> RestCall[bytes]:
        """Download the table of all runs of a job as CSV, piece by piece."""
        return call("GET /v1/jobs/{}/runs.csv", job)

    @fetch_pieces
    def download_estimates(self, run: str) -> RestCall[bytes]:
        """Download the estimates of a run as CSV, one parameter per row."""
        return call("GET /v1/runs/{}/estimates.csv", run)

    @fetch
    def run(self, name: str) -> RestCall[documents.RunDocument]:
        """Fetch the result of one run."""
        return call("GET /v1/runs/{}", name)

    @fetch
    def edit_run(
        self, run: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> RestCall[documents.RunDocument]:
        """Change note or tags of a run; `if_match` is the ETag that was read."""
        return build_edit("PATCH /v1/runs/{}", run, changes, if_match)

    @fetch
    def delete_run(self, run: str, *, cascade: bool = False) -> RestCall[documents.DeletedDocument]:
        """Delete a run of a job that has ended; `cascade` adds what was made from it."""
        return call("DELETE /v1/runs/{}", run, cascade=cascade or None)

    @fetch
    def history(self, run: str) -> RestCall[documents.HistoryDocument]:
        """Fetch the improvements of each island's champion."""
        return call("GET /v1/runs/{}/history", run)

    @fetch
    def response(self, run: str, max_points: int = 1000) -> RestCall[documents.ResponseDocument]:
        """Fetch the measured and simulated outputs."""
        return call("GET /v1/runs/{}/response", run, max_points=max_points)

    @fetch
    def bands(self, run: str, max_points: int = 1000) -> RestCall[documents.BandsDocument]:
        """Fetch the 95 % confidence and prediction bands of the outputs."""
        return call("GET /v1/runs/{}/bands", run, max_points=max_points)

    @fetch
    def disturbances(
        self, run: str, max_points: int = 1000
    ) -> RestCall[documents.DisturbancesDocument]:
        """Fetch the estimated disturbances with their 95 % bands."""
        return call("GET /v1/runs/{}/disturbances", run, max_points=max_points)

    @fetch
    def simulate_run(
        self, run: str, body: Mapping[str, Any], max_points: int = 1000
    ) -> RestCall[documents.RunSimulationDocument]:
        """Simulate the identified model on a new input or under P, PI or PID control."""
        return call("POST /v1/runs/{}:simulate", run, json=body, max_points=max_points)

    @fetch
    def validate_run(
        self,
        run: str,
        dataset: str,
        channels: Mapping[str, str] | None = None,
        *,
        skip: int = 0,
        max_points: int = 1000,
    ) -> RestCall[documents.FreeRunDocument]:
        """Simulate the identified model on another recording: RMS and fit."""
        body = {"dataset": dataset, "channels": dict(channels or {}), "skip": skip}
        return call("POST /v1/runs/{}:validate", run, json=body, max_points=max_points)

    @fetch
    def migrations(self, run: str) -> RestCall[documents.MigrationsDocument]:
        """Fetch the migration log."""
        return call("GET /v1/runs/{}/migrations", run)

    @fetch
    def profile(
        self, run: str, *parameters: str, points: int = 21
    ) -> RestCall[documents.ProfilesDocument]:
        """Compute the profile likelihood of some free parameters; of all if none is named."""
        body = {"parameters": parameters or None, "points": points}
        return call("POST /v1/runs/{}:profile", run, json=body)

    @fetch
    def residuals(self, run: str) -> RestCall[documents.ResidualsDocument]:
        """Fetch the correlation functions of the residuals, their bands and tests."""
        return call("GET /v1/runs/{}/residuals", run)

    @fetch
    def run_figure(
        self, /, run: str, name: str, **options: Any
    ) -> RestCall[documents.FigureDocument]:
        """Draw a figure of a run, such as ``response`` or ``history``, as Plotly JSON."""
        return call("GET /v1/runs/{}/figures/{}", run, name, **options)

    @fetch_pieces
    def download_signals(self, run: str) -> RestCall[bytes]:
        """Download the fitted signals of a run as MCAP, piece by piece."""
        return call("GET /v1/runs/{}/signals.mcap", run)

    @fetch
    def export(self, run: str, format: str = "json", pade_order: int = 3) -> RestCall[str]:
        """Export the identified model as text: json, python, c or control."""
        return call("GET /v1/runs/{}/export", run, format=format, pade_order=pade_order)

    @fetch
    def compare(self, *runs: str) -> RestCall[documents.ComparisonDocument]:
        """Compare runs on the same data, best first."""
        return call("POST /v1/runs:compare", json={"runs": runs})

    # ---- references
    def _list_references(
        self, /, limit: int | None = None, **filters: Any
    ) -> RestCall[documents.ReferenceDocument]:
        """Give the references in use, by name: all, or at most `limit`."""
        return call("GET /v1/references", **filters).limit_to(limit)

    references, iterate_references = collect(_list_references), iterate(_list_references)

    @fetch
    def reference(self, name: str) -> RestCall[documents.ReferenceDocument]:
        """Fetch one reference with its history."""
        return call("GET /v1/references/{}", name)

    @fetch
    def accept_reference(
        self, name: str, run: str, *, by: str | None = None, note: str | None = None
    ) -> RestCall[documents.ReferenceDocument]:
        """Make a run the reference of a name; the previous one stays in the history."""
        body = {"run": run, "by": by, "note": note}
        return call("PUT /v1/references/{}", name, json=body)

    @fetch
    def edit_reference(
        self, reference: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> RestCall[documents.ReferenceDocument]:
        """Change name, note or tags of a reference; `if_match` is the ETag that was read."""
        return build_edit("PATCH /v1/references/{}", reference, changes, if_match)

    @fetch
    def delete_reference(
        self, reference: str, *, cascade: bool = False
    ) -> RestCall[documents.DeletedDocument]:
        """Delete a reference with its history; `cascade` adds what was made from it."""
        return call("DELETE /v1/references/{}", reference, cascade=cascade or None)
