"""Reference values and Cramér–Rao bounds for the runs of a job with noise.

A job may have several problems, for example axes over datasets or bounds. Each has its own true
values. Bounds are proportional to σ, so one bound per problem serves every σ.

The dispatcher computes them when all runs of the job have ended, so that the web process need not
(decision 15). It does so problem by problem in a background thread, to keep the workers busy
(`service.dispatch.background`).
"""

import logging
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.bodies.json_pointer import build_run_body
from service.core.bodies.user_documents import to_finite
from service.core.errors import ServiceError
from service.dispatch.background import DocumentMaker
from service.dispatch.job_parts import JobParts
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.summary_rows import find_quietest_run
from service.storage.columns import Document
from service.storage.retry import retry_transient
from service.storage.sessions import Database
from service.storage.storage_errors import StorageError
from service.storage.tables import Run
from service.sweeps.groups import GroupKey, SweepGroups
from service.sweeps.true_parameters import find_true_parameters
from sysid.core.errors import SysidError
from sysid.core.threads import use_one_thread
from sysid.core.types import FloatArray
from sysid.data.noise import Noise
from sysid.models.parse import parse_model
from sysid.models.starts import compares_starts
from sysid.simulation.problem import Problem
from sysid.simulation.start_values import list_starts
from sysid.uncertainty.cramer_rao import (
    CramerRaoBound,
    cramer_rao_bound,
    measures_its_recursion,
)
from workers.errors import RecordsDelayed, RecordsUnavailable
from workers.protocol import ProblemSpec
from workers.tasks import prepare_run_records

_log = logging.getLogger(__name__)

# Fields of a run that do not affect its reference values.
IRRELEVANT_FIELDS = (
    "/noise/sigma",
    "/noise/seed",
    "/seed",
    "/algorithm",
    "/loss",
    "/weights",
    "/prediction",
    "/warm_start",
)
MAX_PROBLEMS = 64
LEFT_OUT_NOTE = (
    f"the sweep has more than {MAX_PROBLEMS} different problems. Only the first {MAX_PROBLEMS} "
    "have Cramér–Rao bounds and reference values"
)
RETRY_SECONDS = 1.0
"""Pause before records are asked for again whose store is away."""
MAX_WORK = 10_000_000
"""Samples to simulate for the bounds of one job: below a second for most models."""


def build_bounds_maker(database: Database, parts: JobParts) -> DocumentMaker | None:
    """Return the steps that build the bounds document of a job; None for a job without noise.

    All runs of the job must have ended, and their results must be written. Each step handles one
    problem. The document has ``axes``, the paths that distinguish the problems, ``note`` on omitted
    problems, and ``problems``, each with

    - ``cell``: its values of the axes;
    - ``reference``: ``kind`` (``truth``, or ``estimate``: the best run at the smallest σ), the
      ``run`` and ``sigma`` of an estimate, and ``values`` by parameter; or null;
    - ``stderr``: the bound of each free parameter for σ = 1, null if there is none;
    - ``rms``: that of the response; null for noise inside the plant, which moves it;
    - ``note``: why something is missing, or nothing.
    """
    spec = parts.job.spec
    axes = spec["sweep"]["axes"]
    if not spec["noise"]["sigma"] and not any(axis["path"].startswith("/noise") for axis in axes):
        return None
    return _BoundsMaker(database, parts).iterate_steps


class _BoundsMaker:
    """Computes the bounds of one job within a limit of work."""

    def __init__(self, database: Database, parts: JobParts) -> None:
        self._database, self._job, self._parts = database, parts.job, parts
        self._left = MAX_WORK

    def iterate_steps(self) -> Iterator[Document | None]:
        """Yield None after each problem, and the document at the end."""
        axes = [
            axis["path"]
            for axis in self._job.spec["sweep"]["axes"]
            if not axis["path"].startswith(IRRELEVANT_FIELDS)
        ]
        keys = [GroupKey("axis", path) for path in axes]
        groups = SweepGroups(self._job.spec, keys, MAX_PROBLEMS)
        cells = [dict(zip(axes, key, strict=True)) for key in groups.keys]
        problems = []
        for cell in cells:
            while (problem := self._describe_problem(cell)) is None:
                yield None
                time.sleep(RETRY_SECONDS)
            problems.append(problem)
            yield None
        note = LEFT_OUT_NOTE if groups.is_cut else ""
        yield {"axes": axes, "problems": problems, "note": note}

    def _describe_problem(self, cell: Mapping[str, Any]) -> Document | None:
        """Describe the bounds of a cell; None if its records cannot be loaded now."""
        entry: Document = {
            "cell": dict(cell),
            "reference": None,
            "stderr": {},
            "rms": None,
            "note": "",
        }
        try:
            entry["reference"] = retry_transient(partial(self._read_reference, cell))
            if entry["reference"] is None:
                return {**entry, "note": "no run succeeded, so there is no reference for errors"}
            spec = self._parts.share_parts(cell).build_specification(cell).problem
            return {**entry, **self._compute_bounds(spec, entry["reference"]["values"])}
        except RecordsDelayed:
            return None
        except (SysidError, ServiceError, StorageError, RecordsUnavailable) as error:
            _log.warning("%s: no Cramér–Rao bound: %s", self._job.id, error)
            return {**entry, "note": f"no Cramér–Rao bound: {error}"}
        except Exception as error:  # noqa: BLE001 - the results must not be lost for a bound
            _log.exception("%s: no Cramér–Rao bound", self._job.id)
            return {**entry, "note": f"no Cramér–Rao bound: internal error: {type(error).__name__}"}

    def _read_reference(self, cell: Mapping[str, Any]) -> Document | None:
        with self._database.read_session() as session:
            return self._find_reference(session, cell)

    def _find_reference(self, session: Session, cell: Mapping[str, Any]) -> Document | None:
        body = build_run_body(self._job.spec, cell)
        rows = DatasetRepository(session, self._job.project_id).get_all(body["datasets"])
        true = find_true_parameters(session, body["model"], rows)
        if true is not None:
            return {"kind": "truth", "run": None, "sigma": None, "values": true}
        run: Run | None = find_quietest_run(session, self._job.id, cell, self._job.project_id)
        if run is None:
            return None
        values = {name: estimate["value"] for name, estimate in (run.estimates or {}).items()}
        return {"kind": "estimate", "run": run.id, "sigma": run.sigma, "values": values}

    def _compute_bounds(self, spec: ProblemSpec, values: Mapping[str, float]) -> Document:
        model = parse_model(spec.model)
        if model.rule is not None:
            return {"note": "no Cramér–Rao bound: the model selects its terms from the data"}
        is_inside = spec.noise.place == "plant"
        if is_inside and not measures_its_recursion(model):
            return {
                "note": "no Cramér–Rao bound: inside the plant there is one for recursions of one "
                "state that is measured"
            }
        records = {key: self._parts.load_records(key) for key in spec.record_keys}
        problem = Problem.build(
            model,
            prepare_run_records(replace(spec, noise=Noise()), records).estimation,
            parameters=dict(_widen_bounds(spec, values)),
            skip=spec.settings.skip,
            initial=spec.settings.initial,
            weights={output.name: 1.0 for output in model.outputs},
            prediction="one-step" if is_inside else "simulation",
        )
        problem = _take_rest(problem, values)
        unknown = [name for name in problem.free_names if name not in values]
        if unknown:
            return {"note": f"no Cramér–Rao bound: the value of {', '.join(unknown)} is unknown"}
        work = problem.n_scored * (2 * len(problem.free_parameters) + 1)
        if work > self._left:
            return {"note": "no Cramér–Rao bound: the records are too long"}
        self._left -= work
        theta: FloatArray = np.array([values[name] for name in problem.free_names])
        with use_one_thread():
            bounds = _to_bounds_document(cramer_rao_bound(problem, theta))
        return bounds | {"rms": None} if is_inside else bounds


def _take_rest(problem: Problem, values: Mapping[str, float]) -> Problem:
    """Take a start at rest if the data decide on it, and the values rest or say nothing of it."""
    if not compares_starts(problem.given_model, problem.settings.initial):
        return problem
    with suppress(SysidError, KeyError):  # the model has no rest, or a value is unknown
        rest = problem.rebuild(initial="rest")
        starts = list_starts(rest, np.array([values[name] for name in rest.free_names]))
        given = [(values.get(name, start), start) for name, start in starts.items()]
        if all(math.isclose(value, start, rel_tol=1e-9, abs_tol=1e-12) for value, start in given):
            return rest
    return problem


def _to_bounds_document(bound: CramerRaoBound) -> Document:
    stderr = {
        name: to_finite(value)
        for name, value in zip(bound.names, bound.stderr.tolist(), strict=True)
    }
    undetermined = [name for name, value in stderr.items() if value is None]
    note = (
        f"no Cramér–Rao bound: the data do not determine {', '.join(undetermined)}"
        if undetermined
        else ""
    )
    return {"stderr": stderr, "rms": to_finite(bound.response_rms), "note": note}


def _widen_bounds(
    spec: ProblemSpec, values: Mapping[str, float]
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Iterate over the parameter changes, with bounds widened to include the reference values."""
    parameters = parse_model(spec.model).parameters
    bounds = {p.name: (p.lower, p.upper) for p in parameters}
    follow_data = {p.name for p in parameters if p.bounds is not None}
    changes = spec.settings.parameters
    for name in {**bounds, **changes}:
        change = dict(changes.get(name, {}))
        lower, upper = bounds.get(name, (-math.inf, math.inf))
        lower, upper = change.get("lower", lower), change.get("upper", upper)
        value = values.get(name)
        is_outside = value is not None and not lower <= value <= upper
        if value is not None and "fixed" not in change and (is_outside or name in follow_data):
            change |= {"lower": min(lower, value), "upper": max(upper, value)}
        if change:
            yield name, change
