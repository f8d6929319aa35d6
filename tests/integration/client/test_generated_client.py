"""A client generated from the committed OpenAPI document runs the three uses."""

import importlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest

from service.api.contract.write_contract import DOCUMENT_FILE
from service.client.embedded import run_embedded_service
from tests.support.checkout import ROOT
from tests.support.limits import LIMIT_SECONDS
from tests.support.requirements import report_missing
from tests.support.service.web_app import recording

pytestmark = [pytest.mark.night, pytest.mark.ray, pytest.mark.slow]

GENERATOR = "openapi-python-client"
PACKAGE = "lagid_generated"
# The generator knows few media types by name; it takes those of files as bytes.
CONFIGURATION = "content_type_overrides:\n  application/x-mcap: application/octet-stream\n"
SMALL = {"population": 20, "generations": 40}


@pytest.fixture(scope="module")
def generated_package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The package that the generator writes from the committed document."""
    program = shutil.which(GENERATOR)
    if program is None:
        report_missing("generator", f"there is no program {GENERATOR}")
    folder = tmp_path_factory.mktemp("generated")
    (folder / "settings.yaml").write_text(CONFIGURATION)
    done = subprocess.run(
        [
            *(program, "generate", "--meta", "none", "--path", ROOT / DOCUMENT_FILE),
            *("--output-path", folder / PACKAGE, "--config", folder / "settings.yaml"),
        ],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    # Nothing but a further form of some bodies may be left out.
    left_out = [line for line in done.stdout.splitlines() if line.startswith("Cannot parse")]
    assert left_out == []
    sys.path.insert(0, str(folder))
    yield importlib.import_module(PACKAGE)
    sys.path.remove(str(folder))


class Generated:
    """Calls of the generated package; an answer that is no success is an error."""

    def __init__(self, package: Any, url: str) -> None:
        self._client = package.Client(base_url=url, timeout=LIMIT_SECONDS)

    def close(self) -> None:
        self._client.get_httpx_client().close()

    def call(self, group: str, operation: str, *names: str, **given: Any) -> Any:
        module = importlib.import_module(f"{PACKAGE}.api.{group}.{operation}")
        answer = module.sync_detailed(*names, client=self._client, **given)
        assert answer.status_code < 300, (operation, answer.content)
        return answer.parsed

    def body(self, name: str, document: dict[str, Any]) -> Any:
        return getattr(importlib.import_module(f"{PACKAGE}.models"), name).from_dict(document)

    def wait(self, job: str) -> Any:
        limit = time.monotonic() + LIMIT_SECONDS
        while time.monotonic() < limit:
            state = self.call("jobs", "read_job", job)
            if str(state.state) not in ("queued", "running"):
                assert str(state.state) == "succeeded", state.error
                return state
            time.sleep(0.3)
        raise AssertionError(f"{job} has not ended")


@pytest.fixture(scope="module")
def remote(generated_package: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Generated]:
    folder = tmp_path_factory.mktemp("data")
    with run_embedded_service(folder / "data", cpus=1) as url:
        remote = Generated(generated_package, url)
        yield remote
        remote.close()


def simulate(remote: Generated, name: str, delay: float) -> str:
    body = {
        "name": name,
        "model": "fopdt",
        "parameters": {"K": 2, "T": 1, "L": delay, "y0": 0},
        "inputs": {"u": {"kind": "binary", "period": 2}},
        "samples": 200,
        "sample_time": 0.1,
        "noise": {"sigma": 0.02, "seed": 1},
    }
    stored = remote.call("datasets", "simulate_dataset", body=remote.body("SimulateIn", body))
    return str(stored.id)


def test_use_1_a_recording_is_identified(remote: Generated, generated_package: Any) -> None:
    types = importlib.import_module(f"{PACKAGE}.types")
    file = types.File(payload=BytesIO(recording()), mime_type="application/octet-stream")
    stored = remote.call("datasets", "add_dataset", body=file, name="steps")
    assert [channel.name for channel in stored.channels] == ["u", "y"]
    body = {"model": "fopdt", "datasets": [stored.id], "algorithm": SMALL}
    job = remote.call("jobs", "submit_job", body=remote.body("JobIn", body))
    ended = remote.wait(job.id)
    assert ended.request.algorithm.population == SMALL["population"]
    [run] = remote.call("jobs", "list_runs", job.id).items
    estimates = {estimate.name: estimate for estimate in run.parameters}
    assert estimates["L"].value == pytest.approx(0.5, abs=0.06)
    assert estimates["L"].unit == "s"
    assert run.fit_percent.estimation > 95
    assert remote.call("runs", "read_run", run.id).search.settled in (True, False)
    mcap = remote.call("runs", "read_run_signals", run.id)
    assert mcap.payload.read().startswith(b"\x89MCAP")
    table = remote.call("jobs", "export_runs_csv", job.id)
    assert table.count("\n") == 2  # a head, and the run
    refusal = importlib.import_module(f"{PACKAGE}.api.jobs.read_job").sync(
        "none", client=remote._client
    )
    assert (refusal.status, refusal.title) == (404, "Not found")


def test_use_2_a_noise_sweep_is_summarised(remote: Generated) -> None:
    dataset = simulate(remote, "for the sweep", 0.5)
    body = {
        "model": "fopdt",
        "datasets": [dataset],
        "sigma": [0, 0.1],
        "replicates": 2,
        "methods": ["improved"],
        "algorithm": SMALL,
    }
    job = remote.call("jobs", "submit_noise_sweep", body=remote.body("NoiseSweepIn", body))
    remote.wait(job.id)
    summary = remote.call("jobs", "read_summary", job.id)
    assert [group.runs for group in summary.groups] == [2, 2]
    assert {parameter.name for parameter in summary.groups[0].parameters} >= {"K", "T", "L"}


def test_use_3_a_batch_has_a_trend_and_a_reference(remote: Generated) -> None:
    lengths = (5, 10, 20)
    batch = [
        {"x": x, "datasets": [simulate(remote, f"tube of {x} m", 0.1 + 0.02 * x)]} for x in lengths
    ]
    body = {"model": "fopdt", "label": "length_m", "batch": batch, "trend_parameters": ["L"]}
    body |= {"predict": [15], "algorithm": SMALL}
    job = remote.call("jobs", "submit_reidentification", body=remote.body("ReidentifyIn", body))
    remote.wait(job.id)
    [quantity] = [
        entry for entry in remote.call("jobs", "read_trend", job.id).quantities if entry.name == "L"
    ]
    assert [point.x for point in quantity.points] == [5, 10, 20]
    assert quantity.predictions[0].value == pytest.approx(0.4, abs=0.05)
    run = remote.call("jobs", "list_runs", job.id).items[1]
    accepted = remote.call(
        "references", "accept_reference", "tube", body=remote.body("ReferenceIn", {"run": run.id})
    )
    assert remote.call("references", "read_reference", "tube").run == accepted.run == run.id
