"""Figure 15 with noise inside the equation: as a force, and as printed in Eq. 16."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from plotly.graph_objects import Figure

from examples.paper import figures, published
from examples.paper.bench import METHODS, StudyBench
from examples.paper.document import Plot, ReportTable, Section
from examples.paper.oscillators import EXAMPLE_1
from lagid import ProblemError

FORCE_SIGMAS = (0.1, 0.5, 1.0, 2.0)
PRINTED_SIGMAS = (0.01, 0.1)  # m
# φ(t) in Eq. 13 is a force, so the recursion needs it with h²/m; Eq. 16 adds it without.
BARE_TERM = "q(k-2))/m"
NOISE_TERMS = {
    "force": ("q(k-2) - sigma*phi(k-2))/m", "N"),
    "printed": ("q(k-2))/m + sigma*phi(k-2)", "m"),
}
N_DRAWS = 20
# Draws of unit deviation, one per channel; the models scale them.
NOISE_MODEL = {
    "name": "noise",
    "form": "difference",
    "states": {"x": "1"},
    "equations": {"x": "0"},
    "outputs": {f"phi_{n}": "x" for n in range(N_DRAWS)},
    "initial": {"x": 0},
}
SAMPLING = {"samples": published.SAMPLES, "sample_time": published.SAMPLE_TIME}


def model_document(recursion: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Build Example 1's recursion with φ as a second input."""
    after, unit = NOISE_TERMS[kind]
    equation = str(recursion["equations"]["x"])
    if equation.count(BARE_TERM) != 1:
        raise ValueError(f"the recursion {equation!r} must contain {BARE_TERM!r} exactly once")
    return {
        **recursion,
        "name": f"duffing-{kind}-noise",
        "inputs": {**recursion["inputs"], "phi": "1"},
        "parameters": {**recursion["parameters"], "sigma": {"lower": 0, "upper": 10, "unit": unit}},
        "equations": {"x": equation.replace(BARE_TERM, after)},
    }


def build_section(bench: StudyBench, exact: str) -> Section:
    """Build the section for both kinds of noise; `exact` is the dataset without noise."""
    draws = 3 if bench.quick else 8
    recursion = bench.client.model(EXAMPLE_1.recursion)["document"] or {}
    bench.say("paper Figure 15: records with noise inside the equation")
    noise = bench.client.simulate_dataset(
        {
            **SAMPLING,
            "name": "φ of Eq. 13, unit deviation",
            "model": NOISE_MODEL,
            "noise": {"sigma": 1.0, "seed": 1},
        }
    )["id"]
    force, printed = (model_document(recursion, kind) for kind in NOISE_TERMS)
    records = [
        (sigma, _simulate_record(bench, force, noise, sigma, draw))
        for sigma in FORCE_SIGMAS
        for draw in range(draws)
    ]
    stable_records = [(sigma, record) for sigma, record in records if record is not None]
    runs = bench.run_job(job_body(stable_records, exact))
    lost = [
        (
            sigma,
            sum(
                _simulate_record(bench, printed, noise, sigma, draw) is None
                for draw in range(N_DRAWS)
            ),
        )
        for sigma in PRINTED_SIGMAS
    ]
    medians = {
        method: [_median_error(runs, method, sigma) for sigma in FORCE_SIGMAS] for method in METHODS
    }
    return Section(
        "Figure 15, the noise inside the equation",
        "Eq. 13 adds φ(t) to the force q(t), so Eq. 16 should have h²φ(k)/m. Such noise moves the "
        f"mass and cannot be separated from its dynamics. {len(records)} records, {draws} draws "
        "for each σ, are identified without φ. The error is against the response without φ. As "
        "printed, φ(k) is added to the displacement at every step.",
        [
            ReportTable(
                "φ as a force: median error of the identified response [m]",
                ["σ [N]", *METHODS],
                [
                    [f"{sigma:g}", *(f"{medians[m][n]:.4f}" for m in METHODS)]
                    for n, sigma in enumerate(FORCE_SIGMAS)
                ],
            ),
            ReportTable(
                f"φ as printed: records that diverge within 300 samples, of {N_DRAWS} draws",
                ["", *(f"σ = {sigma:g} m" for sigma, _ in lost)],
                [["diverge", *(str(count) for _, count in lost)]],
            ),
        ],
        [
            Plot(
                "Figure 15: φ as a force",
                _plot_errors(runs, medians),
                "Paper: low up to σ about 0.5, then rising. Ours: medians and single runs. Force "
                "noise biases the estimates of every method alike. Minimising the simulation error "
                "treats motion caused by φ as the system's own.",
            )
        ],
        jobs=[runs[0]["job"]],
    )


def job_body(records: Sequence[tuple[float, str]], exact: str) -> dict[str, Any]:
    """Build the request of the job: every record with every method."""
    return {
        "name": "paper Figure 15: force noise",
        "model": EXAMPLE_1.recursion,
        "datasets": [records[0][1]],
        "validation": {"datasets": [exact]},
        "algorithm": dict(published.SETTINGS),
        "sweep": {
            "axes": [
                {
                    "path": "/datasets",
                    "values": [[record] for _, record in records],
                    "labels": [{"sigma": sigma} for sigma, _ in records],
                },
                {"path": "/algorithm/method", "values": list(METHODS)},
            ]
        },
    }


def _simulate_record(
    bench: StudyBench, model: dict[str, Any], noise: str, sigma: float, draw: int
) -> str | None:
    """Simulate the model driven by q and by a draw of φ; None if it diverges."""
    wave = {"kind": "cosine", "amplitude": published.AMPLITUDE, "omega": published.OMEGA}
    phi = {"kind": "dataset", "dataset": noise, "channel": f"phi_{draw}"}
    try:
        dataset = bench.client.simulate_dataset(
            {
                **SAMPLING,
                "name": f"paper example 1, φ of σ {sigma:g}, draw {draw}",
                "model": model,
                "parameters": {**EXAMPLE_1.true, "sigma": sigma},
                "inputs": {"q": wave, "phi": phi},
            }
        )
    except ProblemError as problem:
        if "diverges" not in str(problem):
            raise
        return None
    return str(dataset["id"])


def _select_errors(runs: Sequence[Mapping[str, Any]], method: str, sigma: float) -> list[float]:
    return [
        run["rms_validation"]
        for run in runs
        if run["cell"]["/algorithm/method"] == method
        and run["labels"]["sigma"] == sigma
        and run["rms_validation"] is not None
    ]


def _median_error(runs: Sequence[Mapping[str, Any]], method: str, sigma: float) -> float:
    return float(np.median(_select_errors(runs, method, sigma)))


def _plot_errors(
    runs: Sequence[Mapping[str, Any]], medians: Mapping[str, Sequence[float]]
) -> Figure:
    data = []
    for method in METHODS:
        single = [
            (sigma, value)
            for sigma in FORCE_SIGMAS
            for value in _select_errors(runs, method, sigma)
        ]
        data += [
            figures.make_points(method, [s for s, _ in single], [v for _, v in single], method),
            figures.make_line(
                method, list(FORCE_SIGMAS), medians[method], figures.METHOD_LINES[method]
            ),
        ]
    return figures.draw_lines(data, "standard deviation of φ [N]", "RMS error [m]")
