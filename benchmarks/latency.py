"""Measure how long a user waits: a job over REST, the whole command, a new model.

What is said of an estimate is measured beside it: the search, the conclusion of a sweep's run, and
the parts that a single run has more, each as a share of search and conclusion.
"""

import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from math import exp
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.signal import lfilter

from benchmarks import paper_example
from benchmarks.table import Row, parser, report
from service.client.client import Client
from service.client.embedded import run_embedded_service
from sysid.core.code_cache import find_cache_folder
from sysid.core.settings import GeneticAlgorithm
from sysid.core.threads import use_one_thread
from sysid.data.records import Channel, Record
from sysid.identification.conclude import conclude_run
from sysid.identification.run import advance_run, begin_run, is_finished
from sysid.islands.run_state import RunState
from sysid.judgement.judge import explain_residuals
from sysid.judgement.process_order import compare_orders
from sysid.judgement.residual_context import ResidualContext
from sysid.judgement.starts import compare_starts
from sysid.judgement.yardstick import fit_yardstick
from sysid.models.catalogue.load import load_model
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate

_Value = TypeVar("_Value")

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


class Judged(NamedTuple):
    """A first-order plant with a dead time, recorded under noise of some colour."""

    name: str
    samples: int
    colour: float

    def draw(self) -> Record:
        """Draw the record, with levels of 8 samples."""
        random, n = np.random.default_rng(self.samples), self.samples
        u = np.repeat(random.uniform(-1.0, 1.0, n // 8 + 1), 8)[:n]
        u[:8] = 0.0
        late, decay = np.concatenate([np.zeros(5), u[:-5]]), exp(-0.1 / 1.5)
        y = lfilter([0.0, 2.0 * (1.0 - decay)], [1.0, -decay], late)
        y += lfilter([1.0], [1.0, -self.colour], random.normal(0.0, 0.03, n))
        times = 0.1 * np.arange(n)
        return Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))


JUDGED = (
    Judged("300 samples, white", 300, 0.0),
    Judged("2,000 samples, coloured", 2000, 0.9),
    Judged("20,000 samples, coloured", 20_000, 0.9),
)


def judgement(count: int) -> list[Row]:
    """Processor time of the judgement of an identification, part by part."""
    rows = []
    for one in JUDGED:
        problem = Problem.build(load_model("fopdt"), [one.draw()])
        spent = [_spend_on(problem, seed) for seed in range(count + 1)][1:]
        plain = [each["search"] + each["conclusion of a sweep's run"] for each in spent]
        for part in spent[0]:
            shares = [each[part] / whole for each, whole in zip(spent, plain, strict=True)]
            rows.append(Row(f"{one.name}: {part}", 100 * statistics.median(shares), "%"))
        rows.append(Row(f"{one.name}: both", 1e3 * statistics.median(plain), "ms"))
    return rows


def _spend_on(problem: Problem, seed: int) -> dict[str, float]:
    """Measure the processor time (s) of the steps of an identification."""
    algorithm, spent = GeneticAlgorithm(), dict[str, float]()

    def spend(part: str, work: Callable[[], _Value]) -> _Value:
        start = time.process_time()
        value = work()
        spent[part] = time.process_time() - start
        return value

    state = spend("search", lambda: _search(problem, algorithm, seed))
    swept = spend("conclusion of a sweep's run", lambda: conclude_run(problem, algorithm, state))
    spend(
        "conclusion of a single run", lambda: conclude_run(problem, algorithm, state, orders=True)
    )
    theta = np.array([swept[name].value for name in problem.free_names])
    with use_one_thread():
        analysis = analyse_estimate(problem, theta)
        simulated = problem.predict(theta[None])[0]
        context = ResidualContext(problem, theta, analysis)
        spend("explanations of the residuals", lambda: explain_residuals(context))
        spend("starts", lambda: compare_starts(problem, theta))
        spend("orders", lambda: compare_orders(problem, theta, analysis.estimates))
        spend("yardstick", lambda: fit_yardstick(problem, simulated))
    return spent


def _search(problem: Problem, algorithm: GeneticAlgorithm, seed: int) -> RunState:
    state = begin_run(problem, algorithm, seed, None)
    while not is_finished(algorithm, state):
        state = advance_run(problem, algorithm, state, 1.0)
    return state


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--judgement", action="store_true", help="nothing but the judgement")
    options = arguments.parse_args()
    few = options.quick
    judged = judgement(3 if few else 7)
    if options.judgement:
        report("Judgement", judged, [], options)
        return
    rows = [*judged, *never_seen(3 if few else 7), *whole_command(3 if few else 9)]
    report("Latency", [*rows, *over_rest(10 if few else 50)], [], options)


if __name__ == "__main__":
    main()
