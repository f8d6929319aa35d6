"""Measure hits and length of searches on twelve systems with wide bounds and three noise levels.

Bounds span up to four decades, time lags up to half the record. Each search has its own noise draw
and seed, the default method and no budget but its 400 generations. A search hits if its champion,
refined, lies within 0.01 % of the lowest RMS that is reached from it or from the true values.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import mean, median
from typing import Any

import numpy as np

from benchmarks.searches import NEAR
from benchmarks.systems import System, switching
from benchmarks.table import Row, parser, report
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.identification.run import advance_run, begin_run
from sysid.search.refine import refine_candidates

FIRST_SEED, SEARCHES, QUICK = 520_000, 16, 2
NOISES = (0.02, 0.1, 0.3)
"""Standard deviations of the noise, as shares of the output's."""

Bounds = tuple[float, float] | tuple[float, float, str]


@dataclass(frozen=True)
class Search:
    """Whether a search hit the optimum, and what it took."""

    hits: bool
    generations: int
    evaluations: int


def sines(level: float, rates: Sequence[float], seed: int) -> Callable[[FloatArray], FloatArray]:
    """A sum of sines of random phases."""

    def signal(times: FloatArray) -> FloatArray:
        phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(rates))
        total = np.sin(np.outer(times, rates) + phases).sum(axis=1)
        return np.asarray(level * total / np.sqrt(len(rates)))

    return signal


def raised(level: float, signal: Callable[[FloatArray], FloatArray]) -> Any:
    """A signal with an offset."""
    return lambda times: level + signal(times)


def document(
    parameters: Mapping[str, Bounds],
    equations: Mapping[str, str],
    output: str,
    initial: Mapping[str, Any],
    **other: Any,
) -> dict[str, Any]:
    """A model document in which every unit is 1."""
    fields = ("lower", "upper", "scale")
    return {
        "name": "wide",
        "form": "differential",
        "inputs": {"u": "1"},
        "states": dict.fromkeys(equations, "1"),
        "parameters": {
            name: dict(zip(fields, bounds, strict=False)) for name, bounds in parameters.items()
        },
        "equations": dict(equations),
        "outputs": {"y": output},
        "initial": dict(initial),
        **other,
    }


def steps(count: int, method: str = "rk4") -> dict[str, Any]:
    """The solver."""
    return {"method": method, "substeps": count}


SYSTEMS = (
    System(
        "oscillator with dead time",
        document(
            {
                "K": (-100, 100),
                "w": (0.05, 50, "log"),
                "z": (0, 3),
                "L": (0, 15),
                "y0": (-50, 50),
            },
            {"x": "v", "v": "w**2*(K*u(t - L) - x) - 2*z*w*v"},
            "x + y0",
            {"x": 0, "v": 0},
            solver=steps(4),
        ),
        400,
        0.075,
        {"K": 3, "w": 2.2, "z": 0.15, "L": 1.9, "y0": 4},
        switching(1, 12, 11),
    ),
    System(
        "two resonances",
        document(
            {
                "K1": (-50, 50),
                "w1": (0.1, 30, "log"),
                "z1": (0, 2),
                "K2": (-50, 50),
                "r": (1.05, 20, "log"),
                "z2": (0, 2),
            },
            {
                "x1": "v1",
                "v1": "w1**2*(K1*u - x1) - 2*z1*w1*v1",
                "x2": "v2",
                "v2": "(r*w1)**2*(K2*u - x2) - 2*z2*r*w1*v2",
            },
            "x1 + x2",
            {"x1": 0, "v1": 0, "x2": 0, "v2": 0},
            solver=steps(3),
        ),
        500,
        0.04,
        {"K1": 2, "w1": 1.7, "z1": 0.1, "K2": 0.8, "r": 3.6, "z2": 0.05},
        switching(1, 15, 12),
    ),
    System(
        "valve with a dead zone",
        document(
            {
                "K": (-20, 20),
                "T1": (0.05, 200, "log"),
                "r": (0.05, 1),
                "L": (0, 20),
                "d": (0, 2),
                "y0": (-50, 50),
            },
            {
                "w": "(K*(max(u(t - L) - d, 0) + min(u(t - L) + d, 0)) - w)/T1",
                "x": "(w - x)/(r*T1)",
            },
            "x + y0",
            {"w": 0, "x": 0},
            solver=steps(4),
        ),
        400,
        0.1,
        {"K": 4, "T1": 1.5, "r": 0.4, "L": 3.1, "d": 0.35, "y0": 10},
        switching(1, 15, 13),
    ),
    System(
        "saturating sensor",
        document(
            {
                "K": (-50, 50),
                "T": (0.01, 100, "log"),
                "L": (0, 20),
                "A": (0.1, 100, "log"),
                "b": (-5, 5),
            },
            {"x": "(K*u(t - L) - x)/T"},
            "A*tanh(x + b)",
            {"x": 0},
            solver=steps(2),
        ),
        400,
        0.1,
        {"K": 2.5, "T": 1.1, "L": 4.2, "A": 7, "b": 0.4},
        switching(1, 10, 14),
    ),
    System(
        "two tanks",
        document(
            {"K": (0, 50), "k1": (0.01, 20, "log"), "k2": (0.01, 20, "log"), "L": (0, 50)},
            {
                "a": "K*u(t - L) - k1*sqrt(max(a, 0))",
                "b": "k1*sqrt(max(a, 0)) - k2*sqrt(max(b, 0))",
            },
            "b",
            {"a": 0, "b": {"lower": 0, "upper": 20}},
            solver=steps(2),
        ),
        400,
        0.25,
        {"K": 1.4, "k1": 0.7, "k2": 0.5, "L": 6.3, "b(0)": 2.0},
        raised(1.0, switching(0.8, 15, 15)),
    ),
    System(
        "hysteresis",
        document(
            {"w": (0.1, 50, "log"), "c": (0, 10), "k": (0, 200), "g": (-20, 20), "b": (0, 20)},
            {"x": "v", "v": "10*u - c*v - w**2*x - k*z", "z": "v - b*abs(v)*z - g*v*abs(z)"},
            "x",
            {"x": 0, "v": 0, "z": 0},
            solver=steps(4),
        ),
        500,
        0.03,
        {"w": 2.5, "c": 0.5, "k": 6, "g": 0.8, "b": 2.2},
        sines(1.5, (1.1, 2.3, 3.7, 5.2), 16),
    ),
    System(
        "delayed growth",
        document(
            {"r": (0.01, 20, "log"), "K": (0.1, 1000, "log"), "L": (0, 10)},
            {"x": "r*x*(1 - x(t - L)/K)"},
            "x",
            {"x": "measured"},
            solver=steps(2),
            inputs={},
        ),
        400,
        0.05,
        {"r": 1.8, "K": 10, "L": 1.0},
        start={"y": 2.0},
    ),
    System(
        "predator and prey",
        document(
            {
                "a": (0.01, 20, "log"),
                "b": (0.001, 20, "log"),
                "c": (0.01, 20, "log"),
                "d": (0.001, 20, "log"),
                "p0": (0.1, 50, "log"),
            },
            {"x": "a*x - b*x*p", "p": "d*x*p - c*p"},
            "x",
            {"x": "measured", "p": "p0"},
            solver=steps(2),
            inputs={},
        ),
        300,
        0.1,
        {"a": 1.1, "b": 0.4, "c": 0.9, "d": 0.12, "p0": 3},
        start={"y": 10.0},
    ),
    System(
        "excitable cell",
        document(
            {
                "a": (-3, 3),
                "b": (0, 3),
                "e": (0.001, 5, "log"),
                "g": (0.1, 10, "log"),
                "L": (0, 20),
            },
            {"v": "v - v**3/3 - w + g*u(t - L)", "w": "e*(v + a - b*w)"},
            "v",
            {"v": "measured", "w": {"lower": -3, "upper": 3}},
            solver=steps(4),
        ),
        500,
        0.2,
        {"a": 0.7, "b": 0.8, "e": 0.08, "g": 0.9, "L": 3.3, "w(0)": -0.6},
        switching(1, 15, 17),
        start={"y": -1.2},
    ),
    System(
        "reactor",
        document(
            {
                "q": (0.01, 10, "log"),
                "k": (0.01, 100, "log"),
                "E": (0.1, 30, "log"),
                "H": (0, 20),
                "U": (0, 20),
                "L": (0, 10),
            },
            {
                "c": "q*(1 - c) - k*c*exp(-E/(T + 1))",
                "T": "-q*T + H*k*c*exp(-E/(T + 1)) + U*(u(t - L) - T)",
            },
            "T",
            {"c": 1, "T": 0},
            solver=steps(4),
        ),
        400,
        0.06,
        {"q": 0.8, "k": 6, "E": 3, "H": 2.5, "U": 0.6, "L": 1.3},
        raised(0.6, switching(0.8, 15, 18)),
    ),
    System(
        "two lags of one input",
        document(
            {"a": (-0.99, 0.999), "b1": (-20, 20), "L1": (0, 60), "b2": (-20, 20), "D": (1, 80)},
            {"x": "a*x(k-1) + b1*u(k-1 - L1) + b2*u(k-1 - L1 - D)"},
            "x",
            {"x": 0},
            form="difference",
        ),
        500,
        1.0,
        {"a": 0.85, "b1": 1.2, "L1": 13.4, "b2": -0.7, "D": 22.7},
        switching(1, 6, 19),
    ),
    System(
        "dry friction",
        document(
            {"m": (0.01, 100, "log"), "d": (0, 20), "F": (0, 20), "k": (0, 200), "L": (0, 7)},
            {"x": "v", "v": "(10*u(t - L) - d*v - F*sign(v) - k*x)/m"},
            "x",
            {"x": 0, "v": 0},
            solver=steps(4, "semi-implicit"),
        ),
        500,
        0.03,
        {"m": 0.9, "d": 0.4, "F": 1.5, "k": 12, "L": 0.45},
        sines(1.2, (1.3, 2.9, 4.4, 6.1), 20),
    ),
)


def search(system: System, seed: int) -> Search:
    """Run one search without its conclusion."""
    problem, algorithm = system.problem(seed), GeneticAlgorithm()
    state = advance_run(problem, algorithm, begin_run(problem, algorithm, seed))
    champion = min(state.islands, key=lambda island: island.champion_rms).history[-1]
    ends = [
        refine_candidates(problem, [start])[0]
        for start in (np.array(champion.parameters), system.place(problem))
    ]
    reached = champion.rms if ends[0] is None else ends[0].rms
    lowest = min(end.rms for end in ends if end is not None)
    return Search(reached <= lowest * (1.0 + NEAR), state.generation, state.evaluations)


def rows(name: str, searches: Sequence[Search]) -> list[Row]:
    """The figures of some searches."""
    last = GeneticAlgorithm().generations
    of = f"of {len(searches)}"
    return [
        Row(f"{name}: hits", sum(one.hits for one in searches), of),
        Row(f"{name}: ran all generations", sum(one.generations >= last for one in searches), of),
        Row(f"{name}: median generations", median(one.generations for one in searches), ""),
        Row(f"{name}: mean evaluations", mean(one.evaluations for one in searches), "simulations"),
    ]


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    count = QUICK if options.quick else options.searches
    found: list[Row] = []
    for noise in NOISES:
        every: list[Search] = []
        for system in SYSTEMS:
            noisy = replace(system, noise=noise)
            done = [search(noisy, options.first_seed + i) for i in range(count)]
            every += done
            found += rows(f"noise {noise:g}, {system.name}", done)
        found += rows(f"noise {noise:g}, all", every)
    report("Searches with wide bounds", found, [], options)


if __name__ == "__main__":
    arguments = parser(__doc__ or "")
    arguments.add_argument("--first-seed", type=int, default=FIRST_SEED, metavar="N")
    arguments.add_argument("--searches", type=int, default=SEARCHES, metavar="N", help="of each")
    main(arguments.parse_args())
