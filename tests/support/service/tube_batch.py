"""A batch of tubes of four lengths, re-identified once in a session and copied for its users."""

import atexit
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from starlette.testclient import TestClient

from service.api.app import create_app
from service.api.requests.dependencies import Parts
from tests.support.service.local_runs import carry_out_job
from tests.support.service.web_app import parts_of, settings_of, store_csv

LENGTHS = (2.0, 4.0, 8.0, 16.0)
BODY: dict[str, Any] = {
    "model": "tube",
    "label": "length_m",
    "algorithm": {"population": 20, "islands": 2, "stop": {"settled": 3}},
    "trend_parameters": ["L", "T"],
}


@dataclass(frozen=True)
class Batch:
    """Two recordings of each length, and the job of the first ones, sent in reverse order."""

    datasets: dict[float, list[str]]
    job: str


@dataclass(frozen=True)
class ServedBatch(Batch):
    """The same, and an application on a data folder that has it."""

    server: TestClient

    @property
    def parts(self) -> Parts:
        return parts_of(self.server)


def make_recording(length: float, seed: int = 1, longer: float = 0.0) -> bytes:
    """A tube of that length: T = 0.06 s·m^½, dead time 20 ms + 10 ms/m; holds of 2 s."""
    draw = np.random.default_rng(1000 * seed + round(10 * length))
    t = np.arange(1000) * 0.01
    u = np.repeat([1.0, 4.0, 2.0, 5.0, 3.0], 200)
    lag = round((0.02 + 0.01 * length + longer) / 0.01)
    delayed = np.concatenate([np.full(lag, u[0]), u[: u.size - lag]])
    y, share = np.full(t.size, u[0]), np.exp(-0.01 / (0.06 * length**0.5))
    for k in range(1, t.size):
        y[k] = share * y[k - 1] + (1 - share) * delayed[k - 1]
    y += 0.01 * draw.normal(size=t.size)
    rows = ["t,u [bar],y [bar]"]
    rows += [f"{a:.6g},{b:.6g},{c:.6g}" for a, b, c in zip(t, u, y, strict=True)]
    return "\n".join(rows).encode()


def store_tube(server: TestClient, length: float, seed: int, longer: float = 0.0) -> str:
    name = f"tube-{length:g}-{seed}-{longer:g}"
    return store_csv(server, make_recording(length, seed, longer), name)


def identify_batch(server: TestClient, **fields: Any) -> str:
    """Submit a batch and carry it out; gives the job."""
    answer = server.post("/v1/recipes/reidentify", json={**BODY, **fields})
    assert answer.status_code == 202, answer.text
    job = str(answer.json()["id"])
    assert answer.headers["location"] == f"/v1/jobs/{job}"
    carry_out_job(parts_of(server), job)
    return job


def copy_batch(folder: Path) -> Batch:
    """Copy the data folder of the batch."""
    template, batch = _batch_template()
    shutil.copytree(template, folder, dirs_exist_ok=True)
    return batch


@contextmanager
def serve_batch(folder: Path) -> Iterator[ServedBatch]:
    """An application on a copy of the data folder."""
    batch = copy_batch(folder)
    with TestClient(create_app(settings_of(folder)), raise_server_exceptions=False) as server:
        yield ServedBatch(batch.datasets, batch.job, server)


@cache
def _batch_template() -> tuple[Path, Batch]:
    folder = Path(tempfile.mkdtemp(prefix="lagid-batch-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    with TestClient(create_app(settings_of(folder))) as server:
        datasets = {x: [store_tube(server, x, seed) for seed in (1, 2)] for x in LENGTHS}
        batch = [{"x": x, "datasets": datasets[x][:1]} for x in reversed(LENGTHS)]
        job = identify_batch(server, batch=batch, predict=[10, 32])
    return folder, Batch(datasets, job)
