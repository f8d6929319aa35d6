"""Pages of models: the gallery, and one of each model with its equations and parameters."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import yaml
from markupsafe import Markup
from sqlalchemy.orm import Session

from service.items.items import compute_etag
from service.jobs.outcomes import read_outcomes
from service.models import models
from service.models.catalogue import to_builtin_out
from service.models.model_schemas import ModelOut, ModelParameterOut
from service.pages.render import render_template
from service.pages.views import to_job_view
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.job_rows import JobRepository
from service.repositories.model_rows import ModelRepository
from service.repositories.search_conditions import ListFilter
from service.storage.tables import ModelVersion
from sysid.models.catalogue import load

MODELS_PER_PAGE = 50
JOBS_SHOWN, DATASETS_OFFERED = 10, 200
MAX_PARAMETERS_SHOWN = 200

TYPICAL_SYSTEMS: Mapping[str, str] = {
    "actuator": "A pneumatic vane or cylinder that sticks and slips.",
    "coulomb-delay": "A machine with dry friction, damped by a delayed feedback.",
    "coulomb-eq16": "As coulomb-delay, with the recursion of the paper.",
    "delayed-logistic": "A population whose food grows back late.",
    "delayed-van-der-pol": "An oscillator with delayed feedback, such as a heart rhythm.",
    "duffing-delay": "A spring that stiffens, with a delayed damper.",
    "duffing-eq16": "As duffing-delay, with the recursion of the paper.",
    "emps": "A linear axis with a motor, a screw and dry friction.",
    "exponential": "A growing or decaying quantity, for tests.",
    "foipdt": "A motor's position, or a large tank behind a slow valve.",
    "fopdt": "A heater, an oven, a flow or pressure loop, a heat exchanger.",
    "ipdt": "A level in a tank, or a slow drum whose inflow is late.",
    "mackey-glass": "Blood cells, whose production follows their number late.",
    "narx": "A plant whose equations nobody knows; scale its signals first.",
    "silverbox": "An electronic or mechanical resonator with a stiffening spring.",
    "silverbox-9": "As silverbox, where damping is nonlinear too.",
    "sopdt": "Two vessels in a row, an oven with a slow sensor, a servo valve.",
    "topdt": "Three stages in a row, such as a heater, a pipe and a thick sensor.",
    "tube": "A long pneumatic tube from its inlet to a small volume.",
    "tube-second-order": "A shorter tube whose pressure overshoots.",
}
"""What each built-in model is used for."""

RULES: Mapping[str, str] = {
    "gain": "± 5 times span of the output / span of the input",
    "rate": "± 5 times span of the output / span of the input's integral",
    "offset": "the range of the output, extended",
    "time": "a tenth of the sampling period … twice the shortest record",
    "delay": "0 … half the shortest record",
    "state": "the range of the output, extended",
}
"""How bounds follow the data, by their rule."""


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """One row of the table of a model's parameters."""

    name: str
    description: str
    unit: str
    range: str
    scale: str


@dataclass(frozen=True, slots=True)
class ModelCard:
    """A model in words and formulas."""

    name: str
    reference: str
    title: str
    is_builtin: bool
    version: int
    form: str
    signals: str
    equations: Sequence[Markup]
    description: str
    source: str
    typical: str
    parameters: Sequence[ParameterRow]


def models_page(session: Session, form: Mapping[str, str], cursor: str | None) -> str:
    """Render the gallery: your own models, the latest version of each, then the built-in ones."""
    part = form.get("name", "").lower()
    page = ModelRepository(session).list_page(
        cursor=cursor,
        limit=MODELS_PER_PAGE,
        chosen=ListFilter(name=part or None),
        only_latest=True,
    )
    built_in = [] if cursor else [view for view in view_catalogue() if _contains(view, part)]
    return render_template(
        "models.html",
        own=[_view_own(row) for row in page.items],
        built_in=built_in,
        form=form,
        cursor=cursor,
        next=page.next,
    )


def model_page(session: Session, reference: str) -> str:
    """Render one model: equations, parameters, jobs that used it, a form to try it.

    Raises
    ------
    NotFound
        With the most similar name.
    """
    model = models.get_model(session, reference)
    repository = ModelRepository(session)
    jobs = JobRepository(session).list_page(
        limit=JOBS_SHOWN, chosen=ListFilter(terms=(("model", model.name),))
    )
    outcomes = read_outcomes(session, jobs.items)
    row = None if model.builtin else repository.get(reference)
    return render_template(
        "model.html",
        model=_to_view(model),
        row=row,
        etag="" if row is None else compute_etag(row),
        versions=[] if row is None else [one.version for one in repository.list_versions(row.name)],
        text=_to_yaml(model.document),
        jobs=[to_job_view(session, job, outcomes.get(job.id)) for job in jobs.items],
        has_more_jobs=jobs.next is not None,
        datasets=DatasetRepository(session).list_page(limit=DATASETS_OFFERED).items,
    )


def model_text(session: Session, name: str) -> str:
    """Return a model as YAML, to read and change in the form."""
    return _to_yaml(models.get_model(session, name).document)


def job_model_text(session: Session, job_id: str) -> str:
    """Return the model document of a job as YAML, for the form of its clone."""
    model = JobRepository(session).get(job_id).spec["model"]
    return _to_yaml(models.get_model(session, model).document if isinstance(model, str) else model)


def _to_yaml(document: dict[str, Any] | None) -> str:
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100)


@cache
def view_catalogue() -> tuple[ModelCard, ...]:
    """Build the views of all built-in models, once per process."""
    return tuple(_to_view(to_builtin_out(name, with_document=True)) for name in load.catalogue())


def _contains(view: ModelCard, part: str) -> bool:
    return any(part in text.lower() for text in (view.name, view.title, view.typical))


def _view_own(row: ModelVersion) -> ModelCard:
    return _to_view(models.to_own_out(row, with_document=True))


def _to_view(model: ModelOut) -> ModelCard:
    document: Mapping[str, Any] = model.document
    return ModelCard(
        name=model.name,
        reference=model.name if model.builtin else f"{model.name}@{model.version}",
        title=model.title,
        is_builtin=model.builtin,
        version=model.version,
        form=model.form,
        signals=_describe_signals(model),
        equations=[Markup(equation.mathml) for equation in model.equations],
        description=document.get("description", ""),
        source=document.get("source", ""),
        typical=TYPICAL_SYSTEMS.get(model.name, "") if model.builtin else "",
        parameters=list(_list_parameters(model, document)),
    )


def _describe_signals(model: ModelOut) -> str:
    inputs, outputs = (
        ", ".join(name if unit == "1" else f"{name} [{unit}]" for name, unit in signals.items())
        for signals in (model.inputs, model.outputs)
    )
    return f"{inputs or 'no input'} → {outputs}"


def _list_parameters(model: ModelOut, document: Mapping[str, Any]) -> Iterator[ParameterRow]:
    declared = document.get("parameters") or {}
    for name, one in list(model.parameters.items())[:MAX_PARAMETERS_SHOWN]:
        entry = declared.get(name)
        about = entry.get("description", "") if isinstance(entry, Mapping) else ""
        yield ParameterRow(name, about, one.unit, _describe_range(one), one.scale)


def _describe_range(one: ModelParameterOut) -> str:
    if one.tied is not None:
        return f"tied: {one.tied}"
    if one.fixed is not None:
        return f"fixed at {one.fixed:.6g}"
    if one.bounds is not None:
        return f"follows the data: {RULES[one.bounds]}"
    limit = "" if one.physical is None else f" ({one.physical}: physical)"
    return f"{one.lower:.6g} … {one.upper:.6g}".replace("-", "−") + limit
