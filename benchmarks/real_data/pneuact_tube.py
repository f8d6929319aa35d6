"""Pneumatic tubes of 1 to 8 m, fill (measured): pooled repeats, the time lag over the length."""

import csv
from collections import defaultdict
from collections.abc import Mapping, Sequence
from math import sqrt
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.real_data.session import identify_all, parameter, program
from benchmarks.table import Row
from service.client.client import Client

TITLE = "pneuact tube, fill, medians over pressures"
LABELS = ["length_m", "p_nom_bar", "phase", "file", "repeat"]
SEPARABLE_FROM_M = 5.0  # the data's README: T and L are separable only from about here
NOT_SEPARABLE = {"ridge", "no time lag"}  # explanations that say so
PUBLISHED_MS = {3.0: 6.9, 4.0: 6.9, 6.0: 12.4, 8.0: 20.8}
Runs = Mapping[float, Sequence[dict[str, Any]]]


def measure(client: Client, folder: Path) -> list[Row]:
    """Upload, derive, identify each length's pressures in one job over REST, print."""
    source = folder / "pneuact_tube" / "pneuact_tube.csv"
    raw = client.add_dataset(source, name="pneuact tube", segments=",".join(LABELS))["id"]
    runs = {
        length: identify_all(client, _job(client, raw, length, several))
        for length, several in pressures(source).items()
    }
    _print_runs(runs)
    return _rows(runs)


def pressures(source: Path) -> dict[float, list[float]]:
    """Nominal pressures (bar) of the fill phase at each length (m)."""
    by_length: dict[float, set[float]] = defaultdict(set)
    with source.open(newline="") as lines:
        for row in csv.DictReader(lines):
            if row["phase"] == "fill":
                by_length[float(row["length_m"])].add(float(row["p_nom_bar"]))
    return {length: sorted(by_length[length]) for length in sorted(by_length)}


def _job(client: Client, raw: str, length: float, several: list[float]) -> dict[str, Any]:
    """A sweep over the pressures; a lag is sought up to half the record or the model's bound."""
    even = [pooled(client, raw, length, pressure, 0) for pressure in several]
    odd = [pooled(client, raw, length, pressure, 1) for pressure in several]
    half = [min(dataset["duration"] / 2, 1.0) for dataset in even]
    values = {
        "/datasets": [[dataset["id"]] for dataset in even],
        "/validation/datasets": [[dataset["id"]] for dataset in odd],
        "/parameters/L/upper": half,
    }
    return {
        "name": f"pneuact tube {length:g} m, fill",
        "model": "tube",
        "datasets": [even[0]["id"]],
        "validation": {"datasets": [odd[0]["id"]]},
        "channels": {"u": "p_in_bar", "y": "p_out_bar"},
        "loss": {"kind": "soft-l1", "scale": 0.1},
        "parameters": {"L": {"upper": half[0]}},
        "sweep": {
            "axes": [
                {"path": path, "values": each, "zip": "pressure"} for path, each in values.items()
            ]
        },
    }


def pooled(
    client: Client, raw: str, length: float, pressure: float, remainder: int
) -> dict[str, Any]:
    """The outlet of the even (0) or odd (1) repeats over the inlet curve of all (data's README)."""
    chosen = {"length_m": length, "p_nom_bar": pressure, "phase": "fill"}
    pooling = {
        "input": "p_in_bar",
        "outputs": ["p_out_bar"],
        "bin": 0.003,
        "start": 0,
        "stop": 1,
        "outputs_from": {"repeat": {"modulus": 2, "remainder": remainder}},
    }
    name = f"{length:g} m, {pressure:g} bar, fill, {'odd' if remainder else 'even'} repeats"
    return client.derive(raw, [{"select": chosen}, {"pool": pooling}], name=name)


def _print_runs(runs: Runs) -> None:
    print("\n| length, m | record | T, ms | L, ms | standard error, ms | fit, % | separable |")
    print("|--:|---|--:|--:|--:|--:|---|")
    for length, several in runs.items():
        for number, run in enumerate(several):
            lag, constant = parameter(run, "L"), parameter(run, "T")
            is_separable = "no" if _is_unseparated(run) else "yes"
            print(
                f"| {length:g} | pressure {number + 1} | {1e3 * constant['value']:.2f} "
                f"| {1e3 * lag['value']:.2f} | {1e3 * (lag['stderr'] or float('nan')):.2f} "
                f"| {run['fit_percent']['validation']:.1f} | {is_separable} |"
            )
    print("\nL/length has the slope 1/c = 2.92 ms/m at 343 m/s; published 3.19 ms/m over 3-8 m")


def _is_unseparated(run: Mapping[str, Any]) -> bool:
    """Whether a run tells that L is not known by itself: its status, or a finding."""
    found = {finding["explanation"] for finding in run["findings"]}
    return parameter(run, "L")["status"] != "identified" or bool(found & NOT_SEPARABLE)


def _rows(runs: Runs) -> list[Row]:
    rows = []
    lags: dict[float, tuple[float, float]] = {}
    for length, several in runs.items():
        fit = median(run["fit_percent"]["validation"] for run in several)
        estimates = [parameter(run, "L") for run in several]
        errors = [estimate["stderr"] for estimate in estimates if estimate["stderr"]]
        # A median of n estimates of about equal error has pi/2 of the variance of their mean.
        error = median(errors) * sqrt(1.5708 / len(several)) if errors else float("nan")
        lags[length] = (median(estimate["value"] for estimate in estimates), error)
        rows += [
            Row(f"{length:g} m, fit", fit, "%", 93.0 if length >= 3 else None, ">="),
            Row(f"{length:g} m, L", 1e3 * lags[length][0], "ms"),
            Row(f"{length:g} m, standard error of L", 1e3 * error, "ms"),
            _row_of_warnings(length, several),
        ]
    slope, error = _slope({length: lag for length, lag in lags.items() if length >= 3})
    return [
        *rows,
        Row("slope of L over 3-8 m", 1e3 * slope, "ms/m", 2.6, ">="),
        Row("slope of L over 3-8 m, from above", 1e3 * slope, "ms/m", 3.6),
        Row("standard error of the slope", 1e3 * error, "ms/m"),
    ]


def _row_of_warnings(length: float, several: Sequence[dict[str, Any]]) -> Row:
    """The part of the runs that warn; below 5 m the median one should."""
    part = sum(_is_unseparated(run) for run in several) / len(several)
    bar = 0.5 if length < SEPARABLE_FROM_M else None
    return Row(
        f"{length:g} m, part of the runs told that T and L are not separable", part, "1", bar, ">="
    )


def _slope(lags: Mapping[float, tuple[float, float]]) -> tuple[float, float]:
    """Slope (s/m) of a straight line by weighted least squares, and its standard error."""
    weights = {length: error**-2 for length, (_, error) in lags.items()}
    total = sum(weights.values())
    x = sum(weights[length] * length for length in lags) / total
    y = sum(weights[length] * lag for length, (lag, _) in lags.items()) / total
    spread = sum(weights[length] * (length - x) ** 2 for length in lags)
    moment = sum(weights[length] * (length - x) * (lags[length][0] - y) for length in lags)
    return moment / spread, spread**-0.5


if __name__ == "__main__":
    program(TITLE, __doc__ or "", measure)
