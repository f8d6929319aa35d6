"""Result of an identification: estimates with their uncertainty, and the evidence."""

from collections.abc import ItemsView, Iterator, KeysView, Mapping, Sequence, ValuesView
from dataclasses import dataclass, field
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal

from sysid.core.errors import UnknownParameter
from sysid.core.settings import LossKind, PredictionKind
from sysid.core.types import FloatArray
from sysid.data.holds import Hold
from sysid.data.records import Record
from sysid.models.model import Model, SelectedTerm
from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import CorrelationFunction, ResidualTests
from sysid.search.state import Improvement, IslandSummary, Migrant
from sysid.simulation.metrics import ChannelMetrics
from sysid.uncertainty.estimates import Criteria, Estimate, Posterior, Uncertainty

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from sysid.data.records import Channels, Recording
    from sysid.figures.theme import Theme
    from sysid.results.figures import FigureName
    from sysid.results.verdict import Verdict
    from sysid.uncertainty.output_bands import OutputBands

CHI_SQUARE_95 = 3.841
"""Quantile of χ² with one degree of freedom."""
STRONG_EVIDENCE = 6.0
"""Difference of BIC: odds of 20 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """A minimum of the loss.

    Attributes
    ----------
    values : FloatArray, shape (D,)
        Of the free parameters.
    rms : float
    count : int
        How many least-squares fits ended in it, in the search and after it.
    independent : int
        How many of them began at random points.
    likelihood_ratio : float
        n ln(Σe²/Σe²₀) to the best minimum, twice the logarithm of the ratio of likelihoods, made
        smaller for coloured residuals.
    recorded_from : float or None
        Compared only where the input is recorded: samples of each record after so many seconds.
    """

    values: FloatArray
    rms: float
    count: int
    independent: int
    likelihood_ratio: float
    recorded_from: float | None = None

    @property
    def is_compatible(self) -> bool:
        """Whether the data do not rule it out."""
        return self.likelihood_ratio <= CHI_SQUARE_95


@dataclass(frozen=True, slots=True, eq=False)
class SearchEvidence:
    """What a result knows of the whole search.

    Attributes
    ----------
    settled : bool
    because : "starts", "residuals" or None
        What shows it; None if nothing does.
    independent_starts, agreeing_starts : int
        Local searches from random points, and those of them that ended in the best minimum.
    names : tuple of str
        Free parameters, in the order of the values of a minimum.
    minima : tuple of Minimum
        Minima in which least squares ended after the search, the lowest first.
    """

    settled: bool
    because: Literal["starts", "residuals"] | None
    independent_starts: int
    agreeing_starts: int
    names: tuple[str, ...] = ()
    minima: tuple[Minimum, ...] = ()


@dataclass(frozen=True, slots=True)
class InputHold:
    """How an input is read between its samples.

    Attributes
    ----------
    chosen : {"zero", "first", "band-limited"}
    reason : str or None
        Reason of a choice by the values; None if the hold was given.
    other : {"zero", "first"} or None
        The reading that was not chosen. None if the hold was given or has no effect.
    estimates_other : dict or None
        Estimates of the free parameters with the other reading, from the estimates by least
        squares. None if they were not computed.
    rms_other : float or None
        RMS error with the other reading.
    """

    input: str
    chosen: Hold
    reason: str | None
    other: Hold | None = None
    estimates_other: dict[str, float] | None = None
    rms_other: float | None = None


@dataclass(frozen=True, slots=True)
class OrderFit:
    """A process of one order, fitted to the samples of an identification.

    Attributes
    ----------
    model : str
        Its name in the catalogue.
    order : int
        Number of poles.
    delay, delay_stderr : float, float or None
        Dead time (s) and its standard error.
    values : mapping of str to float
        All parameters of that model.
    rms : float
        RMS error, as that of the identification.
    bic : float
        Schwarz's criterion, smaller is better; with the noise model of the comparison.
    """

    model: str
    order: int
    delay: float
    delay_stderr: float | None
    values: Mapping[str, float]
    rms: float
    bic: float


@dataclass(frozen=True, slots=True)
class OrderComparison:
    """The model's order, one order less and one more, fitted to the same samples.

    Attributes
    ----------
    model : str
        The catalogue's name of the model's own order.
    delay, unit : str
        The model's parameter that is the dead time, and its unit.
    noise_model : {"white", "ar1"}
        Noise model of the criteria.
    fits : tuple of OrderFit
        The lowest order first.

    Examples
    --------
    >>> first = OrderFit("fopdt", 1, 1.57, 0.01, {"L": 1.57}, 0.027, -1264.0)
    >>> second = OrderFit("sopdt", 2, 1.33, 0.01, {"L": 1.33}, 0.019, -1474.0)
    >>> comparison = OrderComparison("fopdt", "L", "s", "white", (first, second))
    >>> comparison.preferred_model, comparison.delay_range
    ('sopdt', (1.33, 1.33))
    """

    model: str
    delay: str
    unit: str
    noise_model: Literal["white", "ar1"]
    fits: tuple[OrderFit, ...]

    @property
    def own_fit(self) -> OrderFit:
        """The fit of the model's own order."""
        return next(fit for fit in self.fits if fit.model == self.model)

    @property
    def open_fits(self) -> tuple[OrderFit, ...]:
        """The orders without strong evidence against them: BIC within 6 of the lowest."""
        limit = min(fit.bic for fit in self.fits) + STRONG_EVIDENCE
        return tuple(fit for fit in self.fits if fit.bic <= limit)

    @property
    def preferred_model(self) -> str | None:
        """The one order that is open; None if there are several."""
        fits = self.open_fits
        return fits[0].model if len(fits) == 1 else None

    @property
    def delay_range(self) -> tuple[float, float]:
        """Smallest and largest dead time (s) of the open orders."""
        delays = [fit.delay for fit in self.open_fits]
        return min(delays), max(delays)


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


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Identification:
    """The result of one identification.

    In a notebook it shows a table of the estimates, the fit, the verdicts and the warnings.

    Attributes
    ----------
    rms : float
        J of Eq. 10 over all scored samples. In the output's unit if there is one output, else in
        units of the outputs' standard deviations.
    rms_validation, fit_percent_validation : float or None
        None without validation data.
    history : tuple
        One tuple of improvements per island.
    simulated, simulated_validation : tuple
        Model output at the measured times, per experiment and output.
    agreement, agreement_validation : tuple of ChannelMetrics
        Metrics of each output of each experiment.
    selection : tuple of SelectedTerm
        Selected terms, if the model requests a selection.
    correlation_times : mapping of str to float
        Correlation time (s) of each output's noise, where the noise model has one.
    noise_deviations : tuple of tuple of float, or None
        Estimated relative deviation of the noise by experiment and output, by which residuals were
        divided. None: all count alike, or the weights were given.
    input_holds : tuple of InputHold
        How each input is read between its samples, and the estimates if it were read otherwise.
    data_bounds : tuple of str
        Free parameters whose bounds follow the data, unless given; see the estimates.
    sample_time : float or None
        Sampling period (s) of all outputs; None if irregular or not the same for all.
    search : SearchEvidence
        Whether the search settled, and the minima that were found.
    substeps : int
        Integration steps in one grid step, with which the result was computed: the model's or more.
    known_before, known_before_validation : tuple of float
        Time (s) before the start of each experiment for which the inputs are recorded. Before
        that, the first value is assumed.
    posterior : Posterior or None
        None if it was not requested.
    order_comparison : OrderComparison or None
        The model with one order less and one more, if it is a process with dead time. None if it is
        not, or if the comparison was not requested.
    data : FittedData or None
        Model and records, from `identify`; None in a result of the service's workers.
    delays : tuple of str
        Free parameters that time lags depend on.

    Examples
    --------
    >>> t = [0.1 * k for k in range(100)]
    >>> u = [1.0 if time >= 1 else 0.0 for time in t]
    >>> y = [3 * (1 - 2.718281828 ** -(time - 1.5)) if time > 1.5 else 0.0 for time in t]
    >>> found = identify("fopdt", {"t": t, "u": u, "y": y})
    >>> found["K"].status
    'identified'
    >>> sorted(found.parameter_values)
    ['K', 'L', 'T', 'x(0)', 'y0']
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
    selection: tuple[SelectedTerm, ...]
    criteria: Criteria
    residual_tests: ResidualTests | None
    onset_delays: tuple[OnsetDelay, ...]
    correlation_times: Mapping[str, float]
    input_holds: tuple[InputHold, ...]
    data_bounds: tuple[str, ...]
    sample_time: float | None
    search: SearchEvidence
    substeps: int
    known_before: tuple[float, ...]
    known_before_validation: tuple[float, ...]
    posterior: Posterior | None = None
    order_comparison: OrderComparison | None = None
    data: FittedData | None = None
    delays: tuple[str, ...] = ()
    noise_deviations: tuple[tuple[float, ...], ...] | None = None

    def __getitem__(self, name: str) -> Estimate:
        """Return the estimate of a parameter.

        Raises
        ------
        UnknownParameter
            If there is none; the message suggests the nearest.
        """
        for estimate in self.estimates:
            if estimate.name == name:
                return estimate
        raise UnknownParameter(name, list(self))

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the parameters, so that ``"L" in found`` holds."""
        return (estimate.name for estimate in self.estimates)

    def __len__(self) -> int:
        """Return the number of parameters."""
        return len(self.estimates)

    def keys(self) -> KeysView[str]:
        """Return the names of the parameters."""
        return self._by_name().keys()

    def values(self) -> ValuesView[Estimate]:
        """Return the estimates."""
        return self._by_name().values()

    def items(self) -> ItemsView[str, Estimate]:
        """Return the names of the parameters with their estimates."""
        return self._by_name().items()

    def get(self, name: str, default: Estimate | None = None) -> Estimate | None:
        """Return the estimate of a parameter, or a default if there is none."""
        return self._by_name().get(name, default)

    def _by_name(self) -> dict[str, Estimate]:
        return {estimate.name: estimate for estimate in self.estimates}

    def __eq__(self, other: object) -> bool:
        """Test whether every number, name and record is the same; ``nan`` is equal to ``nan``."""
        if not isinstance(other, Identification):
            return NotImplemented
        from sysid.results.saved_result import have_same_content

        return self is other or have_same_content(self, other)

    def __hash__(self) -> int:
        return hash((self.evaluations, self.generations, tuple(self)))

    def __repr__(self) -> str:
        from sysid.results.summary import summarise_result

        return summarise_result(self)

    def _repr_html_(self) -> str:
        from sysid.results.summary import to_html

        return to_html(self)

    @property
    def parameter_values(self) -> dict[str, float]:
        """Values of all parameters by name, as `simulate` takes them."""
        return {estimate.name: estimate.value for estimate in self.estimates}

    @property
    def verdict(self) -> "Verdict":
        """Whether the estimates can be relied on, in words, with the reasons."""
        from sysid.results.verdict import Evidence, judge_result

        return judge_result(
            Evidence(
                estimates=self.estimates,
                valid=self.valid,
                fit_percent=self.fit_percent,
                fit_percent_validation=self.fit_percent_validation,
                search=self.search,
                tests=() if self.residual_tests is None else self.residual_tests.tests,
                delays=self.delays,
                orders=self.order_comparison,
                channels=self.agreement,
            )
        )

    def plot(
        self,
        *names: "FigureName | Sequence[FigureName]",
        experiment: int = 0,
        theme: "Theme" = "light",
    ) -> Any:
        """Draw figures one below the other, as a figure of Plotly.

        Without names: measured against identified output with the residuals, their correlation
        functions, the correlation of the estimates, and what each island of the search found.

        Parameters
        ----------
        *names : {"response", "residuals", "correlation", "waterfall", "history", "convergence", \
"posterior"}
            The figures to draw, also as a list.
        experiment : int
            Which record, from 0, if there are several.
        theme : {"light", "dark"}

        Raises
        ------
        MissingLibrary
            If Plotly is not installed.
        InvalidSettings
            If there is no such figure, record or theme, or a named figure has no data.
        """
        from sysid.results.figures import plot_result

        return plot_result(self, names, experiment, theme)

    def compute_bands(
        self,
        inputs: "Channels | Record | Recording | None" = None,
        *,
        channels: Mapping[str, str] | None = None,
        times: "ArrayLike | None" = None,
        experiment: int = 0,
    ) -> "tuple[OutputBands, ...]":
        """Compute 95 % bands of each output, on a record of the fit or on new inputs.

        The confidence band holds the output without noise, the prediction band a new measurement.
        Both come from the covariance of the estimates, or from the posterior where it was sampled.

        Parameters
        ----------
        inputs : Channel, sequence of Channel, table, Record or Recording, optional
            New inputs, as `simulate` takes them. Default: the record that was fitted.
        channels : mapping of str to str, optional
            Model's input → channel's name.
        times : array of shape (N,), optional
            Seconds. Default: the times of the first input.
        experiment : int
            Which record of the fit, from 0, if there are several.

        Returns
        -------
        tuple of OutputBands
            In the units of the outputs, (N, 2) each.

        Raises
        ------
        InvalidSettings
            If the result has no standard errors, or there is no such record.
        InvalidRecord, RecordTooShort
            If new inputs cannot be simulated.

        Examples
        --------
        >>> t = [0.1 * k for k in range(100)]
        >>> u = [1.0 if time >= 1 else 0.0 for time in t]
        >>> y = [3 * (1 - 2.718281828 ** -(time - 1.5)) if time > 1.5 else 0.0 for time in t]
        >>> found = identify("fopdt", {"t": t, "u": u, "y": y})
        >>> [bands] = found.compute_bands()
        >>> bands.output, bands.confidence.shape, bands.source
        ('y', (100, 2), 'covariance')
        """
        from sysid.results.bands import compute_bands

        return compute_bands(self, inputs, channels=channels, times=times, experiment=experiment)

    def to_pandas(self) -> Any:
        """Return the estimates as a table of pandas, one row for each parameter.

        Raises
        ------
        MissingLibrary
            If pandas is not installed.
        """
        from sysid.results.summary import to_frame

        return to_frame(self)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the result with model and records to a JSON file.

        Raises
        ------
        UnwritableFile
            If the file cannot be written.
        """
        from sysid.results.saved_result import write_result

        write_result(self, path)

    @staticmethod
    def load(path: str | PathLike[str]) -> "Identification":
        """Read a result that `save` wrote; it is equal to the one that was saved.

        Raises
        ------
        UnreadableResult
            If the file cannot be read, or is something else.
        """
        from sysid.results.saved_result import read_result

        return read_result(path)

    @property
    def holds(self) -> dict[str, Hold]:
        """How each input is read between its samples."""
        return {hold.input: hold.chosen for hold in self.input_holds}

    @property
    def noise_model(self) -> Literal["white", "ar1"]:
        """Noise model under which the estimates were made."""
        return "ar1" if any(self.correlation_times.values()) else "white"
