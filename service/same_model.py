"""Whether runs are of one model: their estimates then stand for the same quantities."""

from typing import Any

from sqlalchemy.orm import Session

from service import models
from service.storage.jobs import JobRepository
from service.storage.tables import Run
from service.sweeps import body_of
from sysid.core.errors import SysidError
from sysid.models.model import Model

_BESIDES = ("name", "title", "description", "source", "parameters", "initial", "solver")
"""Of a model's document, what does not say what its parameters mean."""


def model_in(session: Session, run: Run) -> Model | None:
    """The model of a run; None if this version of the program cannot read it any more."""
    job = JobRepository(session).get(run.job_id)
    try:
        return models.resolve(session, body_of(job.spec, run.cell)["model"])[0]
    except SysidError:
        return None


def says_the_same(one: Model, other: Model) -> bool:
    """Whether two models have the same equations of the same parameters, in the same units.

    Names and texts, bounds, initial states and the solver may differ.
    """
    return bool(_meaning(one) == _meaning(other))


def _meaning(model: Model) -> Any:
    document = {key: value for key, value in model.document.items() if key not in _BESIDES}
    return document, [(one.name, one.unit) for one in model.parameters]
