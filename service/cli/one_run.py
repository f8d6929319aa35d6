"""One run in a terminal: what distinguishes it, its estimates, its fit, its warnings."""

from collections.abc import Sequence
from typing import Any

from service.cli.common import estimate, out, print_json, print_table, status_of

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
    if run.get("reused_from"):
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
