"""Figure 15 with the noise where the equations have it: as a force, and as Eq. 16 prints it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from service.client.calls import ProblemError
from service.paper import figures, published
from service.paper.bench import METHODS, Bench
from service.paper.document import Plot, Section, Table
from service.paper.oscillators import EXAMPLE_1

LEVELS = (0.1, 0.5, 1.0, 2.0)
PRINTED = (0.01, 0.1)  # m
# φ(t) in Eq. 13 is a force, so it comes into the recursion with h²/m; Eq. 16 adds it bare.
BARE = "q(k-2))/m"
TERMS = {
    "force": ("q(k-2) - sigma*phi(k-2))/m", "N"),
    "printed": ("q(k-2))/m + sigma*phi(k-2)", "m"),
}  # fmt: skip
DRAWS = 20
# Draws of unit deviation, one a channel; the models scale them.
NOISE = {
    "name": "noise", "form": "difference", "states": {"x": "1"}, "equations": {"x": "0"},
    "outputs": {f"phi_{n}": "x" for n in range(DRAWS)}, "initial": {"x": 0},
}  # fmt: skip
SHARED = {"samples": published.SAMPLES, "sample_time": published.SAMPLE_TIME}


def document(known: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Example 1's recursion with φ as a second input."""
    after, unit = TERMS[kind]
    equation = str(known["equations"]["x"])
    if equation.count(BARE) != 1:
        raise ValueError(f"the recursion {equation!r} has no {BARE!r} to put the noise beside")
    return {
        **known, "name": f"duffing-{kind}-noise", "inputs": {**known["inputs"], "phi": "1"},
        "parameters": {**known["parameters"], "sigma": {"lower": 0, "upper": 10, "unit": unit}},
        "equations": {"x": equation.replace(BARE, after)},
    }  # fmt: skip


def section(bench: Bench, exact: str) -> Section:
    """Both ways; `exact` is the dataset without any noise."""
    draws = 3 if bench.quick else 8
    known = bench.client.model(EXAMPLE_1.recursion)["document"]
    bench.say("paper Figure 15: records with noise inside the equation")
    noise = bench.client.simulate_dataset({
        **SHARED, "name": "φ of Eq. 13, unit deviation", "model": NOISE,
        "noise": {"sigma": 1.0, "seed": 1},
    })["id"]  # fmt: skip
    force, printed = (document(known, kind) for kind in TERMS)
    records = [
        (sigma, _record(bench, force, noise, sigma, draw))
        for sigma in LEVELS for draw in range(draws)
    ]  # fmt: skip
    kept = [(sigma, record) for sigma, record in records if record is not None]
    runs = bench.runs(job(kept, exact))
    lost = [
        (sigma, sum(_record(bench, printed, noise, sigma, draw) is None for draw in range(DRAWS)))
        for sigma in PRINTED
    ]
    medians = {method: [_median(runs, method, sigma) for sigma in LEVELS] for method in METHODS}
    return Section(
        "Figure 15, the noise inside the equation",
        "Eq. 13 has φ(t) beside the force q(t), so in Eq. 16 it ought to be h²φ(k)/m; there it "
        f"moves the mass and cannot be told from its dynamics. {len(records)} records of "
        f"{draws} draws for each σ, identified without knowledge of φ, the error taken against "
        "the response without φ. As printed, φ(k) is added to the displacement at every step.",
        [
            Table("φ as a force: median error of the identified response [m]", ["σ [N]", *METHODS],
                  [[f"{sigma:g}", *(f"{medians[m][n]:.4f}" for m in METHODS)]
                   for n, sigma in enumerate(LEVELS)]),
            Table(f"φ as printed: records that diverge within 300 samples, of {DRAWS} draws",
                  ["", *(f"σ = {sigma:g} m" for sigma, _ in lost)],
                  [["diverge", *(str(count) for _, count in lost)]]),
        ],
        [Plot("Figure 15: φ as a force", _figure(runs, medians),
              "Paper: low up to σ about 0.5, then rising. Ours: medians and single runs. Force "
              "noise bends the estimates of every method alike, since a search for the free "
              "run's error takes the motion that φ made for the system's own.")],
        links=[runs[0]["job"]],
    )  # fmt: skip


def job(records: Sequence[tuple[float, str]], exact: str) -> dict[str, Any]:
    """Body of the job: every record with every method."""
    return {
        "name": "paper Figure 15: force noise", "model": EXAMPLE_1.recursion,
        "datasets": [records[0][1]], "validation": {"datasets": [exact]},
        "algorithm": dict(published.SETTINGS),
        "sweep": {"axes": [
            {"path": "/datasets", "values": [[record] for _, record in records],
             "labels": [{"sigma": sigma} for sigma, _ in records]},
            {"path": "/algorithm/method", "values": list(METHODS)},
        ]},
    }  # fmt: skip


def _record(bench: Bench, model: dict[str, Any], noise: str, sigma: float, draw: int) -> str | None:
    """A record of the model driven by q and by a draw of φ; None if it diverges."""
    wave = {"kind": "cosine", "amplitude": published.AMPLITUDE, "omega": published.OMEGA}
    phi = {"kind": "dataset", "dataset": noise, "channel": f"phi_{draw}"}
    try:
        made = bench.client.simulate_dataset({
            **SHARED, "name": f"paper example 1, φ of σ {sigma:g}, draw {draw}", "model": model,
            "parameters": {**EXAMPLE_1.true, "sigma": sigma}, "inputs": {"q": wave, "phi": phi},
        })  # fmt: skip
    except ProblemError as problem:
        if "diverges" not in str(problem):
            raise
        return None
    return str(made["id"])


def _of(runs: Sequence[Mapping[str, Any]], method: str, sigma: float) -> list[float]:
    return [
        run["rms_validation"] for run in runs
        if run["cell"]["/algorithm/method"] == method and run["labels"]["sigma"] == sigma
        and run["rms_validation"] is not None
    ]  # fmt: skip


def _median(runs: Sequence[Mapping[str, Any]], method: str, sigma: float) -> float:
    return float(np.median(_of(runs, method, sigma)))


def _figure(
    runs: Sequence[Mapping[str, Any]], medians: Mapping[str, Sequence[float]]
) -> dict[str, Any]:
    data = []
    for method in METHODS:
        single = [(sigma, value) for sigma in LEVELS for value in _of(runs, method, sigma)]
        data += [
            figures.points(method, [s for s, _ in single], [v for _, v in single], method),
            figures.line(method, list(LEVELS), medians[method], line=figures.style(method)),
        ]
    return figures.chart(data, "standard deviation of φ [N]", "RMS error [m]")
