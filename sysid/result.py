"""What an identification gives: estimates with their uncertainty, and the evidence."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

from sysid.metrics import ChannelMetrics
from sysid.types import FloatArray

EstimateStatus = Literal["identified", "group", "at bound", "unidentifiable", "fixed"]
Phase = Literal["start", "genetic", "sequence", "migration", "refinement"]


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter's estimate.

    Attributes
    ----------
    stderr : float or None
        Standard error, in `unit`; None when there is none, and `reason` says why.
    interval95 : tuple of float or None
        95 % interval by the t distribution.
    """

    name: str
    unit: str
    value: float
    lower: float
    upper: float
    stderr: float | None
    interval95: tuple[float, float] | None
    status: EstimateStatus
    reason: str = ""


class Improvement(NamedTuple):
    """A better champion of one island: the RMS history is kept as these only, without loss.

    `rms` is the fitness: J of Eq. 10, with soft-l1 √(robust loss / n) in its stead.
    """

    generation: int
    evaluations: int
    rms: float
    phase: Phase
    parameters: tuple[float, ...]


class Migrant(NamedTuple):
    """One line of the migration log."""

    epoch: int
    source: int
    destination: int
    fitness: float


@dataclass(frozen=True, slots=True)
class IslandSummary:
    """What one island found, before and after refinement (for the waterfall).

    The two RMS are fitnesses: J of Eq. 10, with soft-l1 √(robust loss / n) in its stead.
    """

    champion_rms: float
    refined_rms: float | None
    parameters: tuple[float, ...]
    evaluations: int


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Local analysis at the estimate; rows and columns are the free parameters `names`."""

    names: tuple[str, ...]
    covariance: FloatArray
    correlation: FloatArray
    condition: float
    singular_values: FloatArray
    noise_sd: float


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """The result of one identification.

    `rms` is J of Eq. 10 over all scored samples, in the output's unit when there is one output
    (else in units of the outputs' standard deviations). `history` has one tuple of improvements
    per island. `simulated` has per experiment, per output, the model's output at the measured
    times. `fit_percent_validation` and `rms_validation` are None without validation data.
    `agreement` and `agreement_validation` tell each output of each experiment on its own.
    """

    estimates: tuple[Estimate, ...]
    rms: float
    fit_percent: float
    rms_validation: float | None
    fit_percent_validation: float | None
    valid: bool
    evaluations: int
    generations: int
    islands: tuple[IslandSummary, ...]
    history: tuple[tuple[Improvement, ...], ...]
    migrations: tuple[Migrant, ...]
    uncertainty: Uncertainty | None
    simulated: tuple[tuple[FloatArray, ...], ...]
    simulated_validation: tuple[tuple[FloatArray, ...], ...]
    agreement: tuple[ChannelMetrics, ...]
    agreement_validation: tuple[ChannelMetrics, ...]
    warnings: tuple[str, ...]
