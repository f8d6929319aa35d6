"""A rehearsal of the deployment: the commands of Compose as processes, and a job through all."""

import json
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.cluster.deployment import (
    BUCKET,
    WORKER_HOST,
    Deployment,
    open_client,
    rehearse_deployment,
)
from tests.support.service.web_app import CSV, recording

pytestmark = [
    pytest.mark.ray,
    pytest.mark.postgres,
    pytest.mark.slow,
    pytest.mark.night,
    pytest.mark.timeout(600),
]
SWEEP = {"axes": [{"path": "/seed", "range": [0, 4]}]}


def read_lines(deployment: Deployment, name: str) -> list[dict[str, Any]]:
    """The log lines of a process that are JSON; what Ray's commands print is none."""
    lines = deployment.read_log(name).splitlines()
    return [json.loads(line) for line in lines if line.startswith("{")]


def start_all(deployment: Deployment) -> list[str]:
    """Start the services as Compose does, each after those it needs; return the web addresses."""
    for service in ("ray-head", "ray-worker"):
        deployment.start(service)
        deployment.wait_until_healthy(service)
    for service, number in (("dispatcher", 0), ("web", 0), ("web", 1)):
        deployment.start(service, number)
    for number in (0, 1):
        deployment.wait_until_healthy("web", number)
    port = deployment.environments["web"]["LAGID_PORT"]
    return [f"http://{host}:{port}" for host in ("127.0.0.5", "127.0.0.6")]


def test_the_commands_of_compose_carry_out_a_job_on_postgresql_s3_and_two_nodes(
    tmp_path: Path,
) -> None:
    with rehearse_deployment(tmp_path) as deployment, httpx.Client(timeout=60) as asked:
        key = deployment.run("web", "lagid", "key", "create", "me", "--scope", "admin")
        first, second = start_all(deployment)
        assert httpx.get(f"{first}/v1/jobs").status_code == 401
        asked.headers["Authorization"] = f"Bearer {key}"
        ready = f"{second}/readyz"
        deployment.wait_until(lambda: httpx.get(ready).status_code == 200, "a ready dispatcher")
        assert deployment.check_health("dispatcher")
        content = recording()
        added = asked.post(f"{first}/v1/datasets?name=steps", content=content, headers=CSV)
        assert added.status_code == 201, added.text
        body = {
            "model": "fopdt",
            "datasets": ["steps"],
            "sweep": SWEEP,
            "keep_signals": True,
            "parameters": {"T": {"upper": 10.0}, "L": {"upper": 2.0}},
        }
        job = asked.post(f"{first}/v1/jobs", json=body, headers={"X-Request-ID": "rehearsal-1"})
        assert (job.status_code, job.headers["x-request-id"]) == (202, "rehearsal-1")
        at = f"{second}/v1/jobs/{job.json()['id']}"  # what one web process takes, the other shows
        open_states = ("queued", "running")
        deployment.wait_until(lambda: asked.get(at).json()["state"] not in open_states, "the end")
        ended = asked.get(at).json()
        progress = ended["progress"]
        assert (ended["state"], progress["finished"], progress["failed"]) == ("succeeded", 4, 0)
        run = asked.get(f"{at}/runs").json()["items"][0]["id"]
        found = asked.get(f"{second}/v1/runs/{run}").json()["parameters"]
        values = {parameter["name"]: parameter["value"] for parameter in found}
        assert abs(values["L"] - 0.5) < 0.1

        endpoint = deployment.environments["web"]["AWS_ENDPOINT_URL"]
        stored = open_client(endpoint).list_objects_v2(Bucket=BUCKET)["Contents"]
        keys = [entry["Key"] for entry in stored if entry["Key"].startswith("objects/sha256/")]
        assert len(keys) >= 2  # the recording, and the fitted signals of the runs

        lines = read_lines(deployment, "dispatcher-0")
        assert any("with 1 cores" in line["message"] for line in lines)
        assert {line["attempt"] for line in lines if line.get("job_id") == ended["id"]} == {1}
        requests = [line for line in read_lines(deployment, "web-0") if "route" in line]
        assert {"rehearsal-1"} <= {line["request_id"] for line in requests}
        numbers = httpx.get(f"{deployment.metrics_url}/metrics").text
        assert 'lagid_runs_total{outcome="succeeded"} 4.0' in numbers
        assert "lagid_dispatcher_cores 1.0" in numbers
        assert 'lagid_jobs{state="succeeded"} 1.0' in asked.get(f"{first}/metrics").text
        assert WORKER_HOST in deployment.read_log("ray-worker-0")
    assert all(child.returncode is not None for child in deployment.processes.values())
