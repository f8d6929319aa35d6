"""Data of figures and tables as plain values, independent of storage."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sysid.models.parameters import Parameter
from sysid.search.state import Improvement
from sysid.uncertainty.estimates import Estimate

Floats = NDArray[np.float64]


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
class DisturbanceTraces:
    """The estimated disturbances of one record, each with the ends (N, 2) of its 95 % band."""

    name: str
    disturbances: tuple[tuple[SignalTrace, Floats], ...]


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
class SearchTraces:
    """The search of one run, finished or not.

    Attributes
    ----------
    unit : str
        Unit of the RMS.
    fitness_label : str
        What the search minimised: the RMS, or a robust loss expressed as an RMS.
    parameters : sequence of Parameter
        The free parameters, with the bounds that are drawn.
    estimates : mapping of str to Estimate
        Estimates by name; empty until there is a result.
    history : sequence of sequence of Improvement
        One sequence per island, in the order of the generations.
    epoch : int
        Generations between two migrations; 0 without migration.
    migrations : sequence of int
        Epochs after which individuals migrated.
    """

    unit: str
    fitness_label: str = "RMS"
    generations: int = 0
    parameters: Sequence[Parameter] = ()
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    history: Sequence[Sequence[Improvement]] = ()
    epoch: int = 0
    migrations: Sequence[int] = ()
