"""``python -m service.dispatch.process``: a dispatcher that starts quickly.

A recovery waits for this start. Starting Ray is mostly waiting, so the program is imported and its
compiled loops are loaded in parallel. Nothing heavy is therefore imported here.
"""

import logging
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

from service.core.process.logs import configure_logging
from service.core.settings import Settings
from workers.errors import ClusterUnavailable
from workers.local_ray import LocalRay

if TYPE_CHECKING:
    from service.dispatch.start import DispatcherStart

_log = logging.getLogger("lagid.dispatcher")


def run_process(settings: Settings) -> int:
    """Run a dispatcher until it is stopped, and return the exit code."""
    configure_logging(settings.log_format)
    if settings.ray_address is not None:
        from service.dispatch.dispatcher import run_dispatcher

        return run_dispatcher(settings)
    prepared: list[Future[DispatcherStart]] = []
    with ThreadPoolExecutor(1, "preparation") as pool:
        try:
            local = LocalRay(
                settings.cpus,
                lambda: prepared.append(pool.submit(_prepare_dispatcher, settings)),
                settings.start_seconds,
            )
        except ClusterUnavailable as error:
            _log.error("%s", error)
            for future in prepared:
                if future.exception() is None:
                    future.result().close()
            return 1
    from service.dispatch.dispatcher import run_dispatcher

    return run_dispatcher(settings, local, prepared[0].result)


def _prepare_dispatcher(settings: Settings) -> "DispatcherStart":
    """Import the dispatcher, announce its start, and load the compiled loops."""
    import service.dispatch.dispatcher  # noqa: F401
    from service.dispatch.start import DispatcherStart

    start = DispatcherStart(settings)
    start.announce()
    start.compile_search()
    return start


if __name__ == "__main__":
    sys.exit(run_process(Settings()))
