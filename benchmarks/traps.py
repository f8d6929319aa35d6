"""Identify recordings on which a search or a default is easily wrong without a word.

Each draw has its own true values, noise and search seed, and nothing is set but what is named. The
records come from integrators of this program: a step of 1/200 of the sampling period, held inputs.

An answer is confidently wrong if the time lag is called identified, but lies more than four of its
standard errors from the truth. It is honest if the interval of 2.5 standard errors holds the truth.
"""

import argparse
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.table import Row, parser, report
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.results.identification import Identification
from sysid.uncertainty.estimates import Estimate

DRAWS, QUICK = 20, 4
FINE = 200
"""Steps of the integrators in a sampling period."""
FIRST_SEED = 62_000
HONEST, WRONG = 2.5, 4.0  # standard errors


@dataclass(frozen=True)
class Draw:
    """A recording, the model to identify, and the name and true value of its time lag.

    `period`: of the input (s); time lags so far apart fit as well. `skip`: samples to leave out.
    """

    record: Record
    model: Model
    delay: str
    truth: float
    period: float = 0.0
    skip: int = 0


def respond(
    u: FloatArray, period: float, lag: float, times: list[float], gain: float
) -> FloatArray:
    """Response to an input held from sample to sample: dead time, then first-order lags."""
    grid = np.arange((u.size - 1) * FINE + 1) * period / FINE
    x = gain * u[np.clip(np.floor((grid - lag) / period + 1e-9).astype(int), 0, u.size - 1)]
    for time in times:
        pole = np.exp(-period / FINE / time)
        y, out = x[0], np.empty_like(x)
        for k, value in enumerate(x.tolist()):
            out[k] = y
            y = pole * y + (1.0 - pole) * value
        x = out
    return x[::FINE]


def make_record(period: float, u: FloatArray, y: FloatArray, units: tuple[str, str]) -> Record:
    """A recording of one input and one output, that says nothing of what holds between samples."""
    times = np.arange(u.size) * period
    return Record((Channel("u", times, u, units[0]),), (Channel("y", times, y, units[1]),))


def lag_document(name: str, bounds: dict[str, tuple[float, float]], start: float) -> Model:
    """First order, or second with T2, with dead time and offset."""
    units = {"K": "degC/%", "T1": "s", "T2": "s", "L": "s", "y0": "degC"}
    second = "T2" in bounds
    states = ["w", "x"] if second else ["w"]
    return parse_model(
        {
            "name": name,
            "form": "differential",
            "inputs": {"u": "%"},
            "states": dict.fromkeys(states, "degC"),
            "parameters": {
                key: {"lower": low, "upper": high, "unit": units[key]}
                for key, (low, high) in bounds.items()
            },
            "equations": {"w": "(K*u(t - L) - w)/T1"} | ({"x": "(w - x)/T2"} if second else {}),
            "outputs": {"y": ("x" if second else "w") + (" + y0" if "y0" in bounds else "")},
            "initial": {state: {"lower": -start, "upper": start} for state in states},
        }
    )


def draw_heater(random: np.random.Generator) -> tuple[Record, float]:
    """A heated plant at ambient temperature, driven by steps of a minute."""
    lag, count = random.uniform(5.0, 25.0), 1200
    u = np.repeat(random.uniform(0.0, 60.0, count // 60), 60)
    u[:60] = 20.0
    times = [random.uniform(20.0, 60.0), random.uniform(5.0, 20.0)]
    y = respond(u, 1.0, lag, times, random.uniform(0.5, 1.5)) + random.uniform(10.0, 30.0)
    return make_record(1.0, u, y + random.normal(0.0, 0.15, count), ("%", "degC")), lag


def held_input(random: np.random.Generator) -> Draw:
    """Own model with bounds; that the input was held is not told."""
    bounds = {"K": (0, 5), "T1": (1, 300), "T2": (1, 100), "L": (0, 60), "y0": (0, 60)}
    record, lag = draw_heater(random)
    return Draw(record, lag_document("heater", bounds, 100.0), "L", lag)


def warm_plant(random: np.random.Generator) -> Draw:
    """The catalogue's `sopdt` without any option."""
    record, lag = draw_heater(random)
    return Draw(record, load_model("sopdt"), "L", lag)


def periodic_input(random: np.random.Generator) -> Draw:
    """Cut from a longer recording under a periodic input: the lag is told up to a period."""
    period, count, steps = 0.2, 300, int(random.integers(20, 31))
    lag = random.uniform(0.5, 0.8 * steps * period)
    u = np.where(np.arange(count + 8 * steps) % steps < 0.4 * steps, 1.0, -0.5)
    y = respond(u, period, lag, [random.uniform(1.0, 2.0)], 2.0)[8 * steps :]
    y += random.normal(0.0, 0.02, count)
    bounds = {"K": (0, 10), "T1": (0.05, 10), "L": (0, 20)}
    return Draw(
        make_record(period, u[8 * steps :], y, ("%", "degC")),
        lag_document("lag", bounds, 5.0),
        "L",
        lag,
        period=steps * period,
    )


def skipped_start(random: np.random.Generator) -> Draw:
    """The same, without the first samples, which alone contradict the input before the record."""
    draw = periodic_input(random)
    return replace(draw, skip=int(draw.truth / draw.record.inputs[0].sampling.period) + 1)


CHATTER = {
    "name": "chatter",
    "form": "differential",
    "inputs": {"u": "N"},
    "states": {"x": "m", "v": "m/s"},
    "parameters": {
        "ze": {"lower": 0, "upper": 2, "unit": "1"},
        "om": {"lower": 1, "upper": 120, "unit": "rad/s"},
        "kc": {"lower": 0, "upper": 120, "unit": "1/s^2"},
        "tau": {"lower": 0, "upper": 13, "unit": "s"},
    },
    "equations": {"x": "v", "v": "u - 2*ze*om*v - om**2*x - kc*(x - x(t - tau))"},
    "outputs": {"y": "x"},
    "initial": {"x": 0, "v": 0},
}


def chatter(random: np.random.Generator) -> Draw:
    """Regenerative chatter: a comb of false minima in the delay."""
    period, count = 0.05, 600
    w, k, tau = random.uniform(5, 7), random.uniform(2, 3), random.uniform(1.6, 2.4)
    damping, step = 0.05, period / FINE
    back = round(tau / step)
    force = np.where(np.arange(count) % 140 < 8, 10.0, 0.0)
    x, v = np.zeros(count * FINE + 1), 0.0
    for i in range(count * FINE):
        past = x[i - back] if i >= back else 0.0
        pull = force[i // FINE] + k * past
        a = pull - 2 * damping * w * v - (w**2 + k) * x[i]
        half = v + 0.5 * step * a
        x[i + 1] = x[i] + step * half
        v = half + 0.5 * step * (pull - 2 * damping * w * half - (w**2 + k) * x[i + 1])
    y = x[: count * FINE : FINE]
    y = y + random.normal(0.0, 0.015 * np.std(y), count)
    record = make_record(period, force, y, ("N", "m"))
    return Draw(record, parse_model(CHATTER), "tau", back * step)


def find_estimate(found: Identification, name: str) -> Estimate:
    """The estimate of a parameter."""
    return next(one for one in found.parameters if one.name == name)


def count_errors(found: Identification, draw: Draw) -> float:
    """How many of its standard errors the time lag lies from the truth; inf without one."""
    estimate = find_estimate(found, draw.delay)
    if not estimate.stderr:
        return np.inf
    return abs(estimate.value - draw.truth) / estimate.stderr


def lists_all(found: Identification, draw: Draw) -> bool:
    """Whether estimate and reason name all lags a period apart, up to half of the record."""
    estimate = find_estimate(found, draw.delay)
    listed = re.findall(r"[\d.]+", (estimate.reason or "").split(" s fit")[0])
    named = np.array([estimate.value, *map(float, listed)])
    reach = min(0.5 * draw.record.duration, estimate.upper)
    truths = np.arange(draw.truth % draw.period, 0.98 * reach, draw.period)
    near = max(0.05, WRONG * (estimate.stderr or 0.0))
    return all(np.min(np.abs(named - truth)) <= near for truth in truths)


def run_trap(name: str, draw_one: Callable[[np.random.Generator], Draw], draws: int) -> list[Row]:
    """Identify the draws of a trap; one row for each count."""
    honest = wrong = ambiguous = listed = unsettled = 0
    for number in range(draws):
        seed = FIRST_SEED + number
        draw = draw_one(np.random.default_rng(seed))
        found = identify(draw.model, draw.record, skip=draw.skip, seed=seed)
        errors, status = count_errors(found, draw), find_estimate(found, draw.delay).status
        honest += errors <= HONEST
        wrong += status == "identified" and errors > WRONG
        ambiguous += status == "ambiguous"
        unsettled += not found.search.settled
        listed += draw.period > 0 and lists_all(found, draw)
    rows = [Row(f"{name}: identified, but over {WRONG:g} standard errors off", wrong, "", 0)]
    if name in PERIODIC:
        rows += [
            Row(f"{name}: lag told to be ambiguous", ambiguous, "", draws, ">="),
            Row(f"{name}: all lags a period apart are named", listed, "", draws, ">="),
        ]
    else:  # of 20 right answers one lies beyond 2.5 standard errors with probability 0.2
        rows.append(Row(f"{name}: truth within {HONEST:g}", honest, "", draws - 1, ">="))
    return [*rows, Row(f"{name}: search not settled", unsettled, "")]


TRAPS: dict[str, Callable[[np.random.Generator], Draw]] = {
    "held input": held_input,
    "catalogue on a warm plant": warm_plant,
    "periodic input": periodic_input,
    "periodic input, start skipped": skipped_start,
    "chatter": chatter,
}
PERIODIC = [name for name in TRAPS if name.startswith("periodic")]


def main(options: argparse.Namespace) -> None:
    """Run all traps."""
    draws = QUICK if options.quick else DRAWS
    rows = [row for name, draw_one in TRAPS.items() for row in run_trap(name, draw_one, draws)]
    report(f"Traps, {draws} draws each", rows, [], options)


if __name__ == "__main__":
    main(parser(__doc__ or "").parse_args())
