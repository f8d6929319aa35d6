"""Measure how long a user waits: a job over REST, the whole command, a new model."""

import os
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks import paper_example
from benchmarks.table import Row, parser, report
from service.client.client import Client
from service.client.embedded import run_embedded_service
from sysid.core.code_cache import find_cache_folder

POLL_SECONDS = 0.004
"""Between two looks at the job; half of it is in every figure."""

NEVER_SEEN = """
import time, sys
import sysid.identification.identify, numpy as np
from sysid import load_model
from sysid.simulation.problem import Problem
from sysid.data.records import Channel
from sysid.data.records import Record
t = 0.1 * np.arange(300)
record = Record((Channel("u", t, np.cos(t), "1"),), (Channel("y", t, np.sin(t), "1"),))
start = time.perf_counter()
model = load_model({
    "name": "new", "form": "differential", "inputs": {"u": "1"}, "states": {"x": "1", "v": "1/s"},
    "parameters": {n: {"lower": 0, "upper": 2} for n in ("p", "q", "r", "L")},
    "equations": {"x": "v", "v": "p*tanh(u(t - L)) - q*v - r*x*abs(x(t - L))"},
    "outputs": {"y": "x"}, "initial": {"x": 0, "v": 0}})
Problem.build(model, [record]).evaluate_fitness(np.ones((50, 4)))
print(time.perf_counter() - start)
"""


def over_rest(count: int) -> list[Row]:
    """From the submission of a paper-size job to its stored result, on a warm service."""
    waits = []
    with (
        TemporaryDirectory(prefix="lagid-") as folder,
        run_embedded_service(Path(folder) / "data") as url,
        Client(url) as client,
    ):
        path = paper_example.write_csv(Path(folder) / "record.csv", seed=1)
        dataset = client.add_dataset(path, name="example 1")["id"]
        for number in range(count + 3):  # the first ones warm the workers
            start = time.perf_counter()
            job = client.submit(paper_example.job(dataset, seed=number))["id"]
            while client.job(job)["state"] in ("queued", "running"):
                time.sleep(POLL_SECONDS)
            waits.append(1e3 * (time.perf_counter() - start))
    waits = sorted(waits[3:])
    return [
        Row("paper-size job over REST: median", statistics.median(waits), "ms", 150),
        Row("paper-size job over REST: nine in ten within", waits[int(0.9 * len(waits))], "ms"),
    ]


def whole_command(count: int) -> list[Row]:
    """`lagid identify` from the shell, with everything compiled before."""
    command = [str(Path(sys.executable).with_name("lagid")), "identify"]
    waits, spent = [], []
    with TemporaryDirectory() as folder:
        path = paper_example.write_csv(Path(folder) / "record.csv", seed=1)
        for _ in range(count + 1):
            start, before = time.perf_counter(), _children_seconds()
            arguments = [*command, str(path), "--model", "duffing-eq16"]
            subprocess.run(arguments, check=True, capture_output=True)
            waits.append(time.perf_counter() - start)
            spent.append(_children_seconds() - before)
    return [
        Row("lagid identify, whole command: median", statistics.median(waits[1:]), "s", 1.2),
        Row("lagid identify, its CPU: median", statistics.median(spent[1:]), "s"),
    ]


def _children_seconds() -> float:
    """CPU of the commands that have ended: what a busy machine does not lengthen by much."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def never_seen(count: int) -> list[Row]:
    """From equations to the first fitness of a population, in a new process each time."""
    cold: list[float] = []
    cached: list[float] = []
    for _ in range(count):
        with TemporaryDirectory() as folder:
            environment = {
                "NUMBA_CACHE_DIR": str(find_cache_folder()),  # the search is no part of a model
                **os.environ,
                "LAGID_CACHE_DIR": folder,
            }
            for seconds in (cold, cached):
                ran = subprocess.run(
                    [sys.executable, "-c", NEVER_SEEN],
                    env=environment,
                    check=True,
                    capture_output=True,
                    text=True,
                )
                seconds.append(float(ran.stdout))
    return [
        Row("model never seen: equations to first fitness", statistics.median(cold), "s", 3.0),
        Row("the same in another process, from the cache", statistics.median(cached), "s", 0.2),
    ]


def main() -> None:
    """Measure and print."""
    options = parser(__doc__ or "").parse_args()
    few = options.quick
    rows = [*never_seen(3 if few else 7), *whole_command(3 if few else 9)]
    report("Latency", [*rows, *over_rest(10 if few else 50)], [], options)


if __name__ == "__main__":
    main()
