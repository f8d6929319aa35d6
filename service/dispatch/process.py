"""``python -m service.dispatch.process``: a dispatcher that starts quickly.

A recovery waits for this start. Starting Ray is mostly waiting, so the program is imported and its
compiled loops are loaded in parallel. Nothing heavy is therefore imported here.
"""

import logging
import sys
import threading

from service.core.settings import LOG_FORMAT, Settings
from workers.errors import ClusterUnavailable
from workers.local_ray import LocalRay

_log = logging.getLogger("lagid.dispatcher")


def run_process(settings: Settings) -> int:
    """Run a dispatcher until it is stopped, and return the exit code."""
    local = None
    if settings.ray_address is None:
        reading = threading.Thread(target=_import_dispatcher, name="reading")
        try:
            local = LocalRay(settings.cpus, meanwhile=reading.start)
        except ClusterUnavailable as error:
            logging.basicConfig(format=LOG_FORMAT)
            _log.error("%s", error)
            return 1
        reading.join()
    from service.dispatch.dispatcher import run_dispatcher

    return run_dispatcher(settings, local)


def _import_dispatcher() -> None:
    """Import the dispatcher and load the compiled loops. The caller meets any error again."""
    import service.dispatch.dispatcher  # noqa: F401
    from workers.warmup import warm_up_worker

    warm_up_worker()


if __name__ == "__main__":
    sys.exit(run_process(Settings()))
