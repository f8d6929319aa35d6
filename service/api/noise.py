"""The route of the noise sweep."""

from fastapi import APIRouter, Response, status

from service.api.deps import PartsDep
from service.api.jobs import Key
from service.recipes import noise
from service.schemas_jobs import JobOut
from service.schemas_noise import NoiseSweepIn

router = APIRouter(prefix="/v1/recipes", tags=["jobs"])


@router.post("/noise-sweep", status_code=status.HTTP_202_ACCEPTED)
def noise_sweep(
    body: NoiseSweepIn, parts: PartsDep, response: Response, idempotency_key: Key = None
) -> JobOut:
    """Queue a job of σ × replicates × methods, from true parameters or from a dataset."""
    job = noise.submit(parts.database, parts.store, parts.settings, body, idempotency_key)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job
