"""What is told about runs. The result's names are those of the numerical core.

Comparison of runs on the same data.

What is sent and told when an identified model runs freely over a recording.

What is sent and told when parameters of a run are profiled.
"""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from service.core.states import StateName
from service.core.wire import Answer, Body, Finite
from service.datasets.schemas import SeriesOut


class RunOut(Answer):
    """One identification: its cell of the sweep, how far it is, and what it gave.

    The fields of the result document (estimates, fit, islands, warnings …) follow once there is
    one; see the contract in the documentation of the interface.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    id: str
    job: str
    number: int
    cell: dict[str, Any]
    labels: dict[str, Any]
    state: StateName
    valid: bool | None = None
    rms: float | None = None
    rms_unit: str | None = Field(
        default=None, description="given for a single run; σ for several weighted outputs"
    )
    evaluations: int = 0
    generations: int = 0
    seconds: float | None = None
    progress: float
    error: str | None = None
    reused_from: str | None = Field(
        default=None, description="the earlier run with the same specification"
    )
    created_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None
    parameters: list[dict[str, Any]] = Field(default=[])


class ImprovementOut(Answer):
    """A better champion of one island."""

    generation: int
    evaluations: int
    rms: float
    phase: str
    parameters: list[float]


class HistoryOut(Answer):
    """Improvements of every island; `names` are those of the columns of `parameters`."""

    id: str
    names: list[str]
    islands: list[list[ImprovementOut]]


class ExperimentOut(Answer):
    """Measured and simulated outputs of one experiment."""

    name: str
    measured: list[SeriesOut]
    simulated: list[SeriesOut]


class ResponseOut(Answer):
    """Measured against simulated, experiment by experiment."""

    id: str
    experiments: list[ExperimentOut]


class CorrelationOut(Answer):
    """A correlation function of residuals with its bands, and the test made of it.

    `input` is null for the autocorrelation. `lags` are in periods of `period` seconds, or, where
    `period` is null, in samples of irregular times. Bands are symmetric about zero.
    """

    experiment: int
    output: str
    test: Literal["whiteness", "independence"]
    input: str | None
    outcome: Literal["passed", "failed", "not tested"]
    reason: str
    samples: int
    lags_tested: int
    inside95: float | None
    inside99: float | None
    statistic: float | None
    degrees: float | None
    p: float | None
    period: float | None
    lags: list[float]
    values: list[float]
    band95: list[float]
    band99: list[float]


class ResidualsOut(Answer):
    """Tests of a run's residuals with their correlation functions.

    `level` is the chance that a true model fails one test or more of all; `passed` is null where
    nothing could be tested; `note` says what could not be read.
    """

    id: str
    data: Literal["estimation", "validation"]
    passed: bool | None
    level: float
    note: str
    tests: list[CorrelationOut]


class MigrantOut(Answer):
    """One line of the migration log."""

    epoch: int
    source: int
    destination: int
    fitness: float


class MigrationsOut(Answer):
    """The migration log of a run."""

    id: str
    migrants: list[MigrantOut]


class ProfileIn(Body):
    """Which free parameters, and at about how many values of each."""

    parameters: list[Annotated[str, Field(max_length=200)]] | None = Field(
        default=None, min_length=1, max_length=64
    )
    points: int = Field(default=21, ge=3, le=101)


class ProfileOut(Answer):
    """The profile likelihood of one parameter.

    `ratio` is n ln(S(v)/S₀) at `values`; an end of `interval95` is null where the ratio stays
    below the threshold up to the bound, or as far as was looked. `others` are the free parameters
    besides, estimated anew at each of `values`.
    """

    name: str
    unit: str
    estimate: float
    interval95: tuple[float | None, float | None]
    values: list[float]
    ratio: list[Finite]
    rms: list[Finite]
    others: dict[str, list[float]]
    evaluations: int


class Profiles(Answer):
    """Profiles of a run, and the likelihood ratio at which their intervals end."""

    id: str
    threshold: float
    profiles: list[ProfileOut]


class ProfilesOut(Profiles):
    """Profiles of a run, and their figure as Plotly JSON."""

    figure: dict[str, Any]


class CompareIn(Body):
    """Which runs to compare: at least two, of any jobs, fitted to the same data."""

    runs: list[str] = Field(min_length=2, max_length=50)


class ComparedRun(Answer):
    """One candidate. `parameters` counts the free ones; AIC and BIC are smaller where better."""

    run: str
    job: str
    number: int
    model: str
    title: str
    cell: dict[str, Any]
    parameters: int
    samples: int
    rms: float | None
    rms_validation: float | None
    fit_estimation: float | None
    fit_validation: float | None
    aic: float | None
    bic: float | None
    residuals_passed: bool | None
    residuals_data: str | None
    evaluations: int


class ComparedValue(Answer):
    """What one run says of a parameter; `stderr` and `interval95` are null where it has none."""

    run: str
    value: float
    stderr: float | None
    interval95: list[float] | None
    status: str


class ComparedParameter(Answer):
    """A parameter that two runs or more have.

    `differs` if two of its 95 % intervals are apart; null where fewer than two have one.
    """

    name: str
    unit: str
    values: list[ComparedValue]
    differs: bool | None
    note: str


class ComparisonOut(Answer):
    """Runs side by side, the best first; `unit` is that of the RMS.

    `notes` are sentences: which parameters depend on the model, which figures do not compare.
    """

    unit: str
    runs: list[ComparedRun]
    parameters: list[ComparedParameter]
    notes: list[str]


class FreeRunIn(Body):
    """The model of a run over a stored `dataset`, every segment an experiment of its own.

    `channels` say which recorded channel is which signal of the model, where that is another one
    than in the run's job. The first `skip` samples of every output are not judged.
    """

    dataset: str
    channels: dict[str, str] = Field(default={})
    skip: int = Field(default=0, ge=0)


class AgreementOut(Answer):
    """How well one output of one experiment (from 1) is told; null where it does not vary."""

    experiment: int
    output: str
    unit: str
    samples: int
    rms: float
    fit_percent: Finite


class FreeRunOut(Answer):
    """Measured and simulated outputs, and how well they agree.

    `rms` is in `unit`: with several outputs weighted, in standard deviations of each. `starts`
    are initial states that the model does not fix: they belong to a recording, and are found on
    it, alone.
    """

    id: str
    dataset: str
    unit: str
    rms: float
    fit_percent: Finite
    agreement: list[AgreementOut]
    starts: dict[str, float]
    experiments: list[ExperimentOut]
