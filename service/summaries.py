"""Use case of summaries: how a sweep's results depend on its axes."""

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from service.errors import InvalidRequest
from service.schemas_summaries import GroupOut, ParameterSummaryOut, SummaryOut
from service.storage.jobs import JobRepository
from service.storage.runs import RunRepository
from service.storage.summaries import QUANTILES, Group, GroupKey, Quantity, groups
from service.storage.tables import Job, Run, State
from sysid.errors import nearest

MOST_GROUPS = 2_000
MIDDLE = QUANTILES.index(500)
RMS, ESTIMATION, VALIDATION = (
    Quantity("rms"), Quantity("fit_estimation"), Quantity("fit_validation"),
)  # fmt: skip


def summary(session: Session, job_id: str, by: Sequence[str] | None) -> SummaryOut:
    """Aggregates over the values of some axes or labels of a job.

    Parameters
    ----------
    by : sequence of str, optional
        Paths of axes (``/noise/sigma``) and names of labels (``length_m``); by default every
        axis that is no seed.

    Raises
    ------
    InvalidRequest
        If a key is neither, or the keys part the runs into too many groups.
    """
    job = JobRepository(session).get(job_id)
    keys = _keys(job, by)
    units = _units(session, job)
    quantities = [RMS, ESTIMATION, VALIDATION]
    for name in units:
        quantities += [Quantity("estimate", name), Quantity("stderr", name)]
    found = groups(session, job.id, keys, quantities, MOST_GROUPS)
    if len(found) > MOST_GROUPS:
        raise InvalidRequest.at(
            "?by", f"gives more than {MOST_GROUPS} groups; name fewer axes, such as no seed"
        )
    return SummaryOut(
        job=job.id,
        by=[key.name for key in keys],
        quantiles=[q / 1000 for q in QUANTILES],
        groups=[_told(group, keys, units) for group in found],
    )


def _keys(job: Job, by: Sequence[str] | None) -> list[GroupKey]:
    axes = job.spec.get("sweep", {}).get("axes", [])
    paths = [axis["path"] for axis in axes]
    labels = {name for axis in axes for one in axis.get("labels") or [] for name in one}
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
    if any(axis["path"] == "/model" for axis in job.spec.get("sweep", {}).get("axes", [])):
        for group in groups(session, job.id, [GroupKey("axis", "/model")], [], MOST_GROUPS):
            cell = {"/model": group.key[0]}
            heads += runs.page(job.id, limit=1, states=[State.SUCCEEDED], cell=cell).items
    return {
        one["name"]: one["unit"]
        for run in heads
        for one in (run.result or {}).get("parameters", [])
        if one["status"] != "fixed"
    }


def _told(group: Group, keys: Sequence[GroupKey], units: dict[str, str]) -> GroupOut:
    ended = group.states[State.SUCCEEDED] + group.states[State.FAILED]
    return GroupOut(
        key={key.name: value for key, value in zip(keys, group.key, strict=True)},
        runs=sum(group.states.values()),
        succeeded=group.states[State.SUCCEEDED],
        failed=group.states[State.FAILED],
        success_rate=group.n_valid / ended if ended else 0.0,
        evaluations=group.mean_evaluations,
        seconds=group.mean_seconds,
        rms=_list(group, RMS),
        fit_percent={
            "estimation": _list(group, ESTIMATION), "validation": _list(group, VALIDATION),
        },
        parameters=list(_parameters(group, units)),
    )  # fmt: skip


def _parameters(group: Group, units: dict[str, str]) -> list[ParameterSummaryOut]:
    told = []
    for name, unit in units.items():
        values = _list(group, Quantity("estimate", name))
        errors = _list(group, Quantity("stderr", name))
        if values is not None:
            middle = None if errors is None else errors[MIDDLE]
            told.append(ParameterSummaryOut(name=name, unit=unit, value=values, stderr=middle))
    return told


def _list(group: Group, quantity: Quantity) -> Any:
    found = group.quantiles.get(quantity)
    return None if found is None else list(found)
