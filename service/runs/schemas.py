"""Bodies and answers about runs: results, comparisons, free runs, profiles.

The names in results are those of the numerical core.
"""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from service.core.states import StateName
from service.core.wire import Answer, Body, Finite
from service.datasets.schemas import SeriesOut


class RunOut(Answer):
    """One identification: its cell of the sweep, progress, and result.

    The fields of the result document (estimates, fit, islands, warnings …) are added once it
    exists. See the contract in the documentation of the interface.
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
    seed: int | None = None
    spec_hash: str | None = Field(
        default=None, description="digest of all that the result depends on"
    )
    version: str | None = Field(
        default=None, description="version of the program that computed the result"
    )
    fingerprint: str | None = Field(
        default=None,
        description="digest of the kernels' program: equal ones give results equal bit for bit",
    )
    note: str | None = None
    tags: list[str] = Field(default=[])
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
    """Correlation function of residuals with its bands, and its test.

    `input` is null for the autocorrelation. `lags` are in periods of `period` seconds. If `period`
    is null, they are in samples of irregular times. Bands are symmetric about zero.
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

    `level` is the probability that a true model fails at least one test. `passed` is null if
    nothing could be tested. `note` says what could not be read.
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
    """Free parameters to profile, and the approximate number of values of each."""

    parameters: list[Annotated[str, Field(max_length=200)]] | None = Field(
        default=None, min_length=1, max_length=64
    )
    points: int = Field(default=21, ge=3, le=101)


class ProfileOut(Answer):
    """Profile likelihood of one parameter.

    `ratio` is n ln(S(v)/S₀) at `values`. An end of `interval95` is null if the ratio stays below
    the threshold up to the bound, or over the whole search range. `others` are the other free
    parameters, estimated again at each of `values`.
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


class RunProfilesOut(Answer):
    """Profiles of a run, and the likelihood ratio at the ends of their intervals."""

    id: str
    threshold: float
    profiles: list[ProfileOut]


class ProfilesOut(RunProfilesOut):
    """Profiles of a run, and their figure as Plotly JSON."""

    figure: dict[str, Any]


class CompareIn(Body):
    """Runs to compare: at least two, of any jobs, fitted to the same data."""

    runs: list[str] = Field(min_length=2, max_length=50)


class ComparedRunOut(Answer):
    """Candidate of a comparison; `parameters` counts the free ones. Low AIC and BIC are better."""

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


class ComparedValueOut(Answer):
    """Estimate of a parameter by one run; `stderr` and `interval95` are null without errors."""

    run: str
    value: float
    stderr: float | None
    interval95: list[float] | None
    status: str


class ComparedParameterOut(Answer):
    """Parameter that at least two runs have.

    `differs` is true if two of its 95 % intervals do not overlap. It is null if fewer than two have
    one.
    """

    name: str
    unit: str
    values: list[ComparedValueOut]
    differs: bool | None
    note: str


class ComparisonOut(Answer):
    """Comparison of runs, the best first; `unit` is that of the RMS.

    `notes` say which parameters depend on the model, and which figures do not compare.
    """

    unit: str
    runs: list[ComparedRunOut]
    parameters: list[ComparedParameterOut]
    notes: list[str]


class FreeRunIn(Body):
    """Simulation of a run's model on a stored `dataset`; every segment is one experiment.

    `channels` map signals of the model to recorded channels that differ from the run's job. The
    first `skip` samples of every output are not scored.
    """

    dataset: str
    channels: dict[str, str] = Field(default={})
    skip: int = Field(default=0, ge=0)


class AgreementOut(Answer):
    """Fit of one output of one experiment (counted from 1); null if the output does not vary."""

    experiment: int
    output: str
    unit: str
    samples: int
    rms: float
    fit_percent: Finite


class FreeRunOut(Answer):
    """Measured and simulated outputs, and their agreement.

    `rms` is in `unit`. For several outputs it is weighted, in standard deviations of each. `starts`
    are initial states that the model does not fix. They belong to a recording, so they are
    estimated on it.
    """

    id: str
    dataset: str
    unit: str
    rms: float
    fit_percent: Finite
    agreement: list[AgreementOut]
    starts: dict[str, float]
    experiments: list[ExperimentOut]
