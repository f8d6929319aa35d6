"""Table 3, Figures 17 and 18: the pneumatic tube of 40 m, two patterns."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.paper import figures, published
from service.paper.bench import METHODS, MethodRun, StudyBench
from service.paper.document import Check, Plot, ReportTable, Section
from service.paper.oscillators import format_estimate
from sysid.figures import theme

LENGTH_M = 40
PARAMETER_NAMES = ("K", "T", "L")
TITLE = "Table 3, Figures 17 and 18: pneumatic tube of 40 m"
L_TOLERANCE_S, T_TOLERANCE = 0.010, 0.03


def find_records_folder() -> Path | None:
    """Find the folder of the reference records below LAGID_DATA; None if they are absent."""
    data = os.environ.get("LAGID_DATA")
    folder = Path(data or Path("..") / "shared" / "data") / "tube_reference"
    return folder if all(path.is_file() for path in _record_files(folder)) else None


@dataclass(frozen=True, slots=True)
class TubeRecords:
    """One dataset for each pattern, the names of their channels, and their origin."""

    datasets: list[str]
    inlet: str
    outlet: str
    origin: str


def store_records(bench: StudyBench) -> TubeRecords:
    """Store the reference records of LAGID_DATA or, if absent, records of the reference plant."""
    source = find_records_folder()
    if source is not None:
        ids = [
            bench.client.add_dataset(path, name=path.stem)["id"] for path in _record_files(source)
        ]
        return TubeRecords(ids, "P1_meas_Pa", "P2_meas_Pa", "The records are those of LAGID_DATA")
    bench.say("paper Table 3: the reference plant makes the records, as LAGID_DATA has none")
    datasets = [
        bench.client.simulate_dataset(
            {
                "name": f"paper Table 3: tube {LENGTH_M} m, pattern {pattern}",
                "plant": "tube",
                "parameters": {"length_m": LENGTH_M, "pattern": pattern, "gauges": pattern},
            }
        )["id"]
        for pattern in (1, 2)
    ]
    return TubeRecords(datasets, "P1", "P2", "LAGID_DATA has no records, so the service made them")


def _record_files(source: Path) -> list[Path]:
    return [source / f"tube_{LENGTH_M:03d}m_pattern{n}.csv" for n in (1, 2)]


def job_body(records: TubeRecords) -> dict[str, Any]:
    """Build the request of the job: each pattern by itself, with every method."""
    labels = [{"pattern": float(n)} for n in (1, 2)]
    return {
        "name": f"paper Table 3: tube {LENGTH_M} m",
        "model": "tube",
        "datasets": records.datasets[:1],
        "channels": {"u": records.inlet, "y": records.outlet},
        "algorithm": dict(published.SETTINGS),
        "sweep": {
            "axes": [
                {
                    "path": "/datasets",
                    "values": [[dataset] for dataset in records.datasets],
                    "labels": labels,
                },
                {"path": "/algorithm/method", "values": list(METHODS)},
            ]
        },
    }


def build_sections(bench: StudyBench) -> list[Section]:
    """Build the section."""
    records = store_records(bench)
    runs = bench.run_job(job_body(records))
    by_pattern: list[dict[str, MethodRun]] = [{}, {}]
    for run in runs:
        pattern = int(run["labels"]["pattern"]) - 1
        by_pattern[pattern][run["cell"]["/algorithm/method"]] = bench.read_run(run)
    return [
        Section(
            TITLE,
            "Model `tube`, K e^(−Ls)/(Ts + 1) (Eq. 21), from the pressure at one gauge to the "
            f"pressure at the other. {records.origin}: a gas-dynamic model of the paper's tube "
            "with 12-bit gauges and noise of 0.5 kPa. The paper's own records are not published.",
            [_estimates_table(by_pattern)],
            [
                plot
                for n, by_method in enumerate(by_pattern)
                for plot in _build_plots(bench, n, by_method, records)
            ],
            build_checks(by_pattern),
            links=[runs[0]["job"]],
        )
    ]


def _estimates_table(by_pattern: list[dict[str, MethodRun]]) -> ReportTable:
    rows = []
    for name in PARAMETER_NAMES:
        unit = by_pattern[0]["improved"].get_parameter(name)["unit"]
        for n, by_method in enumerate(by_pattern):
            printed = published.TABLE_3[n]
            label = name if unit == "1" else f"{name} [{unit}]"
            rows.append(
                [
                    f"{label}, pattern {n + 1}",
                    f"{printed.simple[name]:.4f}",
                    f"{printed.proposed[name]:.4f}",
                    *(format_estimate(by_method[method], name) for method in METHODS),
                ]
            )
    for n, by_method in enumerate(by_pattern):
        rms = (f"{by_method[m].run['rms'] / 1e3:.3f}" for m in METHODS)
        rows.append([f"RMS [kPa], pattern {n + 1}", "", "", *rms])
    return ReportTable(
        "Table 3",
        ["parameter", "paper, simple", "paper, proposed", *(f"ours, {m}" for m in METHODS)],
        rows,
        "A first-order model of a long tube leaves autocorrelated residuals. The standard errors "
        "account for this.",
    )


def _build_plots(
    bench: StudyBench, number: int, runs: Mapping[str, MethodRun], records: TubeRecords
) -> list[Plot]:
    pattern = number + 1
    rms = ", ".join(f"{m} ends at {runs[m].run['rms'] / 1e3:.2f} kPa" for m in METHODS)
    return [
        Plot(
            f"Figure 17: input and output, pattern {pattern}",
            _plot_signals(bench, runs, records, number),
            "Paper: the outlet follows the inlet late and smoothed. Ours: the same, with the "
            "response of the model identified by `improved`.",
        ),
        Plot(
            f"Figure 18: RMS of the best individual, pattern {pattern}",
            figures.plot_rms_history(runs, "kPa", scale=1e-3),
            f"Paper: the error of the proposed search is smaller. Ours: {rms}.",
        ),
    ]


def _plot_signals(
    bench: StudyBench, runs: Mapping[str, MethodRun], records: TubeRecords, number: int
) -> dict[str, Any]:
    answer = bench.client.signals(records.datasets[number], 900)
    channels = {channel["name"]: channel for channel in answer["channels"]}
    looks = {records.inlet: (theme.GREEN, "inlet (1)"), records.outlet: (theme.GREY, "outlet (2)")}
    data = [
        figures.line_trace(
            text,
            channels[name]["times"],
            _to_kilo(channels[name]["values"]),
            line={"color": colour, "width": 1.6},
        )
        for name, (colour, text) in looks.items()
    ]
    model = runs["improved"].response["experiments"][0]["simulated"][0]
    dashed = {**figures.method_style("improved"), "dash": "dash", "width": 1.4}
    data.append(figures.line_trace("model", model["times"], _to_kilo(model["values"]), line=dashed))
    return figures.plot_lines(data, "time [s]", "pressure [kPa absolute]")


def _to_kilo(values: list[float | None]) -> list[float | None]:
    return [None if value is None else value / 1e3 for value in values]


def build_checks(by_pattern: list[dict[str, MethodRun]]) -> list[Check]:
    """Check that the two patterns give the same tube."""
    first, second = (by_method["improved"] for by_method in by_pattern)
    difference = abs(first.get_estimate("L") - second.get_estimate("L"))
    constant = abs(first.get_estimate("T") - second.get_estimate("T")) / first.get_estimate("T")
    return [
        Check(
            f"L of the two patterns agrees within {1e3 * L_TOLERANCE_S:g} ms "
            f"({1e3 * difference:.2f} ms; the paper's differ by 15.6 ms)",
            difference <= L_TOLERANCE_S,
        ),
        Check(
            f"T of the two patterns agrees within {100 * T_TOLERANCE:g} % ({100 * constant:.2f} %; "
            "the paper's differ by 6.3 %)",
            constant <= T_TOLERANCE,
        ),
    ]
