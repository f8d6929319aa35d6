"""Table 3, Figures 17 and 18: the pneumatic tube of 40 m, two patterns."""

from collections.abc import Mapping
from typing import Any

from plotly.graph_objects import Figure

from examples.paper import figures, published
from examples.paper.bench import METHODS, MethodRun, StudyBench
from examples.paper.document import Check, Plot, ReportTable, Section

LENGTH_M = 40
PARAMETER_NAMES = ("K", "T", "L")
TITLE = "Table 3, Figures 17 and 18: pneumatic tube of 40 m"
L_TOLERANCE_S, T_TOLERANCE = 0.010, 0.03


def store_records(bench: StudyBench) -> list[str]:
    """Store a record of the reference plant for each pattern."""
    return [
        bench.client.simulate_dataset(
            {
                "name": f"paper Table 3: tube {LENGTH_M} m, pattern {pattern}",
                "plant": "tube",
                "parameters": {"length_m": LENGTH_M, "pattern": pattern, "gauges": pattern},
            }
        )["id"]
        for pattern in (1, 2)
    ]


def job_body(records: list[str]) -> dict[str, Any]:
    """Build the request of the job: each pattern by itself, with every method."""
    labels = [{"pattern": float(n)} for n in (1, 2)]
    return {
        "name": f"paper Table 3: tube {LENGTH_M} m",
        "model": "tube",
        "datasets": records[:1],
        "channels": {"u": "P1", "y": "P2"},
        "algorithm": dict(published.SETTINGS),
        "sweep": {
            "axes": [
                {
                    "path": "/datasets",
                    "values": [[dataset] for dataset in records],
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
            "pressure at the other. The paper's records are not published. The reference plant "
            "simulates them: gas dynamics in the paper's tube, with 12-bit gauges and noise of "
            "0.5 kPa.",
            [_estimates_table(by_pattern)],
            [
                plot
                for n, by_method in enumerate(by_pattern)
                for plot in _build_plots(bench, n, by_method, records)
            ],
            build_checks(by_pattern),
            jobs=[runs[0]["job"]],
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
                    *(by_method[method].format_estimate(name) for method in METHODS),
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
    bench: StudyBench, number: int, runs: Mapping[str, MethodRun], records: list[str]
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
            figures.draw_rms_history(runs, "kPa", scale=1e-3),
            f"Paper: the error of the proposed search is smaller. Ours: {rms}.",
        ),
    ]


def _plot_signals(
    bench: StudyBench, runs: Mapping[str, MethodRun], records: list[str], number: int
) -> Figure:
    answer = bench.client.signals(records[number], 900)
    channels = {channel["name"]: channel for channel in answer["channels"]}
    looks = {"P1": (figures.GREEN, "inlet (1)"), "P2": (figures.GREY, "outlet (2)")}
    data = [
        figures.make_line(
            text,
            channels[name]["times"],
            _to_kilo(channels[name]["values"]),
            {"color": colour, "width": 1.6},
        )
        for name, (colour, text) in looks.items()
    ]
    model = runs["improved"].response["experiments"][0]["simulated"][0]
    dashed = {**figures.METHOD_LINES["improved"], "dash": "dash", "width": 1.4}
    data.append(figures.make_line("model", model["times"], _to_kilo(model["values"]), dashed))
    return figures.draw_lines(data, "time [s]", "pressure above atmosphere [kPa]")


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
