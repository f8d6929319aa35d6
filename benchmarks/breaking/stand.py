"""Run a service in separate processes and restart it when it ends, like an init system."""

import contextlib
import os
import secrets
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx

from benchmarks.breaking.processes import MARK, Family
from service.client.client import Client
from service.client.embedded import find_free_port
from service.core.settings import make_sqlite_url
from service.storage.sessions import Database
from sysid.core.child_processes import build_child_command

SHIM = Path(__file__).with_name("shim")
START_SECONDS = 180.0
PAUSE_SECONDS = 0.1
"""Between two looks, which take processor time of the service themselves."""
RESTART_SECONDS = 0.5
"""What the caretaker waits before it starts a web process that has ended."""


class Stand:
    """`lagid serve` with its dispatcher, on a folder of its own.

    Parameters
    ----------
    database_url : str, optional
        PostgreSQL; by default SQLite in the folder.
    lease_seconds : float
        Length of the leases of its dispatchers.
    has_second : bool
        Whether another supervised dispatcher works beside that of the service.
    environment : mapping
        Further variables for all its processes.
    working_folder : Path, optional
        Where the service is started; by default here.
    """

    def __init__(
        self,
        folder: Path,
        *,
        database_url: str | None = None,
        cpus: int = 2,
        lease_seconds: float = 10.0,
        has_second: bool = False,
        environment: Mapping[str, str] | None = None,
        working_folder: Path | None = None,
    ) -> None:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.temporary = Path(tempfile.mkdtemp(prefix=""))  # short: Ray puts sockets there
        self.folder, self.port = folder, find_free_port()
        self._working_folder = working_folder
        self.lease_seconds, self._has_second = lease_seconds, has_second
        self.family = Family(mark := secrets.token_hex(8))
        address = {} if database_url is None else {"LAGID_DATABASE_URL": database_url}
        self.environment = {
            **os.environ,
            MARK: mark,
            "LAGID_DATA_DIR": str(folder),
            "LAGID_CPUS": str(cpus),
            "LAGID_PORT": str(self.port),
            "LAGID_LEASE_SECONDS": str(lease_seconds),
            "OPENBLAS_NUM_THREADS": "1",
            "TMPDIR": str(self.temporary),
            "PYTHONPATH": os.pathsep.join([str(SHIM), str(Path.cwd())]),
            **address,
            **(environment or {}),
        }
        self.url = f"http://127.0.0.1:{self.port}"
        self.database = Database(database_url or make_sqlite_url(folder / "lagid.db"))
        self.client = Client(self.url)
        self.web: subprocess.Popen[bytes] | None = None
        self._second: subprocess.Popen[bytes] | None = None
        self._before = set(shared_memory())
        self._ending, self._down = threading.Event(), threading.Event()
        self._caretaker = threading.Thread(target=self._take_care, daemon=True)

    def start(self, *, wait: bool = True) -> None:
        """Start it; by default until a dispatcher is ready."""
        self._spawn()
        self._caretaker.start()
        if wait:
            until(self.is_ready, "the service was ready", START_SECONDS)

    @property
    def log(self) -> str:
        """What the dispatchers have told."""
        file = self.folder / "logs" / "dispatcher.log"
        return file.read_text(errors="replace") if file.exists() else ""

    def is_ready(self) -> bool:
        """Whether database, store and a dispatcher are."""
        with contextlib.suppress(httpx.TransportError):
            return httpx.get(f"{self.url}/readyz", timeout=5.0).status_code == httpx.codes.OK
        return False

    def answers(self) -> int | None:
        """The status of the list of jobs; None if nobody listens."""
        try:
            return httpx.get(f"{self.url}/v1/jobs", timeout=20.0).status_code
        except httpx.TransportError:
            return None

    @contextmanager
    def another_dispatcher(self) -> Iterator["subprocess.Popen[bytes]"]:
        """A second dispatcher for the length of the block, which ends in order."""
        with (self.folder / "second.log").open("ab") as log:
            child = subprocess.Popen(
                build_child_command("service.dispatch.process"),
                env=self.environment,
                cwd=self._working_folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        try:
            yield child
        finally:
            child.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(20.0)
            child.kill()
            child.wait()

    @contextmanager
    def down(self) -> Iterator[None]:
        """End it in order, and start it again after the block."""
        self._down.set()
        try:
            self._end_web()
            yield
        finally:
            self._down.clear()

    def stop(self) -> None:
        """End it in order."""
        self._ending.set()
        self._caretaker.join()
        self._end_web()
        self.client.close()
        self.database.dispose()

    def leftovers(self, seconds: float = 10.0) -> list[str]:
        """Processes, shared memory and temporary files that a stopped service has not taken along.

        Ray's last helpers end by themselves; they have some seconds.
        """
        limit = time.monotonic() + seconds
        while (left := self._left()) and time.monotonic() < limit:
            time.sleep(0.2)
        return left

    def _left(self) -> list[str]:
        leftovers = [
            f"process {process.pid} {process.info['name']}" for process in self.family.members()
        ]
        leftovers += [f"shared memory {name}" for name in set(shared_memory()) - self._before]
        leftovers += [f"temporary {path.name}" for path in self.temporary.glob("*")]
        unfinished = self.folder / "objects" / "tmp"
        return leftovers + [f"object {path.name}" for path in unfinished.glob("*")]

    def _spawn(self) -> None:
        if self.web is None or self.web.poll() is not None:
            self.web = self._spawn_command("serve")
        if self._has_second and (self._second is None or self._second.poll() is not None):
            self._second = self._spawn_command("dispatcher")

    def _spawn_command(self, name: str) -> "subprocess.Popen[bytes]":
        with (self.folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(
                build_child_command("service.cli.main", name),
                env=self.environment,
                cwd=self._working_folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def _end_web(self) -> None:
        both = [child for child in (self.web, self._second) if child is not None]
        running = [child for child in both if child.poll() is None]
        for child in running:
            child.send_signal(signal.SIGTERM)
        for child in running:
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(20.0)

    def _take_care(self) -> None:
        while not self._ending.wait(RESTART_SECONDS):
            if not self._down.is_set():
                self._spawn()


@contextmanager
def standing_service(stand: Stand, *, wait: bool = True) -> Iterator[Stand]:
    """Run it for the length of the block; whatever happens, nothing of it stays alive."""
    try:
        stand.start(wait=wait)
        yield stand
        stand.stop()
    finally:
        stand._ending.set()
        if stand.web is not None and stand.web.poll() is None:
            stand.stop()
        stand.family.kill()
        shutil.rmtree(stand.temporary, ignore_errors=True)


def until(holds: Callable[[], bool], what: str, seconds: float) -> float:
    """Wait until something is so; gives the seconds it took.

    Raises
    ------
    TimeoutError
        If it has not come true in time.
    """
    begun = time.monotonic()
    while not holds():
        if time.monotonic() - begun > seconds:
            raise TimeoutError(f"not within {seconds:g} s: {what}")
        time.sleep(PAUSE_SECONDS)
    return time.monotonic() - begun


def shared_memory() -> list[str]:
    """Names below ``/dev/shm`` that Ray or a pool of processes may have made."""
    folder = Path("/dev/shm")
    return [
        path.name for path in folder.glob("*") if not path.name.startswith(("PostgreSQL", "sem"))
    ]
