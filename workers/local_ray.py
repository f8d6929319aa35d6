"""Start a Ray on this machine: as early as can be, and as little of it as is needed.

It is what a recovery waits for. So this module imports nothing heavy, and a process can read the
rest of the program while Ray starts.
"""

import logging
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from workers.cluster_address import explain_failure
from workers.errors import ClusterUnavailable
from workers.ray_folders import clear_dead_dispatchers, get_ray_folder

OBJECT_STORE_BYTES = 200 * 2**20
"""Records are small; the default of Ray, 30 % of the memory, is not."""
INIT_ARGUMENTS = {"log_to_driver": False, "logging_level": logging.ERROR}
"""Arguments of `ray.init`, whichever Ray it is."""
INIT_ERRORS = (ConnectionError, RuntimeError, ValueError, OSError, TimeoutError)
"""What `ray.init` raises."""
ONE_THREAD_ENVIRONMENT = {
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
RAY_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_task_events_report_interval_ms": "0",  # else the GCS keeps 3-4 kB for each task
    "RAY_memory_monitor_refresh_ms": "0",  # it kills the youngest task, not the largest
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # tomorrow's default; silences a warning
    # Behind the service itself, but not behind everything else on the machine, as its 15 would be.
    "RAY_worker_niceness": "5",
}
_UNUSED_STARTS = ("start_monitor", "start_log_monitor", "start_api_server")
"""Methods of Ray's `Node` that start the autoscaler, the collector of logs and the dashboard."""


class LocalRay:
    """A Ray that ends with this process, in a folder of its own.

    Parameters
    ----------
    cpus : int or None
        Its cores; None: all.
    meanwhile : callable, optional
        Called once Ray is imported, before it starts, which is mostly waiting.

    Attributes
    ----------
    module
        `ray`: it reads its environment when it is imported, and so is imported here.
    folder : Path

    Raises
    ------
    ClusterUnavailable
        If it cannot be started.
    """

    def __init__(
        self, cpus: int | None = None, meanwhile: Callable[[], None] | None = None
    ) -> None:
        self.folder = make_folder()
        os.environ.update(RAY_ENVIRONMENT)
        os.environ.update(RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=secrets.token_hex(32))
        os.environ.update(ONE_THREAD_ENVIRONMENT)  # inherited by the workers
        import ray

        self.module: Any = ray
        if meanwhile is not None:
            meanwhile()
        try:
            _start_ray(ray, cpus, self.folder)
        except INIT_ERRORS as error:
            self.remove_folder()
            raise ClusterUnavailable(explain_failure(None, error)) from error

    def close(self) -> None:
        """End it in order."""
        self.module.shutdown()
        self.remove_folder()

    def remove_folder(self) -> None:
        """Remove its folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def make_folder() -> Path:
    """Make Ray's folder for this process; what dispatchers that are gone have left is cleared.

    Raises
    ------
    ClusterUnavailable
        If it cannot be made, or somebody else has made it.
    """
    clear_dead_dispatchers()
    folder = get_ray_folder(os.getpid())
    shutil.rmtree(folder, ignore_errors=True)
    try:
        folder.mkdir(mode=0o700)  # fails for whatever is there, so that it is ours and new
    except OSError as error:
        raise ClusterUnavailable(
            f"Ray's folder {folder} cannot be made ({error.strerror}). Remove it if it exists, "
            "or set TMPDIR to a folder of your own."
        ) from error
    return folder


def _start_ray(ray: Any, cpus: int | None, folder: Path) -> None:
    with _skip_unused_programs():
        ray.init(
            address="local",  # never a cluster that happens to run on this host
            num_cpus=cpus,
            include_dashboard=False,
            object_store_memory=OBJECT_STORE_BYTES,
            _temp_dir=str(folder),
            **INIT_ARGUMENTS,
        )


@contextmanager
def _skip_unused_programs() -> Iterator[None]:
    """Ray starts three programs that nobody here uses, a fifth of what its start costs.

    There is no setting for it. A version of Ray that has other methods starts them as before.
    """
    from ray._private.node import Node

    originals = {name: getattr(Node, name) for name in _UNUSED_STARTS if hasattr(Node, name)}
    try:
        for name in originals:
            setattr(Node, name, _start_nothing)
        yield
    finally:
        for name, method in originals.items():
            setattr(Node, name, method)


def _start_nothing(_node: Any, *_arguments: Any, **_settings: Any) -> None:
    """In the place of a method of `Node`."""
