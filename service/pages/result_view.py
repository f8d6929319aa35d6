"""View of a result document for the templates, without a job or a database."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from service.pages.diagnostics import Diagnostics, to_diagnostics
from sysid.core.text import format_estimate, format_interval
from sysid.models.equation_display import format_equations
from sysid.models.model import Model

Document = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class EstimateView:
    """One row of the table of estimates."""

    name: str
    unit: str
    value_text: str
    stderr_text: str
    interval_text: str
    bounds_text: str
    status: str
    reason: str


@dataclass(frozen=True, slots=True)
class PosteriorView:
    """One row of the table of the posterior."""

    name: str
    unit: str
    median_text: str
    interval_text: str
    effective_samples: float


@dataclass(frozen=True, slots=True)
class ModelView:
    """What a model is called, and its equations as MathML."""

    name: str
    title: str
    equations: Sequence[str]


@dataclass(frozen=True, slots=True)
class ResultView:
    """A result as the shared pieces of pages and reports show it; `unit` is that of the RMS."""

    unit: str
    valid: bool
    best_rms: float | None
    fit_estimation: float | None
    fit_validation: float | None
    evaluations: int
    generations: int
    seconds: float
    estimates: Sequence[EstimateView]
    verdict: Document
    warnings: Sequence[str]
    diagnostics: Diagnostics
    posterior: Sequence[PosteriorView]
    title: str
    model: ModelView
    error: str | None = None


def to_model_view(model: Model) -> ModelView:
    """Build the view of a model."""
    equations = [equation.mathml for equation in format_equations(model)]
    return ModelView(model.name, model.title, equations)


def to_result_view(result: Document, model: Model, unit: str, title: str) -> ResultView:
    """Build the view of a result document."""
    return ResultView(
        unit=unit,
        valid=result["valid"],
        best_rms=result["rms"],
        fit_estimation=result["fit_percent"]["estimation"],
        fit_validation=result["fit_percent"]["validation"],
        evaluations=result["evaluations"],
        generations=result["generations"],
        seconds=result["seconds"],
        estimates=[to_estimate_view(parameter) for parameter in result["parameters"]],
        verdict=result["verdict"],
        warnings=result["warnings"],
        diagnostics=to_diagnostics(result),
        posterior=to_posterior_views(result),
        title=title,
        model=to_model_view(model),
    )


def to_posterior_views(result: Document) -> list[PosteriorView]:
    """Build the rows of the table of the posterior; none without samples."""
    parameters = (result.get("posterior") or {}).get("parameters", ())
    return [_to_posterior_view(parameter) for parameter in parameters]


def _to_posterior_view(parameter: Document) -> PosteriorView:
    low, high = parameter["interval95"]
    spread = (high - low) / 4.0  # about a standard deviation, which gives the digits
    return PosteriorView(
        name=parameter["name"],
        unit=parameter["unit"],
        median_text=format_estimate(parameter["median"], spread)[0],
        interval_text=format_interval((low, high), spread),
        effective_samples=parameter["effective_samples"],
    )


def to_estimate_view(estimate: Document) -> EstimateView:
    """Build a row of the table from an entry of the result's ``parameters``."""
    stderr, status = estimate["stderr"], estimate["status"]
    value, error = format_estimate(estimate["value"], stderr, status=status)
    bounds = [estimate[name] for name in ("lower", "upper") if estimate[name] is not None]
    return EstimateView(
        name=estimate["name"],
        unit=estimate["unit"],
        value_text=value,
        stderr_text=error,
        interval_text=format_interval(estimate["interval95"], stderr, status=status),
        bounds_text=" … ".join(f"{bound:.6g}".replace("-", "−") for bound in bounds),
        status=status,
        reason=estimate["reason"] or "",
    )
