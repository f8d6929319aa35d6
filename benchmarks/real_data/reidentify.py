"""Re-identify a batch of tubes by the recipe: table, trend, cold and warm starts."""

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.real_data import pneuact_tube
from benchmarks.real_data.session import PEAK, data_folder, peak_memory_row, service
from benchmarks.real_data.tube_reference import LAST_DIGIT, REFERENCE
from benchmarks.table import Row, Skipped, parser, report
from service.client.client import Client

TITLE = "batch re-identification of tubes"
CHANNELS = {"u": "P1_meas_Pa", "y": "P2_meas_Pa"}
PREDICTED_M = 30.0
SAME = 0.05  # of a standard error: estimates this near are one result
SEPARABLE_FROM_M = 3.0
Batch = Sequence[tuple[float, Sequence[str]]]


@dataclass(frozen=True)
class BatchResult:
    """A batch that is over: its job, its trend, the results of its runs by their length."""

    job: str
    trend: dict[str, Any]
    runs: list[tuple[float, dict[str, Any]]]

    @property
    def first(self) -> int:
        """Simulations of the first run."""
        return int(self.runs[0][1]["evaluations"])

    @property
    def evaluations(self) -> int:
        """Simulations of all runs."""
        return sum(run["evaluations"] for _, run in self.runs)


def measure(client: Client, folder: Path, *, quick: bool = False) -> list[Row]:
    """Both sets of tubes; `quick`: the reference tubes only."""
    rows = _reference_tubes(client, folder / "tube_reference")
    return rows if quick else rows + _measured_tubes(client, folder / "pneuact_tube")


def run_batch(client: Client, batch: Batch, **fields: Any) -> BatchResult:
    """Submit a batch to the recipe and wait for it."""
    body = {
        "model": "tube",
        "label": "length_m",
        "predict": [PREDICTED_M],
        "batch": [{"x": x, "datasets": list(datasets)} for x, datasets in batch],
        **fields,
    }
    job = client.reidentify(body)
    job_end = client.wait(job["id"], progress=lambda _: PEAK.sample())
    if job_end["state"] != "succeeded":
        raise SystemExit(f"job {job['id']} {job_end['state']}: {job_end.get('error')}")
    runs = [(run["labels"]["length_m"], client.run(run["id"])) for run in client.runs(job["id"])]
    return BatchResult(job["id"], client.trend(job["id"]), runs)


def _reference_tubes(client: Client, folder: Path) -> list[Row]:
    stored = {
        (length, pattern): client.add_dataset(folder / f"tube_{length:03d}m_pattern{pattern}.csv")[
            "id"
        ]
        for length in REFERENCE
        for pattern in (1, 2)
    }
    rows: list[Row] = []
    cold_all, warm_all, first = 0, 0, None
    for pattern in (1, 2):
        batch = [(float(length), [stored[length, pattern]]) for length in REFERENCE]
        shared = {"channels": CHANNELS, "reuse": False}
        cold = run_batch(client, batch, **shared, warm_start="none")
        warm = run_batch(client, batch, **shared, warm_start="previous")
        rows += [row for x, run in warm.runs for row in _against_table(int(x), pattern, run)]
        rows.append(_apart(f"pattern {pattern}, warm from the neighbour", cold, warm))
        cold_all += cold.evaluations - cold.first  # the first of a chain has no neighbour
        warm_all += warm.evaluations - warm.first
        print_trend(f"tube reference, pattern {pattern}, fitted by itself", warm)
        if first is not None:
            again = run_batch(client, batch, **shared, reference=first)
            rows.append(_apart(f"pattern {pattern}, warm from pattern 1 at 40 m", cold, again))
            cold_all, warm_all = cold_all + cold.evaluations, warm_all + again.evaluations
        first = next(run["id"] for x, run in warm.runs if x == 40)
    jointly = [(float(length), [stored[length, 1], stored[length, 2]]) for length in REFERENCE]
    print_trend(
        "tube reference, both patterns together", run_batch(client, jointly, channels=CHANNELS)
    )
    print(f"\nthe same runs: cold starts {cold_all} simulations, warm starts {warm_all}")
    return [*rows, Row("cold over warm simulations", cold_all / warm_all, "1", 2.0, ">=")]


def _against_table(length: int, pattern: int, run: Mapping[str, Any]) -> list[Row]:
    """Deviations from the reference, beyond what its printed digits leave open."""
    constant, delay = REFERENCE[length][pattern - 1]
    estimates = {parameter["name"]: parameter["value"] for parameter in run["parameters"]}
    off = {
        name: max(abs(estimates[name] - reference) - LAST_DIGIT / 2, 0.0)
        for name, reference in (("T", constant), ("L", delay))
    }
    place = f"{length} m, pattern {pattern}"
    return [
        Row(f"{place}, T off the table", 100 * off["T"] / constant, "%", 1.0),
        Row(f"{place}, L off the table", 1e3 * off["L"], "ms", 2.0),
    ]


def _apart(name: str, cold: BatchResult, warm: BatchResult) -> Row:
    """The largest difference of an estimate, in its standard errors."""
    largest = 0.0
    for (_, first), (_, second) in zip(cold.runs, warm.runs, strict=True):
        for a, b in zip(first["parameters"], second["parameters"], strict=True):
            if a["stderr"]:
                largest = max(largest, abs(a["value"] - b["value"]) / a["stderr"])
    return Row(f"{name}, estimates off the cold start's", largest, "standard errors", SAME)


def _measured_tubes(client: Client, folder: Path) -> list[Row]:
    """pneuact, fill: each pressure a run of its own, pooled over the pressures of a length."""
    source = folder / "pneuact_tube.csv"
    labels = ",".join(pneuact_tube.LABELS)
    raw = client.add_dataset(source, name="pneuact tube", segments=labels)["id"]
    batch, shortest = [], 2.0
    for length, several in pneuact_tube.pressures(source).items():
        for pressure in several if length >= SEPARABLE_FROM_M else ():
            dataset = pneuact_tube.pooled(client, raw, length, pressure, 0)
            shortest = min(shortest, dataset["duration"])
            batch.append((length, [dataset["id"]]))
    result = run_batch(
        client,
        batch,
        channels={"u": "p_in_bar", "y": "p_out_bar"},
        trend_parameters=["T", "L"],
        loss={"kind": "soft-l1", "scale": 0.1},
        parameters={"L": {"upper": shortest / 2}},
    )
    print_trend("pneuact, fill, 3 to 8 m", result)
    law = next(law for law in _quantity(result, "L")["laws"] if law["law"] == "line")
    slope = law["coefficients"][1]
    return [
        Row("pneuact, slope of L over 3-8 m", 1e3 * slope["value"], "ms/m", 2.6, ">="),
        Row("pneuact, slope of L over 3-8 m, from above", 1e3 * slope["value"], "ms/m", 3.6),
        Row("pneuact, standard error of the slope", 1e3 * slope["stderr"], "ms/m"),
    ]


def _quantity(result: BatchResult, name: str) -> dict[str, Any]:
    return next(
        dict(quantity) for quantity in result.trend["quantities"] if quantity["name"] == name
    )


def print_trend(title: str, result: BatchResult) -> None:
    """Print the table of a batch, its laws and predictions."""
    quantities = result.trend["quantities"]
    names = [
        f"{quantity['name']}{'' if quantity['unit'] == '1' else ', ' + quantity['unit']}"
        for quantity in quantities
    ]
    print(f"\n### {title}: {result.evaluations} simulations\n")
    print(f"| length, m | runs | {' | '.join(names)} | measured span |")
    print(f"|--:|--:|{'--:|' * len(names)}--:|")
    for place in result.trend["labels"]:
        cells = [_format_point(quantity, place["x"]) for quantity in quantities]
        span = "; ".join(f"{span['lower']:.6g} to {span['upper']:.6g}" for span in place["spans"])
        print(f"| {place['x']:g} | {len(place['runs'])} | {' | '.join(cells)} | {span} |")
    print()
    for quantity in quantities:
        for law in quantity["laws"]:
            coefficients = ", ".join(
                f"{c['name']} = {c['value']:.4g} ± {c['stderr']:.2g}" for c in law["coefficients"]
            )
            chosen = ", chosen" if law["is_chosen"] else ""
            print(
                f"- {quantity['name']} = {law['formula']}: {coefficients}; AIC {law['aic']:.2f}, "
                f"Birge ratio {law['birge']:.2f}{chosen}"
            )
        for at in quantity["predictions"]:
            print(
                f"- {quantity['name']} at {at['x']:g} m: {at['value']:.4g}, 95 % interval "
                f"{at['lower']:.4g} to {at['upper']:.4g}"
            )


def _format_point(quantity: Mapping[str, Any], x: float) -> str:
    point = next((p for p in quantity["points"] if p["x"] == x), None)
    if point is None or point["value"] is None:
        return "–"
    error = "" if point["stderr"] is None else f" ± {point['stderr']:.2g}"
    return f"{point['value']:.4g}{error}{' (outlier)' if point['is_outlier'] else ''}"


def main() -> None:
    """Run the program from the command line."""
    options: argparse.Namespace = parser(__doc__ or "").parse_args()
    folder = data_folder()
    if folder is None:
        report(TITLE, [], [Skipped(TITLE, "LAGID_DATA is absent")], options)
        return
    with service() as (client, _):
        rows = measure(client, folder, quick=options.quick)
    skipped = [Skipped("pneuact", "--quick")] if options.quick else []
    report(TITLE, [*rows, peak_memory_row()], skipped, options)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
