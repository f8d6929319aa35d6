"""What a terminal tells at the end of a job of many runs: counts, groups, kinds of warnings."""

import re
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from service.calls import ProblemError
from service.cli.common import out, print_table, with_unit

if TYPE_CHECKING:
    from service.client import Client

MOST = 50
"""Runs, and groups of runs, that are printed one by one."""
MOST_KINDS = 10
NUMBER = re.compile(r"\d[\d.,]*(e[-+]?\d+)?")
LOW, MIDDLE, HIGH = 0.05, 0.5, 0.95


def print_many(client: "Client", job: dict[str, Any], runs: list[dict[str, Any]]) -> None:
    """Print a summary of a job instead of its runs."""
    states = Counter(run["state"] for run in runs)
    told = ", ".join(f"{count} {state}" for state, count in states.most_common())
    _line(f"{job['id']}: {len(runs)} runs, {told}")
    _groups(client, job)
    _line(f"single runs: lagid runs {job['id']}")
    _kinds([warning for run in runs for warning in run.get("warnings", [])])


def _groups(client: "Client", job: dict[str, Any]) -> None:
    try:
        summary = client.summary(job["id"])
    except ProblemError as error:  # more groups than the server parts runs into
        _line(f"no groups: {error}")
        return
    groups, places = summary["groups"], [summary["quantiles"].index(q) for q in (LOW, MIDDLE, HIGH)]
    units = {one["name"]: one["unit"] for group in groups for one in group["parameters"]}
    headings = [*(key.removeprefix("/").replace("/", ".") for key in summary["by"]), ">runs",
                ">success", f"{with_unit('RMS', summary['rms_unit'])}: median, 5 to 95 %",
                *(with_unit(*one) for one in units.items())]  # fmt: skip
    print_table(headings, [_row(one, units, places) for one in groups[:MOST]], empty="no runs")
    if len(groups) > MOST:
        _line(f"… and {len(groups) - MOST} groups more")


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
        _line(f"note ({count} ×, such as): {first[kind]}")
    if len(kinds) > MOST_KINDS:
        _line(f"… and {len(kinds) - MOST_KINDS} kinds of notes more")


def _line(text: str) -> None:
    out.print(text, markup=False, soft_wrap=True)
