"""The queue's numbers for Prometheus: read from the database at each scrape, beside the process's.

Every web process gives the same ones. A dashboard takes their maximum.
"""

from collections.abc import Iterator

from prometheus_client import REGISTRY, CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError

from service.core import metrics
from service.queue.dispatchers import DispatcherRepository, describe_start
from service.queue.queue_state import QueueState, read_queue_state
from service.storage.sessions import Database
from sysid.kernels.compilation import get_compile_seconds


def write_metrics(database: Database) -> bytes:
    """Write the numbers of this process and of the queue in Prometheus' text format.

    Without the database, those of the process remain: that is when they are looked at.
    """
    metrics.record_kernel_seconds("process", get_compile_seconds())
    registry = CollectorRegistry()
    registry.register(_QueueCollector(database))
    return generate_latest(REGISTRY) + generate_latest(registry)


class _QueueCollector(Collector):
    def __init__(self, database: Database) -> None:
        self._database = database

    def describe(self) -> Iterator[GaugeMetricFamily]:
        """Describe nothing, so that registering reads nothing."""
        return iter(())

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """Read the queue."""
        is_up = GaugeMetricFamily("lagid_database_up", "Whether the database answers.")
        try:
            with self._database.read_session() as session:
                state = read_queue_state(session)
                alive = DispatcherRepository(session).list_alive()
        except SQLAlchemyError:
            is_up.add_metric((), 0)
            yield is_up
            return
        is_up.add_metric((), 1)
        yield is_up
        yield from _list_queue_gauges(state)
        dispatchers = GaugeMetricFamily(
            "lagid_dispatchers", "Dispatchers with a heartbeat.", labels=("state",)
        )
        n_starting = sum(describe_start(one) is not None for one in alive)
        dispatchers.add_metric(("starting",), n_starting)
        dispatchers.add_metric(("ready",), len(alive) - n_starting)
        yield dispatchers


def _list_queue_gauges(state: QueueState) -> Iterator[GaugeMetricFamily]:
    jobs = GaugeMetricFamily("lagid_jobs", "Jobs by state.", labels=("state",))
    for name, n in state.jobs.items():
        jobs.add_metric((name.value,), n)
    yield jobs
    yield GaugeMetricFamily(
        "lagid_queue_age_seconds",
        "Age in s of the job that has waited longest; 0 without one.",
        value=state.oldest_seconds,
    )
