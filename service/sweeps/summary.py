"""Use case of summaries: how a sweep's results depend on its axes."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest
from service.core.states import JobState
from service.datasets.rms_unit import find_rms_unit
from service.repositories.job_rows import JobRepository
from service.repositories.summary_rows import SummaryQuantity
from service.storage.tables import Job
from service.sweeps.group_cramer_rao import StoredBounds, scale_to_sigma
from service.sweeps.groups import QUANTILES_PER_MILLE, GroupKey, RunGroup, SweepGroups
from service.sweeps.job_summary import MAX_GROUPS, list_default_keys, load_groups, load_summary
from service.sweeps.sweep_schemas import (
    ErrorReferenceOut,
    GroupOut,
    ParameterSummaryOut,
    SummaryOut,
)
from sysid.core.errors import suggest_name

MEDIAN = QUANTILES_PER_MILLE.index(500)
RMS, RMS_NOISE_FREE, FIT_ESTIMATION, FIT_VALIDATION = (
    SummaryQuantity("rms"),
    SummaryQuantity("rms_noise_free"),
    SummaryQuantity("fit_estimation"),
    SummaryQuantity("fit_validation"),
)
SUCCESS_NOTE = "a run succeeds if it ends with a finite simulation"
SAFE_LIMIT_NOTE = "a run succeeds if it ends with an RMS within the safe limit"
BOUND_NOTE = (
    "Cramér–Rao bounds are those of the added noise alone. Limits of parameters or an early stop "
    "of the search can keep errors below them"
)


def summarise_job(session: Session, job_id: str, by: Sequence[str] | None) -> SummaryOut:
    """Aggregate the runs of a job over the values of some axes or labels.

    Parameters
    ----------
    by : sequence of str, optional
        Paths of axes (``/noise/sigma``) and names of labels (``length_m``). By default every
        axis that is not a seed.

    Raises
    ------
    InvalidRequest
        If a key is unknown, or the keys give too many groups. No run is read before.
    """
    job = JobRepository(session).get(job_id)
    keys = _choose_keys(job, by)
    groups = SweepGroups(job.spec, keys, MAX_GROUPS)
    if groups.is_cut:
        raise InvalidRequest.from_fault(
            "?by", f"gives more than {MAX_GROUPS} groups. Name fewer axes, for example no seed"
        )
    parameters = load_summary(session, job).parameters
    units = {one.name: one.unit for one in parameters if not one.is_fixed}
    cramer_rao = StoredBounds(job.cramer_rao)
    return SummaryOut(
        job=job.id,
        by=[key.name for key in keys],
        quantiles=[q / 1000 for q in QUANTILES_PER_MILLE],
        groups=[
            _to_group_out(group, keys, units, cramer_rao)
            for group in load_groups(session, job, groups)
        ],
        runs=job.n_runs,
        reused=job.n_reused,
        rms_unit=find_rms_unit(session, job.spec),
        references=[_to_reference_out(problem) for problem in cramer_rao.problems],
        notes=list(_list_notes(job, cramer_rao)),
    )


def _list_notes(job: Job, cramer_rao: StoredBounds) -> Iterator[str]:
    yield SUCCESS_NOTE if job.spec["algorithm"]["safe_limit"] is None else SAFE_LIMIT_NOTE
    if cramer_rao.problems:
        yield from cramer_rao.list_notes()
        yield BOUND_NOTE


def _to_reference_out(problem: Mapping[str, Any]) -> ErrorReferenceOut:
    reference = problem["reference"] or {}
    none = {"kind": None, "run": None, "sigma": None}
    return ErrorReferenceOut.model_validate(
        {**none, **reference, **problem, "parameters": reference.get("values", {})}
    )


def _choose_keys(job: Job, by: Sequence[str] | None) -> list[GroupKey]:
    axes = job.spec["sweep"]["axes"]
    paths = [axis["path"] for axis in axes]
    labels = {name for axis in axes for labels in axis["labels"] or [] for name in labels}
    if by is None:
        return list_default_keys(job.spec)
    keys = []
    for name in dict.fromkeys(by):
        if name not in paths and name not in labels:
            names = [*paths, *sorted(labels)]
            available = f". The names are {', '.join(names)}" if names else ". The job has no axes"
            raise InvalidRequest.from_fault(
                "?by",
                f"the job has no axis or label {name!r}{suggest_name(name, names)}{available}",
            )
        keys.append(GroupKey("axis" if name in paths else "label", name))
    return keys


def _to_group_out(
    group: RunGroup, keys: Sequence[GroupKey], units: dict[str, str], cramer_rao: StoredBounds
) -> GroupOut:
    ended = group.states[JobState.SUCCEEDED] + group.states[JobState.FAILED]
    named = {key.name: value for key, value in zip(keys, group.key, strict=True)}
    problem = cramer_rao.find_problem(named) or {}
    same = group.sigma is not None and group.sigma[0] == group.sigma[1]
    return GroupOut(
        key=named,
        runs=sum(group.states.values()),
        succeeded=group.states[JobState.SUCCEEDED],
        failed=group.states[JobState.FAILED],
        sigma=group.sigma[0] if group.sigma is not None and same else None,
        success_rate=group.n_valid / ended if ended else 0.0,
        evaluations=group.mean_evaluations,
        seconds=group.mean_seconds,
        rms=_list_quantiles(group, RMS),
        rms_noise_free=_list_quantiles(group, RMS_NOISE_FREE),
        rms_cramer_rao_bound=scale_to_sigma(problem.get("rms"), group.sigma),
        fit_percent={
            "estimation": _list_quantiles(group, FIT_ESTIMATION),
            "validation": _list_quantiles(group, FIT_VALIDATION),
        },
        parameters=list(_summarise_parameters(group, units, problem)),
    )


def _summarise_parameters(
    group: RunGroup, units: dict[str, str], problem: Mapping[str, Any]
) -> Iterator[ParameterSummaryOut]:
    references = (problem.get("reference") or {}).get("values", {})
    bounds = problem.get("stderr", {})
    for name, unit in units.items():
        values = _list_quantiles(group, SummaryQuantity("estimate", name))
        errors = _list_quantiles(group, SummaryQuantity("stderr", name))
        if values is not None:
            reference = references.get(name)
            yield ParameterSummaryOut(
                name=name,
                unit=unit,
                value=values,
                stderr=None if errors is None else errors[MEDIAN],
                reference=reference,
                error=None if reference is None else [value - reference for value in values],
                cramer_rao_bound=scale_to_sigma(bounds.get(name), group.sigma),
            )


def _list_quantiles(group: RunGroup, quantity: SummaryQuantity) -> Any:
    quantiles = group.quantiles.get(quantity)
    return None if quantiles is None else list(quantiles)
