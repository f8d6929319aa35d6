"""Figures 2 and 3: the truncated series of Eq. 5."""

from math import exp, factorial
from typing import Any

from examples.paper import figures
from examples.paper.bench import StudyBench
from examples.paper.document import Plot, ReportTable, Section, format_number

RATE, END_TIME = 0.8, 5.0
TERMS = (1, 2, 3, 4, 5)
# As printed, y(kT+1) follows y(kT), one second later. That is one step only if T is one second.
READINGS = (
    ("as printed: y(kT + 1), so T = 1 s", 1.0),
    ("as corrected: y((k + 1)T), T = 0.02 s", 0.02),
)


def model_document(n: int) -> dict[str, Any]:
    """Build the model document of Eq. 7 with terms up to power n."""
    powers = [f"(L*h*(k-1))**{i}/{factorial(i)}" for i in range(1, n + 1)]
    return {
        "name": f"exponential-{n}",
        "form": "difference",
        "states": {"y": "1"},
        "parameters": {"L": {"lower": 0, "upper": 2, "unit": "1/s"}},
        "equations": {"y": f"y(k-1) + h*({' + '.join(['1', *powers])})"},
        "outputs": {"y": "y"},
        "initial": {"y": 0},
    }


def exact_solution(t: float) -> float:
    """Compute the solution of Eq. 4 that starts at 0."""
    return (exp(RATE * t) - 1) / RATE


def build_sections(bench: StudyBench) -> list[Section]:
    """Build one section with both readings."""
    rows, plots = [], []
    for title, period in READINGS:
        bench.say(f"paper Figures 2 and 3, {title}")
        lines = {n: _simulate_series(bench, n, period) for n in TERMS}
        rows.append(
            [title, *(format_number(y[-1] - exact_solution(t[-1]), 4) for t, y in lines.values())]
        )
        plots += _build_plots(title, lines)
    return [
        Section(
            "Figures 2 and 3: truncated exponential series",
            f"dy/dt = exp(Lt), L = {RATE:g} 1/s, from y(0) = 0 to {END_TIME:g} s. The paper "
            "states neither T nor the span.",
            [
                ReportTable(
                    f"Error at {END_TIME:g} s",
                    ["reading", *(f"n = {n}" for n in TERMS)],
                    rows,
                    "More terms help until the error of Euler's step is greater. With T = 1 s, a "
                    "longer series cannot reduce it.",
                )
            ],
            plots,
        )
    ]


def _simulate_series(bench: StudyBench, n: int, period: float) -> tuple[list[float], list[float]]:
    dataset = bench.client.simulate_dataset(
        {
            "name": f"paper Figure 2, n = {n}, T = {period:g} s",
            "model": model_document(n),
            "parameters": {"L": RATE},
            "samples": round(END_TIME / period) + 1,
            "sample_time": period,
        }
    )
    series = bench.client.signals(dataset["id"])["channels"][0]
    return series["times"], [value for value in series["values"] if value is not None]


def _build_plots(title: str, lines: dict[int, tuple[list[float], list[float]]]) -> list[Plot]:
    times = next(iter(lines.values()))[0]
    fine = [END_TIME * k / 200 for k in range(201)]
    solid = {"color": figures.GREY, "width": 2.4}
    outputs = [figures.make_line("exact", fine, [exact_solution(t) for t in fine], solid)]
    errors = []
    for number, (n, (x, y)) in enumerate(lines.items()):
        looks = {"color": figures.COLOURS[number], "dash": "dash", "width": 1.6}
        outputs.append(figures.make_line(f"n = {n}", x, y, looks))
        off = [value - exact_solution(t) for t, value in zip(x, y, strict=True)]
        errors.append(figures.make_line(f"n = {n}", x, off, {**looks, "dash": "solid"}))
    first, last = (abs(lines[n][1][-1] - exact_solution(times[-1])) for n in (TERMS[0], TERMS[-1]))
    return [
        Plot(
            f"Figure 2, {title}",
            figures.draw_lines(outputs, "time [s]", "y"),
            "Paper: the dashed lines of the series approach the solid exact solution as n grows. "
            f"Ours too: n = {TERMS[-1]} reaches "
            f"{100 * lines[TERMS[-1]][1][-1] / exact_solution(times[-1]):.0f} % "
            f"of it at {END_TIME:g} s.",
        ),
        Plot(
            f"Figure 3, {title}",
            figures.draw_lines(errors, "time [s]", "ŷ − y"),
            "Paper: the error shrinks with n. Ours: at the end "
            f"{first:.3g} with n = {TERMS[0]} and {last:.3g} with n = {TERMS[-1]}.",
        ),
    ]
