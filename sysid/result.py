"""What an identification gives: estimates with their uncertainty, and the evidence."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from sysid.metrics import ChannelMetrics
from sysid.models.terms import SelectedTerm
from sysid.onset import OnsetDelay
from sysid.records import Hold
from sysid.residuals import ResidualTests
from sysid.types import FloatArray

NoiseColour = Literal["white", "first-order", "coloured", "drifting"]
EstimateStatus = Literal["identified", "group", "at bound", "unidentifiable", "fixed", "tied"]
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


@dataclass(frozen=True, slots=True)
class Group:
    """A combination of parameters that the data tell, though not what each of them is.

    Attributes
    ----------
    members : tuple of str
        The parameters in it.
    expression : str
        A product of powers, such as ``A_m*k_b/J``, or else a sum, such as ``T + L``.
    value : float
    stderr : float or None
        Standard error of `value`.
    """

    members: tuple[str, ...]
    expression: str
    value: float
    stderr: float | None


@dataclass(frozen=True, slots=True)
class Criteria:
    """Information criteria, smaller is better: only models fitted to the same samples compare.

    The log-likelihood is that of independent Gaussian residuals whose one variance is estimated
    with the parameters: ln ℓ = -n/2 (ln(2π Σe²/n) + 1), e weighted. With κ = D + 1 (the variance
    counts): AIC = 2κ - 2 ln ℓ, AICc = AIC + 2κ(κ + 1)/(n - κ - 1), BIC = κ ln n - 2 ln ℓ
    (Akaike 1974; Hurvich and Tsai 1989; Schwarz 1978).

    Attributes
    ----------
    aic, bic : float
        Minus infinity where the residuals vanish.
    aicc : float or None
        None where there are not more samples than κ + 1.
    samples, parameters : int
        n scored samples and D free parameters.
    """

    aic: float
    aicc: float | None
    bic: float
    samples: int
    parameters: int


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Local analysis at the estimate; rows and columns are the free parameters `names`.

    `noise_colour` tells what the covariance takes the residuals for. Where they drift over the
    whole record, it is a lower bound. `correlation` is of this covariance, `alike` that of
    (SᵀS)⁻¹: how alike the sensitivities S are, whatever the colour of the residuals.
    """

    names: tuple[str, ...]
    covariance: FloatArray
    correlation: FloatArray
    alike: FloatArray
    condition: float
    singular_values: FloatArray
    noise_sd: float
    groups: tuple[Group, ...] = ()
    noise_colour: NoiseColour = "white"


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """The result of one identification.

    `rms` is J of Eq. 10 over all scored samples, in the output's unit when there is one output
    (else in units of the outputs' standard deviations). `history` has one tuple of improvements
    per island. `simulated` has per experiment, per output, the model's output at the measured
    times. `fit_percent_validation` and `rms_validation` are None without validation data.
    `agreement` and `agreement_validation` tell each output of each experiment on its own.
    `selection` has the terms that were selected, if the model asked for it. `correlation_times`
    (s) are those of each output's noise, where the noise model found any. `holds` tells what the
    inputs of the first experiment did between their samples, `sample_time` (s) how all outputs
    were sampled; None where that was not regular, or not the same. `known_before` and
    `known_before_validation` tell of every experiment for how long (s) before its start the inputs
    are known; further back their first value is taken to have stood.
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
    selection: tuple[SelectedTerm, ...] = ()
    criteria: Criteria | None = None
    residual_tests: ResidualTests | None = None
    onset_delays: tuple[OnsetDelay, ...] = ()
    correlation_times: Mapping[str, float] = field(default_factory=dict)
    holds: Mapping[str, Hold] = field(default_factory=dict)
    sample_time: float | None = None
    known_before: tuple[float, ...] = ()
    known_before_validation: tuple[float, ...] = ()

    @property
    def noise_model(self) -> Literal["white", "ar1"]:
        """The noise model that the estimates are of."""
        return "ar1" if any(self.correlation_times.values()) else "white"
