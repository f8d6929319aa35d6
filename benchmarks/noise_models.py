"""Compare the noise model that `auto` selects with `white` and `ar1`: measured and simulated data.

Each record is fitted with both, and the free run is judged on data that were not used. `auto` fails
if its choice is more than 5 % worse there than the better of the two: at most one record in ten.
They are no validation data of its run, as those choose nothing.

Measured records are fitted on one half and predicted on the other, in both directions. Simulated
plants have random parameters and random steps as input. The model has their structure, except with
"a lag too few". Noise is white or slow at the sensor, random at the input, or of both kinds.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from math import exp, sqrt
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.table import Row, parser, report
from sysid.core.settings import Loss, NoiseModel
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model

DRAWS, QUICK = 240, 24
FIRST_SEED = 93_000
LEAST_WORSE = 1.05
MOST_FAILURES = 10.0
FINE = 20
"""Steps of the integrator in a sampling period."""


@dataclass(frozen=True)
class Case:
    """A model, the record it is fitted to, and the one it is judged on."""

    name: str
    kind: str
    model: Model
    record: Record
    other: Record


@dataclass(frozen=True)
class Outcome:
    """RMS of the free run on the other record, and what `auto` chose."""

    name: str
    kind: str
    white: float
    ar1: float
    chosen: str

    def is_failure(self, choice: str) -> bool:
        """Whether a choice is clearly worse than the better of the two."""
        own = self.ar1 if choice == "ar1" else self.white
        return own > LEAST_WORSE * min(self.white, self.ar1)


def read_columns(path: Path, columns: tuple[int, ...]) -> list[FloatArray]:
    """The columns of a CSV file with one line of names."""
    return list(np.loadtxt(path, delimiter=",", skiprows=1, usecols=columns, unpack=True))


def make_record(period: float, u: FloatArray, y: FloatArray) -> Record:
    """A record from 0 s on."""
    times = period * np.arange(u.size)
    return Record((Channel("u", times, u),), (Channel("y", times, y),))


def list_measured(folder: Path) -> Iterator[Case]:
    """The measured records, one half against the other."""
    for name, period in (("gas_furnace", 9.0), ("ball_and_beam", 0.1), ("hydraulic_actuator", 1.0)):
        _, u, y = read_columns(folder / name / "data.csv", (0, 1, 2))
        model = load_model(folder / name / "model.yaml")
        yield from swap_halves(name, model, period, u, y)
    u, y = read_columns(folder / "dryer2" / "dryer2.csv", (1, 2))
    for order in ("fopdt", "sopdt"):
        yield from swap_halves(f"dryer2 {order}", load_model(order), 0.08, u - 5.0, y)
    drives = [
        make_record(0.001, *read_columns(folder / "emps" / f"emps_{part}.csv", (1, 2)))
        for part in ("train", "test_pulses")
    ]
    for name, (one, other) in (("train", drives), ("pulses", drives[::-1])):
        yield Case(f"emps, {name}", "measured", load_model("emps"), one, other)
    for length in ("005", "010", "020", "040", "080"):
        one, other = (
            make_record(0.01, *read_columns(folder / "tube_reference" / name, (4, 5)))
            for name in (f"tube_{length}m_pattern{number}.csv" for number in (1, 2))
        )
        yield Case(f"tube of {length} m", "measured", load_model("tube"), one, other)
    u, y = read_columns(folder / "silverbox" / "silverbox_snls80mv.csv", (1, 2))
    silverbox = load_model("silverbox")
    for first in (50_000, 70_000, 90_000):
        rows = slice(first, first + 3000)
        yield from swap_halves(f"silverbox {first}", silverbox, 1 / 610.35, u[rows], y[rows])


def swap_halves(
    name: str, model: Model, period: float, u: FloatArray, y: FloatArray
) -> Iterator[Case]:
    """Fit one half and judge on the other."""
    middle = u.size // 2
    halves = [
        make_record(period, u[rows], y[rows]) for rows in (slice(middle), slice(middle, None))
    ]
    yield Case(f"{name}, first half", "measured", model, halves[0], halves[1])
    yield Case(f"{name}, second half", "measured", model, halves[1], halves[0])


def draw_noise(random: np.random.Generator, n: int, pole: float) -> FloatArray:
    """First-order noise of standard deviation 1."""
    noise, value = np.empty(n), random.standard_normal()
    for k, shock in enumerate(random.standard_normal(n).tolist()):
        noise[k] = value
        value = pole * value + sqrt(1.0 - pole**2) * shock
    return noise


Plant = Callable[[FloatArray, float], FloatArray]
PLANTS = ("fopdt", "sopdt", "ipdt")
NOISES = ("white", "slow", "slow and white", "random input", "a lag too few")


def draw_case(number: int, first_seed: int) -> Case:
    """A plant of the catalogue's kinds with one kind of noise, and two records of it."""
    random = np.random.default_rng(first_seed + number)
    plant, noise = PLANTS[number % 3], NOISES[number // 3 % 5]
    period, n = 0.2, int(random.integers(250, 600))
    gain, lag = random.uniform(1.0, 3.0), random.uniform(0.3, 1.5)
    times = [] if plant == "ipdt" else [random.uniform(0.8, 3.0)]
    times += [random.uniform(0.3, 0.8)] if plant == "sopdt" or noise == "a lag too few" else []
    pole, level = exp(-period / random.uniform(1.0, 8.0)), random.uniform(0.02, 0.2)
    records = []
    for _ in range(2):
        u = np.repeat(random.uniform(-1, 1, n), random.integers(3, 20, n))[:n]
        u[:5] = 0.0
        force = np.repeat(u, FINE)
        if noise == "random input":
            force = force + np.repeat(level * 3 * draw_noise(random, n, pole), FINE)
        y = respond(force, period / FINE, lag, gain, times, is_integrator=plant == "ipdt")[::FINE]
        size = level * float(np.std(y))
        white, slow = size * random.standard_normal(n), size * draw_noise(random, n, pole)
        y = y + {"white": white, "slow": slow, "slow and white": slow + 0.5 * white}.get(
            noise, 0.1 * white
        )
        records.append(make_record(period, u, y))
    return Case(f"{plant} {number}", noise, load_model(plant), records[0], records[1])


def respond(
    force: FloatArray,
    step: float,
    lag: float,
    gain: float,
    times: list[float],
    *,
    is_integrator: bool,
) -> FloatArray:
    """Response to a held input: dead time, then first-order lags, then an integrator."""
    back = round(lag / step)
    x = gain * np.concatenate([np.zeros(back), force])[: force.size]
    for time in times:
        pole, value, out = exp(-step / time), 0.0, np.empty_like(x)
        for k, drive in enumerate(x.tolist()):
            out[k] = value
            value = pole * value + (1.0 - pole) * drive
        x = out
    return np.asarray(np.concatenate([[0.0], np.cumsum(x[:-1]) * step])) if is_integrator else x


def run_case(case: Case) -> Outcome:
    """Fit with both noise models, and ask `auto`."""

    def fit(noise_model: NoiseModel, other: Record | None) -> tuple[float, str]:
        loss = Loss(noise_model=noise_model)
        found = identify(case.model, case.record, loss=loss, validation=other)
        chosen = "ar1" if any(found.correlation_times.values()) else "white"
        return found.rms_validation or float("nan"), chosen

    white, ar1 = fit("white", case.other)[0], fit("ar1", case.other)[0]
    if white == ar1:  # white residuals: there is nothing to choose
        return Outcome(case.name, case.kind, white, ar1, "white")
    return Outcome(case.name, case.kind, white, ar1, fit("auto", None)[1])


def run_draw(number: int, first_seed: int) -> Outcome:
    """Run a simulated case."""
    return run_case(draw_case(number, first_seed))


def print_outcomes(title: str, outcomes: list[Outcome]) -> None:
    """Print what differs, one line for each record."""
    print(f"\n{title}\n\n| record | noise | white | ar1 | auto |")
    print("|---|---|--:|--:|---|")
    for one in outcomes:
        if one.white != one.ar1:
            mark = f"{one.chosen}{' (worse)' if one.is_failure(one.chosen) else ''}"
            print(f"| {one.name} | {one.kind} | {one.white:.4g} | {one.ar1:.4g} | {mark} |")


def count_failures(title: str, outcomes: list[Outcome]) -> list[Row]:
    """The share of the records with a clearly worse choice."""

    def share(choose: Callable[[Outcome], str]) -> float:
        return 100.0 * float(np.mean([one.is_failure(choose(one)) for one in outcomes]))

    return [
        Row(f"{title}: auto clearly worse", share(lambda one: one.chosen), "%", MOST_FAILURES),
        Row(f"{title}: always white", share(lambda _: "white"), "%"),
        Row(f"{title}: always ar1", share(lambda _: "ar1"), "%"),
        Row(f"{title}: records", float(len(outcomes)), ""),
    ]


def main(options: argparse.Namespace) -> None:
    """Measured records first, then simulated plants."""
    draws = options.draws or (QUICK if options.quick else DRAWS)
    cases = list(list_measured(options.data)) if options.data else []
    with get_context("spawn").Pool(options.jobs) as pool:
        measured = pool.map(run_case, cases, chunksize=1)
        run = partial(run_draw, first_seed=options.first_seed)
        simulated = pool.map(run, range(draws), chunksize=4)
    rows = []
    for title, outcomes in (("measured", measured), ("simulated", simulated)):
        if outcomes:
            print_outcomes(title, outcomes)
            rows += count_failures(title, outcomes)
    for noise in NOISES if options.by_kind else ():
        rows += count_failures(noise, [one for one in simulated if one.kind == noise])
    report(f"Noise models, {draws} simulated plants", rows, [], options)


if __name__ == "__main__":
    arguments = parser(__doc__ or "")
    arguments.add_argument("--data", type=Path, help="folder of the measured records")
    arguments.add_argument("--draws", type=int, help=f"simulated plants (default {DRAWS})")
    arguments.add_argument("--first-seed", type=int, default=FIRST_SEED)
    arguments.add_argument("--by-kind", action="store_true", help="a row for each kind of noise")
    arguments.add_argument("--jobs", type=int, default=1, help="processes")
    main(arguments.parse_args())
