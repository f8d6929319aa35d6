"""Result of an identification: estimates with their uncertainty, and the evidence."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from sysid.core.types import FloatArray
from sysid.data.holds import Hold
from sysid.models.model import SelectedTerm
from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import ResidualTests
from sysid.search.state import Improvement, IslandSummary, Migrant
from sysid.simulation.metrics import ChannelMetrics
from sysid.uncertainty.estimates import Criteria, Estimate, Posterior, Uncertainty

CHI_SQUARE_95 = 3.841
"""Quantile of χ² with one degree of freedom."""


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


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """The result of one identification.

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

    @property
    def holds(self) -> dict[str, Hold]:
        """How each input is read between its samples."""
        return {hold.input: hold.chosen for hold in self.input_holds}

    @property
    def noise_model(self) -> Literal["white", "ar1"]:
        """Noise model under which the estimates were made."""
        return "ar1" if any(self.correlation_times.values()) else "white"
