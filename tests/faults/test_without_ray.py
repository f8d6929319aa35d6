"""A dispatcher that is told to end, and one that starts without Ray."""

import os
import re
import signal

import httpx
import pytest

from benchmarks.breaking.stand import until
from service.core.states import JobState
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.whole_service import ENDLESS, Service

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.timeout(400)]

REFUSAL = "Ray could not be started"


def test_jobs_wait_for_ray_with_their_checkpoints(service: Service) -> None:
    stand = service.stand
    stopped = service.submit_endless()
    service.wait_for_checkpoint(stopped)
    refusals = stand.log.count(REFUSAL)
    with service.without_ray():
        (dispatcher,) = stand.family.dispatchers()
        os.kill(dispatcher, signal.SIGTERM)
        queued, cancelled = service.submit(), service.submit(algorithm=ENDLESS)
        until(lambda: stand.log.count(REFUSAL) > refusals + 1, "two tries", LIMIT_SECONDS)
        readiness = httpx.get(f"{stand.url}/readyz", timeout=LIMIT_SECONDS)
        assert readiness.status_code == 503
        assert re.search("no dispatcher is alive|Ray is starting", readiness.json()["detail"])
        for _ in range(2):  # the second time it is cancelled already
            assert stand.client.cancel(cancelled)["state"] == "cancelled"
        assert [run.state for run in service.list_runs(cancelled)] == [JobState.CANCELLED]
        assert "the dispatcher exited with code 0" in (stand.folder / "serve.log").read_text()
        job = service.read_job(stopped)
        assert (job.state, job.lost_leases) == (JobState.QUEUED, 0)
        assert service.has_checkpoint(stopped)
        assert service.read_job(queued).state is JobState.QUEUED
        before = service.read_job(stopped).evaluations
    assert service.wait_for_end(queued).state is JobState.SUCCEEDED
    until(lambda: service.read_job(stopped).evaluations > before, "more", LIMIT_SECONDS)
    assert service.read_job(stopped).attempt == 2
    stand.client.cancel(stopped)
    assert service.wait_for_end(stopped).state is JobState.CANCELLED
