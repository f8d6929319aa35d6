"""Whether a run can be started from another's estimates, and which run a reference means."""

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from service import references
from service.errors import FieldError, InvalidRequest
from service.schemas_jobs import PREVIOUS
from service.storage.tables import Run
from sysid.models.model import Model

POINTER = "/warm_start"


def faults(
    session: Session, reference: str | None, model: Model, pointer: str = POINTER
) -> list[FieldError]:
    """Why a body's warm start cannot be used: no such run, or one of another model."""
    if reference in (None, PREVIOUS):
        return []
    try:
        run = references.run_of(session, str(reference), pointer)
    except InvalidRequest as error:
        return list(error.errors)
    return [FieldError(pointer, text) for text in [_of_another_model(run, model)] if text]


def resolved(session: Session, reference: str | None) -> str | None:
    """The run that is meant now: what is accepted later does not change a job that waits."""
    if reference in (None, PREVIOUS):
        return reference
    return references.run_of(session, str(reference), POINTER).id


def _of_another_model(run: Run, model: Model) -> str | None:
    """What differs between the run's parameters and the model's, by names and units."""
    known: Mapping[str, Any] = {one["name"]: one for one in (run.result or {})["parameters"]}
    names = [one.name for one in model.parameters]
    if model.rule is not None:  # which of the candidates have coefficients, the data decide
        names = [name for name in names if name in known] or names[:1]
    missing = [name for name in names if name not in known]
    if missing:
        return (
            f"run {run.id} is of another model: it has the parameters {_listed(known)}, "
            f"{model.name!r} has {_listed(names)}; need a run with {_listed(missing)}"
        )
    for one in model.parameters:
        unit = known[one.name]["unit"] if one.name in known else one.unit
        if unit != one.unit:
            return (
                f"run {run.id} is of another model: {one.name} is in {unit}, in {model.name!r} "
                f"it is in {one.unit}"
            )
    return None


def _listed(names: Any) -> str:
    found = list(names)
    return ", ".join(found[:8]) + (" …" if len(found) > 8 else "")
