"""What an identification gives: estimates with their uncertainty, and the evidence."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from sysid.core.types import FloatArray
from sysid.data.records import Hold
from sysid.models.model import SelectedTerm
from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import ResidualTests
from sysid.search.state import Improvement, IslandSummary, Migrant
from sysid.simulation.metrics import ChannelMetrics
from sysid.uncertainty.estimates import Criteria, Estimate, Uncertainty


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
    selection: tuple[SelectedTerm, ...]
    criteria: Criteria
    residual_tests: ResidualTests | None
    onset_delays: tuple[OnsetDelay, ...]
    correlation_times: Mapping[str, float]
    holds: Mapping[str, Hold]
    sample_time: float | None
    known_before: tuple[float, ...]
    known_before_validation: tuple[float, ...]

    @property
    def noise_model(self) -> Literal["white", "ar1"]:
        """The noise model that the estimates are of."""
        return "ar1" if any(self.correlation_times.values()) else "white"
