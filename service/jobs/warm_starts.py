"""Checks whether a run can start from another's estimates, and resolution of references."""

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from service.core.bodies.job_fields import WARM_START_PATH
from service.core.errors import FieldError, InvalidRequest
from service.items.reference_names import REFERENCE_PREFIX
from service.jobs import references
from service.jobs.job_schemas import PREVIOUS
from service.jobs.stored_run import load_run
from service.models.models import have_same_equations
from service.storage.tables import Run
from sysid.models.model import Model


def find_warm_start_faults(
    session: Session, reference: str | None, model: Model, pointer: str = WARM_START_PATH
) -> list[FieldError]:
    """Report why a warm start or reference cannot be used: no such run, or another model.

    A reference stands for a model, so its equations must be the same. A run named as a starting
    point needs the same parameters only. It may belong to an earlier version of the equations.
    """
    if reference in (None, PREVIOUS):
        return []
    try:
        run = references.resolve_reference(session, str(reference), pointer)
    except InvalidRequest as error:
        return list(error.errors)
    text = _describe_other_parameters(session, run, model)
    if not text and (pointer != WARM_START_PATH or str(reference).startswith(REFERENCE_PREFIX)):
        text = _describe_other_equations(session, run, model)
    return [FieldError(pointer, text)] if text else []


def resolve_warm_start(session: Session, reference: str | None) -> str | None:
    """Resolve the run that is meant now. Later acceptances do not change a queued job."""
    if reference in (None, PREVIOUS):
        return reference
    return references.resolve_reference(session, str(reference), WARM_START_PATH).id


def _describe_other_equations(session: Session, run: Run, model: Model) -> str:
    other = load_run(session, run.id).model_of_request
    if have_same_equations(other, model):
        return ""
    return (
        f"run {run.id} has another model: the equations of {other.name!r} differ from those of "
        f"{model.name!r}. Give a run of {model.name!r}"
    )


def _describe_other_parameters(session: Session, run: Run, model: Model) -> str:
    """Describe how the run's parameters differ from the model's in names and units."""
    estimates: Mapping[str, Any] = {
        estimate["name"]: estimate for estimate in (run.result or {})["parameters"]
    }
    names = [parameter.name for parameter in model.parameters]
    if model.rule is not None:  # the data decide which candidates have coefficients
        names = [name for name in names if name in estimates] or names[:1]
    missing = [name for name in names if name not in estimates]
    if missing:
        other = load_run(session, run.id).model_of_request
        return (
            f"run {run.id} of {other.name!r} has another model: "
            f"its parameters are {_join_names(estimates)}, "
            f"those of {model.name!r} are {_join_names(names)}. "
            f"Give a run with {_join_names(missing)}"
        )
    for parameter in model.parameters:
        unit = estimates[parameter.name]["unit"] if parameter.name in estimates else parameter.unit
        if unit != parameter.unit and not parameter.has_unit_of_data:
            return (
                f"run {run.id} has another model: {parameter.name} is in {unit} there, but in "
                f"{parameter.unit} in {model.name!r}"
            )
    return ""


def _join_names(names: Any) -> str:
    listed = list(names)
    return ", ".join(listed[:8]) + (" …" if len(listed) > 8 else "")
