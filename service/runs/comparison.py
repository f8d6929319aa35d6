"""Use case of a comparison: several runs side by side, on the same data or on others."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations
from math import isfinite
from typing import Any

from sqlalchemy.orm import Session

from service.core.bodies.user_documents import to_finite
from service.core.errors import FieldError, InvalidRequest
from service.jobs.stored_run import StoredRun, load_run
from service.runs.run_schemas import (
    ComparedParameterOut,
    ComparedRunOut,
    ComparedValueOut,
    ComparisonOut,
)
from service.storage.storage_errors import RowNotFound
from sysid.core.text import plain_estimate, plain_unit
from sysid.core.value_documents import encode
from sysid.results.result import Result
from sysid.uncertainty.estimates import Estimate

_NORMAL_QUANTILE = 1.96  # of a 95 % interval
_DOUBTED = ("dependent", "ambiguous", "not settled", "refuted")  # by other explanations
_DATA_DIFFERENCES = {
    "datasets": "other datasets",
    "outputs": "other measured channels as outputs",
    "validation": "other validation data",
    "skip": "another number of skipped samples",
    "noise": "other added noise",
}


def compare_runs(session: Session, runs: Sequence[str], *, same_data: bool = True) -> ComparisonOut:
    """Compare runs, the best RMS first, or as they are named if their data differ.

    Parameters
    ----------
    same_data : bool
        Whether runs on different data are refused. Else the notes tell what does not compare.

    Raises
    ------
    InvalidRequest
        If a run is missing, has no result, is named twice, or was fitted to other data than
        the first.
    """
    ordered = load_compared_runs(session, runs, same_data=same_data)
    titles = build_titles(ordered)
    parameters = list(_compare_parameters(ordered, titles))
    return ComparisonOut(
        unit=_find_common_unit(ordered),
        runs=[_to_compared_run(stored, titles[stored.run.id]) for stored in ordered],
        parameters=parameters,
        notes=[parameter.note for parameter in parameters if parameter.differs]
        + [*_list_data_notes(ordered, titles), *_list_notes(ordered)],
    )


def load_compared_runs(
    session: Session, runs: Sequence[str], *, same_data: bool = True
) -> list[StoredRun]:
    """Load runs that can be compared, the best RMS first, or as named if their data differ.

    Raises
    ------
    InvalidRequest
        If a run is missing, has no result, is named twice, or was fitted to other data than
        the first.
    """
    candidates = _read_candidates(session, runs)
    if same_data:
        _check_same_data(candidates)
    elif not have_same_data(candidates):
        return candidates
    return sorted(candidates, key=lambda stored: _rank_rms(_get_result(stored).rms))


def _read_candidates(session: Session, runs: Sequence[str]) -> list[StoredRun]:
    candidates, faults = [], []
    for number, name in enumerate(runs):
        pointer = f"/runs/{number}"
        if name in runs[:number]:
            faults.append(FieldError(pointer, f"run {name!r} is named twice"))
            continue
        try:
            stored = load_run(session, name)
        except RowNotFound as error:
            faults.append(FieldError(pointer, str(error)))
            continue
        if stored.run.result is None:
            state = stored.run.state.value
            detail = f"run {name!r} is {state}. Only runs with a result can be compared"
            faults.append(FieldError(pointer, detail))
            continue
        candidates.append(stored)
    if faults:
        raise InvalidRequest(faults)
    return candidates


def _collect_data_settings(stored: StoredRun) -> dict[str, Any]:
    """Collect the settings that must be equal, or else the RMS of two runs do not compare."""
    body = stored.body
    return {
        "datasets": body["datasets"],
        "outputs": sorted(channel for _, channel in stored.channels.outputs),
        "validation": {k: v for k, v in (body["validation"] or {}).items() if v is not None},
        "skip": body["skip"],
        "noise": body["noise"],
    }


def have_same_data(candidates: Sequence[StoredRun]) -> bool:
    """Test whether all runs were fitted to the same data, so that their RMS compare."""
    return not any(_describe_data_difference(candidates[0], other) for other in candidates[1:])


def _check_same_data(candidates: Sequence[StoredRun]) -> None:
    first = candidates[0]
    faults = [
        FieldError(
            f"/runs/{number}",
            f"run {candidate.run.id!r} has {difference} than {first.run.id!r}. Only runs on the "
            "same data can be compared",
        )
        for number, candidate in enumerate(candidates[1:], 1)
        if (difference := _describe_data_difference(first, candidate))
    ]
    if faults:
        raise InvalidRequest(faults)


def _describe_data_difference(first: StoredRun, other: StoredRun) -> str:
    """Describe how the data of two runs differ; empty if they do not."""
    ours, theirs = _collect_data_settings(first), _collect_data_settings(other)
    texts = (text for name, text in _DATA_DIFFERENCES.items() if theirs[name] != ours[name])
    return " and ".join(texts)


def build_titles(ordered: Sequence[StoredRun]) -> dict[str, str]:
    """Build a title of each run, all different: the model, the job, then the number of the run.

    Jobs of equal names differ by the ends of their identifiers.
    """
    titles = {stored.run.id: stored.model.name for stored in ordered}
    jobs = {stored.job.id for stored in ordered}
    forms: list[Callable[[StoredRun], str]] = [
        lambda stored: f"{stored.model.name}, run {stored.run.number + 1}",
        lambda stored: f"{stored.job.name}, run {stored.run.number + 1}",
        lambda stored: f"{stored.job.name}, {stored.run.id[-6:]}",
    ]
    if len(jobs) > 1:
        forms[0] = lambda stored: stored.job.name
    for form in forms:
        repeated = Counter(titles.values())
        for stored in ordered:
            if repeated[titles[stored.run.id]] > 1:
                titles[stored.run.id] = form(stored)
    return titles


def _get_result(stored: StoredRun) -> Result:
    assert stored.result is not None  # only runs with a result are compared
    return stored.result


def _to_compared_run(stored: StoredRun, title: str) -> ComparedRunOut:
    result = _get_result(stored)
    criteria, tests, fit = result.criteria, result.residual_tests, result.fit_percent
    return ComparedRunOut(
        run=stored.run.id,
        job=stored.job.id,
        number=stored.run.number,
        model=stored.model.name,
        title=title,
        cell=stored.run.cell,
        parameters=criteria.parameters,
        samples=criteria.samples,
        rms=to_finite(result.rms),
        rms_validation=to_finite(result.rms_validation),
        fit_estimation=to_finite(fit.estimation),
        fit_validation=to_finite(fit.validation),
        aic=to_finite(criteria.aic),
        bic=to_finite(criteria.bic),
        residuals_passed=tests.passed,
        residuals_data=tests.data,
        evaluations=result.evaluations,
    )


def _compare_parameters(
    ordered: Sequence[StoredRun], titles: Mapping[str, str]
) -> Iterator[ComparedParameterOut]:
    """Compare parameters that have the same name and unit in at least two runs."""
    entries: dict[tuple[str, str], list[tuple[StoredRun, Estimate]]] = {}
    for stored in ordered:
        for estimate in stored.estimates:
            entries.setdefault((estimate.name, estimate.unit), []).append((stored, estimate))
    for (name, unit), values in entries.items():
        if len(values) < 2:
            continue
        pair = find_furthest_pair([estimate for _, estimate in values])
        note = ""
        if pair is not None:
            note = _describe_difference(
                name,
                unit,
                [(titles[values[i][0].run.id], values[i][1]) for i in pair],
                same_model=len({stored.model.name for stored, _ in values}) == 1,
            )
        n_intervals = sum(_has_ends(estimate.interval95) for _, estimate in values)
        yield ComparedParameterOut(
            name=name,
            unit=unit,
            differs=None if n_intervals < 2 else pair is not None,
            note=note,
            values=[
                ComparedValueOut.model_validate({**encode(e), "run": stored.run.id})
                for stored, e in values
            ],
        )


def _find_own_interval(estimate: Estimate) -> tuple[float, float] | None:
    """Find the 95 % interval of an estimate under its own model."""
    if estimate.status not in _DOUBTED or estimate.stderr is None:
        return estimate.interval95
    half = _NORMAL_QUANTILE * estimate.stderr
    return estimate.value - half, estimate.value + half


def find_furthest_pair(estimates: Sequence[Estimate]) -> tuple[int, int] | None:
    """Find the two estimates whose 95 % intervals are furthest apart; None if all overlap.

    A dependent value has the interval of its own model here, not that over other explanations.
    """
    own = {i: _find_own_interval(estimate) for i, estimate in enumerate(estimates)}
    intervals = {i: ends for i, ends in own.items() if ends is not None and _has_ends(ends)}
    gaps = {
        (i, j): max(intervals[i][0], intervals[j][0]) - min(intervals[i][1], intervals[j][1])
        for i, j in combinations(intervals, 2)
    }
    widest = max(gaps, key=lambda pair: gaps[pair], default=None)
    return widest if widest is not None and gaps[widest] > 0 else None


def _has_ends(interval: tuple[float, float] | None) -> bool:
    return interval is not None and all(map(isfinite, interval))


def _describe_difference(
    name: str, unit: str, pair: Sequence[tuple[str, Estimate]], *, same_model: bool
) -> str:
    texts = [
        (plain_estimate(one.value, one.stderr, status=one.status), title) for title, one in pair
    ]
    values = ", ".join(f"{text}{plain_unit(unit)} with {title}" for text, title in texts)
    return f"{name} depends on the {'run' if same_model else 'model'}: {values}"


def _find_common_unit(ordered: Sequence[StoredRun]) -> str:
    """Find the common unit of the RMS. Weighted outputs have none."""
    units = set()
    for stored in ordered:
        agreement = _get_result(stored).agreement.estimation
        outputs = {entry.output for entry in agreement}
        units.add(agreement[0].unit if len(outputs) == 1 else "1")
    return units.pop() if len(units) == 1 else "1"


def _list_data_notes(ordered: Sequence[StoredRun], titles: Mapping[str, str]) -> Iterator[str]:
    """Report which runs were fitted to other data than the first."""
    first = ordered[0]
    for other in ordered[1:]:
        if difference := _describe_data_difference(first, other):
            title = titles[other.run.id]
            yield (
                f"{title} has {difference} than {titles[first.run.id]}. "
                "Their RMS, fits and criteria do not compare"
            )


def _list_notes(ordered: Sequence[StoredRun]) -> Iterator[str]:
    """Report why numbers of the table do not compare."""
    if len({stored.body["prediction"] for stored in ordered}) > 1:
        yield (
            "some runs predict one step ahead and others simulate. "
            "Their RMS, fits and criteria do not compare"
        )
    losses = (
        {**stored.body["loss"], "noise_model": _get_result(stored).noise_model}
        for stored in ordered
    )
    if len({repr(sorted(loss.items())) for loss in losses}) > 1:
        yield "the runs were fitted with different losses. Each loss favours its own measure"
    if len({_get_result(stored).criteria.samples for stored in ordered}) > 1:
        yield (
            "the runs scored different numbers of samples, so AIC and BIC do not compare. "
            "Recursions do not score their initial samples. Give all runs the same skip"
        )


def _rank_rms(value: float) -> float:
    return value if isfinite(value) else float("inf")
