"""`lagid doctor --deep`: a service of its own for a minute, with a fault and a restoration.

It shows on this machine what the tests show elsewhere: a job survives the death of a worker with
the same results, and a backup has all of them. The drill has a folder of its own, SQLite and a
local Ray. It touches nothing of the user's data.
"""

import os
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import psutil

from service.client.calls import ClientError
from service.client.client import Client
from service.client.embedded import run_embedded_service
from service.core.errors import ServiceError

if TYPE_CHECKING:
    from service.core.settings import Settings

RUNS_PER_CORE = 150
"""Runs of the job: about ten seconds of each core."""
COMPARED_RUNS = 8
WORKER_SECONDS = 30.0
"""How long a worker is looked for."""
WORKER_NAME = "ray::process_pack"
"""How Ray calls a process that computes a pack."""
_RECORDING: dict[str, Any] = {
    "model": "fopdt",
    "parameters": {"K": 2.0, "T": 1.5, "L": 0.7, "y0": 0.0},
    "samples": 300,
    "sample_time": 0.1,
    "inputs": {"u": {"kind": "binary", "period": 1.0}},
    "noise": {"sigma": 0.02, "seed": 1},
}


class DrillFailed(ServiceError):
    """The installation does not do what it should."""

    kind, title = "drill-failed", "The drill failed"


class Drill:
    """The steps of a drill, in order; each returns what it found.

    Parameters
    ----------
    settings : Settings
        Those of the user: the number of cores.
    """

    def __init__(self, settings: "Settings") -> None:
        self._cores = settings.cpus or os.cpu_count() or 1
        self._resources = ExitStack()
        self._folder = Path(".")
        self._client: Client | None = None
        self._job: dict[str, Any] = {}

    def __enter__(self) -> "Drill":
        folder = TemporaryDirectory(prefix="lagid-drill-", ignore_cleanup_errors=True)
        self._folder = Path(self._resources.enter_context(folder)) / "data"
        return self

    def __exit__(self, *_error: object) -> None:
        self._resources.close()

    def start_service(self) -> str:
        """Start a web process, a dispatcher and a local Ray."""
        begun = time.monotonic()
        url = self._resources.enter_context(
            run_embedded_service(self._folder, cpus=self._cores, environment=_build_environment())
        )
        self._client = self._resources.enter_context(Client(url))
        return f"ready after {time.monotonic() - begun:.0f} s with {self._cores} cores"

    def survive_kill(self) -> str:
        """Compute a job, kill a worker meanwhile, and compare with runs that were not disturbed."""
        client = self._get_client()
        try:
            return self._survive_kill(client)
        except ClientError as error:
            raise DrillFailed(str(error)) from error

    def _survive_kill(self, client: Client) -> str:
        begun = time.monotonic()
        dataset = client.simulate_dataset(_RECORDING)["id"]
        self._job = dict(client.submit(_build_job(dataset, RUNS_PER_CORE * self._cores)))
        killed = _kill_worker()
        ended = client.wait(self._job["id"])
        done = ended["progress"]
        if ended["state"] != "succeeded" or done["finished"] != done["runs"]:
            raise DrillFailed(f"the job is {ended['state']}: {ended['error']}")
        again = client.submit(_build_job(dataset, COMPARED_RUNS))["id"]
        client.wait(again)
        disturbed, calm = (_read_results(client, one) for one in (self._job["id"], again))
        if disturbed != calm:
            raise DrillFailed("runs differ from the same ones without the death of a worker")
        return (
            f"{done['runs']} runs in {time.monotonic() - begun:.0f} s; process {killed} was killed "
            f"meanwhile; {len(calm)} runs repeated, bit for bit equal"
        )

    def restore_backup(self) -> str:
        """Back the drill up while it runs, and restore it into a scratch database."""
        from service.storage.storage_errors import StorageError

        self._get_client()
        try:
            return self._restore_backup()
        except StorageError as error:
            raise DrillFailed(str(error)) from error

    def _restore_backup(self) -> str:
        from service.core.settings import make_sqlite_url
        from service.storage.garbage import find_damaged, find_lost_hashes
        from service.storage.objects import open_store
        from service.storage.sessions import Database
        from service.upkeep import backup

        begun = time.monotonic()
        file, scratch = self._folder / "drill.zip", self._folder / "restored"
        scratch.mkdir()
        with ExitStack() as opened:
            here, there = (
                Database(make_sqlite_url(place / "lagid.db")) for place in (self._folder, scratch)
            )
            for database in (here, there):
                opened.callback(database.dispose)
            written = backup.write_backup(
                here, open_store((self._folder / "objects").as_uri()), file
            )
            store = open_store((scratch / "objects").as_uri())
            restored = backup.restore_backup(there, store, file)
            with there.read_session() as session:
                lost = sorted(find_lost_hashes(session, store))
            damaged = [sha256 for sha256, is_damaged in find_damaged(store) if is_damaged]
        if restored != written or lost or damaged:
            raise DrillFailed(
                f"{restored.rows} were restored of {written.rows}; {len(lost)} objects are lost, "
                f"{len(damaged)} damaged"
            )
        rows = sum(restored.rows.values())
        return f"{rows} rows and {restored.objects} objects in {time.monotonic() - begun:.0f} s"

    def _get_client(self) -> Client:
        if self._client is None:
            raise DrillFailed("not tried: the service did not start")
        return self._client


def _build_environment() -> Mapping[str, str]:
    """Build the environment of the drill: without the user's database, store, keys and Ray."""
    kept = ("LAGID_CACHE_DIR", "LAGID_WORKER_MEMORY_MB", "LAGID_START_SECONDS")
    return {
        name: value
        for name, value in os.environ.items()
        if not name.startswith("LAGID_") or name in kept
    }


def _build_job(dataset: str, n_runs: int) -> dict[str, Any]:
    return {
        "name": "drill",
        "model": "fopdt",
        "datasets": [dataset],
        "reuse": False,
        "sweep": {"axes": [{"path": "/seed", "range": [0, n_runs]}]},
    }


def _kill_worker() -> int:
    """Kill one of the workers of this process's service that compute; return its number."""
    limit = time.monotonic() + WORKER_SECONDS
    while time.monotonic() < limit:
        for child in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):
                if child.name().startswith(WORKER_NAME[:15]):  # as long as Linux keeps names
                    child.send_signal(signal.SIGKILL)
                    return int(child.pid)
        time.sleep(0.05)
    raise DrillFailed(f"no worker computed within {WORKER_SECONDS:g} s")


def _read_results(client: Client, job: str) -> list[tuple[Any, ...]]:
    """Read what the first runs of a job have found, number by number."""
    found: Iterator[Mapping[str, Any]] = iter(client.runs(job, limit=COMPARED_RUNS))
    return [
        (run["rms"], run["evaluations"], *(one["value"] for one in run["parameters"]))
        for run in found
    ][:COMPARED_RUNS]
