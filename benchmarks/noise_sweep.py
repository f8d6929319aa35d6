"""A noise-sensitivity sweep through the service (Figure 15): from submission to stored results."""

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks import paper_example
from benchmarks.family import cpu_seconds
from benchmarks.table import Row, parser, report
from service.client import Client
from service.embedded import embedded_service

SIGMAS = [round(0.05 * i, 2) for i in range(21)]
METHODS = ["simple", "improved"]


def body(dataset: str, replicates: int) -> dict[str, Any]:
    """The sweep as one job: σ × replicates × methods; a replicate has noise of its own."""
    return {
        "name": "noise sweep", "model": "duffing-eq16", "datasets": [dataset],
        "sweep": {
            "axes": [
                {"path": "/noise/sigma", "values": SIGMAS},
                {"path": "/noise/seed", "range": [0, replicates], "zip": "replicate"},
                {"path": "/seed", "range": [0, replicates], "zip": "replicate"},
                {"path": "/algorithm/method", "values": METHODS},
            ]
        },
    }  # fmt: skip


def main() -> None:
    """Measure and print."""
    options = parser(__doc__ or "").parse_args()
    replicates = 5 if options.quick else 100
    with (
        TemporaryDirectory(prefix="lagid-") as folder,
        embedded_service(Path(folder) / "data") as url,
        Client(url) as client,
    ):
        path = paper_example.write_csv(Path(folder) / "record.csv", seed=1)
        dataset = client.add_dataset(path, name="example 1")["id"]
        client.wait(client.submit(paper_example.job(dataset, seed=0))["id"])  # workers are warm
        before = cpu_seconds()
        start = time.perf_counter()
        job = client.submit(body(dataset, replicates))["id"]
        submitted = time.perf_counter()
        ended = client.wait(job)
        done = time.perf_counter()
        spent = cpu_seconds()
    runs = ended["progress"]["runs"]
    wall = done - start
    rows = [
        Row(f"{runs} identifications: submission", submitted - start, "s"),
        Row(f"{runs} identifications: submission to stored results", wall, "s",
            60.0 if not options.quick else None),
        Row("the same for 4,200 at this pace", wall * 4200 / runs, "s", 60.0),
    ]  # fmt: skip
    for name, seconds in sorted(spent.items()):
        used = seconds - before.get(name, 0.0)
        if used > 0.05:
            rows.append(Row(f"CPU of {name}", used, "s"))
    report("Noise sweep", rows, [], options)


if __name__ == "__main__":
    main()
