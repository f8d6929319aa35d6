"""The route that compares runs."""

from fastapi import APIRouter

from service import comparison
from service.api.deps import ReadSession
from service.schemas_comparison import CompareIn, ComparisonOut

router = APIRouter(prefix="/v1", tags=["runs"])


@router.post("/runs:compare")
def compare(body: CompareIn, session: ReadSession) -> ComparisonOut:
    """Runs of several models on the same data side by side, the best first."""
    return comparison.compare(session, body.runs)
