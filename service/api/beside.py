"""What can be told of a body that its type refuses, so that one answer has every fault."""

from collections.abc import Callable, Mapping, Sequence, Set
from typing import Any

from pydantic import BaseModel
from sqlalchemy.orm import Session

from service.api.deps import Parts
from service.errors import FieldError
from service.partial import beside
from service.recipes import noise, reidentify
from service.schemas_jobs import JobIn
from service.schemas_noise import NoiseSweepIn
from service.schemas_reidentify import ReidentifyIn
from service.sweep_checks import faults_of_rest

Meaning = Callable[[Session, Any, int, Set[str]], list[FieldError]]
MEANINGS: Mapping[type[BaseModel], Meaning] = {
    JobIn: faults_of_rest,
    NoiseSweepIn: noise.faults_of_rest,
    ReidentifyIn: reidentify.faults_of_rest,
}


def faults_beside(
    parts: Parts, kind: Any, body: Any, faults: Sequence[FieldError]
) -> list[FieldError]:
    """Faults of what can be read of a body, besides those of its type."""
    meant = MEANINGS.get(kind) if isinstance(kind, type) else None
    if meant is None:
        return []
    most = parts.settings.max_runs_per_job
    with parts.database.read() as session:
        return beside(kind, body, faults, lambda whole, unread: meant(session, whole, most, unread))
