"""Count how often 95 % intervals hold the true value, for systems with unknown time lags.

All settings are the defaults. Each draw has its own true values, input, noise and search seed. The
outputs are those of the same equations with 64 times as many integration steps, so the step of the
fit has to be found. Each value is counted: time lags, other parameters, initial states. An estimate
without an interval is counted apart.

A rate of 95 % from 200 draws has a standard error of 1.5 %, so 93 to 97 % is asked for. Intervals
of one draw are correlated, so the bar on all values of a system is no sharper than that on one.
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np

from benchmarks.table import Row, parser, report
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.model import name_initial_state, replace_substeps
from sysid.models.parse import parse_model
from sysid.simulation.simulate import simulate

DRAWS, QUICK = 200, 12
FIRST_SEED = 81_000
FINE = 64
LEAST, MOST = 93.0, 97.0
SPREAD = 0.2  # of the true values, as a share


@dataclass(frozen=True)
class System:
    """A model with nominal true values.

    `drive` makes the inputs, by name, from a generator and the sample times. `start` are initial
    states. `noise` is a share of the standard deviation of each output.
    """

    document: Mapping[str, Any]
    truth: Mapping[str, float]
    start: Mapping[str, float]
    samples: int
    period: float
    noise: float
    drive: Callable[[np.random.Generator, FloatArray], Mapping[str, FloatArray]] | None = None


def hold_levels(every: int) -> Callable[[np.random.Generator, FloatArray], dict[str, FloatArray]]:
    """Make an input `u` that takes a new random level after so many samples."""

    def drive(random: np.random.Generator, times: FloatArray) -> dict[str, FloatArray]:
        levels = random.uniform(-1.0, 1.0, times.size // every + 1)
        return {"u": np.repeat(levels, every)[: times.size]}

    return drive


def describe(
    name: str,
    equations: Mapping[str, str],
    bounds: Mapping[str, tuple[float, float]],
    start: Mapping[str, tuple[float, float]],
    outputs: Mapping[str, str],
    inputs: tuple[str, ...] = ("u",),
) -> dict[str, Any]:
    """Write the document of a differential model; initial states have bounds."""
    return {
        "name": name,
        "form": "differential",
        "inputs": dict.fromkeys(inputs, "1"),
        "states": dict.fromkeys(equations, "1"),
        "parameters": {key: {"lower": low, "upper": high} for key, (low, high) in bounds.items()},
        "equations": dict(equations),
        "outputs": dict(outputs),
        "initial": {key: {"lower": low, "upper": high} for key, (low, high) in start.items()},
    }


SYSTEMS = {
    "first order, dead time": System(
        describe(
            "first-order",
            {"x": "(K*u(t - L) - x)/T"},
            {"K": (0, 10), "T": (0.05, 20), "L": (0, 6)},
            {"x": (-5, 5)},
            {"y": "x"},
        ),
        {"K": 2.0, "T": 1.5, "L": 1.3},
        {"x": 0.0},
        300,
        0.4,
        0.03,
        hold_levels(6),
    ),
    "delayed feedback": System(
        describe(
            "delayed-feedback",
            {"x": "b*u - a*x - g*x(t - L)"},
            {"a": (0, 5), "b": (0, 10), "g": (0, 5), "L": (0, 5)},
            {"x": (-5, 5)},
            {"y": "x"},
        ),
        {"a": 0.5, "b": 1.5, "g": 0.9, "L": 1.2},
        {"x": 0.3},
        300,
        0.3,
        0.03,
        hold_levels(8),
    ),
    "two time lags": System(
        describe(
            "two-lags",
            {"x": "b*u(t - M) - a*x - g*x(t - L)"},
            {"a": (0, 5), "b": (0, 10), "g": (0, 5), "L": (0, 5), "M": (0, 5)},
            {"x": (-5, 5)},
            {"y": "x"},
        ),
        {"a": 0.5, "b": 1.5, "g": 0.9, "L": 1.2, "M": 0.7},
        {"x": 0.0},
        400,
        0.3,
        0.02,
        hold_levels(7),
    ),
    "oscillator with delayed force": System(
        describe(
            "regenerative",
            {"x": "v", "v": "u - 2*z*w*v - w**2*x - k*(x - x(t - L))"},
            {"z": (0, 2), "w": (0.5, 20), "k": (0, 20), "L": (0, 5)},
            {"x": (-1, 1), "v": (-5, 5)},
            {"y": "x"},
        ),
        {"z": 0.1, "w": 3.0, "k": 2.0, "L": 1.1},
        {"x": 0.0, "v": 0.0},
        400,
        0.1,
        0.03,
        hold_levels(12),
    ),
    "van der Pol, delayed damping": System(
        describe(
            "van-der-pol",
            {"x": "v", "v": "u + m*(1 - x(t - L)**2)*v - w**2*x"},
            {"m": (0, 3), "w": (0.5, 5), "L": (0, 2)},
            {"x": (-3, 3), "v": (-5, 5)},
            {"y": "x"},
        ),
        {"m": 0.6, "w": 1.6, "L": 0.5},
        {"x": 0.5, "v": 0.0},
        400,
        0.15,
        0.02,
        hold_levels(20),
    ),
    "forced logistic growth": System(
        describe(
            "logistic",
            {"x": "r*x*(1 - x(t - L)/c) + 0.3*u*x"},
            {"r": (0.1, 3), "c": (0.5, 10), "L": (0, 3)},
            {"x": (0, 5)},
            {"y": "x"},
        ),
        {"r": 0.8, "c": 3.0, "L": 1.1},
        {"x": 1.5},
        300,
        0.25,
        0.02,
        hold_levels(10),
    ),
    "saturated delayed feedback": System(
        describe(
            "saturated",
            {"x": "b*u - a*x - g*tanh(x(t - L))"},
            {"a": (0, 5), "b": (0, 10), "g": (0, 8), "L": (0, 4)},
            {"x": (-5, 5)},
            {"y": "x"},
        ),
        {"a": 0.4, "b": 2.0, "g": 1.6, "L": 0.8},
        {"x": 0.2},
        300,
        0.25,
        0.03,
        hold_levels(9),
    ),
    "two tanks, delayed return": System(
        describe(
            "tanks",
            {"w": "b*u - a*w + g*x(t - L)", "x": "c*(w - x)"},
            {"a": (0.05, 5), "b": (0, 10), "g": (0, 3), "c": (0.05, 5), "L": (0, 10)},
            {"w": (-5, 5), "x": (-5, 5)},
            {"y": "x", "z": "w"},
        ),
        {"a": 0.9, "b": 1.0, "g": 0.5, "c": 0.6, "L": 3.1},
        {"w": 0.0, "x": 0.0},
        250,
        0.6,
        0.04,
        hold_levels(8),
    ),
}


@dataclass(frozen=True)
class Outcome:
    """For each value: whether its interval holds the truth; None without an interval."""

    holds: Mapping[str, bool | None]
    substeps: int


def run_draw(task: tuple[str, int]) -> Outcome:
    """Identify one draw of a system."""
    name, number = task
    system, seed = SYSTEMS[name], FIRST_SEED + number
    random = np.random.default_rng(seed)
    model = parse_model(dict(system.document))
    truth = {
        key: value * random.uniform(1.0 - SPREAD, 1.0 + SPREAD)
        for key, value in system.truth.items()
    }
    starts = {name_initial_state(key, 0): value for key, value in system.start.items()}
    times = np.arange(system.samples) * system.period
    driven = {} if system.drive is None else system.drive(random, times)
    inputs = tuple(Channel(key, times, values) for key, values in driven.items())
    fine = replace_substeps(model, FINE * model.solver.substeps)
    outputs = [
        Channel(
            one.name,
            times,
            one.values + system.noise * np.std(one.values) * random.standard_normal(times.size),
        )
        for one in simulate(fine, inputs, {**truth, **starts}, times=times).channels
    ]
    found = identify(model, Record(inputs, tuple(outputs)), seed=seed)
    true_values = {**truth, **starts}
    return Outcome(
        {
            one.name: None
            if one.interval95 is None
            else one.interval95[0] <= true_values[one.name] <= one.interval95[1]
            for one in found.estimates
        },
        found.substeps,
    )


def count_coverage(name: str, outcomes: list[Outcome]) -> list[Row]:
    """One row for all values of a system, one for its time lags, and what has no interval."""
    values = [(key, held) for one in outcomes for key, held in one.holds.items()]
    known = [held for _, held in values if held is not None]
    lags = [held for key, held in values if key in "LM" and held is not None]
    rate = 100.0 * float(np.mean(known))
    substeps = float(np.median([one.substeps for one in outcomes]))
    return [
        Row(f"{name}: intervals that hold the truth", rate, "%", LEAST, ">="),
        Row(f"{name}: the same, not too wide", rate, "%", MOST),
        Row(f"{name}: of time lags alone", 100.0 * float(np.mean(lags)), "%"),
        Row(f"{name}: values without an interval", float(len(values) - len(known)), ""),
        Row(f"{name}: median substeps", substeps, ""),
    ]


def main(options: argparse.Namespace) -> None:
    """Count the coverage of all systems, on so many processes."""
    draws = options.draws or (QUICK if options.quick else DRAWS)
    names = [name for name in SYSTEMS if options.system in name]
    tasks = [(name, number) for name in names for number in range(draws)]
    with get_context("spawn").Pool(options.jobs) as pool:
        outcomes = pool.map(run_draw, tasks, chunksize=4)
    rows = [
        row
        for i, name in enumerate(names)
        for row in count_coverage(name, outcomes[i * draws : (i + 1) * draws])
    ]
    report(f"Coverage of 95 % intervals, {draws} draws each", rows, [], options)


if __name__ == "__main__":
    arguments = parser(__doc__ or "")
    arguments.add_argument("--draws", type=int, help=f"of each system (default {DRAWS})")
    arguments.add_argument("--system", default="", help="only systems with this in their name")
    arguments.add_argument("--jobs", type=int, default=1, help="processes")
    main(arguments.parse_args())
