"""One run in a terminal: what distinguishes it, its estimates, its fit, its warnings.

What a terminal tells at the end of a job of many runs: counts, groups, kinds of warnings.

A trend as tables: the batch, the laws, the predictions.
"""

import re
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from service.cli.common import Places, estimate, out, print_json, print_table, status_of, with_unit
from service.client.calls import ProblemError
from service.trends.text import Quantity, flags, law_text, notes, reference_text, span_text

if TYPE_CHECKING:
    from service.client.client import Client


DATA = "/datasets"
REUSED = "the same run was computed before: the result of {} is shown"


def place_of(run: dict[str, Any]) -> dict[str, object]:
    """Labels and values of axes of a run; where labels tell of the data, their ids are left out."""
    labels = run["labels"]
    cell = {
        path.removeprefix("/").replace("/", "."): _brief(value)
        for path, value in run["cell"].items()
        if not (labels and path.startswith(DATA))
    }
    return {**labels, **cell}


def show_run(run: dict[str, Any], as_json: bool) -> None:
    """Print what `GET /v1/runs/{id}` tells."""
    if as_json:
        print_json(run)
        return
    _line(f"{run['id']}  run {run['number'] + 1} of {run['job']}: {run['state']}")
    place = [f"{name} = {_plain(value)}" for name, value in place_of(run).items()]
    if place:
        _line(", ".join(place))
    print_table(
        ("parameter", ">estimate ± standard error", "unit", "95 % interval", "status"),
        [[one["name"], estimate(one), one["unit"], _interval(one["interval95"]), status_of(one)]
         for one in run["parameters"]],
        empty="no estimates" if run["finished_at"] else "no estimates yet",
    )  # fmt: skip
    if run["rms"] is not None:
        _line(_fit(run))
    if run["error"]:
        _line(run["error"])
    if run["reused_from"]:
        _line(f"note: {REUSED.format(run['reused_from'])}")
    for warning in run.get("warnings", []):
        _line(f"note: {warning}")


def tell_reused(job: dict[str, Any], runs: Sequence[dict[str, Any]], cure: str) -> None:
    """Say which results of a job were computed for others before, and how to have them anew."""
    reused, n_runs = job["progress"]["reused"], job["progress"]["runs"]
    if not reused:
        return
    if n_runs == 1 and runs:
        text = REUSED.format(runs[0]["reused_from"])
    else:
        text = f"{reused} of {n_runs} runs were computed before: their results are shown"
    _line(f"note: {text}; to compute anew: {cure}")


def _fit(run: dict[str, Any]) -> str:
    fit = run.get("fit_percent") or {}
    told = [f"RMS {_with_unit(run, 'rms')}"]
    told += [
        f"{name} {fit[part]:.2f} %"
        for name, part in (("fit", "estimation"), ("validation fit", "validation"))
        if fit.get(part) is not None
    ]
    if run.get("rms_validation") is not None:
        told.append(f"validation RMS {_with_unit(run, 'rms_validation')}")
    seconds = "" if run["seconds"] is None else f" in {run['seconds']:.2f} s"
    return f"{', '.join(told)}; {run['evaluations']} simulations{seconds}"


def _with_unit(run: dict[str, Any], name: str) -> str:
    unit = {"1": "", "σ": " standard deviations"}.get(run["rms_unit"], f" {run['rms_unit']}")
    return f"{run[name]:.6g}{unit}"


def _interval(ends: list[float | None] | None) -> str:
    if ends is None:
        return "–"
    low, high = ("open" if end is None else f"{end:.6g}" for end in ends)
    return f"{low} to {high}"


def _plain(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _brief(value: object) -> object:
    return value.get("name", "…") if isinstance(value, dict) else value


def _line(text: str) -> None:
    out.print(text, markup=False, soft_wrap=True)


MOST = 50
"""Runs, and groups of runs, that are printed one by one."""
MOST_KINDS = 10
NUMBER = re.compile(r"\d[\d.,]*(e[-+]?\d+)?")
LOW, MIDDLE, HIGH = 0.05, 0.5, 0.95


def print_many(client: "Client", job: dict[str, Any], runs: list[dict[str, Any]]) -> None:
    """Print a summary of a job instead of its runs."""
    states = Counter(run["state"] for run in runs)
    told = ", ".join(f"{count} {state}" for state, count in states.most_common())
    _run_line(f"{job['id']}: {len(runs)} runs, {told}")
    _groups(client, job)
    _run_line(f"single runs: lagid runs {job['id']}")
    _kinds([warning for run in runs for warning in run.get("warnings", [])])


def _groups(client: "Client", job: dict[str, Any]) -> None:
    try:
        summary = client.summary(job["id"])
    except ProblemError as error:  # more groups than the server parts runs into
        _run_line(f"no groups: {error}")
        return
    groups, places = summary["groups"], [summary["quantiles"].index(q) for q in (LOW, MIDDLE, HIGH)]
    units = {one["name"]: one["unit"] for group in groups for one in group["parameters"]}
    headings = [*(key.removeprefix("/").replace("/", ".") for key in summary["by"]), ">runs",
                ">success", f"{with_unit('RMS', summary['rms_unit'])}: median, 5 to 95 %",
                *(with_unit(*one) for one in units.items())]  # fmt: skip
    print_table(headings, [_row(one, units, places) for one in groups[:MOST]], empty="no runs")
    if len(groups) > MOST:
        _run_line(f"… and {len(groups) - MOST} groups more")


def _row(group: dict[str, Any], units: dict[str, str], places: Sequence[int]) -> list[object]:
    values = {one["name"]: one["value"] for one in group["parameters"]}
    return [
        *group["key"].values(), group["runs"], f"{100 * group['success_rate']:.0f} %",
        _band(group["rms"], places), *(_band(values.get(name), places) for name in units),
    ]  # fmt: skip


def _band(quantiles: Sequence[float] | None, places: Sequence[int]) -> str | None:
    if quantiles is None:
        return None
    low, middle, high = (f"{quantiles[place]:.4g}" for place in places)
    return f"{middle}, {low} to {high}"


def _kinds(warnings: list[str]) -> None:
    """Warnings that differ in their numbers only are of one kind, told by its first."""
    kinds = Counter(NUMBER.sub("…", one) for one in warnings)
    first = {NUMBER.sub("…", one): one for one in reversed(warnings)}
    for kind, count in kinds.most_common(MOST_KINDS):
        _run_line(f"note ({count} ×, such as): {first[kind]}")
    if len(kinds) > MOST_KINDS:
        _run_line(f"… and {len(kinds) - MOST_KINDS} kinds of notes more")


def _run_line(text: str) -> None:
    out.print(text, markup=False, soft_wrap=True)


def print_trend(trend: dict[str, Any], places: Places) -> None:
    """Print what `GET /v1/jobs/{id}/trend` tells, with notes that name the user's `places`."""
    shown = [
        one for one in trend["quantities"] if any(p["value"] is not None for p in one["points"])
    ]
    headings = [f">{trend['x']}", *(f">{_title(one)}" for one in shown), ">measured span",
                ">evaluations", "flags"]  # fmt: skip
    rows = [_trend_row(place, shown) for place in trend["places"]]
    print_table(headings, rows, empty="no run has succeeded")
    out.print()
    laws = [row for one in shown for row in _laws(one, trend["x"])]
    print_table(("quantity", "law", ">AIC", ">Birge ratio", ""), laws, empty="")
    for one in shown:
        if one["reason"]:
            out.print(f"{one['name']}: no law: {one['reason']}", markup=False, soft_wrap=True)
    out.print()
    predicted = [row for one in shown for row in _predictions(one)]
    if predicted:
        above = ("predicted", f">{trend['x']}", ">value", "95 % interval for a new estimate", "")
        print_table(above, predicted, empty="")
        out.print()
    if trend["reference"] is not None:
        named = reference_text(trend)
        text = f"compared with {trend['reference']}{named and ', '}{named}"
        out.print(text, markup=False, soft_wrap=True)
    for note in notes(trend):
        out.print(f"note: {places.in_note(note)}", markup=False, soft_wrap=True)


def _trend_row(place: dict[str, Any], quantities: list[Quantity]) -> list[object]:
    points = [next((p for p in one["points"] if p["x"] == place["x"]), None) for one in quantities]
    cells = [None if p is None or p["value"] is None else estimate(p) for p in points]
    told = flags(place, quantities)
    return [
        place["x"], *cells, "; ".join(map(span_text, place["spans"])) or None, place["evaluations"],
        "; ".join(told),
    ]  # fmt: skip


def _laws(one: Quantity, x: str) -> list[list[object]]:
    name = str(one["name"])
    return [
        [name, law_text(name, law, x, estimate), f"{law['aic']:.2f}", f"{law['birge']:.2f}",
         "chosen" if law["is_chosen"] else ""]
        for law in one["laws"]
    ]  # fmt: skip


def _predictions(one: Quantity) -> list[list[object]]:
    return [_predicted(one, place) for place in one["predictions"]]


def _predicted(one: Quantity, place: dict[str, Any]) -> list[object]:
    told: list[object] = [one["name"], place["x"]]
    if place["value"] is None or place["lower"] is None:
        return [*told, None, "–", "the law has no value here"]
    unit = "" if one["unit"] in ("", "1") else f" {one['unit']}"
    interval = f"{place['lower']:.4g} to {place['upper']:.4g}{unit}"
    outside = "extrapolated" if place["is_outside"] else ""
    return [*told, f"{place['value']:.4g}{unit}", interval, outside]


def _title(one: Quantity) -> str:
    return str(one["name"]) + ("" if one["unit"] in ("", "1") else f" [{one['unit']}]")
