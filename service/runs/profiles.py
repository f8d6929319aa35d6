"""Use case: profile likelihood of a run's parameters, computed when somebody asks.

It runs in a thread of the web process, beside other requests; what would take long is refused
before it begins, what does take long is stopped, and there is one at a time.
"""

from collections.abc import Iterator, Mapping
from threading import Lock
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import Conflict, InvalidRequest
from service.core.json_pointer import body_of
from service.datasets.recordings import recording_of
from service.jobs.to_core import loss_of, noise_model_of
from service.models.models import model_of_run
from service.repositories.datasets import DatasetRepository
from service.repositories.jobs import JobRepository
from service.repositories.runs import RunRepository
from service.runs.schemas import ProfileIn, ProfileOut, Profiles
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from service.storage.tables import Job, Run
from sysid.core.errors import InvalidSettings, nearest
from sysid.data.noise import Noise, with_noise
from sysid.data.records import Record
from sysid.data.splitting import split_record
from sysid.models.model import Model, initial_parameters

if TYPE_CHECKING:
    from sysid.simulation.problem import Problem


MOST_WORK = 300_000_000  # measured values times parameters, points and profiles
SECONDS = 45.0  # a client waits a minute
QUANTILE = 3.841458820694124  # as in sysid.uncertainty.profile_likelihood, which needs a compiler

_one_at_a_time = Lock()


def profiles(database: Database, store: ObjectStore, run_id: str, body: ProfileIn) -> Profiles:
    """Profiles of some parameters of a run, of all free ones if none is named.

    Raises
    ------
    NotFound
        If there is no such run.
    Conflict
        If the run has no estimates, or another profile is being computed.
    InvalidRequest
        If a name is not that of a free parameter, or the work is too much.
    """
    with database.read() as session:
        problem, theta = _problem(session, store, run_id)
    names = _names(problem, body)
    work = problem.evaluator.n_measured * len(problem.space) * body.points * len(names)
    if work > MOST_WORK:
        raise InvalidRequest.at(
            "/parameters",
            f"{len(names)} profiles of {body.points} points are too much for this run: samples "
            f"times parameters, points and profiles is {work:.3g}; need at most {MOST_WORK:.3g}. "
            "Ask for fewer, or use sysid.uncertainty.profile_likelihood.profile",
        )
    if not _one_at_a_time.acquire(blocking=False):
        raise Conflict("another profile is being computed; ask again when it is done")
    try:
        found = list(_computed(problem, theta, names, body.points))
    finally:
        _one_at_a_time.release()
    return Profiles(id=run_id, threshold=QUANTILE, profiles=found)


def _names(problem: "Problem", body: ProfileIn) -> list[str]:
    free = [p.name for p in problem.space]
    for place, name in enumerate(body.parameters or ()):
        if name not in free:
            raise InvalidRequest.at(
                f"/parameters/{place}", f"the run has no free parameter {name!r}"
                f"{nearest(name, free)}",
            )  # fmt: skip
    return list(dict.fromkeys(body.parameters or free))


def _computed(
    problem: "Problem", theta: Any, names: list[str], points: int
) -> Iterator[ProfileOut]:
    # The compiler comes with this import, and most requests never need it.
    from sysid.uncertainty.profile_likelihood import profile

    end = monotonic() + SECONDS
    for name in names:
        found = profile(problem, theta, name, points, lambda: monotonic() > end)
        if not found.is_complete:
            raise InvalidRequest.at(
                "/parameters",
                f"the profiles took more than {SECONDS:g} s and were stopped at {name!r}; ask for "
                "fewer parameters or points, or use sysid.uncertainty.profile_likelihood.profile",
            )
        others = [p.name for p in problem.space if p.name != name]
        yield ProfileOut.from_source(
            found,
            name=name,
            interval95=found.interval,
            others=dict(zip(others, found.others.T.tolist(), strict=True)),
            **{key: getattr(found, key).tolist() for key in ("values", "ratio", "rms")},
        )


def _problem(session: Session, store: ObjectStore, run_id: str) -> "tuple[Problem, Any]":
    """The problem that the run solved, and its estimate."""
    from sysid.simulation.problem import Problem

    run = RunRepository(session).get(run_id)
    if run.result is None or not run.result.get("parameters"):
        raise Conflict(f"run {run_id} is {run.state.value} and has no estimates to profile")
    job = JobRepository(session).get(run.job_id)
    body = body_of(job.spec, run.cell)
    model = model_of_run(session, run, job)
    records = _records(session, store, body, model, job)
    known = {p.name for p in (*model.parameters, *initial_parameters(model, len(records)))}
    changes = {name: fields for name, fields in body["parameters"].items() if name in known}
    try:
        problem = Problem.build(
            model, records, parameters=changes, prediction=body["prediction"],
            loss=loss_of({**body["loss"], "noise_model": noise_model_of(run.result)}),
            weights=body["weights"], skip=body["skip"],
        )  # fmt: skip
    except InvalidSettings as error:  # a job of an older version, with rules that were others
        raise Conflict(f"run {run_id} cannot be profiled: {error}") from error
    return problem, _estimate(problem, run)


def _estimate(problem: "Problem", run: Run) -> Any:
    values = {one["name"]: one["value"] for one in (run.result or {})["parameters"]}
    return np.array([values[p.name] for p in problem.space])


def _records(
    session: Session, store: ObjectStore, body: Mapping[str, Any], model: Model, job: Job
) -> list[Record]:
    """The records that the run was fitted to."""
    channels, noise = body["channels"], body["noise"]
    inputs, outputs = (
        {one.name: channels.get(one.name, one.name) for one in group}
        for group in (model.inputs, model.outputs)
    )
    holds = {channels.get(name, name): hold for name, hold in body["hold"].items()}
    rows = DatasetRepository(session, job.project_id).get_all(body["datasets"])
    records = [
        record
        for row in rows
        for record in recording_of(store, row.sha256).held(holds).records(inputs, outputs, row.name)
    ]
    fraction = (body["validation"] or {}).get("fraction")
    if fraction is not None:
        records = [split_record(record, fraction)[0] for record in records]
    added = Noise(float(noise["sigma"]), int(noise["seed"]))
    return [with_noise(record, added, number) for number, record in enumerate(records)]
