"""Use case of summaries: how a sweep's results depend on its axes."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest
from service.datasets.rms_unit import unit_of
from service.repositories.jobs import JobRepository
from service.repositories.runs import RunRepository
from service.repositories.summaries import QUANTILES, Group, GroupKey, Quantity, groups
from service.storage.tables import Job, Run, State
from service.sweeps.cramer_rao import Floors, at_sigma
from service.sweeps.groups import groups_of
from service.sweeps.schemas import GroupOut, ParameterSummaryOut, ReferenceOut, SummaryOut
from sysid.core.errors import nearest

MOST_GROUPS = 2_000
MIDDLE = QUANTILES.index(500)
RMS, NOISE_FREE, ESTIMATION, VALIDATION = (
    Quantity("rms"), Quantity("rms_noise_free"), Quantity("fit_estimation"),
    Quantity("fit_validation"),
)  # fmt: skip
SUCCESS = "a run succeeds if it ends with a finite simulation"
SAFE = "a run succeeds if it ends with an RMS within the safe limit"
FLOOR = (
    "floors are Cramér–Rao bounds of the added noise alone; bounds on the parameters and a search "
    "that stops early may hold errors below them"
)


def summary(
    session: Session, job_id: str, by: Sequence[str] | None, *, errors_only: bool = False
) -> SummaryOut:
    """Aggregates over the values of some axes or labels of a job.

    Parameters
    ----------
    by : sequence of str, optional
        Paths of axes (``/noise/sigma``) and names of labels (``length_m``); by default every
        axis that is no seed.
    errors_only : bool
        Only the RMS against the records without noise, and the estimates: what figures draw.

    Raises
    ------
    InvalidRequest
        If a key is neither, or the keys part the runs into too many groups.
    """
    job = JobRepository(session).get(job_id)
    keys = _keys(job, by)
    units = _units(session, job)
    floors = Floors(job.floors)
    quantities = [NOISE_FREE, *(Quantity("estimate", name) for name in units)]
    if not errors_only:
        quantities += [RMS, ESTIMATION, VALIDATION]
        quantities += [Quantity("stderr", name) for name in units]
    found = groups_of(session, job, keys, quantities, MOST_GROUPS)
    if len(found) > MOST_GROUPS:
        raise InvalidRequest.at(
            "?by", f"gives more than {MOST_GROUPS} groups; name fewer axes, such as no seed"
        )
    return SummaryOut(
        job=job.id,
        by=[key.name for key in keys],
        quantiles=[q / 1000 for q in QUANTILES],
        groups=[_told(group, keys, units, floors) for group in found],
        runs=job.n_runs,
        reused=job.n_reused,
        rms_unit=unit_of(session, job.spec),
        references=[_reference(one) for one in floors.problems],
        notes=list(_notes(job, floors)),
    )


def _notes(job: Job, floors: Floors) -> Iterator[str]:
    yield SUCCESS if job.spec["algorithm"]["safe_limit"] is None else SAFE
    if floors.problems:
        yield from floors.notes()
        yield FLOOR


def _reference(problem: Mapping[str, Any]) -> ReferenceOut:
    known = problem["reference"] or {}
    none = {"kind": None, "run": None, "sigma": None}
    return ReferenceOut.model_validate(
        {**none, **known, **problem, "parameters": known.get("values", {})}
    )


def _keys(job: Job, by: Sequence[str] | None) -> list[GroupKey]:
    axes = job.spec["sweep"]["axes"]
    paths = [axis["path"] for axis in axes]
    labels = {name for axis in axes for one in axis["labels"] or [] for name in one}
    if by is None:
        return [GroupKey("axis", path) for path in paths if not path.endswith("/seed")]
    keys = []
    for name in dict.fromkeys(by):
        if name not in paths and name not in labels:
            known = [*paths, *sorted(labels)]
            there = f"; there are {', '.join(known)}" if known else "; the job has no axes"
            raise InvalidRequest.at(
                "?by", f"the job has no axis or label {name!r}{nearest(name, known)}{there}"
            )
        keys.append(GroupKey("axis" if name in paths else "label", name))
    return keys


def _units(session: Session, job: Job) -> dict[str, str]:
    """Parameters that some run has estimated, with their units: by what the first ones told.

    Where an axis changes the model, its first run of every value may know others.
    """
    runs = RunRepository(session)
    heads: list[Run] = list(runs.page(job.id, limit=1, states=[State.SUCCEEDED]).items)
    if any(axis["path"] == "/model" for axis in job.spec["sweep"]["axes"]):
        for group in groups(session, job.id, [GroupKey("axis", "/model")], [], MOST_GROUPS):
            cell = {"/model": group.key[0]}
            heads += runs.page(job.id, limit=1, states=[State.SUCCEEDED], cell=cell).items
    return {
        one["name"]: one["unit"]
        for run in heads
        for one in (run.result or {}).get("parameters", [])
        if one["status"] != "fixed"
    }


def _told(
    group: Group, keys: Sequence[GroupKey], units: dict[str, str], floors: Floors
) -> GroupOut:
    ended = group.states[State.SUCCEEDED] + group.states[State.FAILED]
    named = {key.name: value for key, value in zip(keys, group.key, strict=True)}
    problem = floors.problem_of(named) or {}
    same = group.sigma is not None and group.sigma[0] == group.sigma[1]
    return GroupOut(
        key=named,
        runs=sum(group.states.values()),
        succeeded=group.states[State.SUCCEEDED],
        failed=group.states[State.FAILED],
        sigma=group.sigma[0] if group.sigma is not None and same else None,
        success_rate=group.n_valid / ended if ended else 0.0,
        evaluations=group.mean_evaluations,
        seconds=group.mean_seconds,
        rms=_list(group, RMS),
        rms_noise_free=_list(group, NOISE_FREE),
        rms_floor=at_sigma(problem.get("rms"), group.sigma),
        fit_percent={
            "estimation": _list(group, ESTIMATION), "validation": _list(group, VALIDATION),
        },
        parameters=list(_parameters(group, units, problem)),
    )  # fmt: skip


def _parameters(
    group: Group, units: dict[str, str], problem: Mapping[str, Any]
) -> Iterator[ParameterSummaryOut]:
    known = (problem.get("reference") or {}).get("values", {})
    floors = problem.get("stderr", {})
    for name, unit in units.items():
        values = _list(group, Quantity("estimate", name))
        errors = _list(group, Quantity("stderr", name))
        if values is not None:
            reference = known.get(name)
            yield ParameterSummaryOut(
                name=name, unit=unit, value=values,
                stderr=None if errors is None else errors[MIDDLE],
                reference=reference,
                error=None if reference is None else [value - reference for value in values],
                floor=at_sigma(floors.get(name), group.sigma),
            )  # fmt: skip


def _list(group: Group, quantity: Quantity) -> Any:
    found = group.quantiles.get(quantity)
    return None if found is None else list(found)
