"""Routes of recipes: noise sweep and batch re-identification."""

from fastapi import APIRouter, Response, status

from service.api.requests.bodies import JsonRoute
from service.api.requests.dependencies import PartsDep
from service.api.routes.job_routes import IdempotencyKeyHeader, set_location
from service.jobs.job_schemas import JobOut
from service.sweeps import noise_sweep, reidentification
from service.sweeps.sweep_schemas import NoiseSweepIn, ReidentifyIn

recipe_router = APIRouter(prefix="/v1/recipes", tags=["jobs"], route_class=JsonRoute)


@recipe_router.post("/noise-sweep", status_code=status.HTTP_202_ACCEPTED)
def submit_noise_sweep(
    body: NoiseSweepIn,
    parts: PartsDep,
    response: Response,
    idempotency_key: IdempotencyKeyHeader = None,
) -> JobOut:
    """Queue a noise sweep, σ × replicates × methods, of a simulated record or a dataset."""
    job = noise_sweep.submit_noise_sweep(
        parts.database, parts.store, parts.readers, parts.settings, body, idempotency_key
    )
    return set_location(job, response)


@recipe_router.post("/reidentify", status_code=status.HTTP_202_ACCEPTED)
def submit_reidentification(
    body: ReidentifyIn,
    parts: PartsDep,
    response: Response,
    idempotency_key: IdempotencyKeyHeader = None,
) -> JobOut:
    """Queue a warm-started run for each value of a label, with a trend over the label."""
    job = reidentification.submit_reidentification(
        parts.database, body, parts.settings, idempotency_key
    )
    return set_location(job, response)
