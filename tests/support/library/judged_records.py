"""Records of a process with dead time, with and without a defect, and what the judge says of them.

The plant is simulated by itself: an exact response to a held input on a grid of a tenth of the
sampling period. So the judge does not see a record that its own simulation made.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import cont2discrete, lfilter

from sysid.core.types import FloatArray
from sysid.data.records import Channel, HoldSetting, Record
from sysid.judgement.judge import Explained, explain_residuals
from sysid.judgement.residual_context import ResidualContext
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate

STEP, N, FINE = 0.5, 400, 10
TIMES = STEP * np.arange(N)
NOISE = 0.02


@dataclass(frozen=True)
class Process:
    """A gain, time constants (s), a dead time (s) and an offset; `model` estimates them."""

    model: str
    times: tuple[float, ...]
    gain: float = 2.0
    delay: float = 2.2
    offset: float = 1.0

    @property
    def values(self) -> dict[str, float]:
        """The parameters of the model; states start at rest."""
        first, *others = self.times
        parts = {"T1": first, "r": others[0] / first} if others else {"T": first}
        return {"K": self.gain, **parts, "L": self.delay, "y0": self.offset}

    def respond(self, u: FloatArray, before: float | None = None) -> FloatArray:
        """Respond on the fine grid to an input on it, `before` at rest (its first value)."""
        first = float(u[0]) if before is None else before
        denominator = np.array([1.0])
        for time in self.times:
            denominator = np.convolve(denominator, [time, 1.0])
        b, a, _ = cont2discrete(([1.0], denominator), STEP / FINE, method="zoh")
        shift = round(self.delay * FINE / STEP)
        late = np.concatenate([np.full(shift, first), u])[: u.size]
        return np.asarray(self.gain * (first + lfilter(b.ravel(), a, late - first)) + self.offset)


FAST = Process("fopdt", (3.0,))
SLOW = Process("sopdt", (4.0, 1.5), gain=-1.5, delay=1.4)
PLANTS = (FAST, SLOW)


def draw_levels(seed: int, n: int = N, most: int = 16) -> FloatArray:
    """Draw levels (n,) from 0 to 2 that are held for up to so many samples."""
    random = np.random.default_rng([seed, 1])
    lengths = random.integers(2, most, n)
    return np.repeat(random.uniform(0.0, 2.0, n), lengths)[:n]


def hold(u: FloatArray) -> FloatArray:
    """Hold samples (n,) on the fine grid."""
    return np.repeat(u, FINE)


def draw_noise(seed: int, pole: float = 0.0, n: int = N) -> FloatArray:
    """Draw noise (n,) of variance 1, coloured by a pole."""
    white = np.random.default_rng([seed, 2]).standard_normal(n + 200)
    return np.asarray(lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], white)[200:])


def make_record(
    u: FloatArray, y: FloatArray, *, reading: HoldSetting = "zero", times: FloatArray | None = None
) -> Record:
    """Make a record of samples (n,), every `STEP`."""
    times = STEP * np.arange(u.size) if times is None else times
    return Record((Channel("u", times, u, hold=reading),), (Channel("y", times, y),))


def draw_record(plant: Process, seed: int, *, pole: float = 0.0, n: int = N) -> Record:
    """Draw a sound record."""
    u = draw_levels(seed, n)
    return make_record(u, plant.respond(hold(u))[::FINE] + NOISE * draw_noise(seed, pole, n))


def build_context(
    records: Sequence[Record],
    model: Model | str,
    start: Mapping[str, float],
    **settings: Any,
) -> ResidualContext:
    """Estimate by least squares from a start; states that it does not name start at 0."""
    loaded = load_model(model) if isinstance(model, str) else model
    problem = Problem.build(loaded, records, **settings)
    theta = np.array([start.get(name, 0.0) for name in problem.free_names])
    (end,) = refine_candidates(
        problem, [np.clip(theta, problem.evaluator.lower, problem.evaluator.upper)]
    )
    assert end is not None
    return ResidualContext(problem, end.theta, analyse_estimate(problem, end.theta))


def explain(plant: Process, *records: Record, **settings: Any) -> Explained:
    """Explain what the plant's model leaves of records, estimated from the truth."""
    return explain_residuals(build_context(records, plant.model, plant.values, **settings))


def explain_output(
    plant: Process, seed: int, change: Callable[[FloatArray], FloatArray]
) -> Explained:
    """Explain a record whose output (n,) is changed."""
    u = draw_levels(seed)
    y = plant.respond(hold(u))[::FINE] + NOISE * draw_noise(seed)
    return explain(plant, make_record(u, change(y)))


def explain_input(
    plant: Process, seed: int, change: Callable[[FloatArray], FloatArray]
) -> Explained:
    """Explain a record in which a changed input (n,) acts on the plant."""
    u = draw_levels(seed)
    y = plant.respond(hold(change(u)))[::FINE] + NOISE * draw_noise(seed)
    return explain(plant, make_record(u, y))


def list_names(explained: Explained) -> list[str]:
    """List the names of the explanations found, in their order."""
    return [one.explanation for one in explained.findings]
