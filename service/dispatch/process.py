"""``python -m service.dispatch.process``: a dispatcher, ready as soon as can be.

A start is what a recovery waits for. Ray's is mostly waiting, so the program is read, and its
loops are loaded, beside it; therefore nothing heavy is imported here.
"""

import logging
import sys
import threading

from service.core.settings import LOG_FORMAT, Settings
from workers.errors import ClusterUnavailable
from workers.local_ray import LocalRay

_log = logging.getLogger("lagid.dispatcher")


def run_process(settings: Settings) -> int:
    """Run a dispatcher until it is told to stop; gives the exit code."""
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
    """Import the dispatcher and load the loops; what fails here, fails again for whoever waits."""
    import service.dispatch.dispatcher  # noqa: F401
    from workers.warmup import warm_up_worker

    warm_up_worker()


if __name__ == "__main__":
    sys.exit(run_process(Settings()))
