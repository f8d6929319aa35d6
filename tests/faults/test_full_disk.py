"""A disk that is full for a while."""

import os
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from sqlalchemy import func, select

from benchmarks import paper_example
from benchmarks.breaking.audit import is_over
from benchmarks.breaking.disks import fill_folders, small_disk
from benchmarks.breaking.stand import Stand, standing_service, until
from service.core.states import JobState
from service.storage.tables import Checkpoint, Job, Run
from tests.repository import ROOT
from tests.rest import CSV, PROBLEM

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(400)]

LIMIT_SECONDS = 200.0
LONG = {"generations": 60_000, "islands": 4, "stop": {"settled": None}}
NAMESPACE = ["unshare", "--user", "--map-root-user", "--mount"]
"""Runs a command as the root of a namespace, who may mount there."""


def test_a_full_disk_stops_nothing_for_good(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    if os.geteuid() != 0:
        run_in_namespace(request.node.nodeid)
        return
    with small_disk(tmp_path / "disk", 16) as disk:
        if disk is None:
            pytest.skip("this root may not mount a small tmpfs")
        check_service(disk, tmp_path)


def run_in_namespace(test: str) -> None:
    """Run a test as root of a namespace."""
    if subprocess.run([*NAMESPACE, "true"], check=False, capture_output=True).returncode != 0:
        pytest.skip("a small tmpfs needs root or a namespace of users")
    done = subprocess.run(
        [*NAMESPACE, sys.executable, "-m", "pytest", "-p", "no:cacheprovider", test],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "1 passed" in done.stdout, done.stdout


def check_service(disk: Path, tmp_path: Path) -> None:
    """Fill the disk of a service at work; it refuses what is new, and ends what it has."""
    stand = Stand(disk / "data", cpus=1)
    record = paper_example.write_csv(tmp_path / "record.csv", seed=1)
    with standing_service(stand):
        dataset = stand.client.add_dataset(record, name="example 1")["id"]
        body = {"model": "duffing-eq16", "datasets": [dataset], "reuse": False}
        job = stand.client.submit({**body, "algorithm": LONG})["id"]
        until(lambda: count_checkpoints(stand) > 0, "a checkpoint", LIMIT_SECONDS)
        (dispatcher,) = stand.family.dispatchers()
        with fill_folders(disk):
            upload = httpx.post(
                f"{stand.url}/v1/datasets",
                content=record.read_bytes() + b" ",
                headers=CSV,
                timeout=60.0,
            )
            assert upload.status_code == 503
            assert upload.headers["content-type"] == PROBLEM
            os.sync()
            until(lambda: is_refused(stand, body), "a job was refused", LIMIT_SECONDS)
        until(lambda: is_over(stand, job), "the job ended", LIMIT_SECONDS)
        with stand.database.read_session() as session:
            assert session.get_one(Job, job).state is JobState.SUCCEEDED
            hashes = list(session.scalars(select(Run.signals_sha256)))
        assert stand.family.dispatchers() == [dispatcher]
        objects = {path.stem for path in (disk / "data/objects/sha256").rglob("*.mcap")}
        assert set(hashes) - {None} <= objects
    assert stand.leftovers() == []


def count_checkpoints(stand: Stand) -> int:
    with stand.database.read_session() as session:
        return session.scalar(select(func.count()).select_from(Checkpoint)) or 0


def is_refused(stand: Stand, body: dict[str, object]) -> bool:
    """Whether a submission meets a full disk, as a problem document."""
    answer = httpx.post(f"{stand.url}/v1/jobs", json=body, timeout=60.0)
    assert answer.status_code in (202, 503), answer.text
    return answer.status_code == 503
