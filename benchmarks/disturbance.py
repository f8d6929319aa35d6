"""Noise inside the plant: coverage of 95 % intervals, and errors beside the exact likelihood.

The draws of a kind have one plant, and their own load, noise and input. A load is an
Ornstein-Uhlenbeck process at the plant's input, held between the steps of a fine integration. It
has moved the first-order plants before the record, which start at rest otherwise. The
`drift` of a sensor is a random walk of its output, which no load explains.

Kinds: none (noise of the sensor alone), step and binary (with the load's correlation time, s),
loop (under PI control), drift, two-inputs, tank (outflow by the root of the level), feedback
(delayed, of the state), unstable (under proportional control), thermal (two capacities, noise in
both), eq16 and eq16-sensor (the paper's recursion with φ as printed, without noise of the sensor
and with). Where the plant is linear with lags of inputs only, RMSE is divided by that of the exact
likelihood with all parameters free, from the same data (zero-order hold, lag between samples). Of
eq16 it is divided by the Cramér-Rao bound (`benchmarks.noisy_recursion`).

An estimate counts in the coverage if its status is `identified`; else it is `held back`.
"""

import argparse
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.optimize import minimize
from scipy.stats import binomtest

from benchmarks.noisy_recursion import NoisyRecursion
from benchmarks.table import Row, parser, report
from sysid.core.jit import jit_compile
from sysid.core.settings import Loss, NoiseModel
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model

DRAWS, QUICK = 200, 12
FIRST_SEED = 93_000
FINE = 16  # steps of the simulation in a sample
LEAST, MOST = 93.0, 97.0
MOST_RATIO, MOST_OF_BOUND = 1.1, 1.05

Inputs = Mapping[str, FloatArray]
Rates = Callable[[FloatArray, Callable[[str, str], float], Callable[[str], float]], list[float]]
Matrices = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class Kind:
    """A plant, its input and its noise.

    Attributes
    ----------
    model : Model
    truth : mapping of str to float
        Its parameters.
    rates : callable
        Derivatives of the states from the states, `read(input, delay)` and `before(delay)`, which
        is the first state earlier.
    drive : callable
        Makes the inputs from a generator, the times and a list of all outputs so far.
    linear : callable or None
        A, B of the states, columns of loads, and delays of the inputs, from named values.
    """

    model: Model
    truth: Mapping[str, float]
    rates: Rates
    inputs: Callable[[np.random.Generator, FloatArray], dict[str, FloatArray]]
    start: Sequence[float] = (0.0,)
    control: Callable[[np.random.Generator, FloatArray], Callable[[int, float], float]] | None = (
        None
    )
    samples: int = 600
    period: float = 0.25
    load: float = 0.0
    time: float = 20.0
    diffusion: Sequence[float] = ()
    sensor: float = 0.02
    walk: float = 0.0
    offset: float = 0.0
    prelude: float = 0.0  # time before the record in which the load moves the plant, s
    linear: Callable[[Mapping[str, float]], tuple[FloatArray, FloatArray, list[float]]] | None = (
        None
    )
    noise: NoiseModel = "load"
    known: Mapping[str, Any] = field(default_factory=dict)

    def simulate(self, seed: int) -> Record:
        """Simulate a draw."""
        return _simulate(self, seed)


# ---- plants --------------------------------------------------------------------------------------
def _step(random: np.random.Generator, times: FloatArray) -> dict[str, FloatArray]:
    return {"u": (times >= 0.2 * times[-1]) * 1.0}


def _binary(
    random: np.random.Generator, times: FloatArray, names: Sequence[str] = ("u",), every: int = 40
) -> dict[str, FloatArray]:
    found = {}
    for name in names:
        levels = np.repeat(random.integers(0, 2, times.size // every + 1), every)[: times.size]
        levels[:every] = 0
        found[name] = 1.0 * levels
    return found


def _none(random: np.random.Generator, times: FloatArray) -> dict[str, FloatArray]:
    return {"u": np.zeros(times.size)}


def _control_by_pi(random: np.random.Generator, times: FloatArray) -> Callable[[int, float], float]:
    """PI control of the first-order plant, tuned for its lag, with random set points."""
    gain, reset = 0.25 * 12.3 / (2.0 * 4.37), 12.3
    wish = np.repeat(np.r_[0.0, random.choice([-1.0, 1.0], times.size // 200 + 1)], 200)
    total = 0.0

    def act(k: int, output: float) -> float:
        nonlocal total
        error = wish[k] - output
        total += gain * (times[1] - times[0]) / reset * error
        return gain * error + total

    return act


def _control_by_gain(
    random: np.random.Generator, times: FloatArray
) -> Callable[[int, float], float]:
    wish = np.repeat(random.choice([-1.0, 1.0], times.size // 60 + 1), 60)
    return lambda k, output: 2.0 * (wish[k] - output)


def _first_order(values: Mapping[str, float], sign: float = -1.0) -> Any:
    time, gain = values["T"], values["K"]
    return np.array([[sign / time]]), np.array([[gain / time]]), [values["L"]]


def _two_inputs_linear(values: Mapping[str, float]) -> Any:
    time = values["T"]
    drive = np.array([[values["K1"] / time, values["K2"] / time]])
    return np.array([[-1.0 / time]]), drive, [values["L1"], values["L2"]]


def _thermal_linear(values: Mapping[str, float]) -> Any:
    ri, ra, ci, ce = (values[name] for name in ("Ri", "Ra", "Ci", "Ce"))
    matrix = np.array(
        [[-1 / (ri * ci), 1 / (ri * ci)], [1 / (ri * ce), -1 / (ri * ce) - 1 / (ra * ce)]]
    )
    return matrix, np.array([[1 / ci, 0.0], [0.0, 1 / (ra * ce)]]), [0.0, 0.0]


def _write(
    name: str,
    states: Mapping[str, str],
    output: str,
    bounds: Mapping[str, tuple[float, float]],
    inputs: Sequence[str] = ("u",),
    initial: Mapping[str, Any] | None = None,
    plant: Sequence[str] = (),
) -> Model:
    return parse_model(
        {
            "name": name,
            "form": "differential",
            "inputs": dict.fromkeys(inputs, "1"),
            "states": dict.fromkeys(states, "1"),
            "parameters": {
                key: {"lower": low, "upper": high, "scale": "log" if low > 0 else "linear"}
                for key, (low, high) in bounds.items()
            },
            "equations": dict(states),
            "outputs": {"y": output},
            "initial": dict(initial or dict.fromkeys(states, 0)),
            "solver": {"substeps": 2},
            "noise": {"plant": dict.fromkeys(plant, "estimate")}
            if plant
            else {"load": {inputs[0]: "estimate"}},
        }
    )


FIRST_ORDER = {"K": 2.0, "T": 12.3, "L": 4.37}


def _make_first_order(**changes: Any) -> Kind:
    def rates(x: FloatArray, read: Any, before: Any) -> list[float]:
        return [(2.0 * read("u", "L") - x[0]) / 12.3]

    fields: dict[str, Any] = {
        "inputs": _binary,
        "linear": _first_order,
        "offset": 20.0,
        "prelude": 120.0,
    }
    return Kind(load_model("fopdt"), FIRST_ORDER, rates, **(fields | changes))


TWO_INPUTS = {"K1": 2.0, "K2": -1.2, "T": 12.3, "L1": 4.37, "L2": 1.6}
TANK = {"k": 0.6, "c": 0.5, "L": 3.3}
FEEDBACK = {"a": 0.25, "b": 0.6, "L": 3.37}
UNSTABLE = {"K": 1.0, "T": 8.0, "L": 1.13}
THERMAL = {"Ri": 2.0, "Ra": 4.0, "Ci": 1.5, "Ce": 12.0}


def _rate_two_inputs(x: FloatArray, read: Any, before: Any) -> list[float]:
    return [(2.0 * read("u", "L1") - 1.2 * read("v", "L2") - x[0]) / 12.3]


def _rate_tank(x: FloatArray, read: Any, before: Any) -> list[float]:
    return [0.6 * (1.0 + read("u", "L")) - 0.5 * np.sqrt(max(x[0], 0.0))]


def _rate_feedback(x: FloatArray, read: Any, before: Any) -> list[float]:
    return [-0.25 * before("L") + 0.6 * read("u", "")]


def _rate_unstable(x: FloatArray, read: Any, before: Any) -> list[float]:
    return [(x[0] + read("u", "L")) / 8.0]


def _rate_thermal(x: FloatArray, read: Any, before: Any) -> list[float]:
    flow = (x[1] - x[0]) / 2.0
    return [(flow + read("u", "")) / 1.5, (-flow + (read("v", "") - x[1]) / 4.0) / 12.0]


def _heat(random: np.random.Generator, times: FloatArray) -> dict[str, FloatArray]:
    drive = _binary(random, times, every=12)
    day = 3.0 * np.sin(2 * np.pi * times / 24.0 + random.uniform(0, 6))
    return {"u": 3.0 * drive["u"], "v": day}


KINDS: dict[str, Kind | NoisyRecursion] = {
    "none": _make_first_order(),
    "step20": _make_first_order(inputs=_step, load=0.05),
    "step200": _make_first_order(inputs=_step, load=0.05, time=200.0),
    "binary20": _make_first_order(load=0.05),
    "binary200": _make_first_order(load=0.05, time=200.0),
    "loop20": _make_first_order(inputs=_none, control=_control_by_pi, load=0.1, samples=1200),
    "loop100": _make_first_order(
        inputs=_none, control=_control_by_pi, load=0.1, time=100.0, samples=1200
    ),
    "drift": _make_first_order(walk=0.01, linear=None),
    "two-inputs": Kind(
        _write(
            "two-inputs",
            {"x": "(K1*u(t - L1) + K2*v(t - L2) - x)/T"},
            "x",
            {"K1": (-10, 10), "K2": (-10, 10), "T": (0.5, 200), "L1": (0, 20), "L2": (0, 20)},
            ("u", "v"),
        ),
        TWO_INPUTS,
        _rate_two_inputs,
        partial(_binary, names=("u", "v")),
        load=0.05,
        linear=_two_inputs_linear,
    ),
    "tank": Kind(
        _write(
            "tank",
            {"x": "k*(1 + u(t - L)) - c*sqrt(max(x, 0.001))"},
            "x",
            {"k": (0.05, 5), "c": (0.05, 5), "L": (0, 20)},
            initial={"x": {"lower": 0.5, "upper": 3}},
        ),
        TANK,
        _rate_tank,
        _binary,
        start=(1.44,),
        load=0.05,
    ),
    "feedback": Kind(
        _write(
            "feedback",
            {"x": "b*u(t) - a*x(t - L)"},
            "x",
            {"a": (0.02, 0.45), "b": (0.02, 5), "L": (0.0, 15)},
        ),
        FEEDBACK,
        _rate_feedback,
        _binary,
        load=0.1,
    ),
    "unstable": Kind(
        _write(
            "unstable",
            {"x": "(x + K*u(t - L))/T"},
            "x",
            {"K": (0.05, 20), "T": (0.5, 100), "L": (0, 5)},
        ),
        UNSTABLE,
        _rate_unstable,
        _none,
        control=_control_by_gain,
        load=0.05,
        linear=partial(_first_order, sign=1.0),
    ),
    "thermal": Kind(
        _write(
            "thermal",
            {
                "x": "((w - x)/Ri + u)/Ci",
                "w": "((x - w)/Ri + (v - w)/Ra)/Ce",
            },
            "x",
            {"Ri": (0.1, 20), "Ra": (0.1, 40), "Ci": (0.1, 20), "Ce": (0.5, 200)},
            ("u", "v"),
            {"x": {"lower": -5, "upper": 5}, "w": {"lower": -5, "upper": 5}},
            ("x", "w"),
        ),
        THERMAL,
        _rate_thermal,
        _heat,
        start=(0.5, 0.2),
        samples=500,
        diffusion=(0.05, 0.05),
        sensor=0.05,
        linear=_thermal_linear,
        noise="plant",
    ),
    "eq16": NoisyRecursion(),
    "eq16-sensor": NoisyRecursion(sensor=0.01),
}


# ---- simulation ----------------------------------------------------------------------------------
def _simulate(kind: Kind, seed: int) -> Record:
    """Simulate a draw: Runge-Kutta steps of a part of a sample, with means of held inputs."""
    random, h = np.random.default_rng([seed, 11]), kind.period
    times = h * np.arange(kind.samples)
    inputs = kind.inputs(random, times)
    act = None if kind.control is None else kind.control(random, times)
    fine, x = h / FINE, np.array(kind.start, dtype=np.float64)
    load = random.normal(0.0, kind.load)
    keep = np.exp(-fine / kind.time)
    spread = kind.load * np.sqrt(1.0 - keep**2)
    for _ in range(round(kind.prelude / fine)):
        x = _advance(kind.rates, x, lambda *_: load, lambda _: x[0], fine)  # noqa: B023
        load = keep * load + spread * random.normal()
    states = [x.copy()]
    root = np.sqrt(fine) * np.array(kind.diffusion or [0.0] * x.size)
    y = np.empty(kind.samples)
    first = next(iter(inputs))
    areas = {
        name: np.concatenate([[0.0], np.cumsum(values) * h]) for name, values in inputs.items()
    }
    for k in range(kind.samples):
        y[k] = x[0] + random.normal(0.0, kind.sensor)
        if act is not None:
            inputs[first][k] = act(k, y[k])
        for name, values in inputs.items():
            areas[name][k + 1] = areas[name][k] + h * values[k]
        for part in range(FINE):
            begin = k * h + part * fine

            def read(name: str, delay: str, begin: float = begin, load: float = load) -> float:
                lag = kind.truth[delay] if delay else 0.0
                ends = [
                    _integrate(inputs[name], areas[name], h, begin + s - lag) for s in (0, fine)
                ]
                return (ends[1] - ends[0]) / fine + (load if name == first else 0.0)

            def before(delay: str, begin: float = begin) -> float:
                place = max((begin + 0.5 * fine - kind.truth[delay]) / fine, 0.0)
                whole = int(place)
                ends = states[whole][0], states[min(whole + 1, len(states) - 1)][0]
                return float(ends[0] + (place - whole) * (ends[1] - ends[0]))

            x = _advance(kind.rates, x, read, before, fine) + root * random.normal(size=x.size)
            states.append(x.copy())
            load = keep * load + spread * random.normal()
    y += kind.offset + np.cumsum(random.normal(0.0, kind.walk, kind.samples))
    channels = tuple(Channel(name, times, values, hold="zero") for name, values in inputs.items())
    return Record(channels, (Channel("y", times, y),))


def _integrate(values: FloatArray, areas: FloatArray, h: float, at: float) -> float:
    """Integrate a held input from 0 to a time; before 0 it is at its first value."""
    if at <= 0.0:
        return float(values[0] * at)
    k = min(int(at / h + 1e-9), values.size - 1)
    return float(areas[k] + (at - k * h) * values[k])


def _advance(rates: Rates, x: FloatArray, read: Any, before: Any, h: float) -> FloatArray:
    a = np.array(rates(x, read, before))
    b = np.array(rates(x + 0.5 * h * a, read, before))
    c = np.array(rates(x + 0.5 * h * b, read, before))
    d = np.array(rates(x + h * c, read, before))
    return np.asarray(x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d))


# ---- exact likelihood ----------------------------------------------------------------------------
@jit_compile
def sum_innovations(
    phi: FloatArray,
    drive: FloatArray,
    covariance: FloatArray,
    start: FloatArray,
    spread: FloatArray,
    variance: float,
    y: FloatArray,
) -> float:
    """Minus log-likelihood of measurements (N,) of the first state."""
    x, p, total, n = start.copy(), spread.copy(), 0.0, start.size
    turned = np.ascontiguousarray(phi.T)
    for k in range(y.size):
        s = p[0, 0] + variance
        e = y[k] - x[0]
        total += 0.5 * (e * e / s + np.log(s))
        gain = p[0] / s
        x = phi @ (x + gain * e) + drive[k]
        for i in range(n):
            for j in range(n):
                p[i, j] -= gain[i] * gain[j] * s
        p = phi @ p @ turned + covariance
        if not np.abs(x[0]) < 1e8:
            return 1e12
    return total


def fit_likelihood(kind: Kind, record: Record, start: Mapping[str, float]) -> dict[str, float]:
    """Maximise the exact likelihood of a linear kind from a start, by the simplex method."""
    assert kind.linear is not None
    names = list(kind.truth)
    y = record.outputs[0].values - kind.offset
    inputs = [channel.values for channel in record.inputs]
    own = len(kind.start)
    is_load = kind.noise == "load"
    is_free = not is_load  # starts of the states
    has_level = any(parameter.name == "y0" for parameter in kind.model.parameters)
    logs = np.array([kind.truth[name] > 0 and name[0] != "L" for name in names])

    def unpack(p: FloatArray) -> dict[str, float]:
        values = np.where(logs, np.exp(np.where(logs, p[: len(names)], 0.0)), p[: len(names)])
        return dict(zip(names, values.tolist(), strict=True))

    def evaluate(p: FloatArray) -> float:
        values, rest = unpack(p), p[len(names) :]
        if any(values[name] < 0 for name in names if name[0] == "L"):
            return 1e12
        a, b, lags = kind.linear(values)  # type: ignore[misc]
        sensor = np.exp(2 * rest[0])
        if is_load:
            size, constant = np.exp(rest[1]), np.exp(rest[2])
            if not 0.1 < constant < 5000:
                return 1e12
            whole = np.zeros((own + 1, own + 1))
            whole[:own, :own], whole[:own, own], whole[own, own] = a, b[:, 0], -1.0 / constant
            b = np.vstack([b, np.zeros((1, b.shape[1]))])
            noise = np.zeros((own + 1, own + 1))
            noise[own, own] = 2.0 * size**2 / constant
            spread = np.zeros((own + 1, own + 1))
            spread[own, own] = size**2
            if kind.prelude:
                spread = solve_continuous_lyapunov(whole, -noise)
        else:
            whole, noise = a, np.diag(np.exp(2 * rest[1 : 1 + own]))
            spread = np.zeros((own, own))
        x0 = np.zeros(whole.shape[0])
        if is_free:
            x0[:own] = rest[-own:]
        level = rest[-1] if has_level else 0.0
        phi, covariance = discretise(whole, noise, kind.period)
        drive = sum(
            drive_by(whole, b[:, j], inputs[j], lags[j], kind.period) for j in range(len(inputs))
        )
        found = sum_innovations(phi, drive, covariance, x0, spread, sensor, y - level)
        return found if np.isfinite(found) else 1e12

    point = [
        np.log(start[n]) if is_log else start[n] for n, is_log in zip(names, logs, strict=True)
    ]
    noises = (
        [np.log(0.05), np.log(50.0)] + [0.0] * has_level
        if is_load
        else [np.log(0.05)] * own + [float(y[0])] * own
    )
    first = np.array([*point, np.log(kind.sensor), *noises])
    best = minimize(evaluate, first, method="BFGS", options={"gtol": 1e-3})
    again = {"maxfev": 400, "xatol": 1e-4, "fatol": 1e-4}
    best = minimize(evaluate, best.x, method="Nelder-Mead", options=again)
    return unpack(best.x)


def discretise(a: FloatArray, noise: FloatArray, h: float) -> tuple[FloatArray, FloatArray]:
    """Discretise a linear system and its diffusion (Van Loan 1978)."""
    n = a.shape[0]
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -a, noise, a.T
    whole = expm(block * h)
    phi = np.ascontiguousarray(whole[n:, n:].T)
    return phi, phi @ whole[:n, n:]


def drive_by(a: FloatArray, b: FloatArray, u: FloatArray, lag: float, h: float) -> FloatArray:
    """Compute what a held input (N,) adds to the states in each sample, with a lag (s)."""
    n, whole = a.shape[0], int(lag / h)
    part = lag - whole * h

    def integrate(width: float) -> tuple[FloatArray, FloatArray]:
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n] = a, b
        found = expm(block * width)
        return found[:n, :n], found[:n, n]

    phi, new = integrate(h - part)
    old = phi @ integrate(part)[1]
    now = u[np.maximum(np.arange(u.size) - whole, 0)]
    earlier = u[np.maximum(np.arange(u.size) - whole - 1, 0)]
    return np.outer(earlier, old) + np.outer(now, new)


# ---- draws ---------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Outcome:
    """Errors of a draw: estimate, whether its interval holds the truth, exact likelihood."""

    errors: dict[str, float]
    stderrs: dict[str, float]
    held: dict[str, bool | None]
    exact: dict[str, float]
    noise_model: str
    trust: str
    seconds: float
    evaluations: int


def run_draw(task: tuple[str, int, str]) -> Outcome:
    """Identify one draw of a kind."""
    name, seed, noise = task
    kind = KINDS[name]
    record = kind.simulate(seed)
    model = kind.noise if noise == "plants" else noise
    begun = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loss = Loss(noise_model=model)  # type: ignore[arg-type]
        found = identify(kind.model, record, loss=loss, seed=seed)
    seconds = time.process_time() - begun
    errors, stderrs, held = {}, {}, {}
    for key, true in kind.truth.items():
        one = found[key]
        errors[key] = one.value - true
        stderrs[key] = one.stderr or np.nan
        ends = one.interval95 if one.status == "identified" else None
        held[key] = None if ends is None else ends[0] <= true <= ends[1]
    exact = {}
    if isinstance(kind, Kind) and kind.linear is not None:
        fitted = fit_likelihood(kind, record, kind.truth)
        exact = {key: fitted[key] - true for key, true in kind.truth.items()}
    return Outcome(
        errors,
        stderrs,
        held,
        exact,
        found.noise_model,
        found.verdict.trust,
        seconds,
        found.evaluations,
    )


def summarise(name: str, outcomes: list[Outcome]) -> list[Row]:
    """Print a line of a kind; rows for coverage and for RMSE over the exact one."""
    rows, parts, kind = [], [], KINDS[name]
    bound = kind.bound if isinstance(kind, NoisyRecursion) else {}
    for key in outcomes[0].errors:
        errors = np.array([one.errors[key] for one in outcomes])
        rmse = float(np.sqrt(np.mean(errors**2)))
        known = [one.held[key] for one in outcomes if one.held[key] is not None]
        stderr = float(np.nanmedian([one.stderrs[key] for one in outcomes]))
        bias = float(np.mean(errors)) / stderr
        told = f"{key}: rmse {rmse:.3g}, claimed {stderr:.3g}, bias {bias:+.2f}"
        if known:
            low, high = (100.0 * end for end in binomtest(sum(known), len(known)).proportion_ci())
            told += f", held {sum(known)} of {len(known)}"
            rows += [
                Row(f"{name}, {key}: coverage, upper end", high, "%", LEAST, ">="),
                Row(f"{name}, {key}: coverage, lower end", low, "%", MOST),
            ]
        if outcomes[0].exact:
            exact = float(np.sqrt(np.mean([one.exact[key] ** 2 for one in outcomes])))
            told += f", ratio {rmse / exact:.2f}"
            rows.append(Row(f"{name}, {key}: RMSE over exact", rmse / exact, "", MOST_RATIO))
        elif bound:
            told += f", of bound {rmse / bound[key]:.2f}"
            ratio = rmse / bound[key]
            rows.append(Row(f"{name}, {key}: RMSE over its bound", ratio, "", MOST_OF_BOUND))
        parts.append(told)
    held_back = sum(value is None for one in outcomes for value in one.held.values())
    models: dict[str, int] = {}
    for one in outcomes:
        told = f"{one.noise_model}/{one.trust}"
        models[told] = models.get(told, 0) + 1
    seconds = float(np.mean([one.seconds for one in outcomes]))
    print(f"| {name} | {'<br>'.join(parts)} | {held_back} | {models} | {seconds:.2f} |", flush=True)
    return rows


def main(options: argparse.Namespace) -> None:
    """Measure all kinds, on so many processes."""
    draws = options.draws or (QUICK if options.quick else DRAWS)
    names = [name for name in KINDS if name in (options.kind or KINDS)]
    tasks = [
        (name, options.first_seed + number, options.noise)
        for name in names
        for number in range(draws)
    ]
    with get_context("spawn").Pool(options.jobs) as pool:
        outcomes = pool.imap(run_draw, tasks)
        print("| kind | parameters | held back | noise model/verdict | CPU, s |")
        print("|---|---|--:|---|--:|")
        rows = [
            row for name in names for row in summarise(name, [next(outcomes) for _ in range(draws)])
        ]
    report(f"Noise inside the plant, {draws} draws each", rows, [], options)


if __name__ == "__main__":
    arguments = parser(__doc__ or "")
    arguments.add_argument("--draws", type=int, help=f"of each kind (default {DRAWS})")
    arguments.add_argument("--kind", action="append", choices=KINDS, help="only this (repeatable)")
    arguments.add_argument(
        "--noise",
        default="plants",
        choices=("plants", "auto", "white", "ar1", "plant", "load"),
        help="noise model; plants: that of each kind (default)",
    )
    arguments.add_argument("--first-seed", type=int, default=FIRST_SEED)
    arguments.add_argument("--jobs", type=int, default=1, help="processes")
    main(arguments.parse_args())
