"""The route of batch re-identification."""

from fastapi import APIRouter, Response, status

from service.api.deps import PartsDep
from service.api.jobs import Key
from service.recipes import reidentify
from service.schemas_jobs import JobOut
from service.schemas_reidentify import ReidentifyIn

router = APIRouter(prefix="/v1/recipes", tags=["jobs"])


@router.post("/reidentify", status_code=status.HTTP_202_ACCEPTED)
def batch(
    body: ReidentifyIn,
    parts: PartsDep,
    response: Response,
    idempotency_key: Key = None,
) -> JobOut:
    """Queue a run for each value of a label, warm-started, with a trend over it."""
    job = reidentify.submit(parts.database, body, parts.settings, idempotency_key)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job
