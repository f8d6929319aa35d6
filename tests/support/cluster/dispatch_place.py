"""A dispatcher as its own process, and jobs put straight into its queue."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from service.core.settings import Settings
from service.core.states import OPEN_STATES, JobState
from service.datasets.datasets import add_recording
from service.dispatch.dispatcher import Dispatcher
from service.dispatch.held_leases import HeldLeases
from service.dispatch.supervisor import clear_session, to_environment
from service.jobs.job_schemas import JobIn
from service.jobs.submit import submit_job
from service.repositories.job_rows import JobRepository
from service.repositories.run_rows import RunRepository
from service.storage.objects import ObjectStore, open_store
from service.storage.sessions import Database
from service.storage.tables import Job, Run
from sysid.data.records import Recording
from tests.support.cluster.small_runs import step_record
from tests.support.limits import LIMIT_SECONDS
from tests.support.storage.databases import open_migrated_postgres, open_migrated_sqlite
from tests.support.storage.object_stores import make_bucket
from workers.protocol import Executor


class Place:
    """A data folder with its database and store, and one dataset in it.

    The store is a folder beside SQLite, and a bucket beside PostgreSQL. So what runs on both
    databases runs on both stores. With `LAGID_TEST_STORAGE=server` every place has the second pair.
    """

    def __init__(self, folder: Path, database: Database | None = None) -> None:
        self.settings = Settings(data_dir=folder, cpus=2, lease_seconds=3.0)
        self.settings.prepare_data_folder()
        if database is None:
            on_server = os.environ.get("LAGID_TEST_STORAGE") == "server"
            database = open_migrated_postgres() if on_server else open_migrated_sqlite(folder)
        self.database = database
        if not database.is_sqlite:
            url = database.engine.url.render_as_string(hide_password=False)
            address = {"database_url": url, "store_url": make_bucket()}
            self.settings = self.settings.model_copy(update=address)
        self.store: ObjectStore = open_store(self.settings.store_location)
        self.dataset = self._dataset()

    def submit(self, **body: Any) -> str:
        """Queue a job on the dataset."""
        # A test that compares two runs wants both computed.
        default = {
            "model": "fopdt",
            "datasets": [self.dataset],
            "reuse": False,
            "parameters": {"T": {"upper": 10.0}, "L": {"upper": 2.0}},
        }
        return submit_job(self.database, JobIn(**{**default, **body}), self.settings).id

    def job(self, job: str) -> Job:
        with self.database.read_session() as session:
            return JobRepository(session).get(job)

    def runs(self, job: str) -> tuple[Run, ...]:
        with self.database.read_session() as session:
            return RunRepository(session).list_page(job, limit=1000).items

    def history(self, run: str) -> list[tuple[int, int, float]]:
        with self.database.read_session() as session:
            points = RunRepository(session).read_history(run)
            return [(point.island, point.generation, point.rms) for point in points]

    def cancel(self, job: str) -> None:
        with self.database.write_session() as session:
            JobRepository(session).cancel(job)

    def until(self, job: str, *states: JobState) -> Job:
        """Wait until the job is in one of the states."""
        until(lambda: self.job(job).state in states, f"{job} in {states}")
        return self.job(job)

    @contextmanager
    def dispatcher(self) -> Iterator["subprocess.Popen[bytes]"]:
        """A dispatcher for the length of the block; nothing of it is left afterwards."""
        log = (self.settings.data_dir / "dispatcher.log").open("ab")
        child = subprocess.Popen(
            [sys.executable, "-m", "service.dispatch.process"],
            env={**os.environ, **to_environment(self.settings)},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
        try:
            yield child
            child.send_signal(signal.SIGTERM)
            child.wait(LIMIT_SECONDS)
        finally:
            clear_session(child.pid)
            child.wait()
            log.close()

    def _dataset(self) -> str:
        record = step_record()
        recording = Recording((*record.inputs, *record.outputs))
        stored = add_recording(
            self.database,
            self.store,
            recording,
            name="steps",
            kind="upload",
            key="steps",
            details={"warnings": []},
        )
        return stored.dataset.id


def carry_out(place: Place, job: str, executor: Executor) -> None:
    """Run a dispatcher of this executor until the job has ended."""
    dispatcher = Dispatcher(place.database, place.store, executor, HeldLeases(place.database, 30))

    def stop_at_the_end() -> None:
        while place.job(job).state in OPEN_STATES:
            time.sleep(0.03)
        dispatcher.stopping.set()

    watcher = threading.Thread(target=stop_at_the_end)
    watcher.start()
    dispatcher.run_until_stopped()
    watcher.join()


def until(holds: Callable[[], bool], what: str) -> None:
    """Wait for something that must come true."""
    limit = time.monotonic() + LIMIT_SECONDS
    while not holds():
        assert time.monotonic() < limit, f"{what} did not come true"
        time.sleep(0.05)
