"""Bodies and answers about runs: results, comparisons, free runs, profiles.

The names in results are those of the numerical core.
"""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field

from service.core.bodies.value_schemas import describe_value, extend_by, extend_later_by
from service.core.bodies.wire import (
    Answer,
    Body,
    Cell,
    DescribedBy,
    FigureOut,
    Finite,
    Labels,
    Page,
)
from service.core.states import RunStateName
from service.datasets.dataset_schemas import SeriesOut
from service.models.model_schemas import ModelDocumentOut
from sysid.control.linear_form import Covariance, IdentifiedValue
from sysid.residuals.residual_tests import ResidualTest
from sysid.results.result import Result
from sysid.simulation.fit_metrics import ChannelMetrics
from sysid.uncertainty.estimates import Estimate


@extend_later_by(Result, parameters=[], findings=[], warnings=[])
class RunOut(Answer):
    """One identification: its cell of the sweep, progress, and result.

    What belongs to the result is null until it exists. Its fields are those of
    `sysid.results.result.Result`.
    """

    id: str = Field(description="identifier, `run_…`")
    job: str = Field(description="identifier of its job")
    number: int = Field(description="number in the job, from 0")
    cell: Cell = Field(description="values of the sweep's axes, by their pointers")
    labels: Labels = Field(description="labels of the cell, such as a length")
    state: RunStateName = Field(description="state of the run")
    progress: float = Field(description="share that is done, from 0 to 1")
    error: str | None = Field(default=None, description="why the run failed; null if it did not")
    reused_from: str | None = Field(
        default=None, description="the earlier run with the same specification"
    )
    seed: int | None = Field(default=None, description="seed of the search")
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
    note: str | None = Field(default=None, description="note of a user")
    tags: list[str] = Field(default=[], description="tags of users")
    created_at: datetime = Field(description="time when the run was made, UTC")
    started_at: datetime | None = Field(default=None, description="time of the start, UTC")
    finished_at: datetime | None = Field(default=None, description="time of the end, UTC")
    has_signals: bool = Field(default=False, description="whether its fitted signals can be read")
    rms_unit: str | None = Field(
        default=None, description="given for a single run; σ for several weighted outputs"
    )
    rms: float | None = Field(
        default=None, description="RMS error so far, in the output's unit, or in σ if weighted"
    )
    evaluations: int = Field(default=0, description="simulations so far")
    generations: int = Field(default=0, description="generations so far")
    seconds: float | None = Field(default=None, description="compute time, s")
    rms_noise_free: float | None = Field(
        default=None,
        description="RMS error against the record without added noise, in the unit of `rms`",
    )


class RunPage(Page[RunOut]):
    """Runs of a job."""


class ImprovementOut(Answer):
    """A better champion of one island."""

    generation: int = Field(description="generation of the island")
    evaluations: int = Field(description="simulations of the island so far")
    rms: float = Field(description="RMS error, in the unit of the run's `rms`")
    phase: str = Field(description="part of the search that found it")
    parameters: list[float] = Field(description="values in the order of `names`, in their units")


class HistoryOut(Answer):
    """Improvements of every island; `names` are those of the columns of `parameters`."""

    id: str = Field(description="identifier of the run")
    names: list[str] = Field(description="free parameters, in the order of `parameters`")
    islands: list[list[ImprovementOut]] = Field(description="improvements of each island, in order")


class ExperimentOut(Answer):
    """Measured and simulated outputs of one experiment."""

    name: str = Field(description="name of the record")
    measured: list[SeriesOut] = Field(description="measured outputs")
    simulated: list[SeriesOut] = Field(description="simulated outputs")


class ResponseOut(Answer):
    """Measured against simulated, experiment by experiment."""

    id: str = Field(description="identifier of the run")
    experiments: list[ExperimentOut] = Field(description="records of the run")


class BandOut(Answer):
    """95 % bands of one output, in `unit`; null where the simulation diverged."""

    name: str = Field(description="name of the output")
    unit: str = Field(description="unit of all values")
    samples: int = Field(description="samples before the reduction")
    times: list[float] = Field(description="times, s")
    simulated: list[float | None] = Field(description="output at the estimates")
    confidence_lower: list[float | None] = Field(description="lower end for the output itself")
    confidence_upper: list[float | None] = Field(description="upper end for the output itself")
    prediction_lower: list[float | None] = Field(description="lower end for a new measurement")
    prediction_upper: list[float | None] = Field(description="upper end for a new measurement")


class BandExperimentOut(Answer):
    """Bands of all outputs of one record."""

    name: str = Field(description="name of the record")
    outputs: list[BandOut] = Field(description="bands of each output")


class BandsOut(Answer):
    """95 % bands of the outputs on the records that the run was fitted to.

    The confidence band holds the output without noise, the prediction band a new measurement, at
    each time by itself.
    """

    id: str = Field(description="identifier of the run")
    source: Literal["covariance", "posterior"] = Field(
        description="covariance of the estimates, or samples of the posterior"
    )
    experiments: list[BandExperimentOut] = Field(description="records of the run")


class DisturbanceOut(Answer):
    """An estimated disturbance with its 95 % band, in `unit`; null where the filter diverged."""

    place: str = Field(description="input or output with a load, or state that noise moves")
    kind: Literal["load", "plant"] = Field(description="a load, or a state of the plant itself")
    unit: str = Field(description="unit of all values")
    samples: int = Field(description="times before the reduction")
    times: list[float] = Field(description="times, s")
    values: list[float | None] = Field(description="estimate from the whole record")
    lower: list[float | None] = Field(description="lower end of the band")
    upper: list[float | None] = Field(description="upper end of the band")


class DisturbanceExperimentOut(Answer):
    """Disturbances of one record."""

    name: str = Field(description="name of the record")
    disturbances: list[DisturbanceOut] = Field(description="disturbance at each place")


class DisturbancesOut(Answer):
    """Estimated disturbances of a run with noise inside the plant; without it there are no records.

    Each time is estimated from the whole record, and the band holds at each time by itself.
    """

    id: str = Field(description="identifier of the run")
    experiments: list[DisturbanceExperimentOut] = Field(description="records of the run")


@extend_by(ResidualTest)
class CorrelationOut(Answer):
    """Correlation function of residuals with its bands, and its test.

    `input` is null for the autocorrelation. `lags` are in periods of `period` seconds. If `period`
    is null, they are in samples of irregular times. Bands are symmetric about zero.
    """

    period: float | None = Field(description="time between two lags, s; null for irregular times")
    lags: list[float] = Field(description="lags, in periods or samples")
    values: list[float] = Field(description="correlation at each lag, from -1 to 1")
    band95: list[float] = Field(description="half width of the 95 % band at each lag")
    band99: list[float] = Field(description="half width of the 99 % band at each lag")


class ResidualsOut(Answer):
    """Tests of a run's residuals with their correlation functions.

    `level` is the probability that a true model fails at least one test. `passed` is null if
    nothing could be tested. `note` says what could not be read.
    """

    id: str = Field(description="identifier of the run")
    data: Literal["estimation", "validation"] = Field(description="data of the residuals")
    passed: bool | None = Field(
        description="whether all tests passed; null if nothing could be tested"
    )
    level: float = Field(description="probability that a true model fails at least one test")
    note: str = Field(description="what could not be read; empty if nothing")
    tests: list[CorrelationOut] = Field(description="tests with their correlation functions")


class MigrantOut(Answer):
    """One line of the migration log."""

    epoch: int = Field(description="number of the migration, from 0")
    source: int = Field(description="island that sent it, from 0")
    destination: int = Field(description="island that received it, from 0")
    fitness: float = Field(description="fitness of the individual; smaller is better")


class MigrationsOut(Answer):
    """The migration log of a run."""

    id: str = Field(description="identifier of the run")
    migrants: list[MigrantOut] = Field(description="migrants in order")


class ProfileIn(Body):
    """Free parameters to profile, and the approximate number of values of each."""

    parameters: list[Annotated[str, Field(max_length=200)]] | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description="free parameters to profile; null: all",
    )
    points: int = Field(
        default=21, ge=3, le=101, description="approximate number of values of each"
    )


class ProfileOut(Answer):
    """Profile likelihood of one parameter.

    `ratio` is n ln(S(v)/S₀) at `values`. An end of `interval95` is null if the ratio stays below
    the threshold up to the bound, or over the whole search range. `others` are the other free
    parameters, estimated again at each of `values`.
    """

    name: str = Field(description="name of the parameter")
    unit: str = Field(description="unit of its values")
    estimate: float = Field(description="estimate of the run")
    interval95: tuple[float | None, float | None] = Field(
        description="95 % interval by the likelihood ratio; an end is null if it is not reached"
    )
    values: list[float] = Field(description="values of the parameter, in its unit")
    ratio: list[Finite] = Field(description="likelihood ratio n ln(S(v)/S₀) at each value")
    rms: list[Finite] = Field(description="RMS error at each value, in the unit of the run's `rms`")
    others: dict[str, list[float]] = Field(
        description="the other free parameters at each value, in their units"
    )
    evaluations: int = Field(description="simulations of this profile")


class RunProfilesOut(Answer):
    """Profiles of a run, and the likelihood ratio at the ends of their intervals."""

    id: str = Field(description="identifier of the run")
    threshold: float = Field(description="likelihood ratio at the ends of the intervals")
    profiles: list[ProfileOut] = Field(description="profile of each parameter")


class ProfilesOut(RunProfilesOut):
    """Profiles of a run, and their figure as Plotly JSON."""

    figure: FigureOut = Field(description="figure of the profiles, as Plotly JSON")


class ExportedDataOut(Answer):
    """Sampling of the data."""

    sample_time: float | None = Field(description="sampling period, s; null if irregular")
    hold: dict[str, str] = Field(description="how each input was read between its samples")


class ExportedModelOut(Answer):
    """Identified model, from which it can be built and simulated again."""

    format: str = Field(description="name and version of this format")
    lagid: str | None = Field(description="version of lagid that wrote it")
    model: Annotated[Any, DescribedBy(ModelDocumentOut)] = Field(description="model document")
    values: Annotated[Any, DescribedBy(list[describe_value(IdentifiedValue)])] = Field(
        description="parameters and initial states"
    )
    covariance: Annotated[Any, DescribedBy(describe_value(Covariance) | None)] = Field(
        description="covariance of the free parameters"
    )
    data: ExportedDataOut = Field(description="sampling of the data")
    provenance: dict[str, Any] = Field(description="run, job and data of the values")


class CompareIn(Body):
    """Runs to compare: at least two, of any jobs, fitted to the same data."""

    runs: list[str] = Field(min_length=2, max_length=50, description="ids of the runs")


class ComparedRunOut(Answer):
    """Candidate of a comparison; `parameters` counts the free ones. Low AIC and BIC are better."""

    run: str = Field(description="identifier of the run")
    job: str = Field(description="identifier of its job")
    number: int = Field(description="number of the run in its job, from 0")
    model: str = Field(description="name of the model")
    title: str = Field(description="title of the model")
    cell: Cell = Field(description="values of the sweep's axes, by their pointers")
    parameters: int = Field(description="number of free parameters")
    samples: int = Field(description="scored samples")
    rms: float | None = Field(description="RMS error on the estimation data, in `unit`")
    rms_validation: float | None = Field(description="RMS error on the validation data, in `unit`")
    fit_estimation: float | None = Field(description="fit to the estimation data, %")
    fit_validation: float | None = Field(description="fit to the validation data, %")
    aic: float | None = Field(description="Akaike's information criterion")
    bic: float | None = Field(description="Schwarz's information criterion")
    residuals_passed: bool | None = Field(
        description="whether the residual tests passed; null if not tested"
    )
    residuals_data: str | None = Field(description="data of the residual tests")
    evaluations: int = Field(description="simulations of the search")


@extend_by(Estimate)
class ComparedValueOut(Answer):
    """Estimate of a parameter by one run."""

    run: str = Field(description="identifier of the run")


class ComparedParameterOut(Answer):
    """Parameter that at least two runs have.

    `differs` is true if two of its 95 % intervals do not overlap. It is null if fewer than two have
    one.
    """

    name: str = Field(description="name of the parameter")
    unit: str = Field(description="unit of its values")
    values: list[ComparedValueOut] = Field(description="estimate of each run that has it")
    differs: bool | None = Field(
        description="whether two 95 % intervals do not overlap; null if fewer than two have one"
    )
    note: str = Field(description="what limits the comparison; empty if nothing")


class ComparisonOut(Answer):
    """Comparison of runs, the best first; `unit` is that of the RMS.

    `notes` say which parameters depend on the model, and which figures do not compare.
    """

    unit: str = Field(description="unit of each RMS")
    runs: list[ComparedRunOut] = Field(description="runs, the best first")
    parameters: list[ComparedParameterOut] = Field(
        description="parameters that at least two runs have"
    )
    notes: list[str] = Field(description="what does not compare")


class FreeRunIn(Body):
    """Simulation of a run's model on a stored `dataset`; every segment is one experiment.

    `channels` map signals of the model to recorded channels that differ from the run's job. The
    first `skip` samples of every output are not scored.
    """

    dataset: str = Field(description="identifier of a stored dataset")
    channels: dict[str, str] = Field(
        default={}, description="recorded channel of each signal that differs from the run's job"
    )
    skip: int = Field(
        default=0, ge=0, description="samples at the start of each output that are not scored"
    )


@extend_by(ChannelMetrics)
class AgreementOut(Answer):
    """Fit of one output of one experiment (counted from 1); null if the output does not vary."""

    experiment: int = Field(description="record, from 1")


class FreeRunOut(Answer):
    """Measured and simulated outputs, and their agreement.

    `rms` is in `unit`. For several outputs it is weighted, in standard deviations of each. `starts`
    are initial states that the model does not fix. They belong to a recording, so they are
    estimated on it.
    """

    id: str = Field(description="identifier of the run")
    dataset: str = Field(description="identifier of the dataset")
    unit: str = Field(description="unit of the RMS")
    rms: float = Field(description="RMS error, in `unit`")
    fit_percent: Finite = Field(description="fit, %")
    agreement: list[AgreementOut] = Field(description="agreement of each output of each record")
    starts: dict[str, float] = Field(
        description="initial states that were estimated on the recording, in their units"
    )
    experiments: list[ExperimentOut] = Field(description="measured and simulated outputs")
