"""The queue's numbers for Prometheus: read from the database at each scrape, beside the process's.

Every web process gives the same ones. A dashboard takes their maximum.
"""

from prometheus_client import REGISTRY, CollectorRegistry, Gauge, generate_latest
from sqlalchemy.exc import SQLAlchemyError

from service.core.process import service_metrics
from service.queue.dispatchers import DispatcherRepository, describe_start
from service.queue.queue_state import read_queue_state
from service.storage.sessions import Database
from sysid.kernels.compilation.limited_compilation import get_compile_seconds


def write_metrics(database: Database) -> bytes:
    """Write the numbers of this process and of the queue in Prometheus' text format.

    Without the database, those of the process remain: that is when they are looked at.
    """
    service_metrics.record_kernel_seconds("process", get_compile_seconds())
    queue = CollectorRegistry()
    is_up = Gauge("lagid_database_up", "Whether the database answers.", registry=queue)
    try:
        _read_queue(database, queue)
        is_up.set(1)
    except SQLAlchemyError:
        is_up.set(0)
    return generate_latest(REGISTRY) + generate_latest(queue)


def _read_queue(database: Database, registry: CollectorRegistry) -> None:
    with database.read_session() as session:
        state = read_queue_state(session)
        alive = DispatcherRepository(session).list_alive()
    jobs = Gauge("lagid_jobs", "Jobs by state.", ("state",), registry=registry)
    for name, n in state.jobs.items():
        jobs.labels(name.value).set(n)
    age = "Time in s since the submission of the oldest queued job; 0 without one."
    Gauge("lagid_queue_age_seconds", age, registry=registry).set(state.oldest_seconds)
    heartbeats = "Dispatchers with a heartbeat."
    dispatchers = Gauge("lagid_dispatchers", heartbeats, ("state",), registry=registry)
    n_starting = sum(describe_start(one) is not None for one in alive)
    dispatchers.labels("starting").set(n_starting)
    dispatchers.labels("ready").set(len(alive) - n_starting)
