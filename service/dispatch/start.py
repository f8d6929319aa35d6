"""The start of a dispatcher: it tells what it waits for, and compiles while Ray starts.

A first start takes minutes on a slow machine. So the dispatcher sends heartbeats from its
beginning, and whoever asks whether it is ready learns what it does.
"""

import threading
from contextlib import suppress
from functools import partial
from time import monotonic

from sqlalchemy.exc import SQLAlchemyError

from service.core.process import service_metrics
from service.core.settings import Settings
from service.dispatch.held_leases import HeldLeases
from service.queue.dispatchers import STARTING_KEY, StartStep
from service.storage import migrate
from service.storage.retry import retry_transient
from service.storage.sessions import Database
from workers.warmup import warm_up_worker


class DispatcherStart:
    """Steps of a start, which threads finish in any order.

    Attributes
    ----------
    database, leases
        Those of the dispatcher.
    """

    def __init__(self, settings: Settings) -> None:
        settings.prepare_data_folder()
        self.database = Database(settings.database_location)
        self.leases = HeldLeases(self.database, settings.lease_seconds)
        self._settings = settings
        self._begun = monotonic()
        self._waits_for: list[StartStep] = ["ray", "search", "workers"]
        self._is_announced = self._is_closed = False
        self._lock = threading.RLock()
        self._compile_lock = threading.Lock()

    def announce(self) -> None:
        """Upgrade the tables, and send heartbeats from now on; once."""
        with self._lock:
            if self._is_announced:
                return
            if self._settings.metrics_port is not None:
                service_metrics.serve_metrics(
                    self._settings.metrics_host, self._settings.metrics_port
                )
            # The database may be starting too.
            retry_transient(partial(migrate.upgrade_database, self.database))
            self._tell()
            self._is_announced = True

    def compile_search(self) -> None:
        """Compile the search, or load it, unless that was done; wait for another thread's."""
        with self._compile_lock:
            if "search" in self._waits_for:
                with service_metrics.time_compilation():
                    warm_up_worker()
                self.finish("search")

    def finish(self, step: StartStep) -> None:
        """Tell that a step is done. After the last one the dispatcher itself says it is ready."""
        with self._lock:
            self._waits_for.remove(step)
            if self._waits_for and not self._is_closed:
                self._tell()
            else:
                service_metrics.start_seconds.set(monotonic() - self._begun)

    def close(self) -> None:
        """Take the announcement back, and close the database."""
        with self._lock:
            self._is_closed = True
            with suppress(SQLAlchemyError):  # without a heartbeat it is forgotten all the same
                self.leases.stop_heartbeat()
            self.database.dispose()

    def _tell(self) -> None:
        self.leases.start_heartbeat({STARTING_KEY: list(self._waits_for)})
