"""One whole service for the tests that break it or look at it from outside.

Web process, dispatcher and Ray stand from the first test that asks for them to the end of the
session. Each test leaves the service at work.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from benchmarks import paper_example
from benchmarks.breaking.audit import is_over
from benchmarks.breaking.disks import small_disk
from benchmarks.breaking.stand import Stand, standing_service, until
from benchmarks.breaking.work import DEADLY, GREEDY
from service.storage.tables import Checkpoint, Job, Run
from tests.support.files.foreign_modules import ForeignFolder
from tests.support.limits import LIMIT_SECONDS

LEASE_SECONDS = 2.0
DISK_MEGABYTES = 128
ENDLESS = {"generations": 10_000_000, "stop": {"settled": None}}


class Service:
    """The service with one core and one dataset; `clock` and `ray_away` break it (`shim`).

    Attributes
    ----------
    folder : Path
        Has files that break the service, its data and the recording of the dataset.
    foreign : ForeignFolder
        Where the service was started.
    disk : Path or None
        The small file system with all its data; None where none can be mounted.
    """

    def __init__(
        self, stand: Stand, folder: Path, foreign: ForeignFolder, disk: Path | None
    ) -> None:
        self.stand, self.folder, self.foreign, self.disk = stand, folder, foreign, disk
        self.clock, self.ray_away = folder / "clock", folder / "ray-away"
        record = paper_example.write_csv(folder / "record.csv", seed=1)
        self._dataset = stand.client.add_dataset(record, name="example 1")["id"]

    def build_body(self, **body: Any) -> dict[str, Any]:
        """Build the request for a job on the dataset."""
        return {"model": "duffing-eq16", "datasets": [self._dataset], "reuse": False, **body}

    def submit(self, **body: Any) -> str:
        """Submit a job on the dataset; return its id."""
        return str(self.stand.client.submit(self.build_body(**body))["id"])

    def submit_endless(self) -> str:
        """Submit a job that does not end by itself; return its id once it makes progress."""
        job = self.submit(algorithm=ENDLESS)
        until(lambda: self.read_job(job).evaluations > 0, "progress", LIMIT_SECONDS)
        return job

    def wait_for_end(self, job: str) -> Job:
        """Wait until a job has ended."""
        until(lambda: is_over(self.stand, job), f"{job} ended", LIMIT_SECONDS)
        return self.read_job(job)

    def wait_for_checkpoint(self, job: str) -> None:
        """Wait until a run of the job has a checkpoint."""
        until(lambda: self.has_checkpoint(job), "a checkpoint", LIMIT_SECONDS)

    def read_job(self, job: str) -> Job:
        """Read the row of a job."""
        with self.stand.database.read_session() as session:
            return session.get_one(Job, job)

    def list_runs(self, job: str) -> list[Run]:
        """List the rows of its runs."""
        with self.stand.database.read_session() as session:
            query = select(Run).where(Run.job_id == job).order_by(Run.number)
            return list(session.scalars(query))

    def has_checkpoint(self, job: str) -> bool:
        """Whether a checkpoint of the job is stored."""
        with self.stand.database.read_session() as session:
            kept = select(Checkpoint.run_id).where(Checkpoint.job_id == job)
            return session.scalar(kept) is not None

    @contextmanager
    def without_ray(self) -> Iterator[None]:
        """No Ray starts during the block."""
        self.ray_away.touch()
        try:
            yield
        finally:
            self.ray_away.unlink(missing_ok=True)


@pytest.fixture(scope="session")
def whole_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    folder = tmp_path_factory.mktemp("standing")
    (folder / "clock").write_text("0")
    environment = {
        "BREAK_CLOCK": str(folder / "clock"),
        "BREAK_RAY": str(folder / "ray-away"),
        "BREAK_SEEDS": ",".join(map(str, DEADLY)),
        "BREAK_MEMORY": ",".join(map(str, GREEDY)),
        "LAGID_WORKER_MEMORY_MB": "512",
    }
    foreign = ForeignFolder(folder)
    # In the folder of the session, whose guard unmounts it if pytest is killed.
    with small_disk(Path(tempfile.mkdtemp()), DISK_MEGABYTES) as disk:
        stand = Stand(
            (disk or folder) / "data",
            cpus=1,  # each fault starts a worker for each core, for seconds of computing
            lease_seconds=LEASE_SECONDS,
            environment=environment,
            working_folder=foreign.path,
        )
        with standing_service(stand):
            yield Service(stand, folder, foreign, disk)
            stand.stop()
            assert stand.leftovers() == []


@pytest.fixture
def service(whole_service: Service) -> Service:
    """The service, ready; a test before may have broken it."""
    until(whole_service.stand.is_ready, "the service was ready", LIMIT_SECONDS)
    return whole_service
