"""The light client of the service: httpx only, without NumPy or Ray.

All methods take and return plain documents with the field names of the REST interface. Their types
are those of `service.client.documents`, for editors and type checkers.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import httpx

from service.client import calls
from service.client.calls import Answer, Document, RestCall, ServerUnreachable
from service.client.progress import show_progress
from service.client.rows import Rows

if TYPE_CHECKING:
    from service.client import documents


class Client:
    """Synchronous client of the service.

    Parameters
    ----------
    url : str, optional
        Address of the server; by default that of LAGID_URL, else this machine.
    key : str, optional
        API key, if the server requires one; by default that of LAGID_API_KEY.
    timeout : float
        Longest time without a byte of an answer, s. For events it is 45 s: the server sends a sign
        of life every 15 s.
    retries : int
        How often a request is repeated after a lost connection, or an answer 429 or 503. Only
        requests that may be sent twice are repeated: those that read or replace, and those with
        an idempotency key, such as the submission of a job. The pause is that of
        ``Retry-After``, 30 s at most. Without this header it is 0.5 s, and doubles each time.
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
        url: str | None = None,
        key: str | None = None,
        *,
        timeout: float = calls.TIMEOUT_SECONDS,
        retries: int = calls.DEFAULT_RETRIES,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url, self._retries = calls.choose_url(url), retries
        self._has_answered = False
        self._http = httpx.Client(
            base_url=self.url,
            headers=calls.make_auth_header(calls.choose_key(key)),
            timeout=timeout,
            transport=transport,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def send(self, call: RestCall[Any], *, stream: bool = False) -> httpx.Response:
        """Send one call and raise its errors. The caller reads and closes a stream."""
        pauses = calls.plan_pauses(call, self._retries)
        while True:
            try:
                response = self._send_once(call, stream)
            except httpx.TransportError as error:
                pause = next(pauses, None) if self._is_lost(error) else None
                if pause is None:
                    raise ServerUnreachable(self.url, error) from error
            else:
                self._has_answered = True
                pause = calls.choose_pause(response, pauses)
                if pause is None:
                    return calls.raise_for_problem(response)
            time.sleep(pause)

    def _is_lost(self, error: httpx.TransportError) -> bool:
        """Whether a connection broke, or a server that had answered before is away."""
        if isinstance(error, httpx.ConnectError):
            return self._has_answered
        return not isinstance(error, httpx.TimeoutException)

    def _send_once(self, call: RestCall[Any], stream: bool) -> httpx.Response:
        source = call.content
        file: AbstractContextManager[BinaryIO | bytes | None]
        file = source.open("rb") if isinstance(source, Path) else nullcontext(source)
        with file as content:
            request = self._http.build_request(**call.request(content))
            response = self._http.send(request, stream=stream)
            if not response.is_success:
                response.read()
        return response

    def _fetch(self, call: RestCall[Answer]) -> Answer:
        document: Answer = self.send(call).json()
        return document

    def _iterate(self, call: RestCall[Answer], at_most: int | None = None) -> Iterator[Answer]:
        pages = calls.Paginator(call, at_most)
        while (page := pages.next_call()) is not None:
            yield from pages.take_items(self._fetch(page))

    def _fetch_list(self, call: RestCall[Answer], at_most: int | None = None) -> Rows[Answer]:
        return Rows(self._iterate(call, at_most))

    def _download(self, call: RestCall[bytes]) -> Iterator[bytes]:
        with closing(self.send(call, stream=True)) as stream:
            try:
                yield from stream.iter_bytes()
            except httpx.TransportError as error:
                raise ServerUnreachable(self.url, error) from error

    # ---- the server
    def health(self) -> "documents.HealthDocument":
        """Check that the web process answers."""
        return self._fetch(calls.HEALTH())

    def readiness(self) -> "documents.ReadyDocument":
        """Check database, store and dispatcher; `ProblemError` says which of them is away."""
        return self._fetch(calls.READINESS())

    def metrics(self) -> str:
        """Fetch the gauges in Prometheus' text format."""
        return self.send(calls.METRICS()).text

    # ---- datasets
    def add_dataset(
        self,
        source: str | Path | bytes,
        name: str | None = None,
        *,
        segments: str | None = None,
        sample_time: float | None = None,
    ) -> "documents.DatasetDocument":
        """Store a recording from a file of any kind that is read, or from its bytes."""
        return self._fetch(calls.build_upload(source, name, segments, sample_time))

    def simulate_dataset(self, body: Mapping[str, Any]) -> "documents.DatasetDocument":
        """Make a dataset from a model, its true parameters, inputs and noise."""
        return self._fetch(calls.SIMULATE_DATASET(json=body))

    def derive(
        self, dataset: str, steps: list[Document], name: str | None = None
    ) -> "documents.DatasetDocument":
        """Make a dataset from another: noise, resample, trim, select, pool, and so on."""
        body = {"name": name, "steps": steps}
        return self._fetch(calls.DERIVE(dataset, json=body))

    def datasets(
        self, limit: int | None = None, **filters: Any
    ) -> "Rows[documents.DatasetDocument]":
        """List datasets, newest first: all, or at most `limit`; `name`, `tag` … are filters."""
        return self._fetch_list(calls.DATASETS(**filters), limit)

    def iterate_datasets(self, **filters: Any) -> Iterator["documents.DatasetDocument"]:
        """Iterate over the datasets that pass the filters, latest first, a page at a time."""
        return self._iterate(calls.DATASETS(**filters))

    def dataset(self, name: str) -> "documents.DatasetDocument":
        """Fetch one dataset by its id."""
        return self._fetch(calls.DATASET(name))

    def signals(self, dataset: str, max_points: int = 1000) -> "documents.SignalsDocument":
        """Fetch the signals of a dataset, reduced to at most `max_points` points per channel."""
        return self._fetch(calls.SIGNALS(dataset, max_points=max_points))

    def lineage(self, dataset: str) -> "documents.LineageDocument":
        """Fetch the lineage of a dataset: its sources, and everything made from it."""
        return self._fetch(calls.LINEAGE(dataset))

    def content(self, dataset: str) -> bytes:
        """Download a dataset as an MCAP file."""
        return self.send(calls.CONTENT(dataset)).content

    def download(self, dataset: str, format: str = "mcap") -> Iterator[bytes]:
        """Download a dataset piece by piece: mcap or csv."""
        return self._download(calls.build_download(dataset, format))

    def dataset_figure(self, dataset: str, **options: Any) -> "documents.FigureDocument":
        """Draw the signals of a dataset, as Plotly JSON; `options` are those of the interface."""
        return self._fetch(calls.DATASET_FIGURE(dataset, **options))

    def edit_dataset(
        self, dataset: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> "documents.DatasetDocument":
        """Change name, note or tags of a dataset; `if_match` is the ETag that was read."""
        return self._fetch(calls.build_edit(calls.EDIT_DATASET, dataset, changes, if_match))

    def delete_dataset(self, dataset: str, *, cascade: bool = False) -> "documents.DeletedDocument":
        """Delete a dataset; `cascade` adds what was made from it."""
        return self._fetch(calls.build_deletion(calls.DELETE_DATASET, dataset, cascade))

    # ---- access
    def access(self) -> "documents.AccessDocument":
        """Fetch who asks: project and scopes, with the project's limits and use."""
        return self._fetch(calls.ACCESS())

    def audit(self, limit: int | None = None) -> "Rows[documents.AuditEntryDocument]":
        """List who did what in the project, latest first: all, or at most `limit`."""
        return self._fetch_list(calls.AUDIT(), limit)

    def iterate_audit(self) -> Iterator["documents.AuditEntryDocument"]:
        """Iterate over who did what in the project, latest first, a page at a time."""
        return self._iterate(calls.AUDIT())

    # ---- models
    def models(self, limit: int | None = None, **filters: Any) -> "Rows[documents.ModelDocument]":
        """List the built-in models and those of users: all, or at most `limit`."""
        return self._fetch_list(calls.MODELS(**filters), limit)

    def iterate_models(self, **filters: Any) -> Iterator["documents.ModelDocument"]:
        """Iterate over the models that pass the filters, a page at a time."""
        return self._iterate(calls.MODELS(**filters))

    def model(self, name: str) -> "documents.ModelDocument":
        """Fetch one model with its document."""
        return self._fetch(calls.MODEL(name))

    def add_model(self, document: Mapping[str, Any]) -> "documents.ModelDocument":
        """Store a user model; a changed document becomes its next version."""
        return self._fetch(calls.ADD_MODEL(json=document))

    def check_model(self, document: Mapping[str, Any]) -> "documents.CheckDocument":
        """Check a model document; every error has its column."""
        return self._fetch(calls.CHECK_MODEL(json=document))

    def edit_model(
        self, model: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> "documents.ModelDocument":
        """Change note or tags of a model; `if_match` is the ETag that was read."""
        return self._fetch(calls.build_edit(calls.EDIT_MODEL, model, changes, if_match))

    def delete_model(self, model: str, *, cascade: bool = False) -> "documents.DeletedDocument":
        """Delete a model, all versions or ``name@version``; `cascade` adds what used it."""
        return self._fetch(calls.build_deletion(calls.DELETE_MODEL, model, cascade))

    # ---- jobs
    def submit(
        self, job: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> "documents.JobDocument":
        """Queue a job."""
        return self._fetch(calls.build_submission(calls.SUBMIT, job, idempotency_key))

    def noise_sweep(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> "documents.JobDocument":
        """Queue a noise sweep: σ × replicates × methods as one job."""
        return self._fetch(calls.build_submission(calls.NOISE_SWEEP, body, idempotency_key))

    def reidentify(
        self, body: Mapping[str, Any], *, idempotency_key: str | None = None
    ) -> "documents.JobDocument":
        """Queue a batch re-identification: a run for each value of a label, with a trend."""
        return self._fetch(calls.build_submission(calls.REIDENTIFY, body, idempotency_key))

    def jobs(
        self, limit: int | None = None, state: Sequence[str] | None = None, **filters: Any
    ) -> "Rows[documents.JobDocument]":
        """List jobs, newest first: all, at most `limit`, or those that filters select."""
        return self._fetch_list(calls.JOBS(state=state, **filters), limit)

    def iterate_jobs(
        self, state: Sequence[str] | None = None, **filters: Any
    ) -> Iterator["documents.JobDocument"]:
        """Iterate over the jobs that pass the filters, latest first, a page at a time."""
        return self._iterate(calls.JOBS(state=state, **filters))

    def job(self, name: str) -> "documents.JobDocument":
        """Fetch one job with its state and progress."""
        return self._fetch(calls.JOB(name))

    def edit_job(
        self, job: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> "documents.JobDocument":
        """Change name, note or tags of a job; `if_match` is the ETag that was read."""
        return self._fetch(calls.build_edit(calls.EDIT_JOB, job, changes, if_match))

    def delete_job(self, job: str, *, cascade: bool = False) -> "documents.DeletedDocument":
        """Delete a job that has ended; `cascade` adds what was made from it."""
        return self._fetch(calls.build_deletion(calls.DELETE_JOB, job, cascade))

    def cancel(self, job: str) -> "documents.JobDocument":
        """Cancel a job; its results so far stay."""
        return self._fetch(calls.CANCEL(job))

    def resume(self, job: str) -> "documents.JobDocument":
        """Queue a failed or cancelled job again, from where it stopped."""
        return self._fetch(calls.RESUME(job))

    def clone(self, job: str) -> "documents.JobDocument":
        """Queue the same request as a new job."""
        return self._fetch(calls.CLONE(job))

    def report(self, job: str) -> str:
        """Fetch the report of a job, as HTML."""
        return self.send(calls.REPORT(job)).text

    def wait(
        self,
        job: str,
        progress: Callable[["documents.JobDocument"], object] | None = None,
        *,
        poll: float = calls.POLL_SECONDS,
        timeout: float | None = None,
        bar: bool = False,
    ) -> "documents.JobDocument":
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
        limit = calls.WaitLimit(timeout)
        with show_progress(job, is_shown=bar) as advance:
            while True:
                state = self.job(job)
                advance(state)
                if progress is not None:
                    progress(state)
                if state["state"] in calls.TERMINAL_STATES:
                    return state
                time.sleep(limit.shorten(poll, state))

    def events(self, job: str, after: str | None = None) -> Iterator[Document]:
        """Yield the events of a job until its end; `after` is the id of the last event received.

        After a lost connection, or 45 s without a sign of life, the stream is opened again. It
        continues with the next event.

        Raises
        ------
        ServerUnreachable
            If the server stays silent, or too many streams break in succession.
        """
        events = calls.EventParser(after, self._retries)
        while not events.is_over:
            call = calls.build_event_stream(job, events.last)
            stream = self.send(call, stream=True)
            with closing(stream):
                try:
                    for line in stream.iter_lines():
                        yield from events.feed_line(line)
                except httpx.TransportError as error:
                    events.check_loss(ServerUnreachable(self.url, error))
            if events.note_close(stream.status_code):
                time.sleep(calls.FIRST_PAUSE_SECONDS)

    # ---- runs
    def runs(
        self, job: str, *, at_most: int | None = None, **filters: Any
    ) -> "Rows[documents.RunDocument]":
        """List all runs of a job, or the first `at_most` that pass the filters."""
        return self._fetch_list(calls.RUNS(job, **filters), at_most)

    def iterate_runs(self, job: str, **filters: Any) -> Iterator["documents.RunDocument"]:
        """Iterate over the runs of a job that pass the filters, a page at a time."""
        return self._iterate(calls.RUNS(job, **filters))

    def summary(self, job: str, by: Sequence[str] | None = None) -> "documents.SummaryDocument":
        """Fetch quantiles over the values of axes or labels, by default over all axes but seeds."""
        return self._fetch(calls.SUMMARY(job, by=by))

    def trend(self, job: str, outliers: str | None = None) -> "documents.TrendDocument":
        """Fetch the trend of a batch over its label: law, band, predictions, outliers, drift.

        Its laws leave outliers out, or count them with ``outliers="include"``.
        """
        return self._fetch(calls.TREND(job, outliers=outliers))

    def summary_figure(self, job: str, **options: Any) -> "documents.FigureDocument":
        """Draw errors against the noise, as Plotly JSON; `options` are those of the interface."""
        return self._fetch(calls.SUMMARY_FIGURE(job, **options))

    def trend_figure(self, job: str, **options: Any) -> "documents.FigureDocument":
        """Draw the estimates over the label, as Plotly JSON."""
        return self._fetch(calls.TREND_FIGURE(job, **options))

    def download_runs(self, job: str) -> Iterator[bytes]:
        """Download the table of all runs of a job as CSV, piece by piece."""
        return self._download(calls.RUNS_CSV(job))

    def download_estimates(self, run: str) -> Iterator[bytes]:
        """Download the estimates of a run as CSV, one parameter per row."""
        return self._download(calls.ESTIMATES_CSV(run))

    def run(self, name: str) -> "documents.RunDocument":
        """Fetch the result of one run."""
        return self._fetch(calls.RUN(name))

    def edit_run(
        self, run: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> "documents.RunDocument":
        """Change note or tags of a run; `if_match` is the ETag that was read."""
        return self._fetch(calls.build_edit(calls.EDIT_RUN, run, changes, if_match))

    def delete_run(self, run: str, *, cascade: bool = False) -> "documents.DeletedDocument":
        """Delete a run of a job that has ended; `cascade` adds what was made from it."""
        return self._fetch(calls.build_deletion(calls.DELETE_RUN, run, cascade))

    def history(self, run: str) -> "documents.HistoryDocument":
        """Fetch the improvements of each island's champion."""
        return self._fetch(calls.HISTORY(run))

    def response(self, run: str, max_points: int = 1000) -> "documents.ResponseDocument":
        """Fetch the measured and simulated outputs."""
        return self._fetch(calls.RESPONSE(run, max_points=max_points))

    def bands(self, run: str, max_points: int = 1000) -> "documents.BandsDocument":
        """Fetch the 95 % confidence and prediction bands of the outputs."""
        return self._fetch(calls.BANDS(run, max_points=max_points))

    def simulate_run(
        self, run: str, body: Mapping[str, Any], max_points: int = 1000
    ) -> "documents.RunSimulationDocument":
        """Simulate the identified model on a new input or under P, PI or PID control."""
        return self._fetch(calls.SIMULATE_RUN(run, json=body, max_points=max_points))

    def validate_run(
        self,
        run: str,
        dataset: str,
        channels: Mapping[str, str] | None = None,
        *,
        skip: int = 0,
        max_points: int = 1000,
    ) -> "documents.FreeRunDocument":
        """Simulate the identified model on another recording: RMS and fit."""
        body = {"dataset": dataset, "channels": dict(channels or {}), "skip": skip}
        return self._fetch(calls.VALIDATE_RUN(run, json=body, max_points=max_points))

    def migrations(self, run: str) -> "documents.MigrationsDocument":
        """Fetch the migration log."""
        return self._fetch(calls.MIGRATIONS(run))

    def profile(self, run: str, *parameters: str, points: int = 21) -> "documents.ProfilesDocument":
        """Compute the profile likelihood of some free parameters; of all if none is named."""
        body = {"parameters": parameters or None, "points": points}
        return self._fetch(calls.PROFILE(run, json=body))

    def residuals(self, run: str) -> "documents.ResidualsDocument":
        """Fetch the correlation functions of the residuals, their bands and tests."""
        return self._fetch(calls.RESIDUALS(run))

    def run_figure(self, run: str, name: str, **options: Any) -> "documents.FigureDocument":
        """Draw a figure of a run, such as ``response`` or ``history``, as Plotly JSON."""
        return self._fetch(calls.RUN_FIGURE(run, name, **options))

    def download_signals(self, run: str) -> Iterator[bytes]:
        """Download the fitted signals of a run as MCAP, piece by piece."""
        return self._download(calls.RUN_SIGNALS(run))

    def export(self, run: str, format: str = "json", pade_order: int = 3) -> str:
        """Export the identified model as text: json, python, c or control."""
        return self.send(calls.EXPORT(run, format=format, pade_order=pade_order)).text

    def compare(self, *runs: str) -> "documents.ComparisonDocument":
        """Compare runs on the same data, best first."""
        return self._fetch(calls.COMPARE(json={"runs": runs}))

    # ---- references
    def references(
        self, limit: int | None = None, **filters: Any
    ) -> "Rows[documents.ReferenceDocument]":
        """List the references in use, by name: all, or at most `limit`."""
        return self._fetch_list(calls.REFERENCES(**filters), limit)

    def iterate_references(self, **filters: Any) -> Iterator["documents.ReferenceDocument"]:
        """Iterate over the references that pass the filters, by name, a page at a time."""
        return self._iterate(calls.REFERENCES(**filters))

    def reference(self, name: str) -> "documents.ReferenceDocument":
        """Fetch one reference with its history."""
        return self._fetch(calls.REFERENCE(name))

    def accept_reference(
        self, name: str, run: str, *, by: str | None = None, note: str | None = None
    ) -> "documents.ReferenceDocument":
        """Make a run the reference of a name; the previous one stays in the history."""
        body = {"run": run, "by": by, "note": note}
        return self._fetch(calls.ACCEPT_REFERENCE(name, json=body))

    def edit_reference(
        self, reference: str, changes: Mapping[str, Any], *, if_match: str | None = None
    ) -> "documents.ReferenceDocument":
        """Change name, note or tags of a reference; `if_match` is the ETag that was read."""
        return self._fetch(calls.build_edit(calls.EDIT_REFERENCE, reference, changes, if_match))

    def delete_reference(
        self, reference: str, *, cascade: bool = False
    ) -> "documents.DeletedDocument":
        """Delete a reference with its history; `cascade` adds what was made from it."""
        return self._fetch(calls.build_deletion(calls.DELETE_REFERENCE, reference, cascade))
