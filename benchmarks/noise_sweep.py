"""Measure a noise sweep through the service (Figure 15), from submission to stored results.

On a shared machine the wall clock says little. So the program also prints the CPU seconds of each
kind of process, and the time on two evenly loaded cores. The share of CPU time in compiled loops
(search, least squares, simulations) comes from runs of the same kind, timed call by call.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

from benchmarks import paper_example
from benchmarks.family import cpu_seconds
from benchmarks.table import Row, parser, report
from service.client.client import Client
from service.client.embedded import run_embedded_service
from sysid.core.settings import GeneticAlgorithm
from sysid.data.noise import Noise, add_output_noise
from sysid.identification.identify import identify
from sysid.islands import evolve
from sysid.models.catalogue.load import load_model
from sysid.search import least_squares
from sysid.simulation import problem
from sysid.uncertainty import sensitivities

SIGMAS = [round(0.05 * i, 2) for i in range(21)]
METHODS = ["simple", "improved"]
COMPILED: Sequence[tuple[Any, str]] = (
    (evolve, "_run_epochs"),
    (least_squares, "_run_steps"),
    (problem, "evaluate_population"),
    (problem, "predict_population"),
    (sensitivities, "_compute_central_differences"),
)
"""Where Python enters compiled loops during a run: search, least squares, simulations, slopes."""


def body(dataset: str, replicates: int) -> dict[str, Any]:
    """The sweep as one job: σ × replicates × methods; a replicate has noise of its own."""
    return {
        "name": "noise sweep",
        "model": "duffing-eq16",
        "datasets": [dataset],
        "sweep": {
            "axes": [
                {"path": "/noise/sigma", "values": SIGMAS},
                {"path": "/noise/seed", "range": [0, replicates], "zip": "replicate"},
                {"path": "/seed", "range": [0, replicates], "zip": "replicate"},
                {"path": "/algorithm/method", "values": METHODS},
            ]
        },
    }


def compiled_seconds(count: int) -> float:
    """CPU seconds that a run of the sweep spends in compiled loops, mean over `count` draws."""
    model, clean, spent = load_model("duffing-eq16"), paper_example.record(1), 0.0

    def run_cell(sigma: float, method: str, draw: int) -> None:
        noisy = add_output_noise(clean, Noise(sigma, draw))
        identify(model, noisy, GeneticAlgorithm(method=method), seed=draw)  # type: ignore[arg-type]

    def timed(inner: Callable[..., Any]) -> Callable[..., Any]:
        def called(*arguments: Any) -> Any:
            nonlocal spent
            start = time.process_time()
            result = inner(*arguments)
            spent += time.process_time() - start
            return result

        return called

    run_cell(0.0, METHODS[-1], 0)  # loads what is compiled
    with ExitStack() as patches:
        for module, name in COMPILED:
            patches.enter_context(patch.object(module, name, timed(getattr(module, name))))
        cells = [*product(SIGMAS, METHODS, range(count))]
        for cell in cells:
            run_cell(*cell)
    return spent / len(cells)


def main() -> None:
    """Measure and print."""
    options = parser(__doc__ or "").parse_args()
    replicates = 5 if options.quick else 100
    with (
        TemporaryDirectory(prefix="lagid-") as folder,
        run_embedded_service(Path(folder) / "data") as url,
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
        Row(
            f"{runs} identifications: submission to stored results",
            wall,
            "s",
            60.0 if not options.quick else None,
        ),
        Row("the same for 4,200 at this pace", wall * 4200 / runs, "s", 60.0),
    ]
    used = {name: seconds - before.get(name, 0.0) for name, seconds in sorted(spent.items())}
    used.pop("this program", None)
    rows += [
        Row(f"CPU of {name}", seconds, "s") for name, seconds in used.items() if seconds > 0.05
    ]
    whole = sum(used.values())
    inside = compiled_seconds(1 if options.quick else 5) * runs
    rows += [
        Row("CPU of a run", 1e3 * whole / runs, "ms"),
        Row("CPU of 4,200 over two cores", whole * 4200 / runs / 2, "s"),
        Row("share of that in compiled loops", 100 * inside / whole, "%", 85.0, ">="),
        Row("share of the workers' in compiled loops", 100 * inside / used["workers"], "%"),
    ]
    report("Noise sweep", rows, [], options)


if __name__ == "__main__":
    main()
