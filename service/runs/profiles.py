"""Use case: profile likelihood of a run's parameters, computed on request.

It runs in a thread of the web process, in parallel with other requests. Work that would take too
long is refused, or stopped when it does. A project has one profile at a time.
"""

from collections.abc import Callable, Iterator
from functools import partial
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np

from service.core.errors import Conflict, InvalidRequest, ServiceBusy
from service.core.process.concurrency import FairPlaces
from service.jobs.stored_run import StoredRun, load_estimated_run
from service.queue.daily_limit import check_budget, count_evaluations
from service.runs.run_schemas import ProfileIn, ProfileOut, RunProfilesOut
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from sysid.core.errors import suggest_name
from sysid.core.types import FloatArray

if TYPE_CHECKING:
    from sysid.simulation.problem import Problem

MAX_WORK = 300_000_000  # `measure_work` × points × profiles
LIMIT_SECONDS = 45.0  # a client waits a minute
CHI_SQUARED_95 = 3.841458820694124
"""As in `sysid.uncertainty.profile_likelihood`, which needs a compiler."""
_places = FairPlaces(2, 1, waiting=0, what="profiles")
"""One profile of a project at a time: each takes a core for up to `LIMIT_SECONDS`."""


def compute_profiles(
    database: Database, store: ObjectStore, run_id: str, body: ProfileIn
) -> RunProfilesOut:
    """Compute the profiles of some parameters of a run, by default of all free ones.

    Raises
    ------
    NotFound
        If there is no such run.
    Conflict
        If the run has no estimates, or another profile is being computed.
    InvalidRequest
        If a name is not that of a free parameter, or the work is too much.
    """
    with database.read_session() as session:
        stored = load_estimated_run(session, run_id, "profile")
        problem = stored.problem(session, store)
    theta = read_estimate(problem, stored)
    names = _choose_parameters(problem, body)
    work = measure_work(problem) * body.points * len(names)
    if work > MAX_WORK:
        raise InvalidRequest.from_fault(
            "/parameters",
            f"{len(names)} profiles of {body.points} points are too much work for this run. "
            f"Steps × parameters × points × profiles is {work:.3g}; need at most "
            f"{MAX_WORK:.3g}. "
            "Ask for fewer, or use sysid.uncertainty.profile_likelihood.compute_profile",
        )
    check_budget(database)
    count = partial(count_evaluations, database)
    try:
        with _places.hold(database.owner.project_id):
            profiles = list(_profile_parameters(problem, theta, names, body.points, count))
    except ServiceBusy:
        raise Conflict("another profile is being computed. Ask again when it is done") from None
    return RunProfilesOut(id=run_id, threshold=CHI_SQUARED_95, profiles=profiles)


def _choose_parameters(problem: "Problem", body: ProfileIn) -> list[str]:
    free = problem.free_names
    for index, name in enumerate(body.parameters or ()):
        if name not in free:
            raise InvalidRequest.from_fault(
                f"/parameters/{index}",
                f"the run has no free parameter {name!r}{suggest_name(name, free)}",
            )
    return list(dict.fromkeys(body.parameters or free))


def _profile_parameters(
    problem: "Problem",
    theta: FloatArray,
    names: list[str],
    points: int,
    count: Callable[[int], None],
) -> Iterator[ProfileOut]:
    # This imports the compiler, which most requests never need.
    from sysid.uncertainty.profile_likelihood import compute_profile

    end = monotonic() + LIMIT_SECONDS
    for name in names:
        profile = compute_profile(problem, theta, name, points, lambda: monotonic() > end)
        count(profile.evaluations)
        if not profile.is_complete:
            raise InvalidRequest.from_fault(
                "/parameters",
                f"the profiles took more than {LIMIT_SECONDS:g} s and were stopped at {name!r}. "
                "Ask for fewer parameters or points, or use "
                "sysid.uncertainty.profile_likelihood.compute_profile",
            )
        others = [free for free in problem.free_names if free != name]
        yield ProfileOut.from_source(
            profile,
            name=name,
            interval95=profile.interval,
            others=dict(zip(others, profile.others.T.tolist(), strict=True)),
            values=profile.values.tolist(),
            ratio=profile.likelihood_ratio.tolist(),
            rms=profile.rms.tolist(),
        )


def measure_work(problem: "Problem") -> int:
    """Measure the work of all derivatives: integration steps, or values if more, × parameters.

    A model may have a thousand substeps, so its samples do not tell how long a simulation takes.
    """
    return max(problem.evaluator.n_measured, problem.n_steps) * len(problem.free_parameters)


def read_estimate(problem: "Problem", stored: StoredRun) -> FloatArray:
    """Read the estimates (D,) of a run's free parameters."""
    values = {estimate.name: estimate.value for estimate in stored.estimates}
    return np.array([values[name] for name in problem.free_names])
