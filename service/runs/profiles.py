"""Use case: profile likelihood of a run's parameters, computed when somebody asks.

It runs in a thread of the web process, beside other requests; what would take long is refused
before it begins, what does take long is stopped, and there is one at a time.
"""

from collections.abc import Iterator
from threading import Lock
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np

from service.core.errors import Conflict, InvalidRequest
from service.jobs.stored_run import StoredRun, load_estimated_run
from service.runs.schemas import ProfileIn, ProfileOut, Profiles
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from sysid.core.errors import nearest
from sysid.core.types import FloatArray

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
        stored = load_estimated_run(session, run_id, "profile")
        problem = stored.problem(session, store)
    theta = _estimate(problem, stored)
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
    free = problem.free_names
    for place, name in enumerate(body.parameters or ()):
        if name not in free:
            raise InvalidRequest.at(
                f"/parameters/{place}", f"the run has no free parameter {name!r}"
                f"{nearest(name, free)}",
            )  # fmt: skip
    return list(dict.fromkeys(body.parameters or free))


def _computed(
    problem: "Problem", theta: FloatArray, names: list[str], points: int
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
        others = [free for free in problem.free_names if free != name]
        yield ProfileOut.from_source(
            found,
            name=name,
            interval95=found.interval,
            others=dict(zip(others, found.others.T.tolist(), strict=True)),
            **{key: getattr(found, key).tolist() for key in ("values", "ratio", "rms")},
        )


def _estimate(problem: "Problem", stored: StoredRun) -> FloatArray:
    values = {one["name"]: one["value"] for one in stored.estimates}
    return np.array([values[name] for name in problem.free_names])
