"""Show a result in a few lines, as HTML for a notebook, or as a table of pandas."""

from collections.abc import Iterator, Sequence
from html import escape
from math import isfinite
from typing import Any

from sysid.core.lazy_names import load_library
from sysid.core.text import (
    DASH,
    bracket_unit,
    format_estimate,
    format_interval,
    plain_estimate,
    plain_interval,
    plain_unit,
    split_estimate,
)
from sysid.core.units import find_conversion_factor
from sysid.core.value_documents import list_fields
from sysid.results.findings import list_untold_reasons
from sysid.results.parts import OrderComparison, PlantNoise, SearchEvidence
from sysid.results.result import FullResult, Result, find_output_unit
from sysid.uncertainty.estimates import Estimate

ESTIMATE_HEADINGS = ("parameter", "estimate", "95 % interval", "standard error", "unit", "status")
"""Columns of each table of estimates, in terminals, notebooks and pages alike."""

_MAX_NOTES = 3
_MAX_HORIZONS = 6
_BECAUSE = {
    "starts": "the search settled",
    "residuals": "the search settled, as nothing but noise is left",
    None: "the search has not settled",
}


def summarise_result(result: FullResult) -> str:
    """Summarise a result in a few lines: verdict, estimates, evidence, the first notes."""
    lines = [", ".join(_list_facts(result)), f"verdict: {result.verdict.text}"]
    rows = [ESTIMATE_HEADINGS, *map(list_estimate_cells, result.parameters)]
    lines += [f"  {'  '.join(cells).rstrip()}" for cells in _align_columns(rows)]
    lines += _list_checks(result)
    notes = _list_notes(result)
    lines += [f"note: {text}" for text in notes[:_MAX_NOTES]]
    if notes[_MAX_NOTES:]:
        lines.append(f"and {len(notes) - _MAX_NOTES} more in `warnings`")
    return "\n".join(lines)


def to_html(result: FullResult) -> str:
    """Write a result as HTML: verdict, estimates, evidence, all notes."""
    head = "".join(
        f"<th style='text-align:left'>{name}</th>"
        for name in map(str.capitalize, ESTIMATE_HEADINGS)
    )
    rows = "".join(f"<tr>{_write_cells(estimate)}</tr>" for estimate in result.parameters)
    facts = "<br>".join(
        escape(text)
        for text in [
            ", ".join(_list_facts(result)),
            f"verdict: {result.verdict.text}",
            *_list_checks(result),
        ]
    )
    notes = "".join(f"<li>{escape(text)}</li>" for text in _list_notes(result))
    details = f"<details open><summary>Notes</summary><ul>{notes}</ul></details>"
    return (
        f"<div><p>{facts}</p><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
        f"{details if notes else ''}</div>"
    )


def to_frame(result: FullResult) -> Any:
    """Return the estimates as a table of pandas, indexed by the names of the parameters.

    Raises
    ------
    MissingLibrary
        If pandas is not installed.
    """
    pandas = load_library("pandas", "to_pandas()")
    rows = [dict(_list_columns(estimate)) for estimate in result.parameters]
    names = [estimate.name for estimate in result.parameters]
    return pandas.DataFrame(rows, index=pandas.Index(names, name="parameter"))


def _list_columns(estimate: Estimate) -> Iterator[tuple[str, object]]:
    """List the columns of an estimate: its fields but for its name, the interval as two."""
    unknown = float("nan")
    yield "value", estimate.value
    yield "stderr", unknown if estimate.stderr is None else estimate.stderr
    low, high = (unknown, unknown) if estimate.interval95 is None else estimate.interval95
    yield from (("low95", low), ("high95", high), ("unit", estimate.unit))
    yield from (("status", estimate.status), ("lower", estimate.lower), ("upper", estimate.upper))
    shown = {"name", "value", "stderr", "interval95", "unit", "status", "lower", "upper"}
    for field in list_fields(Estimate):
        if field.name not in shown:
            value = getattr(estimate, field.name)
            yield field.name, " ".join(value) if isinstance(value, tuple) else value


def list_evidence(result: Result) -> list[str]:
    """List the evidence beside the findings: residual tests, noise, the order if none tells it."""
    evidence = [describe_times(result)] if result.time_unit != "s" else []
    if result.residual_tests.passed is not None:
        evidence.append(describe_residuals(result))
    if result.plant_noise is not None:
        evidence.append(describe_noise(result.plant_noise))
        evidence += describe_predictions(result.plant_noise, find_output_unit(result))
    if result.order_comparison is not None and not any(
        one.severity != "note" or one.explanation == "order" for one in result.findings
    ):
        evidence.append(describe_order(result.order_comparison))
    return [line for line in evidence if line]


def describe_times(result: Result) -> str:
    """Give the estimates in seconds in the unit of the record's times; empty if there are none."""
    size = find_conversion_factor(result.time_unit, "s")
    if size is None:
        return ""
    shown = []
    for one in result.parameters:
        if one.unit == "s":
            error = None if one.stderr is None else one.stderr / size
            shown.append(f"{one.name} {plain_estimate(one.value / size, error, status=one.status)}")
    return f"in {result.time_unit}: {', '.join(shown)}" if shown else ""


def describe_residuals(result: Result) -> str:
    """Say whether the residuals pass their tests; failed tests have their p-value.

    Beside a verdict without a condition, a failed test is followed by why it changes nothing.
    """
    tests = result.residual_tests
    failed = [
        f"{test.output} {'is not white' if test.input is None else f'depends on {test.input}'}"
        + ("" if test.p is None else f" (p = {test.p:.2g})" if test.p >= 1e-3 else " (p < 0.001)")
        for test in tests.tests
        if test.outcome == "failed"
    ]
    outcome = f"failed: {', '.join(dict.fromkeys(failed))}" if failed else "passed"
    if failed and result.verdict.trust == "trustworthy":
        outcome += "; no explanation of that moves an estimate" if result.explained else ", weakly"
    return f"residuals on {tests.data} data: {outcome}"


def describe_noise(noise: PlantNoise) -> str:
    """Say how large each source of noise is, and how well the free run fits."""
    sources = [
        f"{one.kind} at {one.place} {one.deviation:.2g}{plain_unit(one.unit)}"
        + ("" if one.correlation_time is None else f" with {one.correlation_time:.2g} s")
        for one in noise.sources
    ]
    free = "diverges" if noise.fit_free is None else f"fits {noise.fit_free:.1f} %"
    return f"noise: {', '.join(sources)}; the free run {free}"


def describe_predictions(noise: PlantNoise, unit: str) -> list[str]:
    """Say how large the errors of predictions are, from the next sample to the free run.

    Of many horizons each second one is told, and the furthest.
    """
    errors = noise.prediction_errors
    if not errors:
        return []
    told = errors if len(errors) <= _MAX_HORIZONS else (*errors[:-1:2], errors[-1])
    texts = [f"{_format_rms(one.rms)} at {one.samples}" for one in told]
    return [
        f"RMS of predictions so many samples ahead{bracket_unit(unit)}: {', '.join(texts)}, "
        f"free run {_format_rms(noise.rms_free)}"
    ]


def _format_rms(rms: float | None) -> str:
    return "diverged" if rms is None else f"{rms:.3g}"


def describe_search(evidence: SearchEvidence) -> str:
    """Say whether the search settled, and how many independent starts agree."""
    starts = f"{evidence.agreeing_starts} of {evidence.independent_starts}"
    return f"{_BECAUSE[evidence.because]}: {starts} independent starts ended here"


def describe_order(comparison: OrderComparison) -> str:
    """Say which order the data prefer, and the dead time with others that are open.

    That of the model itself stands in the table of estimates.
    """
    others = [fit for fit in comparison.open_fits if fit.model != comparison.model]
    preferred = comparison.preferred_model
    fits = comparison.open_fits if preferred is None else comparison.fits
    names = " and ".join(fit.model for fit in fits if fit.model != preferred)
    told = f"prefer {preferred} to {names}" if preferred else f"do not tell {names} apart"
    delays = ", ".join(
        f"{plain_estimate(fit.delay, fit.delay_stderr)}{plain_unit(comparison.unit)} with "
        f"{fit.model}"
        for fit in others
    )
    return f"order: the data {told}" + (f"; {comparison.delay} is {delays}" if delays else "")


def _list_checks(result: Result) -> list[str]:
    """List the evidence, and that the search settled; a finding tells that it did not."""
    settled = [describe_search(result.search)] if result.search.settled else []
    return [*list_evidence(result), *settled]


def _list_notes(result: FullResult) -> list[str]:
    """List what is noted: the warnings, and reasons of statuses that none of them tells."""
    return [*result.warnings, *list_untold_reasons(result.parameters, result.findings)]


def _list_facts(result: FullResult) -> Iterator[str]:
    if result.data is not None:
        yield f"Identification of {result.data.model.name!r}"
    else:
        yield "Identification"
    unit = plain_unit(find_output_unit(result))
    yield f"fit {_format_fit(result.fit_percent.estimation)}"
    yield f"RMS {result.rms:.4g}{unit}"
    if result.rms_validation is not None and result.fit_percent.validation is not None:
        yield f"validation fit {_format_fit(result.fit_percent.validation)}"
        yield f"validation RMS {result.rms_validation:.4g}{unit}"


def _format_fit(fit: float) -> str:
    return f"{fit:.2f} %" if isfinite(fit) else "undefined"


def _align_columns(rows: Sequence[tuple[str, ...]]) -> Iterator[list[str]]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]


def list_estimate_cells(estimate: Estimate) -> tuple[str, ...]:
    """List what is shown of an estimate under `ESTIMATE_HEADINGS`."""
    value, stderr, status = estimate.value, estimate.stderr, estimate.status
    shown, error = split_estimate(value, stderr, status=status)
    interval = plain_interval(
        estimate.interval95, stderr, status=status, open_ends=estimate.open_ends
    )
    unit = "" if estimate.unit == "1" else estimate.unit
    return estimate.name, shown, interval or DASH, error or DASH, unit, status


def _write_cells(estimate: Estimate) -> str:
    value, stderr, status = estimate.value, estimate.stderr, estimate.status
    shown, error = format_estimate(value, stderr, status=status)
    interval = format_interval(
        estimate.interval95, stderr, status=status, open_ends=estimate.open_ends
    )
    cells = (
        f"<b>{escape(estimate.name)}</b>",
        shown,
        interval or DASH,
        error or DASH,
        "" if estimate.unit == "1" else escape(estimate.unit),
        escape(status),
    )
    return "".join(f"<td style='text-align:left'>{cell}</td>" for cell in cells)
