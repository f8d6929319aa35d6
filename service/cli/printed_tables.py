"""Print results in a terminal: one run, a summary of many runs, a trend.

One run is printed with its coordinates, estimates, fit and warnings. Many runs are summarised by
counts, groups and kinds of warnings. A trend is printed as tables: batch, laws, predictions.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from service.cli.common import (
    ESTIMATE_HEADINGS,
    FieldOrigins,
    list_estimate_cells,
    out,
    print_json,
    print_line,
    print_note,
    print_table,
)
from service.client.calls import ProblemError
from service.core.bodies.job_fields import DATASETS_PATH
from service.core.label_text import format_labels
from service.trends.trend_text import PLAIN, build_tables, format_reference, list_notes
from sysid.core.text import append_unit, plain_unit

if TYPE_CHECKING:
    from service.client.client import Client


REUSE_NOTE = "this run was computed before; the result of {} is shown"


def run_coordinates(run: Mapping[str, Any]) -> dict[str, object]:
    """Return labels and axis values of a run; labels replace the ids of datasets."""
    labels = run["labels"]
    cell = {
        path.removeprefix("/").replace("/", "."): value
        for path, value in run["cell"].items()
        if not (labels and path.startswith(DATASETS_PATH))
    }
    return {**labels, **cell}


def print_run(run: Mapping[str, Any], as_json: bool) -> None:
    """Print the answer of `GET /v1/runs/{id}`."""
    if as_json:
        print_json(run)
        return
    print_line(f"{run['id']}  run {run['number'] + 1} of {run['job']}: {run['state']}")
    if coordinates := run_coordinates(run):
        print_line(format_labels(coordinates))
    if run["verdict"]:
        print_line(f"verdict: {run['verdict']['text']}")
    print_table(
        ESTIMATE_HEADINGS,
        map(list_estimate_cells, run["parameters"]),
        empty="no estimates" if run["finished_at"] else "no estimates yet",
    )
    if run["rms"] is not None:
        print_line(_format_fit(run))
    if run["error"]:
        print_line(run["error"])
    if run["reused_from"]:
        print_note(REUSE_NOTE.format(run["reused_from"]))
    for text in (*run["warnings"], *_list_untold_reasons(run)):
        print_note(text)


def _list_untold_reasons(run: Mapping[str, Any]) -> list[str]:
    from sysid.core.findings import Finding
    from sysid.core.value_documents import decode  # late: other commands start faster
    from sysid.results.findings import list_untold_reasons
    from sysid.uncertainty.estimates import Estimate

    estimates = decode(tuple[Estimate, ...], run["parameters"])
    return list_untold_reasons(estimates, decode(tuple[Finding, ...], run["findings"]))


def print_reuse_note(job: Mapping[str, Any], runs: Sequence[Mapping[str, Any]], cure: str) -> None:
    """Print which results were computed by earlier jobs, and how to compute them again."""
    reused, n_runs = job["progress"]["reused"], job["progress"]["runs"]
    if not reused:
        return
    if n_runs == 1 and runs:
        text = REUSE_NOTE.format(runs[0]["reused_from"])
    else:
        text = f"{reused} of {n_runs} runs were computed before; their results are shown"
    print_note(f"{text}. To compute again: {cure}")


def _format_fit(run: Mapping[str, Any]) -> str:
    fit = run["fit_percent"] or {}
    parts = [f"RMS {_format_rms(run, 'rms')}"]
    parts += [
        f"{name} {fit[part]:.2f} %"
        for name, part in (("fit", "estimation"), ("validation fit", "validation"))
        if fit.get(part) is not None
    ]
    if run["rms_validation"] is not None:
        parts.append(f"validation RMS {_format_rms(run, 'rms_validation')}")
    seconds = "" if run["seconds"] is None else f" in {run['seconds']:.2f} s"
    return f"{', '.join(parts)}; {run['evaluations']} simulations{seconds}"


def _format_rms(run: Mapping[str, Any], name: str) -> str:
    return f"{run[name]:.6g}{plain_unit(run['rms_unit'])}"


MAX_PRINTED = 50
"""Most runs, or groups of runs, that are printed one by one."""
MAX_WARNING_KINDS = 10
NUMBER_PATTERN = re.compile(r"\d[\d.,]*(e[-+]?\d+)?")
LOW_QUANTILE, MEDIAN, HIGH_QUANTILE = 0.05, 0.5, 0.95


def print_run_summary(
    client: "Client", job: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]
) -> None:
    """Print a summary of a job instead of its runs."""
    states = Counter(run["state"] for run in runs)
    counts = ", ".join(f"{count} {state}" for state, count in states.most_common())
    print_line(f"{job['id']}: {len(runs)} runs, {counts}")
    _print_groups(client, job)
    print_line(f"single runs: lagid runs {job['id']}")
    _print_warning_kinds([warning for run in runs for warning in run["warnings"]])


def _print_groups(client: "Client", job: Mapping[str, Any]) -> None:
    try:
        summary = client.summary(job["id"])
    except ProblemError as error:  # more groups than the server allows
        print_line(f"no groups: {error}")
        return
    groups, places = (
        summary["groups"],
        [summary["quantiles"].index(q) for q in (LOW_QUANTILE, MEDIAN, HIGH_QUANTILE)],
    )
    units = {
        parameter["name"]: parameter["unit"]
        for group in groups
        for parameter in group["parameters"]
    }
    headings = [
        *(key.removeprefix("/").replace("/", ".") for key in summary["by"]),
        ">runs",
        ">success",
        f"{append_unit('RMS', summary['rms_unit'])}: median, 5 to 95 %",
        *(append_unit(*name_and_unit) for name_and_unit in units.items()),
    ]
    print_table(
        headings,
        [_group_row(group, units, places) for group in groups[:MAX_PRINTED]],
        empty="no runs",
    )
    if len(groups) > MAX_PRINTED:
        print_line(f"… and {len(groups) - MAX_PRINTED} more groups")


def _group_row(
    group: Mapping[str, Any], units: dict[str, str], places: Sequence[int]
) -> list[object]:
    values = {parameter["name"]: parameter["value"] for parameter in group["parameters"]}
    return [
        *group["key"].values(),
        group["runs"],
        f"{100 * group['success_rate']:.0f} %",
        _format_band(group["rms"], places),
        *(_format_band(values.get(name), places) for name in units),
    ]


def _format_band(quantiles: Sequence[float] | None, places: Sequence[int]) -> str | None:
    if quantiles is None:
        return None
    low, middle, high = (f"{quantiles[index]:.4g}" for index in places)
    return f"{middle}, {low} to {high}"


def _print_warning_kinds(warnings: list[str]) -> None:
    """Print the first warning of each kind; warnings of one kind differ only in numbers."""
    kinds = Counter(NUMBER_PATTERN.sub("…", warning) for warning in warnings)
    first = {NUMBER_PATTERN.sub("…", warning): warning for warning in reversed(warnings)}
    for kind, count in kinds.most_common(MAX_WARNING_KINDS):
        print_line(f"note ({count} ×, for example): {first[kind]}")
    if len(kinds) > MAX_WARNING_KINDS:
        print_line(f"… and {len(kinds) - MAX_WARNING_KINDS} more kinds of notes")


def print_trend(trend: Mapping[str, Any], origins: FieldOrigins) -> None:
    """Print the answer of `GET /v1/jobs/{id}/trend`; notes name the options of `origins`."""
    tables = build_tables(trend, PLAIN)
    headings = [
        f">{trend['x']}",
        *(f">{heading}" for heading in tables.headings),
        ">measured span",
        ">evaluations",
        "flags",
    ]
    rows = [
        (row.x_text, *row.cells, row.span_text, row.evaluations, "; ".join(row.flags))
        for row in tables.rows
    ]
    print_table(headings, rows, empty="no run has succeeded")
    out.print()
    laws = [
        (law.quantity, law.text, f"{law.aic:.2f}", f"{law.birge:.2f}", law.is_chosen * "chosen")
        for law in tables.laws
    ]
    print_table(("quantity", "law", ">AIC", ">Birge ratio", ""), laws, empty="")
    for name, reason in tables.reasons:
        print_line(f"{name}: no law: {reason}")
    out.print()
    if tables.predictions:
        above = ("predicted", f">{trend['x']}", ">value", "95 % interval for a new estimate", "")
        print_table(above, tables.predictions, empty="")
        out.print()
    if trend["reference"] is not None:
        named = format_reference(trend)
        text = f"compared with {trend['reference']}{named and ', '}{named}"
        print_line(text)
    for note in list_notes(trend):
        print_note(origins.rewrite_note(note))
