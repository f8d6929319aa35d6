"""A disk that is full for a while."""

import os
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from benchmarks.breaking.disks import fill_folders
from benchmarks.breaking.stand import until
from service.core.states import JobState
from tests.support.checkout import ROOT
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.web_app import CSV, PROBLEM
from tests.support.service.whole_service import Service

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(400)]

LONG = {"generations": 10_000_000, "islands": 4, "stop": {"settled": None, "seconds": 20.0}}
"""A run that computes for so long on any machine."""
NAMESPACE = ["unshare", "--user", "--map-root-user", "--mount"]
"""Runs a command as the root of a namespace, who may mount there."""


def test_a_full_disk_stops_nothing_for_good(
    service: Service, request: pytest.FixtureRequest
) -> None:
    if service.disk is not None:
        check_service(service, service.disk)
    elif os.geteuid() != 0:
        run_in_namespace(request.node.nodeid)
    else:
        pytest.skip("this root may not mount a small tmpfs")


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


def check_service(service: Service, disk: Path) -> None:
    """Fill the disk of a service at work; it refuses what is new, and ends what it has."""
    stand = service.stand
    job = service.submit(algorithm=LONG)
    service.wait_for_checkpoint(job)
    (dispatcher,) = stand.family.dispatchers()
    with fill_folders(disk):
        upload = httpx.post(
            f"{stand.url}/v1/datasets",
            content=b"t,u,y\n0,1,1\n",
            headers=CSV,
            timeout=LIMIT_SECONDS,
        )
        assert upload.status_code == 503
        assert upload.headers["content-type"] == PROBLEM
        os.sync()
        until(lambda: is_refused(service), "a job was refused", LIMIT_SECONDS)
    assert service.wait_for_end(job).state is JobState.SUCCEEDED
    assert stand.family.dispatchers() == [dispatcher]
    objects = {path.stem for path in (stand.folder / "objects/sha256").rglob("*.mcap")}
    (run,) = service.list_runs(job)
    assert run.signals_sha256 in objects


def is_refused(service: Service) -> bool:
    """Whether a submission meets a full disk, as a problem document."""
    answer = httpx.post(
        f"{service.stand.url}/v1/jobs", json=service.build_body(), timeout=LIMIT_SECONDS
    )
    assert answer.status_code in (202, 503), answer.text
    return answer.status_code == 503
