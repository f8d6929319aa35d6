"""Use case: estimated disturbances of a run with noise inside the plant, computed on request."""

from functools import partial
from typing import TYPE_CHECKING

from sqlalchemy.orm import Session

from service.core.bodies.user_documents import to_finite
from service.core.computed import ComputedValues
from service.core.errors import Conflict
from service.jobs.stored_run import StoredRun, load_estimated_run
from service.runs.bands import build_spread_fit
from service.runs.run_schemas import DisturbanceExperimentOut, DisturbanceOut, DisturbancesOut
from service.storage.objects import ObjectStore
from service.storage.sessions import release_connection
from sysid.core.types import FloatArray
from sysid.figures.theme import thin_indices

if TYPE_CHECKING:
    from sysid.uncertainty.disturbances import Disturbance

MAX_VALUES = 30_000_000  # of the filter at once: 240 MB
_CACHE_SIZE = 4  # runs: a zoom reads the same disturbances repeatedly
_computed_disturbances = ComputedValues(_CACHE_SIZE)


def load_disturbances(
    session: Session, store: ObjectStore, stored: StoredRun
) -> "tuple[tuple[Disturbance, ...], ...]":
    """Compute the disturbances of each record that a run was fitted to.

    There are none without noise inside the plant.

    Raises
    ------
    Conflict
        If the run has no standard errors, its records are gone, or the work is too much.
    """
    if stored.result is None or stored.result.plant_noise is None:
        return ()
    return _computed_disturbances.get(
        stored.run.id,
        partial(_compute_disturbances, session, store, stored),
        is_final=True,
        before_wait=partial(release_connection, session),
    )


def build_disturbances(
    session: Session, store: ObjectStore, run_id: str, max_points: int
) -> DisturbancesOut:
    """Build the disturbances of a run, reduced so that extremes stay visible.

    Raises
    ------
    NotFound
        If there is no such run.
    Conflict
        If it has no estimates, or they cannot be computed.
    """
    stored = load_estimated_run(session, run_id, "compute disturbances from")
    return DisturbancesOut(
        id=run_id,
        experiments=[
            DisturbanceExperimentOut(
                name=f"record {number}",
                disturbances=[_to_disturbance_out(one, max_points) for one in disturbances],
            )
            for number, disturbances in enumerate(load_disturbances(session, store, stored), 1)
        ],
    )


def _compute_disturbances(
    session: Session, store: ObjectStore, stored: StoredRun
) -> "tuple[tuple[Disturbance, ...], ...]":
    # It imports the compiler, which most requests never need.
    from sysid.uncertainty.disturbances import count_values, estimate_disturbances

    with build_spread_fit(session, store, stored, "disturbances") as (problem, theta, spread):
        if (values := count_values(problem)) > MAX_VALUES:
            raise Conflict(
                f"the disturbances of run {stored.run.id} need {values:.3g} values of the filter "
                f"at once; need at most {MAX_VALUES:.3g}. Use `compute_disturbances` of the "
                "Python library"
            )
        return estimate_disturbances(problem, theta, spread)


def _to_disturbance_out(disturbance: "Disturbance", max_points: int) -> DisturbanceOut:
    shown = thin_indices(disturbance.values, max_points)

    def read(values: FloatArray) -> list[float | None]:
        return [to_finite(value) for value in values[shown].tolist()]

    return DisturbanceOut(
        place=disturbance.place,
        kind=disturbance.kind,
        unit=disturbance.unit,
        samples=disturbance.times.size,
        times=disturbance.times[shown].tolist(),
        values=read(disturbance.values),
        lower=read(disturbance.band[:, 0]),
        upper=read(disturbance.band[:, 1]),
    )
