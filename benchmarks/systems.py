"""Identification problems with true parameters: the paper's, harder versions, others.

The harder versions have five times the samples, five times the range of the time lag, or both. The
paper's examples are unchanged (300 samples, time lag up to 1 s).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.simulation.fit_metrics import rms
from sysid.simulation.problem import Problem

STEP = 0.02
"""Sample time of the paper's examples (s)."""

NARX = {
    "name": "narx-two-lags",
    "form": "polynomial",
    "output": "y",
    "inputs": {"u": "1"},
    "parameters": {
        "dh": {"lower": 0, "upper": 20, "unit": "samples"},
        "dk": {"lower": 0, "upper": 40, "unit": "samples"},
    },
    "terms": ["y(k-1)", "y(k-1-dh)", "u(k-1-dk)", "y(k-1)*u(k-1-dk)", "u(k-1-dk)**2"],
    "coefficients": {"lower": -2, "upper": 2},
}
"""A polynomial model with two unknown lags."""


@dataclass(frozen=True)
class System:
    """A model, what it is driven by, and the values that its data come from.

    `noise` is the standard deviation of the measurement noise as a share of the output's standard
    deviation, or, where `absolute`, in the output's unit.
    """

    name: str
    model: str | Mapping[str, Any]
    samples: int
    step: float
    truth: Mapping[str, float]
    drive: Callable[[FloatArray], FloatArray] | None = None
    hold: str = "zero"
    start: Mapping[str, float] = field(default_factory=dict)
    parameters: Mapping[str, Any] | None = None
    noise: float = 0.02
    absolute: bool = False

    @cached_property
    def parsed(self) -> Model:
        """The model."""
        return load_model(self.model) if isinstance(self.model, str) else parse_model(self.model)

    @cached_property
    def clean(self) -> FloatArray:
        """The output without noise."""
        first = np.full(self.samples, self.start.get("x", 0.0))
        problem = self._build_problem(self._build_record(first))
        return problem.predict(self.place(problem)[None])[0]

    def place(self, problem: Problem) -> FloatArray:
        """The true values in the order of the free parameters."""
        values = {f"{state}(0)": value for state, value in self.start.items()} | dict(self.truth)
        return np.array([values[name] for name in problem.free_names])

    def record(self, seed: int) -> Record:
        """The system's record with the noise of that seed."""
        scale = 1.0 if self.absolute else float(np.std(self.clean))
        draw = np.random.default_rng(seed).standard_normal(self.samples)
        return self._build_record(self.clean + self.noise * scale * draw)

    def problem(self, seed: int) -> Problem:
        """The system's record with the noise of that seed, ready to be fitted."""
        return self._build_problem(self.record(seed))

    @property
    def level(self) -> float:
        """RMS of the output without noise."""
        return rms(self.clean)

    def _build_record(self, y: FloatArray) -> Record:
        times = self.step * np.arange(self.samples)
        inputs = []
        if self.drive is not None:
            signal = self.parsed.inputs[0]
            inputs.append(
                Channel(signal.name, times, self.drive(times), signal.unit, hold=self.hold)
            )  # type: ignore[arg-type]
        return Record(tuple(inputs), (Channel(self.parsed.outputs[0].name, times, y),))

    def _build_problem(self, record: Record) -> Problem:
        return Problem.build(self.parsed, [record], parameters=self.parameters)


def _cosine(times: FloatArray) -> FloatArray:
    return np.asarray(10.0 * np.cos(5.0 * times))


def switching(level: float, least: int, seed: int) -> Callable[[FloatArray], FloatArray]:
    """An input that jumps between random levels, each held for `least` samples or more."""

    def signal(times: FloatArray) -> FloatArray:
        rng = np.random.default_rng(seed)
        values: list[float] = []
        while len(values) < times.size:
            values += [level * rng.uniform(-1.0, 1.0)] * int(rng.integers(least, 3 * least))
        return np.array(values[: times.size])

    return signal


def _supply(times: FloatArray) -> FloatArray:
    """Pressure difference of the actuator: levels with twelve sines on them (Pa)."""
    rates = np.linspace(1.0, 20.0, 12)
    phases = np.random.default_rng(7).uniform(0.0, 2.0 * np.pi, 12)
    sines = np.sin(np.outer(times, rates) + phases).sum(axis=1)
    return np.asarray(switching(8e3, 10, 7)(times) + 2e3 * sines)


def paper(example: str, samples: int = 300, lag: float = 1.0, noise: float = 0.01) -> System:
    """Example 1 (``A``, Duffing) or 2 (``B``, Coulomb) of the paper, as its recursion (Eq. 16)."""
    last, model = ("a", "duffing-eq16") if example == "A" else ("mu", "coulomb-eq16")
    truth = {"c": 0.2, "L": 0.5, "b": 5.0, last: 1.0 if example == "A" else 0.5}
    name = f"{example}/{samples}/{lag:g}" if noise else f"{example}0"
    return System(
        name,
        model,
        samples,
        STEP,
        truth,
        _cosine,
        parameters={"L": {"upper": lag}},
        noise=noise,
        absolute=True,
    )


PAPER = (
    paper("A", noise=0.0),
    paper("B", noise=0.0),
    *(paper(e, n, lag) for e in "AB" for n in (300, 1500) for lag in (1.0, 5.0)),
)
"""A0 and B0; then A and B, 300 and 1500 samples, lag up to 1 and 5 s (A/300/1 is A1)."""

OTHERS = (
    System(
        "delayed van der Pol",
        "delayed-van-der-pol",
        600,
        0.05,
        {"mu": 1.0, "w": 1.5, "g": 0.8, "L": 1.7, "v(0)": 0.0},
        switching(2.0, 20, 1),
        start={"x": 0.5},
    ),
    System(
        "Mackey-Glass",
        "mackey-glass",
        150,
        1.0,
        {"beta": 0.2, "gamma": 0.1, "n": 10.0, "L": 17.0},
        start={"x": 1.2},
    ),
    System(
        "delayed logistic",
        "delayed-logistic",
        400,
        0.05,
        {"r": 1.8, "K": 10.0, "L": 1.0},
        start={"x": 2.0},
    ),
    System(
        "FOPDT, lag to half the record",
        "fopdt",
        400,
        0.05,
        {"K": 2.0, "T": 0.8, "L": 2.3, "y0": 1.0, "x(0)": 0.0},
        switching(1.0, 30, 2),
        parameters={"L": {"upper": 10.0}},
    ),
    System(
        "SOPDT, lag to half the record",
        "sopdt",
        400,
        0.05,
        {"K": 2.0, "T1": 0.8, "r": 0.5, "L": 2.3, "y0": 1.0, "w(0)": 0.0, "x(0)": 0.0},
        switching(1.0, 30, 3),
        parameters={"L": {"upper": 10.0}},
    ),
    System(
        "actuator with stick-slip",
        "actuator",
        800,
        0.01,
        {
            "J": 3.6e-4,
            "F_c": 1.2317e-2,
            "F_max": 3.3333e-2,
            "k_a": 83.089,
            "k_c": 456.99e3,
            "theta(0)": 0.0,
        },
        _supply,
    ),
    System(
        "NARX, two unknown lags",
        NARX,
        400,
        1.0,
        {
            "dh": 6.0,
            "dk": 13.0,
            "a[y(k-1)]": 0.7,
            "a[y(k-1-dh)]": -0.3,
            "a[u(k-1-dk)]": 0.5,
            "a[y(k-1)*u(k-1-dk)]": 0.15,
            "a[u(k-1-dk)**2]": 0.2,
        },
        switching(1.0, 5, 4),
    ),
)
"""Systems for which nothing in the search was chosen."""
