"""Start Ray on this machine: as early as possible, and only the programs that are needed.

A recovery waits for Ray. So this module imports nothing heavy, and a process can import the rest of
the program while Ray starts.
"""

import logging
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any

from sysid.core.child_processes import build_import_path
from workers.cluster_address import explain_failure
from workers.errors import ClusterUnavailable
from workers.ray_folders import (
    clear_dead_dispatchers,
    find_folder_processes,
    get_ray_folder,
    kill_processes,
)

_log = logging.getLogger(__name__)

START_SECONDS = 900.0
"""Time limit for the start of Ray, and then of its workers. A slow machine needs minutes."""
OBJECT_STORE_BYTES = 200 * 2**20
"""Records are small; Ray's default is 30 % of the memory."""
INIT_ARGUMENTS = {"log_to_driver": False, "logging_level": logging.ERROR}
"""Arguments of `ray.init` for a local and for a joined Ray."""
INIT_ERRORS = (ConnectionError, RuntimeError, ValueError, OSError, TimeoutError)
"""Errors that `ray.init` raises."""
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
    # Lower priority than the service, but not than everything else, as Ray's default of 15.
    "RAY_worker_niceness": "5",
}
TEMPORARY_VARIABLE = "RAY_TMPDIR"
"""Where Ray makes its folder `ray`."""
_UNUSED_STARTS = ("start_monitor", "start_log_monitor", "start_api_server")
"""Methods of Ray's `Node` that start the autoscaler, the collector of logs and the dashboard."""


class LocalRay:
    """Ray in a folder of its own, which ends with this process.

    Parameters
    ----------
    cpus : int or None
        Number of cores; None: all.
    meanwhile : callable, optional
        Called after Ray is imported and before it starts. The start is mostly waiting.
    start_seconds : float
        Time limit for the start.

    Attributes
    ----------
    module
        `ray`. It reads its environment at import, so it is imported here.
    folder : Path
        Private folder around Ray's own, which Ray opens to everybody.

    Raises
    ------
    ClusterUnavailable
        If Ray cannot be started.
    """

    def __init__(
        self,
        cpus: int | None = None,
        meanwhile: Callable[[], None] | None = None,
        start_seconds: float = START_SECONDS,
    ) -> None:
        self.folder = make_folder()
        os.environ.update(RAY_ENVIRONMENT)
        os.environ.update(RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=secrets.token_hex(32))
        # Inherited by the workers.
        os.environ.update(ONE_THREAD_ENVIRONMENT, PYTHONPATH=build_import_path())
        import ray

        self.module: Any = ray
        if meanwhile is not None:
            meanwhile()
        try:
            _start_patiently(ray, cpus, self.folder, start_seconds)
        except INIT_ERRORS as error:
            self.remove_folder()
            raise ClusterUnavailable(explain_failure(None, error)) from error

    def close(self) -> None:
        """Shut Ray down and remove its folder."""
        self.module.shutdown()
        self.remove_folder()

    def remove_folder(self) -> None:
        """Remove the folder of Ray."""
        shutil.rmtree(self.folder, ignore_errors=True)


def make_folder() -> Path:
    """Make the private folder for Ray of this process, and clear the remains of dead dispatchers.

    Raises
    ------
    ClusterUnavailable
        If the folder cannot be made, or if another process made it.
    """
    clear_dead_dispatchers()
    folder = get_ray_folder(os.getpid())
    shutil.rmtree(folder, ignore_errors=True)
    try:
        folder.mkdir(mode=0o700)  # fails if the path exists, so the folder is new and ours
    except OSError as error:
        raise ClusterUnavailable(
            f"Ray's folder {folder} cannot be made ({error.strerror}). Remove it if it exists, "
            "or set TMPDIR to a folder of your own."
        ) from error
    return folder


def _start_patiently(ray: Any, cpus: int | None, folder: Path, seconds: float) -> None:
    """Start Ray, and again after each timeout, until `seconds` are over.

    Ray gives up after 30 s, which may be too short on a busy machine, and has no setting for it.
    The next time its programs and libraries are in memory.
    """
    limit = time.monotonic() + seconds
    while True:
        try:
            return _start_ray(ray, cpus, folder)
        except TimeoutError as error:
            if time.monotonic() > limit:
                raise
            _log.warning("Ray has not started in time, and is started again: %s", error)
            kill_processes(find_folder_processes(os.getpid()))


def _start_ray(ray: Any, cpus: int | None, folder: Path) -> None:
    """Start Ray.

    Raises
    ------
    TimeoutError
        If it does not start within its limit. Ray raises a plain `Exception` then.
    """
    try:
        _init_ray(ray, cpus, folder)
    except Exception as error:
        if type(error) is not Exception:
            raise
        raise TimeoutError(str(error)) from error


def _init_ray(ray: Any, cpus: int | None, folder: Path) -> None:
    # Ray's workers import from the working folder first, so it is one without anybody's modules.
    with _skip_unused_programs(), _put_files_into(folder), chdir(folder):
        ray.init(
            address="local",  # never a cluster that happens to run on this host
            num_cpus=cpus,
            include_dashboard=False,
            object_store_memory=OBJECT_STORE_BYTES,
            **INIT_ARGUMENTS,
        )


@contextmanager
def _skip_unused_programs() -> Iterator[None]:
    """Skip three programs of Ray that are not used here, a fifth of the cost of its start.

    Ray has no setting for this, so private names are used here, and nowhere else. A version of Ray
    without them starts these programs, and the log says so.
    """
    try:
        from ray._private.node import Node
    except ImportError:
        Node = None
    originals = {name: getattr(Node, name) for name in _UNUSED_STARTS if hasattr(Node, name)}
    if missing := [name for name in _UNUSED_STARTS if name not in originals]:
        _log.warning(
            "this version of Ray has no %s: it also starts programs that are not needed",
            ", ".join(missing),
        )
    try:
        for name in originals:
            setattr(Node, name, _start_nothing)
        yield
    finally:
        for name, method in originals.items():
            setattr(Node, name, method)


@contextmanager
def _put_files_into(folder: Path) -> Iterator[None]:
    """Let a Ray that starts in the block have its files in this folder."""
    before = os.environ.get(TEMPORARY_VARIABLE)
    os.environ[TEMPORARY_VARIABLE] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ[TEMPORARY_VARIABLE]
        else:
            os.environ[TEMPORARY_VARIABLE] = before


def _start_nothing(_node: Any, *_arguments: Any, **_settings: Any) -> None:
    """Replace a method of `Node`."""
