"""Data of figures and tables as plain values, independent of storage."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class IslandImprovement:
    """A better champion of one island; `parameters` in the order of the free parameters."""

    generation: int
    evaluations: int
    rms: float
    phase: str
    parameters: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class FreeParameter:
    """A free parameter: its bounds, and its estimate if it exists.

    If the bounds follow the data, they are unknown (`follows_data`) until there is a result.
    """

    name: str
    unit: str
    lower: float
    upper: float
    scale: Literal["linear", "log"] = "linear"
    value: float | None = None
    stderr: float | None = None
    follows_data: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class CornerParameter:
    """A free parameter with its estimate, and samples (n,) of its posterior.

    `interval95` is that of the estimate, `posterior95` has the quantiles of the samples.
    """

    name: str
    unit: str
    lower: float
    upper: float
    value: float
    stderr: float | None
    interval95: Sequence[float] | None
    posterior95: Sequence[float]
    samples: Floats


@dataclass(frozen=True, slots=True, eq=False)
class SignalTrace:
    """One signal on its own times (s); `is_held` if it keeps its value until the next sample.

    `history` is the same signal before its first sample, as far back as it is recorded.
    """

    name: str
    unit: str
    times: Floats
    values: Floats
    is_held: bool = False
    history: "SignalTrace | None" = None


@dataclass(frozen=True, slots=True, eq=False)
class BandTraces:
    """Lower and upper ends (N, 2) of the 95 % bands of an output and of its measurement."""

    confidence: Floats
    prediction: Floats


@dataclass(frozen=True, slots=True, eq=False)
class OutputTraces:
    """A measured output, and the output of the identified model at the same times."""

    measured: SignalTrace
    identified: Floats
    bands: BandTraces | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ExperimentTraces:
    """One record of the estimation or validation data.

    Samples from the time `validation_from` (s) on were not used for the estimate. None: all were
    used. Minus infinity: none was used.
    """

    name: str
    outputs: tuple[OutputTraces, ...]
    inputs: tuple[SignalTrace, ...]
    validation_from: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CorrelationTrace:
    """A correlation function of residuals over lags, with its bands.

    `period` (s) is the length of one lag; None if lags count irregular samples.
    """

    title: str
    is_auto: bool
    period: float | None
    lags: Floats
    values: Floats
    band95: Floats
    band99: Floats


@dataclass(frozen=True, slots=True)
class RunFigureData:
    """Data of one run's search and result.

    Attributes
    ----------
    unit : str
        Unit of the RMS.
    fitness_label : str
        What the search minimised: the RMS, or a robust loss expressed as an RMS.
    history : sequence of sequence of Improvement
        One sequence per island, in the order of the generations.
    epoch : int
        Generations between two migrations; 0 without migration.
    migrations : sequence of int
        Epochs after which individuals migrated.
    islands : sequence of (champion RMS, refined RMS or None)
        Result of each island.
    correlation : mapping or None
        ``{"names": [...], "matrix": [[...]]}``.
    """

    id: str
    unit: str
    fitness_label: str = "RMS"
    generations: int = 0
    evaluations: int = 0
    parameters: Sequence[FreeParameter] = ()
    history: Sequence[Sequence[IslandImprovement]] = ()
    epoch: int = 0
    migrations: Sequence[int] = ()
    islands: Sequence[tuple[float, float | None]] = ()
    correlation: Mapping[str, Any] | None = field(default=None)
