"""The route of batch re-identification."""

from fastapi import APIRouter, Response, status

from service import jobs
from service.api.deps import PartsDep, WriteSession
from service.api.jobs import Key
from service.recipes import reidentify
from service.schemas_jobs import JobOut
from service.schemas_reidentify import ReidentifyIn

router = APIRouter(prefix="/v1/recipes", tags=["jobs"])


@router.post("/reidentify", status_code=status.HTTP_202_ACCEPTED)
def batch(
    body: ReidentifyIn,
    parts: PartsDep,
    session: WriteSession,
    response: Response,
    idempotency_key: Key = None,
) -> JobOut:
    """Queue a run for each value of a label, warm-started, with a trend over it."""
    found = reidentify.submit(session, body, parts.settings, idempotency_key)
    response.headers["Location"] = f"/v1/jobs/{found.job.id}"
    return jobs.told(found.job)
