"""Examples 1 and 2 (Tables 1 and 2, Figures 7 to 14), for each reading of the equations."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from examples.paper import figures, published
from examples.paper.bench import METHODS, MethodRun, StudyBench
from examples.paper.cramer_rao import cramer_rao_bound
from examples.paper.document import Check, Plot, ReportTable, Section, format_number
from examples.paper.published import PublishedColumns
from lagid import Channel


@dataclass(frozen=True, slots=True)
class Example:
    """An example of section 4."""

    number: int
    table: int
    figures: tuple[int, int, int, int]  # first parameters, last parameters, RMS, response
    true: Mapping[str, float]
    columns: PublishedColumns
    recursion: str
    continuous: str
    simple_search_remark: str  # what the paper says of the simple search


@dataclass(frozen=True, slots=True)
class EquationReading:
    """A reading of the equations: the model, and the input's frequency in rad/s."""

    title: str
    model: str
    omega: float
    remark: str


EXAMPLE_1 = Example(
    1,
    1,
    (7, 8, 9, 10),
    published.TRUE_1,
    published.TABLE_1,
    "duffing-eq16",
    "duffing-delay",
    "stops near generation 54",
)
EXAMPLE_2 = Example(
    2,
    2,
    (11, 12, 13, 14),
    published.TRUE_2,
    published.TABLE_2,
    "coulomb-eq16",
    "coulomb-delay",
    "cannot lower the error further",
)


def list_readings(example: Example) -> list[EquationReading]:
    """List the corrected reading, the differential equation, and the literal reading."""
    return [
        EquationReading(
            "Eq. 16 with cos(ωhk)",
            example.recursion,
            published.OMEGA,
            "the paper's recursion, the input sampled at the times hk",
        ),
        EquationReading(
            "Eq. 13 itself",
            example.continuous,
            published.OMEGA,
            "the delay differential equation, which the recursion approximates",
        ),
        EquationReading(
            "Eq. 16 as printed, cos(ωk)",
            example.recursion,
            published.OMEGA / published.SAMPLE_TIME,
            "the input as printed, without h: 250 rad/s, which samples 0.02 s apart cannot follow",
        ),
    ]


def record_body(example: Example, reading: EquationReading) -> dict[str, Any]:
    """Build the request of the record: the reading's model, true parameters, measurement noise."""
    wave = {"kind": "cosine", "amplitude": published.AMPLITUDE, "omega": reading.omega}
    return {
        "name": f"paper example {example.number}, {reading.title}",
        "model": reading.model,
        "parameters": dict(example.true),
        "inputs": {"q": wave},
        "samples": published.SAMPLES,
        "sample_time": published.SAMPLE_TIME,
        "noise": {"sigma": published.SIGMA, "seed": 1},
    }


def job_body(example: Example, reading: EquationReading, record: str) -> dict[str, Any]:
    """Build the request of the job, with the settings of section 4."""
    return {
        "name": f"paper Table {example.table}: {reading.title}",
        "model": reading.model,
        "datasets": [record],
        "algorithm": dict(published.SETTINGS),
    }


def build_sections(bench: StudyBench, example: Example) -> list[Section]:
    """Build one section for each reading."""
    return [_build_section(bench, example, reading) for reading in list_readings(example)]


def _build_section(bench: StudyBench, example: Example, reading: EquationReading) -> Section:
    record = bench.client.simulate_dataset(record_body(example, reading))
    runs = bench.compare_methods(job_body(example, reading, record["id"]))
    least = reading_bound(example, reading)
    return Section(
        f"Table {example.table}, Figures {example.figures[0]} to {example.figures[-1]}: "
        f"Example {example.number}, {reading.title}",
        f"Model `{reading.model}`: {reading.remark}. {published.SAMPLES} samples, "
        f"h = {published.SAMPLE_TIME:g} s, measurement noise of sd {published.SIGMA:g} m.",
        [estimates_table(example, runs, least), efforts_table(runs)],
        build_plots(example, runs),
        build_checks(example, runs, least),
        jobs=[runs["improved"].run["job"]],
    )


def reading_bound(example: Example, reading: EquationReading) -> dict[str, float]:
    """Compute the Cramér–Rao bound of the reading's record."""
    times = np.arange(published.SAMPLES, dtype=np.float64) * published.SAMPLE_TIME
    force = published.AMPLITUDE * np.cos(reading.omega * times)
    inputs = [Channel("q", times, force, "N")]
    return cramer_rao_bound(reading.model, inputs, example.true, published.SIGMA, times)


def estimates_table(
    example: Example, runs: Mapping[str, MethodRun], least: Mapping[str, float]
) -> ReportTable:
    """Build the table of the paper's columns and ours, with standard errors and the bound."""
    rows = []
    for name, true in example.true.items():
        unit = runs["improved"].get_parameter(name)["unit"]
        rows.append(
            [
                f"{name} [{unit}]",
                f"{true:g}",
                f"{example.columns.simple[name]:.6f}",
                f"{example.columns.proposed[name]:.6f}",
                *(runs[method].format_estimate(name) for method in METHODS),
                format_number(least[name], 2),
            ]
        )
    for name, true in example.true.items():
        printed = (example.columns.simple[name], example.columns.proposed[name])
        ours = [runs[method].get_estimate(name) for method in METHODS]
        rows.append(
            [
                f"error of {name}",
                "",
                *(f"{abs(value - true):.4f}" for value in (*printed, *ours)),
                "",
            ]
        )
    return ReportTable(
        f"Table {example.table}",
        [
            "parameter",
            "true",
            "paper, simple",
            "paper, proposed",
            *(f"ours, {method}" for method in METHODS),
            "Cramér–Rao sd",
        ],
        rows,
        "Ours: estimate ± standard error. The paper's noise draw is not published. Its columns "
        f"are the same under every reading. {_compare_with_bound(example, least)}",
    )


def _compare_with_bound(example: Example, least: Mapping[str, float]) -> str:
    """Compare the paper's errors with the Cramér–Rao bound."""
    ratios = {
        name: abs(example.columns.proposed[name] - true) / least[name]
        for name, true in example.true.items()
    }
    text = ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items())
    comparison = f"The paper's proposed errors over the Cramér–Rao sd of this record: {text}"
    if below := [name for name, ratio in ratios.items() if ratio < 0.5]:
        return (
            f"{comparison}. Errors below half of it ({', '.join(below)}) are smaller than an ideal "
            "estimator's on average: a lucky draw, or less noise than here."
        )
    return f"{comparison}."


def efforts_table(runs: Mapping[str, MethodRun]) -> ReportTable:
    """Build the table of RMS and number of simulations of each method."""
    return ReportTable(
        "Search",
        ["", *METHODS],
        [
            ["RMS [m]", *(f"{runs[m].run['rms']:.6f}" for m in METHODS)],
            ["simulations", *(str(runs[m].run["evaluations"]) for m in METHODS)],
        ],
    )


def build_plots(example: Example, runs: Mapping[str, MethodRun]) -> list[Plot]:
    """Draw the four figures of an example."""
    names = list(example.true)
    firsts, lasts, rms, response = example.figures
    ends = {method: _absolute_errors(runs[method], example.true) for method in METHODS}
    reached = {method: runs[method].run["rms"] for method in METHODS}
    return [
        Plot(
            f"Figure {number}: convergence of {' and '.join(pair)}",
            figures.draw_convergence(runs, pair, example.true),
            "Paper: the proposed search continues to the true values after the simple one has "
            f"stopped. Ours: {_describe_ends(ends, pair)}",
        )
        for number, pair in ((firsts, names[:2]), (lasts, names[2:]))
    ] + [
        Plot(
            f"Figure {rms}: RMS of the best individual",
            figures.draw_rms_history(runs, "m", published.SIGMA),
            f"Paper: the simple search {example.simple_search_remark}"
            ", the proposed one continues in steps. Ours: "
            + ", ".join(f"{method} ends at {value:.5f} m" for method, value in reached.items())
            + f"; the noise alone has {published.SIGMA:g} m.",
        ),
        Plot(
            f"Figure {response}: responses",
            figures.draw_responses(runs),
            "Paper: the simple search leaves a visible residual, the proposed one lies on the "
            "exact solution. Ours: RMS over the sd of the noise is "
            + ", ".join(f"{value / published.SIGMA:.2f} ({m})" for m, value in reached.items())
            + "; 1 is a perfect fit.",
        ),
    ]


def _absolute_errors(run: MethodRun, true: Mapping[str, float]) -> dict[str, float]:
    return {name: abs(run.get_estimate(name) - value) for name, value in true.items()}


def _describe_ends(ends: Mapping[str, Mapping[str, float]], names: list[str]) -> str:
    parts = [
        f"{method} ends {' and '.join(f'{off[name]:.2g} from {name}' for name in names)}"
        for method, off in ends.items()
    ]
    return "; ".join(parts) + "."


def build_checks(
    example: Example, runs: Mapping[str, MethodRun], least: Mapping[str, float]
) -> list[Check]:
    """Check the paper's claim and the estimates of `improved`."""
    rms = {method: runs[method].run["rms"] for method in METHODS}
    ours = runs["improved"]
    within = {
        name: abs(ours.get_estimate(name) - true) / least[name]
        for name, true in example.true.items()
    }
    worst = max(within, key=lambda name: within[name])
    return [
        Check(
            "the sequence search ends no higher than the simple search "
            f"({rms['improved-paper']:.5f} against {rms['simple']:.5f} m)",
            rms["improved-paper"] <= rms["simple"],
        ),
        Check(
            "`improved` reaches the noise: RMS at most 1.01 of its sd "
            f"({rms['improved'] / published.SIGMA:.3f})",
            rms["improved"] <= 1.01 * published.SIGMA,
        ),
        Check(
            f"`improved` lies within three Cramér–Rao sd of the truth (farthest: {worst}, "
            f"{within[worst]:.2f} sd)",
            within[worst] <= 3,
        ),
    ]
