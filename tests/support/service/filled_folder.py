"""A data folder as it looks after some use: jobs that ended well, run, failed, wait, and a sweep.

The rows are written by the repositories, as the dispatcher would write them. The numbers are made
up by a closed formula, so that every test run sees the same pages.
"""

import atexit
import io
import shutil
import tempfile
from dataclasses import dataclass
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from service.core.settings import Settings
from service.core.states import JobState
from service.datasets.datasets import add_recording
from service.formats.mcap.mcap_files import FitRole, FittedOutput, write_fitted_outputs
from service.jobs import submit
from service.jobs.job_schemas import JobIn
from service.queue.leases import Claim, JobProgress, LeaseQueue
from service.queue.run_writes import RunOutcome, RunWriter
from service.repositories.history_rows import HistoryPoint, MigrantPoint
from service.repositories.run_rows import RunRepository
from service.storage.objects import ObjectStore, open_store
from service.storage.sessions import Database
from sysid.core.findings import note
from sysid.core.value_documents import encode
from sysid.data.records import Channel, Recording
from tests.support.service.web_app import settings_of
from tests.support.storage.databases import open_migrated_sqlite
from tests.support.storage.run_results import write_result

MODEL = {
    "name": "lagged-tube",
    "title": "First-order lag behind a dead time",
    "form": "differential",
    "inputs": {"u": "kPa"},
    "states": {"y": "kPa"},
    "parameters": {
        "K": {"lower": 0, "upper": 2, "unit": "1"},
        "T": {"lower": 0.01, "upper": 2, "unit": "s", "scale": "log"},
        "L": {"lower": 0, "upper": 0.5, "unit": "s"},
    },
    "equations": {"y": "(K*u(t - L) - y)/T"},
    "outputs": {"p": "y"},
    "initial": {"y": 0},
}
TRUE = {"K": 1.0153, "T": 0.3489, "L": 0.1127}
SIGMA = 0.42
STEP = 0.01
NOTE = note(
    "ridge",
    "identifiability",
    "T and L have the correlation −0.78: T + L is better known than either",
)


@dataclass(frozen=True)
class FilledFolder:
    """Identifiers of what was written."""

    dataset: str
    finished: str
    finished_run: str
    running: str
    running_run: str
    failed: str
    queued: str
    sweep: str
    sweep_run: str
    lease: Claim


def copy_filled(folder: Path) -> FilledFolder:
    """Copy the data folder, which is filled once in a session."""
    template, filled = _make_template()
    shutil.copytree(template, folder, dirs_exist_ok=True)
    return filled


@cache
def _make_template() -> tuple[Path, FilledFolder]:
    folder = Path(tempfile.mkdtemp(prefix="lagid-filled-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    settings, database = settings_of(folder), open_migrated_sqlite(folder)
    filled = _fill(database, open_store(settings.store_location), settings)
    database.dispose()  # the last connection folds the write-ahead log into the file
    return folder, filled


def _fill(database: Database, store: ObjectStore, settings: Settings) -> FilledFolder:
    """Write everything; the job that runs can be driven on with `progress`."""
    recording = _recording()
    dataset = add_recording(
        database,
        store,
        recording,
        name="tube 40 m",
        kind="upload",
        key="tube",
        details={"warnings": []},
    ).dataset.id
    finished = _claim_job(database, settings, _body(dataset, "tube 40 m, pattern 1"))
    run = _end(database, store, finished, recording)
    sweep = _claim_job(database, settings, _body(dataset, "three methods, four seeds", sweep=True))
    _end_sweep(database, sweep)
    with database.write_session() as session:
        sweep_run = _first(session, sweep)
    failed = _claim_job(database, settings, _body(dataset, "a model that diverges"))
    with database.write_session() as session:
        reason = "the model diverges everywhere: no individual of 50 gave a finite output"
        ledger = RunWriter(session, failed.lease)
        ledger.record_outcomes(
            [RunOutcome(run_id=_first(session, failed), state=JobState.FAILED, error=reason)]
        )
        LeaseQueue(session).finish_job(failed.lease, JobState.FAILED, reason)
    running = _claim_job(database, settings, _body(dataset, "tube 80 m <b>live</b>"))
    with database.write_session() as session:
        running_run = _first(session, running)
        RunWriter(session, running.lease).start_runs([running_run])
    progress(database, running, running_run, 60)
    queued = submit.submit_job(database, _body(dataset, "tube 5 m, waits"), settings).id
    return FilledFolder(
        dataset,
        finished.job.id,
        run,
        running.job.id,
        running_run,
        failed.job.id,
        queued,
        sweep.job.id,
        sweep_run,
        running,
    )


def progress(database: Database, claim: Claim, run: str, generation: int) -> None:
    """Bring the running job to a generation."""
    with database.write_session() as session:
        points = [p for p in _history(run) if p.generation <= generation]
        RunWriter(session, claim.lease).append_history(points)
        now = JobProgress(50 * generation, generation, min(p.rms for p in points), 12.5)
        LeaseQueue(session).write_progress(claim.lease, now)


def end_running(database: Database, store: ObjectStore, claim: Claim) -> None:
    """Let the running job succeed."""
    _end(database, store, claim, _recording())


def _body(dataset: str, name: str, *, sweep: bool = False) -> JobIn:
    axes: list[dict[str, Any]] = [
        {"path": "/algorithm/method", "values": ["simple", "improved-paper", "improved"]},
        {"path": "/seed", "range": [1, 5]},
    ]
    return JobIn.model_validate(
        {
            "name": name,
            "model": MODEL,
            "datasets": [dataset],
            "channels": {"u": "P1", "p": "P2"},
            "validation": {"fraction": 0.3},
            "posterior": not sweep,
            "sweep": {"axes": axes if sweep else []},
        }
    )


def _recording() -> Recording:
    times = np.arange(3000) * STEP
    levels = np.array([100, 300, 480, 200, 400, 50, 350, 250, 450, 150.0])
    u = np.repeat(levels, 300)
    noise = SIGMA * np.random.default_rng(7).standard_normal(times.size)
    return Recording(
        (
            Channel("P1", times, u, "kPa", "zero"),
            Channel("P2", times, _simulate_tube(u) + noise, "kPa"),
        )
    )


def _simulate_tube(u: np.ndarray) -> np.ndarray:
    delay, pole = round(TRUE["L"] / STEP), np.exp(-STEP / TRUE["T"])
    y = np.zeros_like(u)
    for k in range(1, u.size):
        past = u[max(k - 1 - delay, 0)] if k > delay else u[0]
        y[k] = pole * y[k - 1] + (1 - pole) * TRUE["K"] * past
    return y


def _claim_job(database: Database, settings: Settings, body: JobIn) -> Claim:
    submit.submit_job(database, body, settings)
    with database.write_session() as session:
        claim = LeaseQueue(session).claim_job("test", timedelta(days=1))
    assert claim is not None
    return claim


def _first(session: Any, claim: Claim) -> str:
    return RunRepository(session).list_page(claim.job.id, limit=1).items[0].id


def _history(run: str, islands: int = 4, floor: float = SIGMA) -> list[HistoryPoint]:
    """Improvements that shrink towards `floor`, with sequence searches and a refinement."""
    found = []
    for island in range(islands):
        draws = np.random.default_rng(island)
        generation, rms = 0, 60.0 * (1 + 0.4 * island)
        for number in range(40):
            generation += int(draws.integers(1, 18)) if number else 0
            rms = floor + (rms - floor) * float(draws.uniform(0.55, 0.95)) if number else rms
            off = (rms - floor) / 80
            phase = ("genetic", "sequence", "migration")[0 if number < 12 else number % 3]
            if number == 39:
                phase = "refinement"
            values = [
                TRUE["K"] * (1 + 0.4 * off),
                TRUE["T"] * (1 + 1.5 * off * (-1) ** island),
                TRUE["L"] * (1 + 2 * off),
            ]
            found.append(
                HistoryPoint(
                    run,
                    island,
                    number,
                    min(generation, 400),
                    13 * min(generation, 400),
                    rms,
                    phase,
                    values,
                )
            )
    return found


def _result(rms: float = SIGMA) -> dict[str, Any]:
    stderr = {"K": 0.00007, "T": 0.00041, "L": 0.00023}
    bounds = MODEL["parameters"]
    assert isinstance(bounds, dict)
    parts = {
        "rms": rms,
        "rms_validation": None,
        "fit_percent": {"estimation": 98.1, "validation": None},
        "agreement": {"estimation": [_agreement(rms)], "validation": []},
        "evaluations": 20_000,
        "parameters": [
            {
                "name": name,
                "unit": bounds[name]["unit"],
                "value": value,
                "stderr": stderr[name],
                "lower": float(bounds[name]["lower"]),
                "upper": float(bounds[name]["upper"]),
                "interval95": [value - 1.96 * stderr[name], value + 1.96 * stderr[name]],
                "status": "identified",
                "reason": "",
            }
            for name, value in TRUE.items()
        ],
        "islands": [
            {
                "champion_rms": rms * (1 + 0.2 * i),
                "refined_rms": rms * (1 + 0.02 * i**3),
                "parameters": list(TRUE.values()),
                "evaluations": 5000,
            }
            for i in range(4)
        ],
        "correlation": {
            "names": ["K", "T", "L"],
            "matrix": [[1, 0.31, -0.05], [0.31, 1, -0.78], [-0.05, -0.78, 1]],
        },
        "posterior": _posterior(stderr),
        "criteria": {
            "aic": 2336.4,
            "aicc": 2336.5,
            "bic": 2359.0,
            "samples": 2100,
            "parameters": 3,
        },
        "identifiability": {
            "condition": 41.0,
            "singular_values": [8.1, 2.2, 0.2],
            "groups": [
                {"members": ["T", "L"], "expression": "T + L", "value": 0.4616, "stderr": 0.00014}
            ],
        },
        "residual_tests": {
            "data": "validation",
            "level": 0.05,
            "passed": True,
            "tests": [
                _make_test("whiteness", None, 0.96, 0.412),
                _make_test("independence", "u", 1.0, 0.077),
            ],
        },
        "onset_delays": [
            {
                "experiment": 0,
                "input": "u",
                "output": "p",
                "delay": 0.1197,
                "unit": "s",
                "spread": 0.0006,
                "events": 9,
                "threshold": 0.02,
                "reason": "",
            }
        ],
        "findings": [encode(NOTE)],
        "explained": True,
        "verdict": {"trust": "trustworthy", "text": "trustworthy"},
        "warnings": [NOTE.text],
    }
    return write_result(**parts)


def _posterior(stderr: dict[str, float]) -> dict[str, Any]:
    """Samples of a normal law around the true parameters."""
    values = [
        value + stderr[name] * np.random.default_rng(place).standard_normal(200)
        for place, (name, value) in enumerate(TRUE.items())
    ]
    return {
        "converged": True,
        "reason": "",
        "walkers": 8,
        "steps": 2000,
        "acceptance": 0.41,
        "evaluations": 16_000,
        "correlation": {"names": list(TRUE), "matrix": np.corrcoef(values).tolist()},
        "parameters": [
            {
                "name": name,
                "unit": str(MODEL["parameters"][name]["unit"]),  # type: ignore[index]
                "median": float(np.median(samples)),
                "interval95": np.quantile(samples, [0.025, 0.975]).tolist(),
                "effective_samples": 1712.4,
            }
            for name, samples in zip(TRUE, values, strict=True)
        ],
        "samples": np.column_stack(values).tolist(),
    }


def _agreement(rms: float) -> dict[str, Any]:
    return {
        "experiment": 0,
        "output": "p",
        "unit": "kPa",
        "samples": 2100,
        "rms": rms,
        "fit_percent": 98.1,
        "span": [0.0, 100.0],
    }


def _make_test(kind: str, signal: str | None, inside: float, p: float) -> dict[str, Any]:
    return {
        "experiment": 0,
        "output": "p",
        "test": kind,
        "input": signal,
        "outcome": "passed",
        "reason": "",
        "samples": 900,
        "lags_tested": 25,
        "inside95": inside,
        "inside99": 1.0,
        "statistic": 26.1,
        "degrees": 25.0,
        "p": p,
    }


def _end(database: Database, store: ObjectStore, claim: Claim, recording: Recording) -> str:
    u, y = recording.channel("P1"), recording.channel("P2")
    parts: list[tuple[FitRole, slice]] = [
        ("estimation", slice(0, 2100)),
        ("validation", slice(2100, None)),
    ]
    fits = [
        FittedOutput(
            role, 1, "p", "kPa", y.times[part], y.values[part], _simulate_tube(u.values)[part]
        )
        for role, part in parts
    ]
    with database.write_session() as session:
        run = _first(session, claim)
        target = io.BytesIO()
        write_fitted_outputs(fits, target)
        migrants = [MigrantPoint(run, n, 1 + n // 4, n % 4, (n + 1) % 4, 5.0) for n in range(60)]
        outcome = RunOutcome(
            run_id=run,
            state=JobState.SUCCEEDED,
            result=_result(),
            valid=True,
            best_rms=SIGMA,
            fit_estimation=99.71,
            fit_validation=99.68,
            evaluations=20_000,
            generations=400,
            seconds=0.184,
            signals_sha256=store.put_stream([target.getvalue()]).sha256,
        )
        ledger = RunWriter(session, claim.lease)
        ledger.record_outcomes([outcome], _history(run), migrants)
        queue = LeaseQueue(session)
        queue.append_event(claim.lease, "log", {"message": "compiled lagged-tube in 26 ms"})
        queue.write_progress(claim.lease, JobProgress(20_000, 400, SIGMA))
        queue.finish_job(claim.lease, JobState.SUCCEEDED)
    return run


def _end_sweep(database: Database, claim: Claim) -> None:
    with database.write_session() as session:
        runs = RunRepository(session).list_page(claim.job.id, limit=100).items
        outcomes = [
            RunOutcome(
                run_id=run.id,
                state=JobState.SUCCEEDED,
                result=_result(SIGMA * (1 + (7 * n) % 12)),
                valid=True,
                best_rms=SIGMA * (1 + (7 * n) % 12),
                fit_estimation=99.0 - n,
                fit_validation=98.0 - n,
                evaluations=20_000,
                generations=400,
                seconds=0.2,
            )
            for n, run in enumerate(runs)
        ]
        RunWriter(session, claim.lease).record_outcomes(
            outcomes, [p for r in runs for p in _history(r.id)]
        )
        LeaseQueue(session).write_progress(claim.lease, JobProgress(240_000, 400, SIGMA))
        LeaseQueue(session).finish_job(claim.lease, JobState.SUCCEEDED)
