"""What a process counts of itself, for Prometheus.

Every label has few values: a route is its template, never a path. Each process has its own numbers.
The web process answers with them at `/metrics`, a dispatcher at a port of its own.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter

from prometheus_client import (
    REGISTRY,
    Counter,
    Gauge,
    Histogram,
    disable_created_metrics,
    start_http_server,
)

_log = logging.getLogger(__name__)

# Else each series has a second one, which nobody reads.
disable_created_metrics()  # type: ignore[no-untyped-call]  # the library has no type for it
_LATENCIES = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 120.0)
_COMPILATIONS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)

requests = Counter("lagid_http_requests", "Answered requests.", ("method", "route", "status"))
request_seconds = Histogram(
    "lagid_http_request_seconds",
    "Time from a request to the head of its answer in s.",
    ("method", "route"),
    buckets=_LATENCIES,
)
runs = Counter("lagid_runs", "Runs that this dispatcher has ended.", ("outcome",))
evaluations = Counter("lagid_evaluations", "Simulations of a candidate by the workers.")
lease_losses = Counter(
    "lagid_lease_losses",
    "Lost leases: seen by the dispatcher that had one, or by a process that gives its job back.",
    ("seen_by",),
)
compile_seconds = Histogram(
    "lagid_compile_seconds",
    "Time in s to compile or load the search when a process starts.",
    buckets=_COMPILATIONS,
)
kernel_seconds = Counter(
    "lagid_kernel_compile_seconds",
    "Time in s in which kernels of models were compiled, by this process or by its workers.",
    ("where",),
)
start_seconds = Gauge(
    "lagid_dispatcher_start_seconds",
    "Time in s until this dispatcher was ready.",
)
cores = Gauge("lagid_dispatcher_cores", "Cores of the workers of this dispatcher.")
loop_standing = Gauge(
    "lagid_dispatcher_standing_seconds",
    "Time in s for which the main loop of this dispatcher has not turned; it turns often.",
)
held_jobs = Gauge("lagid_dispatcher_jobs", "Jobs that this dispatcher holds.")
store_errors = Counter(
    "lagid_store_errors", "Failed calls to the database or to the object store.", ("store",)
)
damaged_objects = Counter(
    "lagid_damaged_objects", "Reads of stored objects whose checksum was another."
)
silent_workers = Counter(
    "lagid_silent_workers", "Workers that this dispatcher replaced because they did not answer."
)
silent_connections = Counter(
    "lagid_silent_connections",
    "Connections to PostgreSQL that were replaced because nothing arrived on them.",
)

for _outcome in ("succeeded", "failed", "reused"):
    runs.labels(_outcome)
for _seen_by in ("owner", "reaper"):
    lease_losses.labels(_seen_by)
for _store in ("database", "objects"):
    store_errors.labels(_store)
_kernel_totals = dict.fromkeys(("process", "workers"), 0.0)
for _where in _kernel_totals:
    kernel_seconds.labels(_where)


def record_kernel_seconds(where: str, total: float) -> None:
    """Record the seconds of compilation so far, of this ``process`` or of its ``workers``."""
    kernel_seconds.labels(where).inc(max(0.0, total - _kernel_totals[where]))
    _kernel_totals[where] = total


@contextmanager
def time_compilation() -> Iterator[None]:
    """Observe the time of the block as a compilation."""
    begun = perf_counter()
    try:
        yield
    finally:
        compile_seconds.observe(perf_counter() - begun)


def serve_metrics(host: str, port: int) -> None:
    """Answer with this process's numbers at a port, in a thread.

    Work must not stop for a port in use, so that is one line in the log.
    """
    try:
        start_http_server(port, addr=host, registry=REGISTRY)
    except OSError as error:
        _log.error("metrics are not served at %s:%d: %s", host, port, error.strerror or error)
