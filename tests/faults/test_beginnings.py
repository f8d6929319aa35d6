"""A service that begins badly: no Ray, a full disk."""

import os
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from sqlalchemy import select

from benchmarks import paper_example
from benchmarks.breaking.audit import is_over
from benchmarks.breaking.disks import filled, small_disk
from benchmarks.breaking.stand import Stand, standing_service, until
from service.core.states import JobState
from service.storage.tables import Checkpoint, Job, Run
from tests.rest import CSV, PROBLEM

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(400)]

LIMIT_SECONDS = 200.0
SHORT = {"generations": 20}
LONG = {"generations": 60_000, "islands": 4, "stop": {"settled": None}}


def state_of(stand: Stand, job: str) -> JobState:
    with stand.database.read_session() as session:
        return session.get_one(Job, job).state


def test_jobs_wait_for_ray_and_survive_a_restart(tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    broken.touch()
    folder = tmp_path / "data"
    record = paper_example.write_csv(tmp_path / "record.csv", seed=1)
    with standing_service(Stand(folder, environment={"BREAK_RAY": str(broken)}), wait=False) as one:
        until(lambda: one.answers() == 200, "the web answered", LIMIT_SECONDS)
        dataset = one.client.add_dataset(record, name="example 1")["id"]
        body = {"model": "duffing-eq16", "datasets": [dataset], "algorithm": SHORT, "reuse": False}
        seeds = {"path": "/seed", "values": [1, 2, 3, 4]}
        job = one.client.submit({**body, "sweep": {"axes": [seeds]}})["id"]
        log = folder / "logs" / "dispatcher.log"
        refusal = "Ray could not be started"
        until(lambda: log.exists() and log.read_text().count(refusal) > 1, "tries", LIMIT_SECONDS)
        answer = httpx.get(f"{one.url}/readyz", timeout=60.0)
        assert answer.status_code == 503
        assert "no dispatcher is alive" in answer.json()["detail"]
        assert state_of(one, job) is JobState.QUEUED
        one.stop()
        assert one.leftovers() == []
    with standing_service(Stand(folder)) as stand:
        until(lambda: is_over(stand, job), "the job ended", LIMIT_SECONDS)
        assert state_of(stand, job) is JobState.SUCCEEDED
        assert {run["state"] for run in stand.client.runs(job)} == {"succeeded"}


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 16 MB."""
    with small_disk(tmp_path / "disk", 16) as folder:
        if folder is None:
            pytest.skip("mounting a small tmpfs needs root")
        yield folder


def test_a_full_disk_stops_nothing_for_good(disk: Path, tmp_path: Path) -> None:
    stand = Stand(disk / "data")
    record = paper_example.write_csv(tmp_path / "record.csv", seed=1)
    with standing_service(stand):
        dataset = stand.client.add_dataset(record, name="example 1")["id"]
        body = {"model": "duffing-eq16", "datasets": [dataset], "reuse": False}
        job = stand.client.submit({**body, "algorithm": LONG})["id"]
        until(lambda: checkpoints(stand) > 0, "a checkpoint", LIMIT_SECONDS)
        log = disk / "data" / "logs" / "dispatcher.log"
        (dispatcher,) = stand.family.dispatchers()
        with filled(disk):
            upload = httpx.post(
                f"{stand.url}/v1/datasets",
                content=record.read_bytes() + b" ",
                headers=CSV,
                timeout=60.0,
            )
            assert upload.status_code == 503
            assert upload.headers["content-type"] == PROBLEM
            os.sync()
            until(lambda: refused(stand, body), "a job was refused", LIMIT_SECONDS)
        until(lambda: is_over(stand, job), "the job ended", LIMIT_SECONDS)
        assert state_of(stand, job) is JobState.SUCCEEDED
        assert log.exists()
        assert stand.family.dispatchers() == [dispatcher]
        with stand.database.read_session() as session:
            hashes = list(session.scalars(select(Run.signals_sha256)))
        objects = {path.stem for path in (disk / "data/objects/sha256").rglob("*.mcap")}
        assert set(hashes) - {None} <= objects
    assert stand.leftovers() == []


def checkpoints(stand: Stand) -> int:
    with stand.database.read_session() as session:
        return session.query(Checkpoint).count()


def refused(stand: Stand, body: dict[str, object]) -> bool:
    """Whether a submission meets a full disk, as a problem document."""
    answer = httpx.post(f"{stand.url}/v1/jobs", json=body, timeout=60.0)
    assert answer.status_code in (202, 503), answer.text
    return answer.status_code == 503
