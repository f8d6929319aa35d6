"""Supervisor that keeps a dispatcher running, and leaves no process behind."""

import contextlib
import logging
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import psutil

from service.core.process.process_identity import is_stopped
from service.core.settings import Settings
from sysid.core.awake_clock import read_awake_seconds
from sysid.core.child_processes import SAFE_FOLDER, build_child_command, build_import_path
from workers.ray_folders import clear_ray_remains, kill_processes

_log = logging.getLogger(__name__)

FIRST_PAUSE_SECONDS = 0.2
MAX_PAUSE_SECONDS = 5.0
STEADY_SECONDS = 60.0
"""After this lifetime a child is restarted with the first pause again."""
LIVED_SECONDS = 5.0
"""The same for a child that was killed or lost its workers: its start had not failed."""
RESTART_EXIT_CODE = 75
"""Exit code of a child to restart at once (EX_TEMPFAIL of sysexits)."""
STOP_SECONDS = 2.0
POLL_SECONDS = 1.0
STOPPED_SECONDS = 12.0
"""A child stopped (SIGSTOP) beyond its lease is killed: it may hold SQLite's write lock."""

SUPERVISED_VARIABLE = "LAGID_SUPERVISED"
"""Set for the child. It then ends when its standard input closes, as when this process dies."""


class Supervisor:
    """Runs a command as a child in its own session, and restarts it until `stop`.

    The session identifies every process that the child has started, even after the child was
    killed. Ray's helpers use process groups of their own.
    """

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], log: Path | None = None
    ) -> None:
        self._command, self._environment, self._log_path = tuple(command), dict(environment), log
        self._stopping = threading.Event()
        self._lock, self._stop_lock = threading.Lock(), threading.Lock()
        self._child: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._keep_running, name="supervisor", daemon=True)

    def start(self) -> None:
        """Start the child and watch it."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the child, kill it after `STOP_SECONDS`, and clear what it left.

        A second call, also from another thread, waits for the first. A child that receives two
        signals would not end in order.
        """
        with self._stop_lock:
            if not self._stopping.is_set():
                self._stop_child()

    def _stop_child(self) -> None:
        with self._lock:
            self._stopping.set()
            child = self._child
        if child is None:
            return
        with contextlib.suppress(ProcessLookupError):
            child.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(STOP_SECONDS)
        child.kill()
        child.wait()
        clear_session(child.pid)
        self._thread.join()

    @property
    def pid(self) -> int | None:
        """Process id of the running child."""
        child = self._child
        return None if child is None or child.poll() is not None else child.pid

    def _keep_running(self) -> None:
        pause = FIRST_PAUSE_SECONDS
        while not self._stopping.is_set():
            begun = time.monotonic()
            child = self._spawn_child()
            if child is None:
                return
            code = _wait_for_end(child)
            clear_session(child.pid)
            assert child.stdin is not None
            child.stdin.close()
            if self._stopping.is_set():
                return
            lived = time.monotonic() - begun
            was_well = lived > STEADY_SECONDS or (
                lived > LIVED_SECONDS and (code < 0 or code == RESTART_EXIT_CODE)
            )
            pause = FIRST_PAUSE_SECONDS if was_well else min(2 * pause, MAX_PAUSE_SECONDS)
            _log.warning("the dispatcher exited with code %d. It restarts in %.1f s", code, pause)
            self._stopping.wait(pause)

    def _spawn_child(self) -> "subprocess.Popen[bytes] | None":
        with self._lock, contextlib.ExitStack() as stack:
            if self._stopping.is_set():
                return None
            sink = None
            if self._log_path is not None:
                self._log_path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                sink = stack.enter_context(open(self._log_path, "ab", opener=_open_private))
            self._child = subprocess.Popen(
                self._command,
                env={**os.environ, **self._environment, SUPERVISED_VARIABLE: "1"},
                cwd=SAFE_FOLDER,
                stdin=subprocess.PIPE,  # never written to: its end signals our death
                stdout=sink,
                stderr=sink,
                start_new_session=True,
            )
            return self._child


@contextmanager
def supervise_dispatcher(settings: Settings) -> Iterator[Supervisor]:
    """Keep a dispatcher with these settings running during the block."""
    supervisor = Supervisor(
        build_child_command("service.dispatch.process"),
        {**to_environment(settings), **make_paths_absolute(os.environ)},
        settings.data_dir.absolute() / "logs" / "dispatcher.log",
    )
    supervisor.start()
    try:
        yield supervisor
    finally:
        supervisor.stop()


_PATH_VARIABLES = ("TMPDIR", "LAGID_CACHE_DIR", "NUMBA_CACHE_DIR", "RAY_AUTH_TOKEN_PATH")


def make_paths_absolute(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that name paths, for a child that works in another folder."""
    paths = {
        name: os.path.abspath(environment[name])
        for name in _PATH_VARIABLES
        if environment.get(name)
    }
    return {**paths, "PYTHONPATH": build_import_path()}


def to_environment(settings: Settings) -> dict[str, str]:
    """Convert the settings to environment variables for a child."""
    values = settings.model_dump(mode="json", exclude_none=True)
    values["data_dir"] = str(settings.data_dir.absolute())
    return {
        f"LAGID_{name.upper()}": ",".join(value) if isinstance(value, list) else str(value)
        for name, value in values.items()
    }


def _open_private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _wait_for_end(child: "subprocess.Popen[bytes]") -> int:
    """Wait for the end of a child and return its exit code."""
    awake = read_awake_seconds()
    while True:
        try:
            return child.wait(POLL_SECONDS)
        except subprocess.TimeoutExpired:
            pass
        if not is_stopped(child.pid):
            awake = read_awake_seconds()
        elif read_awake_seconds() - awake > STOPPED_SECONDS:
            _log.warning(
                "the dispatcher was stopped (SIGSTOP) for %g s and is killed", STOPPED_SECONDS
            )
            child.kill()


def clear_session(leader: int) -> None:
    """Kill every process in the session of an ended child, and clear its Ray files."""
    kill_processes(find_session_processes(leader))
    clear_ray_remains(leader)


def find_session_processes(session: int) -> tuple[int, ...]:
    """Find the ids of the processes of a session."""
    pids = []
    for pid in psutil.pids():
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if os.getsid(pid) == session:
                pids.append(pid)
    return tuple(pids)
