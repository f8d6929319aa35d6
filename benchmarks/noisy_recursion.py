"""Eq. 16 with φ in the recursion, as the paper prints it, and the least errors that it allows.

Both are written for this recursion alone, with matrices: nothing is shared with the filter.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import floor

import numpy as np

from sysid.core.settings import NoiseModel
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model

PERIOD, SAMPLES, MEMORY = 0.02, 300, 2
STEPS = {"c": 1e-4, "L": 4e-3, "b": 1e-3, "a": 1e-3}  # of central differences
LOG_STEP = 1e-3  # of a size of noise


@dataclass(frozen=True)
class NoisyRecursion:
    """The oscillator of Example 1, with noise of each sample and of its sensor (m)."""

    plant: float = 1e-4
    sensor: float = 0.0

    noise: NoiseModel = "plant"

    @cached_property
    def model(self) -> Model:
        """The paper's recursion of the catalogue."""
        return load_model("duffing-eq16")

    @cached_property
    def truth(self) -> Mapping[str, float]:
        """The paper's parameters."""
        return {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0}

    def simulate(self, seed: int) -> Record:
        """Simulate a draw."""
        random, times = np.random.default_rng([seed, 16]), PERIOD * np.arange(SAMPLES)
        x, _ = follow(self.truth, self.plant * random.normal(size=SAMPLES))
        y = x + self.sensor * random.normal(size=SAMPLES)
        return Record((Channel("q", times, drive(), "N"),), (Channel("y", times, y, "m"),))

    @cached_property
    def bound(self) -> dict[str, float]:
        """Cramér-Rao bound of the plant's parameters, sizes of noise unknown.

        To first order in the noise the samples are normal, of mean μ(θ) and covariance Σ(θ). Their
        information is μᵢᵀ Σ⁻¹ μⱼ + tr(Σ⁻¹ Σᵢ Σ⁻¹ Σⱼ)/2 (Kay, Estimation Theory, 1993, ch. 3.9).
        """
        names = [*STEPS, "plant", *(["sensor"] if self.sensor else [])]
        weight = np.linalg.inv(self._describe_samples({})[1])
        slopes = []
        for name in names:
            step = STEPS.get(name, LOG_STEP)
            (high, more), (low, less) = (self._describe_samples({name: s * step}) for s in (1, -1))
            slopes.append(((high - low) / (2 * step), weight @ (more - less) / (2 * step)))
        information = np.array(
            [[a @ weight @ b + 0.5 * np.sum(p * q.T) for b, q in slopes] for a, p in slopes]
        )
        errors = np.sqrt(np.diag(np.linalg.inv(information)))
        return dict(zip(STEPS, errors.tolist(), strict=False))

    def _describe_samples(self, moved: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of the samples after the first ones; sizes move by logarithms."""
        values = {name: value + moved.get(name, 0.0) for name, value in self.truth.items()}
        x, tangent = follow(values, np.zeros(SAMPLES))
        spread = np.linalg.inv(np.eye(SAMPLES) - tangent)[MEMORY:, MEMORY:]
        plant = self.plant * np.exp(moved.get("plant", 0.0))
        sensor = self.sensor * np.exp(moved.get("sensor", 0.0))
        return x[MEMORY:], plant**2 * spread @ spread.T + sensor**2 * np.eye(SAMPLES - MEMORY)


def drive() -> FloatArray:
    """The paper's force, N."""
    return np.asarray(10.0 * np.cos(5.0 * PERIOD * np.arange(SAMPLES)))


def follow(values: Mapping[str, float], noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Follow Eq. 16 with φ: the samples (N,), and each one's slopes by those before it (N, N)."""
    c, lag, b, a = (values[name] for name in STEPS)
    force, x, slopes = drive(), np.zeros(SAMPLES), np.zeros((SAMPLES, SAMPLES))
    whole = floor(lag / PERIOD + 1e-9)
    part = lag / PERIOD - whole
    for k in range(MEMORY, SAMPLES):
        row = slopes[k]
        for before, sign in ((k - 1, 1.0), (k - 2, -1.0)):
            for i, share in ((before - whole, 1.0 - part), (before - whole - 1, part)):
                if i >= 0:
                    row[i] -= PERIOD * c * sign * share
        row[k - 1] += 2.0
        row[k - 2] -= 1.0 + PERIOD**2 * b
        cube = PERIOD**2 * a * x[k - 2] ** 2
        x[k] = row @ x - cube * x[k - 2] + PERIOD**2 * force[k - 2] + noise[k]
        row[k - 2] -= 3.0 * cube
    return x, slopes
