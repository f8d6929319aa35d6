"""Measure the service's memory and the time of requests during a job of many runs."""

import statistics
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks import paper_example
from benchmarks.family import memory_megabytes
from benchmarks.table import Row, parser, report
from service.client.calls import RestCall, call
from service.client.client import Client
from service.client.embedded import run_embedded_service

BARS_MB = {"dispatcher": 400.0, "workers": 350.0, "web process": 200.0}
SMALL = {"method": "simple", "population": 4, "generations": 1, "islands": 1, "refine": False}
BETWEEN_SECONDS = 0.25


def body(dataset: str, runs: int) -> dict[str, Any]:
    """A job of many small runs."""
    axes = [{"path": "/seed", "range": [0, runs]}]
    return {**paper_example.job(dataset, 0), "algorithm": SMALL, "sweep": {"axes": axes}}


def milliseconds(client: Client, request: RestCall) -> float:
    """Time of one request, its answer read."""
    start = time.perf_counter()
    client.send(request)
    return 1e3 * (time.perf_counter() - start)


def main() -> None:
    """Measure and print."""
    options = parser(__doc__ or "").parse_args()
    runs = 2_000 if options.quick else 100_000
    peaks: dict[str, float] = {}
    waits: dict[str, list[float]] = {"progress": [], "list": []}
    with (
        TemporaryDirectory(prefix="lagid-") as folder,
        run_embedded_service(Path(folder) / "data") as url,
        Client(url) as client,
    ):
        path = paper_example.write_csv(Path(folder) / "record.csv", seed=1)
        dataset = client.add_dataset(path, name="example 1")["id"]
        client.wait(client.submit(paper_example.job(dataset, seed=0))["id"])
        begun = time.perf_counter()
        job = client.submit(body(dataset, runs))["id"]
        submitted = time.perf_counter() - begun
        state = "queued"
        while state in ("queued", "running"):
            time.sleep(BETWEEN_SECONDS)
            waits["progress"].append(milliseconds(client, call("GET /v1/jobs/{}", job)))
            waits["list"].append(milliseconds(client, call("GET /v1/jobs/{}/runs", job, limit=50)))
            for name, size in memory_megabytes().items():
                peaks[name] = max(peaks.get(name, 0.0), size)
            state = client.job(job)["state"]
        whole = time.perf_counter() - begun
    rows = [
        Row(f"{name}: peak (PSS), a job of {runs:,} runs", peaks[name], "MB", bar)
        for name, bar in BARS_MB.items()
    ]
    for name, measured in waits.items():
        rows.append(
            Row(f"request of {name} meanwhile: median", statistics.median(measured), "ms", 50)
        )
    rows.append(Row("submission", submitted, "s"))
    rows.append(Row("submission to the last stored result", whole, "s"))
    report("Memory", rows, [], options)


if __name__ == "__main__":
    main()
