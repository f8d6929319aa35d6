"""Whether a run can be started from another's estimates, and which run a reference means."""

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest
from service.jobs import references
from service.jobs.schemas import PREVIOUS, REFERENCE
from service.jobs.stored_run import load_run
from service.models.models import says_the_same
from service.storage.tables import Run
from sysid.models.model import Model

POINTER = "/warm_start"


def faults(
    session: Session, reference: str | None, model: Model, pointer: str = POINTER
) -> list[FieldError]:
    """Why a body's warm start, or reference, cannot be used: no such run, or of another model.

    A reference stands for a model. A run that is named as the place to begin from needs no more
    than the same parameters: it may be of an earlier version of the equations.
    """
    if reference in (None, PREVIOUS):
        return []
    try:
        run = references.run_of(session, str(reference), pointer)
    except InvalidRequest as error:
        return list(error.errors)
    text = _of_another_model(session, run, model)
    if not text and (pointer != POINTER or str(reference).startswith(REFERENCE)):
        text = _of_other_equations(session, run, model)
    return [FieldError(pointer, text)] if text else []


def resolved(session: Session, reference: str | None) -> str | None:
    """The run that is meant now: what is accepted later does not change a job that waits."""
    if reference in (None, PREVIOUS):
        return reference
    return references.run_of(session, str(reference), POINTER).id


def _of_other_equations(session: Session, run: Run, model: Model) -> str:
    theirs = load_run(session, run.id).requested_model
    if says_the_same(theirs, model):
        return ""
    return (
        f"run {run.id} is of another model, {theirs.name!r}, whose equations are not those of "
        f"{model.name!r}; need a run of {model.name!r}"
    )


def _of_another_model(session: Session, run: Run, model: Model) -> str:
    """What differs between the run's parameters and the model's, by names and units."""
    known: Mapping[str, Any] = {one["name"]: one for one in (run.result or {})["parameters"]}
    names = [one.name for one in model.parameters]
    if model.rule is not None:  # which of the candidates have coefficients, the data decide
        names = [name for name in names if name in known] or names[:1]
    missing = [name for name in names if name not in known]
    if missing:
        theirs = load_run(session, run.id).requested_model
        return (
            f"run {run.id} of {theirs.name!r} is of another model: "
            f"it has the parameters {_listed(known)}, "
            f"{model.name!r} has {_listed(names)}; need a run with {_listed(missing)}"
        )
    for one in model.parameters:
        unit = known[one.name]["unit"] if one.name in known else one.unit
        if unit != one.unit:
            return (
                f"run {run.id} is of another model: {one.name} is in {unit}, in {model.name!r} "
                f"it is in {one.unit}"
            )
    return ""


def _listed(names: Any) -> str:
    found = list(names)
    return ", ".join(found[:8]) + (" …" if len(found) > 8 else "")
