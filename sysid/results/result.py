"""Result of an identification: estimates with their uncertainty, and the evidence.

These dataclasses are the document of a result. They are stored, sent and saved as
`sysid.core.value_documents` writes them. A field that is added here, with its description, is a
field of the REST interface, of the client's types and of the saved file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from sysid.core.errors import InvalidRecord
from sysid.core.findings import Finding
from sysid.core.settings import FoundNoiseModel, LossKind, PredictionKind, StartKind
from sysid.core.text import find_rms_unit
from sysid.core.types import FloatArray
from sysid.data.holds import Hold
from sysid.data.records import Record
from sysid.identifiability.combinations import IdentifiableCombination
from sysid.models.model import Model, SelectedTerm
from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import CorrelationFunction, ResidualTests
from sysid.results.parts import InputHold, OrderComparison, PlantNoise, SearchEvidence
from sysid.results.verdict import Verdict
from sysid.search.state import Improvement, IslandSummary, Migrant
from sysid.simulation.fit_metrics import ChannelMetrics
from sysid.uncertainty.estimates import (
    CorrelationMatrix,
    Criteria,
    Estimate,
    NoiseColour,
    Posterior,
)


@dataclass(frozen=True, slots=True)
class FitPercent:
    """Fit, 100 (1 - ‖y - ŷ‖ / ‖y - ȳ‖) %.

    Attributes
    ----------
    estimation : float
        Fit to the estimation data, %; not a number for a constant output.
    validation : float or None
        Fit to the validation data, %; none without them.
    """

    estimation: float
    validation: float | None


@dataclass(frozen=True, slots=True)
class Agreements:
    """Agreement of each output of each record.

    Attributes
    ----------
    estimation : tuple of ChannelMetrics
        With the estimation data.
    validation : tuple of ChannelMetrics
        With the validation data.
    """

    estimation: tuple[ChannelMetrics, ...]
    validation: tuple[ChannelMetrics, ...]


@dataclass(frozen=True, slots=True)
class KnownBefore:
    """Time before the start of each record for which its inputs are recorded.

    Before that, the first value is assumed.

    Attributes
    ----------
    estimation : tuple of float
        Of each estimation record, s.
    validation : tuple of float
        Of each validation record, s.
    """

    estimation: tuple[float, ...]
    validation: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Identifiability:
    """What the data can tell apart, by the sensitivities at the estimate.

    Attributes
    ----------
    condition : float or None
        Condition of the scaled sensitivities; none without standard errors.
    groups : tuple of IdentifiableCombination
        Combinations of parameters that are determined, while these are not each.
    singular_values : FloatArray, shape (D,)
        Singular values of the scaled sensitivities.
    """

    condition: float | None
    groups: tuple[IdentifiableCombination, ...]
    singular_values: FloatArray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Result:
    """What is said of an identification: the document.

    Attributes
    ----------
    valid : bool
        Whether the RMS error is below the safe limit.
    parameters : tuple of Estimate
        Estimates with their errors.
    rms : float
        RMS error (J of Eq. 10) over all scored samples. In the output's unit if there is one
        output, else in units of the outputs' standard deviations.
    rms_validation : float or None
        RMS error on the validation data, in the unit of `rms`; none without them.
    fit_percent : FitPercent
        Fit to both kinds of data, %.
    agreement : Agreements
        Agreement of each output of each record.
    evaluations : int
        Simulations of the whole identification.
    generations : int
        Generations of the search.
    islands : tuple of IslandSummary
        Champion of each island.
    identifiability : Identifiability
        What the data can tell apart.
    criteria : Criteria
        Information criteria.
    correlation : CorrelationMatrix or None
        Correlation of the estimates; none without errors.
    noise_sd : float or None
        Standard deviation of the weighted residuals, in the unit of `rms`.
    noise_colour : NoiseColour or None
        Colour of the residuals that the errors assume. If they drift over the whole record, the
        errors are lower bounds.
    noise_model : {"white", "ar1", "plant", "load", "drift"}
        Noise model of the estimates.
    correlation_times : mapping of str to float
        Correlation time of each output's noise, s, where the noise model has one.
    noise_deviations : tuple of tuple of float, or None
        Relative deviation of the noise by experiment and output, by which residuals were divided;
        none if all count alike or weights were given.
    residual_tests : ResidualTests
        Tests of the residuals.
    onset_delays : tuple of OnsetDelay
        Delay between the start of an input's and an output's change.
    time_unit : str
        Unit in which the record had its times, such as ``min``. Estimates are in their own unit.
    data_bounds : tuple of str
        Parameters whose bounds follow the data, unless given.
    input_hold : tuple of InputHold
        How each input is read between its samples, and the estimates if it were read otherwise.
    commands : tuple of str
        Inputs that a controller computes, as the request or the data say. They are read held.
    known_before : KnownBefore
        Recorded time before the start of each record, s.
    search : SearchEvidence
        Whether the search settled, and the minima that were found.
    posterior : Posterior or None
        Samples of the posterior; none if not requested.
    order_comparison : OrderComparison or None
        One order less and one more; none if not compared, or no process with dead time.
    delays : tuple of str
        Free parameters that time lags depend on.
    findings : tuple of Finding
        What explains the residuals, and what speaks against the estimates; the most severe first.
    explained : bool
        Whether explanations of the residuals were looked for. In a sweep they are not, until a run
        is opened.
    verdict : Verdict
        Whether the estimates can be relied on.
    warnings : tuple of str
        The sentences of the findings.
    substeps : int
        Integration steps in one grid step: the model's, or more.
    selection : tuple of SelectedTerm
        Selected terms; empty if none were to be selected.
    initial : StartKind or None
        Start of the states that the estimates assume; none: as the model's document says.
    plant_noise : PlantNoise or None
        Sizes of the noise, and the free run, if noise acts inside the plant. Then `rms`, fits and
        signals are those of predictions one sample ahead.
    """

    valid: bool
    parameters: tuple[Estimate, ...]
    rms: float
    rms_validation: float | None
    fit_percent: FitPercent
    agreement: Agreements
    evaluations: int
    generations: int
    islands: tuple[IslandSummary, ...]
    identifiability: Identifiability
    criteria: Criteria
    correlation: CorrelationMatrix | None
    noise_sd: float | None
    noise_colour: NoiseColour | None
    noise_model: FoundNoiseModel
    correlation_times: Mapping[str, float]
    noise_deviations: tuple[tuple[float, ...], ...] | None
    residual_tests: ResidualTests
    onset_delays: tuple[OnsetDelay, ...]
    time_unit: str
    data_bounds: tuple[str, ...]
    input_hold: tuple[InputHold, ...]
    commands: tuple[str, ...]
    known_before: KnownBefore
    search: SearchEvidence
    posterior: Posterior | None
    order_comparison: OrderComparison | None
    delays: tuple[str, ...]
    findings: tuple[Finding, ...]
    explained: bool
    verdict: Verdict
    warnings: tuple[str, ...]
    substeps: int
    selection: tuple[SelectedTerm, ...]
    initial: StartKind | None = None
    plant_noise: PlantNoise | None = None

    @property
    def parameter_values(self) -> dict[str, float]:
        """Values of all parameters by name, as `simulate` takes them."""
        return {estimate.name: estimate.value for estimate in self.parameters}

    @property
    def holds(self) -> dict[str, Hold]:
        """How each input is read between its samples."""
        return {hold.input: hold.chosen for hold in self.input_hold}


@dataclass(frozen=True, slots=True, eq=False)
class FittedData:
    """What an identification was made from, for its figures and to simulate it again.

    Attributes
    ----------
    model : Model
        The model as it was given, before terms were selected.
    records, validation : tuple of Record
        Signals of the model in its order. With added noise, as they were compared.
    is_part : bool
        Whether the outputs of `validation` are the last parts of those in `records`. The inputs
        are then those of the whole record.
    correlations : tuple of CorrelationFunction
        Correlation functions of the residuals that were tested.
    loss : {"squares", "soft-l1"}
    prediction : {"simulation", "one-step"}
    ties : mapping of str to str
        Expressions of parameters that were tied besides those of the model.
    channels : mapping of str to str
        Channel of each signal in the first recording: model's name → channel's name.

    Raises
    ------
    InvalidRecord
        If there is no record, or one without outputs.
    """

    model: Model
    records: tuple[Record, ...]
    validation: tuple[Record, ...]
    is_part: bool
    correlations: tuple[CorrelationFunction, ...]
    loss: LossKind = "squares"
    prediction: PredictionKind = "simulation"
    ties: Mapping[str, str] = field(default_factory=dict)
    channels: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (self.records and all(record.outputs for record in self.records)):
            raise InvalidRecord("a result has no record, or one without outputs; need both")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FullResult(Result):
    """A result, and what is not said but needed to draw it and to go on from it.

    Attributes
    ----------
    history : tuple
        One tuple of improvements per island.
    migrations : tuple of Migrant
        The migration log.
    covariance : FloatArray or None, shape (D, D)
        Covariance of the free parameters, in the order of `correlation`; none without errors.
    degrees : float
        Least number of degrees of freedom of all intervals.
    simulated, simulated_validation : tuple
        Model output at the measured times, per experiment and output.
    sample_time : float or None
        Sampling period (s) of all outputs; None if irregular or not the same for all.
    data : FittedData or None
        Model and records, from `identify`; None in a result of the service's workers.
    """

    history: tuple[tuple[Improvement, ...], ...]
    migrations: tuple[Migrant, ...]
    covariance: FloatArray | None
    degrees: float
    simulated: tuple[tuple[FloatArray, ...], ...]
    simulated_validation: tuple[tuple[FloatArray, ...], ...]
    sample_time: float | None
    data: FittedData | None = None


def find_output_unit(result: Result) -> str:
    """Find the unit of the RMS of a result: that of its output, or σ for several together."""
    data = result.data if isinstance(result, FullResult) else None
    return find_rms_unit(
        {metrics.output: metrics.unit for metrics in result.agreement.estimation},
        lambda _: "1" if data is None else data.records[0].outputs[0].unit,
    )
