"""Noise added to a record before fitting, for studies of sensitivity (Eq. 19, 20).

Interpretation of Eq. 19: φ = χ + σξ, so `sigma` is a standard deviation. Of Eq. 20: ψ is uniform
in (0, 1), so that ξ = (Σψ − N/2)/√(N/12) has mean 0, variance 1 and excess kurtosis −1.2/N.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, get_args

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.settings import Bounds, check_settings
from sysid.core.types import FloatArray
from sysid.data.records import Record

NoisePlace = Literal["sensor", "plant"]
NoiseKind = Literal["gaussian", "uniform-sum"]
NOISE_KINDS: tuple[NoiseKind, ...] = get_args(NoiseKind)


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise that is added before fitting: to every output, or inside the plant.

    Attributes
    ----------
    sigma : float
        Standard deviation of the noise, in the unit of each output.
    seed : int
        Seed of the noise; the same seed gives the same noise.
    kind : NoiseKind
        ``uniform-sum``: Eq. 20 of the paper with N = `terms`.
    terms : int
        N ≥ 3 of Eq. 20 of the paper.
    mean : float
        χ of Eq. 19 of the paper.
    place : NoisePlace
        ``plant``: φ of Eq. 13 and 16, where the model's document says that noise enters. The
        record is simulated again with it. Then `sigma` is that of each sample of a recursion, or
        else per √s, in the unit of the state.
    parameters : mapping of str to float
        True parameters of that simulation.

    Examples
    --------
    >>> Noise(sigma=0.05, seed=1)
    Noise(sigma=0.05, seed=1, kind='gaussian', terms=12, mean=0.0, place='sensor', parameters={})
    """

    sigma: Annotated[float, Bounds(least=0)] = 0.0
    seed: Annotated[int, Bounds(least=0)] = 0
    kind: NoiseKind = "gaussian"
    terms: Annotated[int, Bounds(least=3)] = 12
    mean: float = 0.0
    place: NoisePlace = "sensor"
    parameters: Mapping[str, float] = field(default_factory=dict)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the fields as they are: every run of a noise sweep has its own."""
        own = (self.sigma, self.seed, self.kind, self.terms, self.mean, self.place, self.parameters)
        return Noise, own

    def __post_init__(self) -> None:
        check_settings(self, "/noise")
        if self.sigma == np.inf:
            raise InvalidSettings("/noise/sigma", f"found {self.sigma!r}; need a finite number")


def draw_noise(noise: Noise, n: int, stream: int = 0) -> FloatArray:
    """Draw `n` samples of φ (Eq. 19); each channel has its own `stream`."""
    generator = np.random.Generator(np.random.Philox(key=[noise.seed, stream]))
    if noise.kind == "gaussian":
        unit = generator.standard_normal(n)
    else:
        total = generator.random((n, noise.terms)).sum(axis=1)
        unit = (total - noise.terms / 2) / np.sqrt(noise.terms / 12)
    return np.asarray(noise.mean + noise.sigma * unit)


def add_output_noise(record: Record, noise: Noise, experiment: int = 0) -> Record:
    """Add noise to every output of a record; the inputs stay unchanged."""
    if noise.sigma == 0 and noise.mean == 0:
        return record
    outputs = tuple(
        replace(
            channel,
            values=channel.values
            + draw_noise(noise, channel.values.size, 1000 * experiment + number),
        )
        for number, channel in enumerate(record.outputs)
    )
    return replace(record, outputs=outputs)
