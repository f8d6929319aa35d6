"""Small identifications for tests of workers and dispatcher."""

import pickle
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from sysid.core.settings import FitSettings, GeneticAlgorithm, Stop
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.islands.run_state import RunState
from sysid.models.catalogue.load import copy_catalogue_document
from sysid.results.identification import Identification
from tests.support.limits import LIMIT_SECONDS
from workers.protocol import (
    CompleteRun,
    Executor,
    InvalidRun,
    ProblemSpec,
    QueuedRun,
    Records,
    RunFailure,
    RunSpec,
)
from workers.scheduler import Scheduler


def step_record(n: int = 120, delay: float = 0.7, seed: int = 3) -> Record:
    """First order plus dead time, excited by random steps, with a little noise."""
    draw = np.random.default_rng(seed)
    times: FloatArray = np.arange(n, dtype=np.float64) * 0.1
    u = np.repeat(draw.integers(0, 2, n // 10 + 1), 10)[:n].astype(np.float64)
    y, state = np.empty(n), 0.0
    lag = round(delay / 0.1)
    for k in range(n):
        y[k] = state
        state += 0.1 * ((2.0 * u[max(k - lag, 0)] if k >= lag else 0.0) - state) / 0.8
    y += draw.normal(0.0, 0.01, n)
    return Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))


RECORDS: Mapping[str, Records] = {"short": (step_record(),), "long": (step_record(4000),)}


def spec(
    seed: int = 1, records: str = "short", generations: int = 60, **settings: object
) -> RunSpec:
    """A small search with two islands, as long as it is told to be."""
    algorithm = GeneticAlgorithm(
        **{
            "population": 16,
            "generations": generations,
            "islands": 2,
            "stop": Stop(settled=None),
            **settings,
        }  # type: ignore[arg-type]
    )
    parameters = {"T": {"upper": 10.0}, "L": {"upper": 2.0}}
    fit = FitSettings(parameters)
    problem = ProblemSpec(copy_catalogue_document("fopdt"), records, settings=fit)
    return RunSpec(problem, algorithm, seed)


class ListedRuns:
    """A job's runs as a list; implements `workers.protocol.JobSource`."""

    def __init__(self, runs: Iterable[QueuedRun | InvalidRun]) -> None:
        self._runs = list(runs)

    def iterate_runs(self) -> Iterator[QueuedRun | InvalidRun]:
        yield from self._runs

    def load_records(self, key: str) -> Records:
        return RECORDS[key]


def encode_runs(complete: Sequence[CompleteRun], records: Mapping[str, Records]) -> bytes:
    """Encode runs whole, so that a test can look at them."""
    return pickle.dumps([(run.run, run.concluded.identification) for run in complete])


class Notebook:
    """Keeps what it is told; implements `workers.protocol.RunObserver`."""

    def __init__(self) -> None:
        self.encoder = encode_runs
        self.begun: list[str] = []
        self.states: dict[str, list[RunState]] = {}
        self.results: dict[str, list[Identification]] = {}
        self.failures: dict[str, list[RunFailure]] = {}
        self.kills: dict[str, list[int]] = {}
        self.told: list[str] = []
        self.is_stopped = False

    def record_start(self, run: str) -> None:
        self.begun.append(run)

    def record_silent_worker(self, text: str) -> None:
        self.told.append(text)

    def record_delay(self, reason: str) -> None:
        self.told.append(reason)

    def record_worker_death(self, run: str, kills: int) -> None:
        self.kills.setdefault(run, []).append(kills)

    def record_progress(self, run: str, state: RunState, seconds: float) -> None:
        self.states.setdefault(run, []).append(state)

    def record_results(self, encoded: bytes) -> None:
        for run, identification in pickle.loads(encoded):
            self.results.setdefault(run, []).append(identification)

    def record_failure(self, run: str, failure: RunFailure) -> None:
        self.failures.setdefault(run, []).append(failure)

    def record_reuse(self, run: str, source: str) -> None:
        raise AssertionError("no run was computed before")

    def should_stop(self) -> bool:
        return self.is_stopped


def carry_out(executor: Executor, specs: Mapping[str, RunSpec]) -> Notebook:
    """Feed one job of these runs to the executor until it has ended."""
    feeder, notebook = Scheduler(executor), Notebook()
    feeder.add_job("job", ListedRuns(QueuedRun(run, one) for run, one in specs.items()), notebook)
    limit = time.monotonic() + LIMIT_SECONDS
    while time.monotonic() < limit:
        if feeder.run_step(0.05):
            return notebook
    raise AssertionError("the job did not end")


def bits(found: Identification) -> tuple[object, ...]:
    """Everything of a result that must not depend on where it was computed."""
    return (
        tuple((one.name, one.value, one.stderr) for one in found.parameters),
        found.rms,
        found.evaluations,
        found.generations,
        found.history,
        found.migrations,
        tuple(values.tobytes() for outputs in found.simulated for values in outputs),
    )
