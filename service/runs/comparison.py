"""Use case of a comparison: several candidate structures on the same data, side by side."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest
from service.core.json_pointer import body_of
from service.jobs.to_core import noise_model_of
from service.models.models import model_of_run
from service.repositories.jobs import JobRepository
from service.repositories.runs import RunRepository
from service.runs.schemas import ComparedParameter, ComparedRun, ComparedValue, ComparisonOut
from service.storage.errors import NotFound
from service.storage.tables import Job, Run
from sysid.models.model import Model

Document = Mapping[str, Any]

_DATA = {
    "datasets": "other datasets",
    "outputs": "other measured channels as outputs",
    "validation": "other data kept for validation",
    "skip": "another number of skipped samples",
    "noise": "other added noise",
}


class _Candidate(NamedTuple):
    """A run that is compared, and what its result is made from."""

    run: Run
    job: Job
    body: Document
    result: Document
    model: Model
    name: str


def compare(session: Session, runs: Sequence[str]) -> ComparisonOut:
    """Runs side by side, the best RMS first.

    Raises
    ------
    InvalidRequest
        If a run is not there, has no result, is named twice, or was fitted to other data than
        the first.
    """
    candidates = _candidates(session, runs)
    _check_same_data(candidates)
    ordered = sorted(candidates, key=lambda one: _or_infinite(one.result.get("rms")))
    titles = _titles(ordered)
    parameters = list(_parameters(ordered, titles))
    return ComparisonOut(
        unit=_unit(ordered), runs=[_row(one, titles[one.run.id]) for one in ordered],
        parameters=parameters,
        notes=[one.note for one in parameters if one.differs] + list(_notes(ordered)),
    )  # fmt: skip


def _candidates(session: Session, runs: Sequence[str]) -> list[_Candidate]:
    found, faults = [], []
    for number, name in enumerate(runs):
        pointer = f"/runs/{number}"
        if name in runs[:number]:
            faults.append(FieldError(pointer, f"run {name!r} is named twice"))
            continue
        try:
            run = RunRepository(session).get(name)
        except NotFound as error:
            faults.append(FieldError(pointer, str(error)))
            continue
        if run.result is None:
            detail = f"run {name!r} is {run.state.value}; only runs with a result are compared"
            faults.append(FieldError(pointer, detail))
            continue
        job = JobRepository(session).get(run.job_id)
        body = body_of(job.spec, run.cell)
        found.append(
            _Candidate(run, job, body, run.result, model_of_run(session, run, job), _name(body))
        )
    if faults:
        raise InvalidRequest(faults)
    return found


def _name(body: Document) -> str:
    model = body["model"]
    return model if isinstance(model, str) else str(model.get("name", "own equations"))


def _data_of(one: _Candidate) -> dict[str, Any]:
    """What must be the same: else the RMS of two runs say nothing about their models."""
    channels = one.body["channels"]
    return {
        "datasets": one.body["datasets"],
        "outputs": sorted(channels.get(output.name, output.name) for output in one.model.outputs),
        "validation": {k: v for k, v in (one.body["validation"] or {}).items() if v is not None},
        "skip": one.body["skip"],
        "noise": one.body["noise"],
    }


def _check_same_data(candidates: Sequence[_Candidate]) -> None:
    first = _data_of(candidates[0])
    faults = []
    for number, one in enumerate(candidates[1:], 1):
        other = _data_of(one)
        apart = [text for name, text in _DATA.items() if other[name] != first[name]]
        if apart:
            faults.append(FieldError(
                f"/runs/{number}",
                f"run {one.run.id!r} has {' and '.join(apart)} than {candidates[0].run.id!r}; "
                "only runs on the same data compare",
            ))  # fmt: skip
    if faults:
        raise InvalidRequest(faults)


def _titles(ordered: Sequence[_Candidate]) -> dict[str, str]:
    """Name of each run: its model, and the run's number where two have the same model."""
    names = [one.name for one in ordered]
    return {
        one.run.id: one.name if names.count(one.name) == 1 else f"{one.name}, run {_number(one)}"
        for one in ordered
    }


def _number(one: _Candidate) -> int:
    return int(one.run.number) + 1


def _row(one: _Candidate, title: str) -> ComparedRun:
    result = one.result
    criteria, tests, fit = result["criteria"], result["residual_tests"], result["fit_percent"]
    return ComparedRun(
        run=one.run.id, job=one.job.id, number=one.run.number, model=one.name, title=title,
        cell=one.run.cell, parameters=criteria["parameters"],
        samples=criteria["samples"], rms=result["rms"],
        rms_validation=result["rms_validation"], fit_estimation=fit["estimation"],
        fit_validation=fit["validation"], aic=criteria["aic"], bic=criteria["bic"],
        residuals_passed=tests.get("passed"), residuals_data=tests.get("data"),
        evaluations=result["evaluations"],
    )  # fmt: skip


def _parameters(
    ordered: Sequence[_Candidate], titles: Mapping[str, str]
) -> Iterator[ComparedParameter]:
    """Parameters that have the same name and unit in two runs or more."""
    kept: dict[tuple[str, str], list[tuple[_Candidate, Document]]] = {}
    for one in ordered:
        for estimate in one.result["parameters"]:
            kept.setdefault((estimate["name"], estimate["unit"]), []).append((one, estimate))
    for (name, unit), found in kept.items():
        if len(found) < 2:
            continue
        pair = _furthest([estimate for _, estimate in found])
        note = ""
        if pair is not None:
            note = _note(name, unit, [(titles[found[i][0].run.id], found[i][1]) for i in pair],
                         same_model=len({one.name for one, _ in found}) == 1)  # fmt: skip
        known = sum(_has_ends(estimate["interval95"]) for _, estimate in found)
        yield ComparedParameter(
            name=name, unit=unit, differs=None if known < 2 else pair is not None, note=note,
            values=[
                ComparedValue(run=one.run.id, value=e["value"], stderr=e["stderr"],
                              interval95=e["interval95"], status=e["status"])
                for one, e in found
            ],
        )  # fmt: skip


def _furthest(estimates: Sequence[Document]) -> tuple[int, int] | None:
    """The two estimates whose 95 % intervals are furthest apart; None if all of them meet."""
    known = [i for i, one in enumerate(estimates) if _has_ends(one["interval95"])]
    gaps = {
        (i, j): max(estimates[i]["interval95"][0], estimates[j]["interval95"][0])
        - min(estimates[i]["interval95"][1], estimates[j]["interval95"][1])
        for i, j in combinations(known, 2)
    }
    widest = max(gaps, key=lambda pair: gaps[pair], default=None)
    return widest if widest is not None and gaps[widest] > 0 else None


def _has_ends(interval: Sequence[float | None] | None) -> bool:
    return interval is not None and all(end is not None for end in interval)


def _note(
    name: str, unit: str, pair: Sequence[tuple[str, Document]], *, same_model: bool
) -> str:  # fmt: skip
    symbol = "" if unit == "1" else f" {unit}"
    told = ", ".join(f"{_plus_minus(estimate)}{symbol} with {title}" for title, estimate in pair)
    return f"{name} depends on the {'run' if same_model else 'model'}: {told}"


def _plus_minus(estimate: Document) -> str:
    """A value and its standard error, both to the error's second digit."""
    value, stderr = float(estimate["value"]), estimate["stderr"]
    if not stderr or stderr <= 0:
        return f"{value:.6g}"
    decimals = 1 - int(f"{stderr:.1e}".partition("e")[2])
    if not 0 <= decimals <= 9:
        return f"{value:.6g} ± {stderr:.2g}"
    return f"{value:.{decimals}f} ± {stderr:.{decimals}f}"


def _unit(ordered: Sequence[_Candidate]) -> str:
    """Unit of the RMS of all, if it is the same: several outputs are weighted together."""
    units = set()
    for one in ordered:
        agreement = one.result["agreement"]["estimation"]
        outputs = {entry["output"] for entry in agreement}
        units.add(agreement[0]["unit"] if len(outputs) == 1 else "1")
    return units.pop() if len(units) == 1 else "1"


def _notes(ordered: Sequence[_Candidate]) -> Iterator[str]:
    """What keeps numbers of the table from being compared."""
    if len({one.body["prediction"] for one in ordered}) > 1:
        yield (
            "some runs predict one step ahead and some simulate: "
            "their RMS, fits and criteria do not compare"
        )
    losses = ({**one.body["loss"], "noise_model": noise_model_of(one.result)} for one in ordered)
    if len({repr(sorted(loss.items())) for loss in losses}) > 1:
        yield "the runs were fitted with different losses, which favour each its own measure"
    if len({one.result["criteria"]["samples"] for one in ordered}) > 1:
        yield (
            "the runs scored different numbers of samples: AIC and BIC do not compare "
            "(recursions do not score the samples they start from; the same skip for all helps)"
        )


def _or_infinite(value: float | None) -> float:
    return float("inf") if value is None else value
