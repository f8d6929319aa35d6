"""What every model of the catalogue is excited by in tests, and the record that this makes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from sysid.core.settings import PredictionKind
from sysid.core.types import FloatArray
from sysid.data.noise import Noise, add_output_noise
from sysid.data.records import Channel, Hold, Record
from sysid.kernels.signals.past_reads import is_difference
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model, replace_substeps
from sysid.simulation.simulate import simulate

Signal = Callable[[FloatArray], FloatArray]


def levels(period: float, low: float, high: float) -> Signal:
    """Holds of `period` s at levels drawn once."""

    def signal(times: FloatArray) -> FloatArray:
        places = np.floor(times / period + 1e-9).astype(np.int64)
        drawn = np.random.default_rng(7).uniform(low, high, int(places[-1]) + 1)
        return np.asarray(drawn[places])

    return signal


def cosine(amplitude: float, rate: float) -> Signal:
    return lambda times: amplitude * np.cos(rate * times)


def noise(amplitude: float) -> Signal:
    return lambda times: amplitude * np.random.default_rng(7).standard_normal(times.size)


def multisine(amplitude: float, first: float, last: float) -> Signal:
    """Twelve sines of equal amplitude from `first` to `last` rad/s."""
    phases = np.random.default_rng(7).uniform(0, 2 * np.pi, 12)
    rates = np.linspace(first, last, 12)
    return lambda times: amplitude * np.sin(np.outer(times, rates) + phases).sum(axis=1)


def sum_of(*signals: Signal) -> Signal:
    return lambda times: np.sum([one(times) for one in signals], axis=0)


@dataclass(frozen=True)
class Case:
    """What a model is excited by, and the parameters it is simulated at.

    `within` is how far from the truth an estimate may be, as a part of the value (of the bound's
    span where the value is 0).
    """

    truth: Mapping[str, float]
    period: float
    samples: int
    signal: Signal | None = None
    hold: Hold = "first"
    sigma: float = 0.0
    within: float = 1e-3
    prediction: PredictionKind = "simulation"
    initial: Mapping[str, float] = field(default_factory=dict)  # and what the model has fixed
    statuses: Mapping[str, str] = field(default_factory=dict)  # of parameters not identified


TUBE = levels(3.0, 0.05e6, 0.5e6)
SILVERBOX = {"b": 1.86e5, "d": 41.9, "k1": 1.84e5, "k2": -6.4e3, "k3": 7.3e5, "c": 1.0e3, "L": 2e-4}
NARX = dict.fromkeys((one.name for one in load_model("narx").parameters), 0.0) | {
    "a[y(k-1)]": 0.5,
    "a[y(k-1-dh)]": -0.2,
    "a[u(k-1)]": 0.6,
    "a[u(k-1-dk)]": 0.3,
    "a[y(k-1)**2]": -0.1,
    "a[y(k-1)*u(k-1)]": 0.15,
    "a[u(k-1-dk)**2]": 0.2,
    "dh": 3.4,
    "dk": 7.6,
}
ACTUATOR = {"J": 3.6e-4, "F_c": 1.2317e-2, "F_max": 3.3333e-2, "k_a": 83.089, "k_c": 456.99e3}
ARM = {**ACTUATOR, "A_m": 5.0e-6, "B": 1.0e-3}
"""The actuator with what is fixed in the catalogue."""
REST = {"y(0)": 0.0, "v(0)": 0.0}
CASES = {
    "duffing-delay": Case(
        {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0}, 0.02, 500, cosine(10, 5), sigma=1e-5
    ),
    "duffing-eq16": Case({"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0}, 0.02, 300, cosine(10, 5)),
    "coulomb-delay": Case({"c": 0.2, "L": 0.5, "b": 5.0, "mu": 0.5}, 0.02, 300, cosine(10, 5)),
    "coulomb-eq16": Case({"c": 0.2, "L": 0.5, "b": 5.0, "mu": 0.5}, 0.02, 300, cosine(10, 5)),
    "tube": Case(
        {"K": 1.0, "T": 0.34, "L": 0.119}, 0.01, 2000, TUBE, sigma=10.0, initial={"y(0)": 2e5}
    ),
    "tube-second-order": Case(
        {"K": 1.0, "w": 20.0, "z": 0.7, "L": 0.05},
        0.01,
        1500,
        TUBE,
        sigma=10.0,
        initial={"y(0)": 2e5},
    ),
    "fopdt": Case(
        {"K": 0.96, "T": 0.375, "L": 0.22, "y0": 4.84},
        0.08,
        500,
        levels(0.6, -1.5, 1.5),
        "zero",
        1e-4,
        initial={"x(0)": -0.5},
    ),
    "sopdt": Case(
        {"K": 0.92, "T1": 0.26, "r": 0.48, "L": 0.16, "y0": 4.85},
        0.08,
        500,
        levels(0.6, -1.5, 1.5),
        "zero",
        1e-5,
        5e-3,
        initial={"w(0)": -0.6, "x(0)": -0.1},
    ),
    "topdt": Case(
        {"K": 0.92, "T1": 0.36, "r2": 0.6, "r3": 0.5, "L": 0.16, "y0": 4.85},
        0.08,
        800,
        levels(0.6, -1.5, 1.5),
        "zero",
        1e-5,
        1e-2,
        initial={"v(0)": -0.6, "w(0)": -0.1, "x(0)": 0.2},
    ),
    "foipdt": Case(
        {"K": 0.8, "T": 0.3, "L": 0.22},
        0.05,
        500,
        levels(0.6, -1.5, 1.5),
        sigma=1e-4,
        within=5e-3,
        initial={"w(0)": 0.3, "y(0)": 0.5},
    ),
    "ipdt": Case(
        {"K": 0.8, "L": 0.22},
        0.05,
        500,
        levels(0.6, -1.5, 1.5),
        sigma=1e-4,
        initial={"y(0)": 0.5},
    ),
    "exponential": Case({"L": 0.8}, 0.01, 200),
    "silverbox": Case(
        SILVERBOX, 1 / 610.35, 1500, noise(0.05), "band-limited", 1e-6, 1e-2, initial=REST
    ),
    "silverbox-9": Case(
        SILVERBOX | {"d1": 20.0, "d2": 119.0, "k5": 4.0e5},
        1 / 610.35,
        3000,
        noise(0.08),
        "band-limited",
        within=1e-2,
        initial=REST,
    ),
    "emps": Case(
        {"M": 95.1, "Fv": 203.5, "Fc": 20.4, "o": -3.2},
        1e-3,
        3000,
        multisine(1.0, 2.0, 20.0),
        within=1e-2,
        initial={"y(0)": 0.0},
    ),
    "narx": Case(NARX, 0.1, 500, noise(0.5), initial={"y(0)": 0.0}),
    "actuator": Case(
        ACTUATOR,
        0.01,
        800,
        sum_of(levels(0.1, -8e3, 8e3), multisine(2e3, 1.0, 20.0)),
        sigma=1e-4,
        within=2e-2,
        initial={"theta(0)": 0.0, "A_m": 5.0e-6, "B": 1.0e-3, "theta_s": 2.356194490192345},
    ),
    "mackey-glass": Case(
        {"beta": 0.2, "gamma": 0.1, "n": 10.0, "L": 17.0},
        1.0,
        90,
        initial={"x(0)": 1.2},
        within=1e-2,
    ),
    "delayed-van-der-pol": Case(
        {"mu": 1.0, "w": 2.0, "g": 0.8, "L": 0.7},
        0.02,
        600,
        levels(0.5, -3, 3),
        sigma=1e-5,
        initial={"x(0)": 0.5, "v(0)": -1.0},
    ),
    "delayed-logistic": Case(
        {"r": 1.6, "K": 5.0, "L": 1.1}, 0.05, 400, initial={"x(0)": 1.0}, sigma=1e-5
    ),
}


def make_record(model: Model, case: Case) -> Record:
    """The record of the true model, with the case's noise; its integration error is negligible."""
    if not is_difference(model):
        model = replace_substeps(model, 16 * model.solver.substeps)
    times: FloatArray = case.period * np.arange(case.samples, dtype=np.float64)
    inputs = tuple(
        Channel(one.name, times, case.signal(times), one.unit, case.hold)
        for one in model.inputs
        if case.signal is not None
    )
    values = {**case.truth, **case.initial}
    outputs = simulate(model, inputs, values, times=times).channels
    return add_output_noise(Record(inputs, outputs), Noise(case.sigma, seed=3))
