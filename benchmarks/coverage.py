"""Count how often 95 % intervals hold the true value: systems with time lags, and kinds of noise.

All settings are the defaults. Each draw has its own true values, input, noise and search seed. The
outputs are those of the same equations with 64 times as many integration steps, so the step of the
fit has to be found. Each value is counted: time lags, other parameters, initial states. An estimate
without an interval is counted apart.

The noise is white but for four cases. AR(1): of a pole from 0.5 to 0.9. Unequal: a second record
has 3 to 30 times the noise. Pooled repeats: each has its own gain and opens a little earlier or
later. One step ahead: random disturbances act inside an unstable plant, in a loop whose controller
holds its command. That the command is held is set there.

A rate of 95 % from 200 draws has a standard error of 1.5 %. So the interval of each rate (Clopper
and Pearson 1934) is compared with 93 to 97 %. Some noise of the sensor makes the model of one step
ahead wrong: that case is shown without a bar.
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks.process_order import draw_noise
from benchmarks.table import Row, parser, report
from sysid.core.settings import PredictionKind
from sysid.core.types import FloatArray
from sysid.data.derivations import derive_recording
from sysid.data.records import Channel, Record, Recording, Segment
from sysid.identification.identify import identify
from sysid.models.model import Model, name_initial_state, replace_substeps
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


FIRST_ORDER = SYSTEMS["first order, dead time"]
EACH, SPAN = 20, 6.0
"""Samples of a repeat, and its length (s)."""


@dataclass(frozen=True)
class Draw:
    """Records, the model to identify, and the true values of its parameters and initial states."""

    model: Model
    records: list[Record]
    truth: Mapping[str, float]
    prediction: PredictionKind = "simulation"


def draw_truth(values: Mapping[str, float], random: np.random.Generator) -> dict[str, float]:
    """Draw true values around nominal ones."""
    return {
        key: value * random.uniform(1.0 - SPREAD, 1.0 + SPREAD) for key, value in values.items()
    }


def draw_system(
    system: System,
    random: np.random.Generator,
    sizes: tuple[float, ...] = (1.0,),
    pole: float = 0.0,
) -> Draw:
    """Draw records of a system; `sizes` are those of the noise relative to the system's own."""
    model = parse_model(dict(system.document))
    fine = replace_substeps(model, FINE * model.solver.substeps)
    truth = draw_truth(system.truth, random)
    starts = {name_initial_state(key, 0): value for key, value in system.start.items()}
    times = np.arange(system.samples) * system.period
    records = []
    for size in sizes:
        driven = {} if system.drive is None else system.drive(random, times)
        inputs = tuple(Channel(key, times, values) for key, values in driven.items())
        outputs = []
        for one in simulate(fine, inputs, {**truth, **starts}, times=times).channels:
            level = size * system.noise * float(np.std(one.values))
            noise = draw_noise(random, times.size, pole)
            outputs.append(Channel(one.name, times, one.values + level * noise))
        records.append(Record(inputs, tuple(outputs)))
    for number in range(len(sizes)):
        truth |= {name_initial_state(key, number): value for key, value in system.start.items()}
    return Draw(model, records, truth)


def draw_slow_noise(random: np.random.Generator) -> Draw:
    """First-order noise at the output."""
    return draw_system(FIRST_ORDER, random, pole=random.uniform(0.5, 0.9))


def draw_unequal_noise(random: np.random.Generator) -> Draw:
    """Two experiments, the second far noisier."""
    return draw_system(FIRST_ORDER, random, sizes=(1.0, 3.0 * 10.0 ** random.random()))


RISE = {
    **describe(
        "rise",
        {"x": "(K*u(t - L) - x)/T"},
        {"K": (0, 10), "T": (0.05, 20), "L": (0, 3)},
        {},
        {"y": "x"},
    ),
    "initial": {"x": 0},
}


def draw_repeats(random: np.random.Generator) -> Draw:
    """Pooled repeats of one smooth rise, sampled too slowly, each at its own phase."""
    model = parse_model(RISE)
    truth = draw_truth({"K": 2.0, "T": 0.8, "L": 0.5}, random)
    fine = np.linspace(-1.0, SPAN, 1401)
    rise = 0.5 - 0.5 * np.cos(np.pi * np.clip(fine - 0.3, 0.0, 1.0))
    (clean,) = simulate(model, (Channel("u", fine, rise),), truth, times=fine).channels
    times, u, y, segments = [], [], [], []
    for number in range(int(random.integers(12, 31))):
        own = SPAN / EACH * (np.arange(EACH) + random.random())
        gain, late = 1.0 + 0.05 * random.standard_normal(), 0.03 * random.standard_normal()
        response = gain * np.interp(own - late, fine, clean.values)
        start = 2.0 * SPAN * number
        times.append(start + own)
        u.append(np.interp(own, fine, rise))
        y.append(response + 0.02 * random.standard_normal(EACH))
        segments.append(Segment(times[-1][0], times[-1][-1], float(own[0]), {"repeat": number}))
    axis = np.concatenate(times)
    channels = (Channel("u", axis, np.concatenate(u)), Channel("y", axis, np.concatenate(y)))
    step = {"pool": {"input": "u", "outputs": ["y"], "bin": 0.03}}
    pooled = derive_recording(Recording(channels, tuple(segments)), [step])
    return Draw(model, [pooled.to_record({"u": "u"}, {"y": "y"})], truth)


UNSTABLE = {
    **describe(
        "unstable",
        {"x": "a*x + b*u(t - L)"},
        {"a": (-1, 1), "b": (0, 5), "L": (0, 5)},
        {},
        {"y": "x"},
    ),
    "initial": {"x": "measured"},
}


def draw_unstable(random: np.random.Generator, sensor: float = 0.0) -> Draw:
    """Draw an unstable plant in a proportional loop, with disturbances inside it."""
    count, period, steps = 400, 0.2, 20
    step, truth = period / steps, draw_truth({"a": 0.2, "b": 1.0, "L": 0.9}, random)
    back = round(truth["L"] / step)
    truth["L"] = back * step
    reference = np.repeat(random.uniform(-1.0, 1.0, count), random.integers(10, 41, count))
    command, u, y, x = np.zeros(count * steps), np.zeros(count), np.zeros(count), 0.0
    shocks = 0.05 * np.sqrt(step) * random.standard_normal(command.size)
    for k in range(command.size):
        sample = k // steps
        if k % steps == 0:
            y[sample] = x + sensor * random.standard_normal()
            u[sample] = -0.6 * (y[sample] - reference[sample])
        command[k] = u[sample]
        drive = command[k - back] if k >= back else u[0]
        x += step * (truth["a"] * x + truth["b"] * drive) + shocks[k]
    times = period * np.arange(count)
    record = Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))
    return Draw(parse_model(UNSTABLE), [record], truth, "one-step")


WRONG_MODEL = "unstable, one step ahead, noise of the sensor too"
CASES: dict[str, Callable[[np.random.Generator], Draw]] = {
    **{name: partial(draw_system, system) for name, system in SYSTEMS.items()},
    "first order, AR(1) noise": draw_slow_noise,
    "first order, unequal noise": draw_unequal_noise,
    "first order, pooled repeats": draw_repeats,
    "unstable, one step ahead": draw_unstable,
    WRONG_MODEL: partial(draw_unstable, sensor=0.01),
}


@dataclass(frozen=True)
class Outcome:
    """For each value whether its interval holds the truth, and half its width; or None."""

    intervals: Mapping[str, tuple[bool, float] | None]
    substeps: int
    is_settled: bool


def run_draw(task: tuple[str, int]) -> Outcome:
    """Identify one draw of a case."""
    name, seed = task
    draw = CASES[name](np.random.default_rng(seed))
    found = identify(draw.model, draw.records, prediction=draw.prediction, seed=seed)
    intervals = {}
    for one in found.parameters:
        ends, true = one.interval95, draw.truth[one.name]
        intervals[one.name] = ends and (ends[0] <= true <= ends[1], 0.5 * (ends[1] - ends[0]))
    return Outcome(intervals, found.substeps, found.search.settled)


def count_coverage(name: str, outcomes: list[Outcome]) -> list[Row]:
    """Print a line for each value of a case, time lags first; rows for the rates and what lacks."""
    rows, without = [], 0
    settled = sum(one.is_settled for one in outcomes)
    for key in sorted(outcomes[0].intervals, key=lambda key: key not in "LM"):
        known = [one.intervals[key] for one in outcomes]
        held, widths = zip(*filter(None, known), strict=True)
        without += len(known) - len(held)
        count = binomtest(sum(held), len(held))
        ends = [100.0 * end for end in count.proportion_ci()]
        print(
            f"| {name} | {key} | {sum(held)} of {len(held)} | {100.0 * count.statistic:.1f} % "
            f"| {ends[0]:.1f}–{ends[1]:.1f} % | {np.median(widths):.3g} | {settled} |"
        )
        bars = (None, None) if name == WRONG_MODEL else (LEAST, MOST)
        rows += [
            Row(f"{name}, {key}: rate, upper end", ends[1], "%", bars[0], ">="),
            Row(f"{name}, {key}: rate, lower end", ends[0], "%", bars[1]),
        ]
    substeps = float(np.median([one.substeps for one in outcomes]))
    return [
        *rows,
        Row(f"{name}: values without an interval", without, ""),
        Row(f"{name}: median substeps", substeps, ""),
        Row(f"{name}: searches that settled", settled, f"of {len(outcomes)}"),
    ]


def main(options: argparse.Namespace) -> None:
    """Count the coverage of all cases, on so many processes."""
    draws = options.draws or (QUICK if options.quick else DRAWS)
    names = [name for name in CASES if any(part in name for part in options.case or [""])]
    tasks = [(name, options.first_seed + number) for name in names for number in range(draws)]
    with get_context("spawn").Pool(options.jobs) as pool:
        outcomes = pool.imap(run_draw, tasks, chunksize=4)
        print("| case | value | truth held | rate | 95 % interval | half width | settled |")
        print("|---|---|--:|--:|--:|--:|--:|")
        rows = [
            row
            for name in names
            for row in count_coverage(name, [next(outcomes) for _ in range(draws)])
        ]
    report(f"Coverage of 95 % intervals, {draws} draws each", rows, [], options)


if __name__ == "__main__":
    arguments = parser(__doc__ or "")
    arguments.add_argument("--draws", type=int, help=f"of each case (default {DRAWS})")
    arguments.add_argument(
        "--case", action="append", help="only cases with this in their name (repeatable)"
    )
    arguments.add_argument("--first-seed", type=int, default=FIRST_SEED)
    arguments.add_argument("--jobs", type=int, default=1, help="processes")
    main(arguments.parse_args())
