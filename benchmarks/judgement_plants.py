"""Plants with their true parameters, the model that a user fits, and an integrator of their own.

Nothing here calls a simulator of the product: Runge–Kutta of fourth order with a fixed step of
1/20 of the sampling period, over which the input is constant, and a buffer of the past.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import log, tanh
from typing import Any

import numpy as np
from scipy.optimize import brentq

from sysid.core.types import FloatArray

FINE = 20
"""Steps of the integrator in a sampling period."""

State = tuple[float, ...]
Values = Mapping[str, float]
Rate = Callable[[State, State, State, Values], State]
"""Derivatives from the states, the delayed inputs, the delayed states and the parameters."""
Control = Callable[[int, float], float]
"""The next value of the first input, from the number of the sample and the measured output."""


@dataclass(frozen=True)
class Plant:
    """A system with true values, and the model that is fitted to its records.

    Attributes
    ----------
    name : str
    model : str or dict
        A name of the catalogue, or a document.
    truth : mapping of str to float
        True parameters, in s and the units of the signals.
    slow : float
        Slowest time constant (s).
    period : float
        Sampling period (s).
    rate : Rate
    rest : callable
        States at rest under constant inputs.
    base, span : float
        Middle and half width of the range of the first input.
    inputs : tuple of str
        Names; the first one is delayed by `L`, further ones are not.
    """

    name: str
    model: str | dict[str, Any]
    truth: Mapping[str, float]
    slow: float
    period: float
    rate: Rate
    rest: Callable[[State, Values], State]
    base: float = 0.0
    span: float = 1.0
    inputs: tuple[str, ...] = ("u",)
    delays_state: bool = False

    @property
    def step(self) -> float:
        """Step of the integrator (s)."""
        return self.period / FINE


def integrate(
    plant: Plant,
    values: Mapping[str, float | FloatArray],
    drives: list[FloatArray],
    load: FloatArray | None = None,
    control: Control | None = None,
) -> FloatArray:
    """Integrate a plant that is at rest under its first inputs.

    Parameters
    ----------
    values : mapping
        Parameters; an array gives one for each step.
    drives : list of FloatArray, shape (M,)
        Inputs, constant over each step. With `control` the first one is written here.
    load : FloatArray, shape (M,), optional
        Added to the derivative of the last state (1/s).
    control : Control, optional
        Sets the first input at every sample from the output.

    Returns
    -------
    FloatArray, shape (M + 1,)
        Last state, and the parameter `y0` where there is one.
    """
    count, h = drives[0].size, plant.step
    changing = {key: one for key, one in values.items() if isinstance(one, np.ndarray)}
    now = {key: float(np.ravel(one)[0]) for key, one in values.items()}
    back = np.broadcast_to(np.rint(np.asarray(values["L"]) / h).astype(int), count).tolist()
    shocks = [0.0] * count if load is None else load.tolist()
    signals = [drive.tolist() for drive in drives]
    x = plant.rest(tuple(one[0] for one in signals), now)
    past = [x]
    for k in range(count):
        for key, one in changing.items():
            now[key] = float(one[k])
        if control is not None and k % FINE == 0:
            signals[0][k : k + FINE] = [control(k // FINE, x[-1] + now.get("y0", 0.0))] * FINE
        j = k if plant.delays_state else max(k - back[k], 0)
        u = (signals[0][j], *(one[k] for one in signals[1:]))
        x = _step(plant, x, u, _look_back(past, k - back[k]), now, shocks[k])
        past.append(x)
    if control is not None:
        drives[0][:] = signals[0]
    return np.array([one[-1] for one in past]) + now.get("y0", 0.0)


def _look_back(past: list[State], at: int) -> tuple[State, State, State]:
    """Delayed states at the begin, the middle and the end of a step."""
    first, last = past[max(at, 0)], past[min(max(at + 1, 0), len(past) - 1)]
    return first, tuple(0.5 * (a + b) for a, b in zip(first, last, strict=True)), last


def _step(
    plant: Plant, x: State, u: State, past: tuple[State, State, State], now: Values, load: float
) -> State:
    """One step of Runge and Kutta's classical method."""
    h, rate = plant.step, plant.rate

    def move(slope: State, share: float) -> State:
        return tuple(a + share * h * b for a, b in zip(x, slope, strict=True))

    first = rate(x, u, past[0], now)
    second = rate(move(first, 0.5), u, past[1], now)
    third = rate(move(second, 0.5), u, past[1], now)
    fourth = rate(move(third, 1.0), u, past[2], now)
    moved = [
        a + h * (b + 2.0 * c + 2.0 * d + e) / 6.0
        for a, b, c, d, e in zip(x, first, second, third, fourth, strict=True)
    ]
    moved[-1] += h * load
    return tuple(moved)


def draw_log(random: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(random.uniform(log(low), log(high))))


def write_document(
    name: str,
    equations: Mapping[str, str],
    bounds: Mapping[str, tuple[float, float]],
    *,
    inputs: tuple[str, ...] = ("u",),
    output: str = "x",
    start: float | None = 20.0,
) -> dict[str, Any]:
    """Write a model's document; initial states lie within ± `start`, or are 0 with None."""
    free = {"lower": -start, "upper": start} if start is not None else 0
    return {
        "name": name,
        "form": "differential",
        "inputs": dict.fromkeys(inputs, "1"),
        "states": dict.fromkeys(equations, "1"),
        "parameters": {
            key: {
                "lower": float(f"{low:.1g}"),
                "upper": float(f"{high:.1g}"),
                "unit": "s" if key in ("T", "L") else "1",
            }
            for key, (low, high) in bounds.items()
        },
        "equations": dict(equations),
        "outputs": {"y": output},
        "initial": dict.fromkeys(equations, free),
    }


@dataclass(frozen=True)
class Clock:
    """Times that a plant is drawn with: its slowest one, the sampling period, the delay (s)."""

    slow: float
    period: float
    delay: float


def draw_clock(random: np.random.Generator) -> Clock:
    """Draw times; the delay is a whole number of steps of the integrator."""
    slow = float(f"{draw_log(random, 2.0, 60.0):.3g}")
    period = float(f"{slow / random.uniform(8.0, 25.0):.2g}")
    step = period / FINE
    return Clock(slow, period, step * round(random.uniform(0.3, 1.4) * slow / step))


def _solve(balance: Callable[[float], float]) -> float:
    """Root of a rising function of the level."""
    return float(brentq(balance, -1e4, 1e4))


def _sign(random: np.random.Generator) -> float:
    return float(random.choice([-1.0, 1.0]))


def draw_fopdt(random: np.random.Generator) -> Plant:
    """First order and dead time, with an offset."""
    clock = draw_clock(random)
    gain, span = draw_log(random, 0.3, 3.0) * _sign(random), draw_log(random, 0.5, 20.0)
    truth = {"K": gain, "T": clock.slow, "L": clock.delay, "y0": random.uniform(-5.0, 5.0) * span}
    return Plant(
        "fopdt",
        "fopdt",
        truth,
        clock.slow,
        clock.period,
        lambda x, u, _, p: ((p["K"] * u[0] - x[0]) / p["T"],),
        lambda u, p: (p["K"] * u[0],),
        random.choice([0.0, 2.0]) * span,
        span,
    )


def draw_sopdt(random: np.random.Generator) -> Plant:
    """Two first-order parts and dead time, with an offset."""
    clock = draw_clock(random)
    gain, span = draw_log(random, 0.3, 3.0) * _sign(random), draw_log(random, 0.5, 20.0)
    truth = {
        "K": gain,
        "T1": clock.slow,
        "r": random.uniform(0.2, 0.7),
        "L": clock.delay,
        "y0": random.uniform(-5.0, 5.0) * span,
    }
    return Plant(
        "sopdt",
        "sopdt",
        truth,
        clock.slow,
        clock.period,
        lambda x, u, _, p: (
            (p["K"] * u[0] - x[0]) / p["T1"],
            (x[0] - x[1]) / (p["r"] * p["T1"]),
        ),
        lambda u, p: (p["K"] * u[0], p["K"] * u[0]),
        random.choice([0.0, 2.0]) * span,
        span,
    )


def draw_ipdt(random: np.random.Generator) -> Plant:
    """Integrator and dead time."""
    clock = draw_clock(random)
    gain, span = draw_log(random, 0.3, 3.0) / clock.slow, draw_log(random, 0.5, 20.0)
    return Plant(
        "ipdt",
        "ipdt",
        {"K": gain, "L": clock.delay},
        clock.slow,
        clock.period,
        lambda _x, u, _, p: (p["K"] * u[0],),
        lambda _u, _p: (0.0,),
        0.0,
        span,
    )


def draw_tank(random: np.random.Generator) -> Plant:
    """A tank whose outflow goes with the root of the level; the inlet pipe is a dead time."""
    clock, level = draw_clock(random), random.uniform(0.5, 4.0)
    c = 2.0 * level**0.5 / clock.slow
    q = c * level**0.5
    rates = (0.03 / clock.slow, 30.0 / clock.slow)
    document = write_document(
        "tank",
        {"x": "q*u(t - L) - c*sqrt(max(x, 0.0))"},
        {"q": rates, "c": rates, "L": (0.0, 5.0 * clock.slow)},
        start=30.0,
    )
    return Plant(
        "tank",
        document,
        {"q": q, "c": c, "L": clock.delay},
        clock.slow,
        clock.period,
        lambda x, u, _, p: (p["q"] * u[0] - p["c"] * max(x[0], 0.0) ** 0.5,),
        lambda u, p: ((p["q"] * u[0] / p["c"]) ** 2,),
        1.0,
        0.4,
    )


def draw_feedback(random: np.random.Generator) -> Plant:
    """Delayed feedback that saturates."""
    clock = draw_clock(random)
    step = clock.period / FINE
    truth = {
        "a": random.uniform(0.4, 0.7) / clock.slow,
        "b": random.uniform(1.0, 2.5) / clock.slow,
        "g": random.uniform(0.6, 1.2) / clock.slow,
        "L": step * round(random.uniform(0.3, 0.8) * clock.slow / step),
    }
    rates = (0.01 / clock.slow, 20.0 / clock.slow)
    document = write_document(
        "feedback",
        {"x": "b*u - a*x - g*tanh(x(t - L))"},
        {"a": rates, "b": rates, "g": rates, "L": (0.0, 4.0 * clock.slow)},
    )
    return Plant(
        "feedback",
        document,
        truth,
        clock.slow,
        clock.period,
        lambda x, u, past, p: (p["b"] * u[0] - p["a"] * x[0] - p["g"] * tanh(past[0]),),
        lambda u, p: (_solve(lambda x: p["a"] * x + p["g"] * tanh(x) - p["b"] * u[0]),),
        0.0,
        random.uniform(0.7, 1.5),
        delays_state=True,
    )


def draw_valve(random: np.random.Generator) -> Plant:
    """A valve with a power law, a pipe, and first order."""
    clock = draw_clock(random)
    truth = {
        "K": draw_log(random, 0.5, 2.0),
        "p": random.uniform(1.4, 2.5),
        "T": clock.slow,
        "L": clock.delay,
    }
    document = write_document(
        "valve",
        {"x": "(K*u(t - L)**p - x)/T"},
        {
            "K": (0.02, 20.0),
            "p": (0.2, 6.0),
            "T": (0.02 * clock.slow, 20.0 * clock.slow),
            "L": (0.0, 5.0 * clock.slow),
        },
    )
    return Plant(
        "valve",
        document,
        truth,
        clock.slow,
        clock.period,
        lambda x, u, _, p: ((p["K"] * u[0] ** p["p"] - x[0]) / p["T"],),
        lambda u, p: (p["K"] * u[0] ** p["p"],),
        1.0,
        0.7,
    )


def draw_cooler(random: np.random.Generator) -> Plant:
    """A body whose loss of heat grows faster than its temperature."""
    clock = draw_clock(random)
    truth = {
        "K": draw_log(random, 1.0, 3.0),
        "q": random.uniform(0.4, 1.5),
        "T": clock.slow,
        "L": clock.delay,
    }
    document = write_document(
        "cooler",
        {"x": "(K*u(t - L) - x - q*x*abs(x))/T"},
        {
            "K": (0.02, 30.0),
            "q": (0.0, 10.0),
            "T": (0.02 * clock.slow, 20.0 * clock.slow),
            "L": (0.0, 5.0 * clock.slow),
        },
    )
    return Plant(
        "cooler",
        document,
        truth,
        clock.slow,
        clock.period,
        lambda x, u, _, p: ((p["K"] * u[0] - x[0] - p["q"] * x[0] * abs(x[0])) / p["T"],),
        lambda u, p: (_solve(lambda x: x + p["q"] * x * abs(x) - p["K"] * u[0]),),
        0.0,
        random.uniform(0.8, 1.5),
    )


def draw_mixer(random: np.random.Generator) -> Plant:
    """A mixing vessel: the flow through it is delayed, and its feed's temperature is an input."""
    clock = draw_clock(random)
    truth = {"V": clock.slow, "k": random.uniform(0.2, 0.6), "L": clock.delay}
    document = write_document(
        "mixer",
        {"x": "(u(t - L)*(v - x) - k*x)/V"},
        {
            "V": (0.03 * clock.slow, 30.0 * clock.slow),
            "k": (0.0, 10.0),
            "L": (0.0, 5.0 * clock.slow),
        },
        inputs=("u", "v"),
        start=50.0,
    )
    return Plant(
        "mixer",
        document,
        truth,
        clock.slow,
        clock.period,
        lambda x, u, _, p: ((u[0] * (u[1] - x[0]) - p["k"] * x[0]) / p["V"],),
        lambda u, p: (u[0] * u[1] / (u[0] + p["k"]),),
        1.0,
        0.5,
        ("u", "v"),
    )


def draw_twin(random: np.random.Generator) -> Plant:
    """First order with two inputs, one of them delayed."""
    clock = draw_clock(random)
    truth = {
        "K": draw_log(random, 0.5, 2.0),
        "M": draw_log(random, 0.5, 2.0),
        "T": clock.slow,
        "L": clock.delay,
    }
    document = write_document(
        "twin",
        {"x": "(K*u(t - L) + M*v - x)/T"},
        {
            "K": (-20.0, 20.0),
            "M": (-20.0, 20.0),
            "T": (0.02 * clock.slow, 20.0 * clock.slow),
            "L": (0.0, 5.0 * clock.slow),
        },
        inputs=("u", "v"),
    )
    return Plant(
        "twin",
        document,
        truth,
        clock.slow,
        clock.period,
        lambda x, u, _, p: ((p["K"] * u[0] + p["M"] * u[1] - x[0]) / p["T"],),
        lambda u, p: (p["K"] * u[0] + p["M"] * u[1],),
        inputs=("u", "v"),
    )


PLANTS: dict[str, Callable[[np.random.Generator], Plant]] = {
    "fopdt": draw_fopdt,
    "sopdt": draw_sopdt,
    "ipdt": draw_ipdt,
    "tank": draw_tank,
    "feedback": draw_feedback,
    "valve": draw_valve,
    "cooler": draw_cooler,
    "mixer": draw_mixer,
    "twin": draw_twin,
}
