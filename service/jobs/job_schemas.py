"""Body of a job, and answers about jobs and accepted references.

Settings of the search and of the fit are derived from `sysid.core.settings`. A narrower bound here
limits what one request may ask of a server.
"""

from datetime import datetime
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from service.core.bodies.derived_bodies import derive_fields, take_setting
from service.core.bodies.wire import Answer, Body, Cell, DescribedBy, Labels, Page, Pointer
from service.core.states import StateName
from service.datasets.dataset_schemas import PlacedNoiseIn
from service.items.reference_names import REFERENCE_PREFIX, RUN_PREFIX
from sysid.core.settings import (
    FitSettings,
    GeneticAlgorithm,
    InitialSetting,
    IslandChange,
    Loss,
    Migration,
    PredictionKind,
    SequenceSearch,
    Stop,
)
from sysid.data.records import HoldSetting
from sysid.identification.options import RunOptions
from sysid.models.parameters import ParameterScale, PhysicalBounds
from sysid.results.verdict import Trust

WholeNumber = Annotated[int, Field(gt=-(2**62), lt=2**62)]
MAX_INDIVIDUALS = 100_000
SCHEDULE_LENGTH = {"min_length": 1, "max_length": 1000}


class ParameterIn(Body):
    """Changes of one parameter of the model."""

    lower: float | None = Field(default=None, description="lower bound, in the parameter's unit")
    upper: float | None = Field(default=None, description="upper bound, in the parameter's unit")
    scale: ParameterScale | None = Field(
        default=None, description="scale on which the search moves"
    )
    fixed: float | None = Field(
        default=None, description="value at which the parameter is held, in its unit"
    )
    tied: str | None = Field(
        default=None,
        max_length=1000,
        description="expression of other parameters that gives the value",
    )
    physical: PhysicalBounds | None = Field(
        default=None, description="bounds that are limits of the quantity itself"
    )


class ValidationIn(Body):
    """Validation data: other datasets, or the last fraction of each record."""

    datasets: list[str] | None = Field(
        default=None, min_length=1, description="datasets that are compared, but not fitted"
    )
    fraction: float | None = take_setting(RunOptions, "validation_fraction")

    @model_validator(mode="after")
    def _check_one_source(self) -> Self:
        if (self.datasets is None) == (self.fraction is None):
            raise PydanticCustomError("one_of", "give either 'datasets' or 'fraction'")
        return self


@derive_fields(Loss)
class LossIn(Body):
    """Loss function: squares, or soft-l1 with a scale in the output's unit.

    The noise model ar1 gives generalised least-squares estimates. auto selects it if the residuals
    are coloured and nothing but noise explains them, else white.
    """


@derive_fields(SequenceSearch)
class SequenceIn(Body):
    """The sequence search."""


@derive_fields(Migration, limits={"migrants": {"le": MAX_INDIVIDUALS}})
class MigrationIn(Body):
    """Exchange between islands."""


@derive_fields(Stop, limits={"settled": {"le": 1_000_000}})
class StopIn(Body):
    """End conditions in addition to the generations.

    `settled`: `improved` stops once independent restarts have confirmed the best individual. This
    takes `settled` + 2 confirmations, and a third of all restarts. Restarts begin at random places
    and near the best individual. The fewer of the random ones agree, the more confirmations are
    needed. Those near it are enough if its residuals look like noise. If the fitness has jumps
    nearby, `settled` of either kind and nearly all restarts must agree. Null disables it.
    """


@derive_fields(IslandChange, limits={"mutation": SCHEDULE_LENGTH})
class IslandIn(Body):
    """Settings in which one island differs."""


@derive_fields(
    GeneticAlgorithm,
    {SequenceSearch: SequenceIn, Migration: MigrationIn, Stop: StopIn, IslandChange: IslandIn},
    limits={
        "population": {"le": MAX_INDIVIDUALS},
        "generations": {"le": 10_000_000},
        "mutation": SCHEDULE_LENGTH,
    },
)
class AlgorithmIn(Body):
    """Settings of the search."""


MAX_AXIS_VALUES = 1_000_000
AxisLabels = Annotated[dict[str, float | str], Field(max_length=32)]


class SweepAxisIn(Body):
    """One axis of a sweep: the field it changes and its values.

    Give exactly one of `values`, `range` and `log`. `range` is start, stop[, step] in whole
    numbers, without stop. `log` is start, stop, count, with both ends. Axes with the same `zip`
    name step together; all others are crossed. `labels` belong to the values, one each.
    """

    path: Pointer = Field(description="JSON pointer to the field of the job that changes")
    values: list[Any] | None = Field(
        default=None, min_length=1, max_length=MAX_AXIS_VALUES, description="values of the field"
    )
    range: list[WholeNumber] | None = Field(
        default=None,
        min_length=2,
        max_length=3,
        description="whole numbers: start, stop[, step], without stop",
    )
    log: tuple[float, float, int] | None = Field(
        default=None, description="start, stop and count of values with equal ratios"
    )
    zip: str | None = Field(
        default=None, max_length=100, description="axes of this name step together"
    )
    labels: list[AxisLabels] | None = Field(
        default=None,
        max_length=MAX_AXIS_VALUES,
        description="labels of each value, such as a length",
    )

    @model_validator(mode="after")
    def _check_one_kind(self) -> Self:
        kinds = [n for n in ("values", "range", "log") if getattr(self, n) is not None]
        if len(kinds) != 1:
            raise PydanticCustomError(
                "one_of",
                "give exactly one of 'values', 'range' and 'log'; found {found}",
                {"found": " and ".join(kinds) or "none"},
            )
        return self


class SweepIn(Body):
    """Sweep: the crossed axes give one run per cell."""

    axes: list[SweepAxisIn] = Field(
        default=[], max_length=16, description="axes, which are crossed"
    )


PREVIOUS = "previous"


def _check_warm_start(value: str) -> str:
    named = value.removeprefix(REFERENCE_PREFIX)
    if value != PREVIOUS and not value.startswith(RUN_PREFIX) and (named == value or not named):
        raise PydanticCustomError(
            "warm_start", "need 'previous', the id of a run (run_…), or 'reference:' and a name"
        )
    return value


def _check_reference(value: str) -> str:
    if value == PREVIOUS:
        raise PydanticCustomError("reference", "need the id of a run, or 'reference:' and a name")
    return _check_warm_start(value)


MIN_X, MAX_X = 1e-100, 1e100
"""Magnitudes of x in a trend. Their squares must be finite."""


def is_valid_x(value: float) -> bool:
    """Test whether a number can be the x of a trend."""
    return value == 0 or MIN_X <= abs(value) <= MAX_X


def _check_x(value: float) -> float:
    if not is_valid_x(value):
        raise PydanticCustomError(
            "place", "need 0, or a magnitude from 1e-100 to 1e100. Write x in another unit"
        )
    return value


TrendX = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_check_x)]


class TrendIn(Body):
    """Trend of parameters over a label.

    `x` names a label that is a number in every cell. `parameters` are those to analyse (by default
    all free ones). `predict` are the values of x to predict at. `reference` is a run (run_…, or
    `reference:` and a name) to compare the batch with.
    """

    x: str = Field(
        min_length=1, max_length=64, description="name of the label that is the abscissa"
    )
    parameters: list[str] = Field(
        default=[], max_length=100, description="parameters to analyse; empty: all free ones"
    )
    predict: list[TrendX] = Field(
        default=[], max_length=100, description="values of x to predict at, in the label's unit"
    )
    reference: Annotated[str, Field(max_length=300), AfterValidator(_check_reference)] | None = (
        Field(
            default=None,
            description="run to compare the batch with: `run_…`, or `reference:` and a name",
        )
    )


def check_model_reference(value: Any) -> Any:
    """Check a model in a body: a name or a document."""
    if not isinstance(value, str | dict):
        raise PydanticCustomError(
            "model_reference",
            "need the name of a model, 'name@version', or a model document (an object)",
        )
    return value


class IdentificationIn(Body):
    """Fields common to a job and to the recipes that make jobs: the model, and how to fit it."""

    name: str | None = Field(
        default=None, max_length=200, description="name of the job; by default model and dataset"
    )
    model: Annotated[Any, AfterValidator(check_model_reference)] = Field(
        description="name of a model, `name@version`, or a whole model document"
    )
    channels: dict[str, str] = Field(
        default={},
        description="recorded channel of each signal of the model; equal names need no entry",
    )
    hold: dict[str, HoldSetting] = Field(
        default={},
        description="how each input is read between its samples; "
        "of which period an output is a mean",
    )
    parameters: dict[str, ParameterIn] = Field(
        default={}, description="changes of the model's parameters by name"
    )
    prediction: PredictionKind = take_setting(FitSettings, "prediction")
    loss: LossIn = Field(default=LossIn(), description="loss function")
    weights: dict[str, float | list[float]] | None = take_setting(FitSettings, "weights")
    skip: int = take_setting(FitSettings, "skip")
    initial: InitialSetting | None = take_setting(FitSettings, "initial")
    commands: list[str] | None = take_setting(FitSettings, "commands")
    algorithm: AlgorithmIn = Field(default=AlgorithmIn(), description="settings of the search")
    priority: int = Field(
        default=0, ge=-100, le=100, description="jobs of higher priority come first"
    )
    reuse: bool = Field(
        default=True, description="take over results of earlier runs with the same specification"
    )

    keep_signals: bool | None = Field(
        default=None,
        description="store the fitted signals of every run. By default a sweep computes them again "
        "when they are asked for",
    )

    def dump_set_fields(self, *also: str) -> dict[str, Any]:
        """Dump these fields and those in `also`, if they were set."""
        names = {*IdentificationIn.model_fields, *also}
        return self.model_dump(include=names, exclude_unset=True)


class JobIn(IdentificationIn):
    """Job: model, data, and how to identify."""

    datasets: list[str] = Field(
        min_length=1,
        max_length=1000,
        description="datasets by name or id, fitted together as several experiments",
    )
    validation: ValidationIn | None = Field(
        default=None, description="data that are compared, but not fitted"
    )
    noise: PlacedNoiseIn = Field(
        default=PlacedNoiseIn(), description="noise that is added before fitting"
    )
    seed: int = take_setting(RunOptions, "seed")
    sweep: SweepIn = Field(default=SweepIn(), description="fields that change from run to run")
    warm_start: Annotated[str, Field(max_length=300), AfterValidator(_check_warm_start)] | None = (
        Field(
            default=None,
            description="where runs begin: `previous`, a run, or `reference:` and a name",
        )
    )
    trend: TrendIn | None = Field(default=None, description="trend of the estimates over a label")
    posterior: bool = take_setting(RunOptions, "posterior")
    compare_orders: bool | None = Field(
        default=None,
        description="fit a process with dead time with one order more and one less, too; null: "
        "in a job without a sweep",
    )

    def to_normal_form(self) -> dict[str, Any]:
        """Return the body with every default written out, as it is stored and sent to workers."""
        document = self.model_dump(mode="json")
        document["parameters"] = {
            name: change.model_dump(mode="json", exclude_none=True)
            for name, change in self.parameters.items()
        }
        return document


class ProgressOut(Answer):
    """Progress of a job."""

    runs: int = Field(description="runs of the job")
    finished: int = Field(description="runs that have ended, failed ones included")
    failed: int = Field(description="runs that failed")
    reused: int = Field(default=0, description="runs taken over from earlier runs")
    best_rms: float | None = Field(
        default=None,
        description="of the best run. Not comparable between runs on other data or noise",
    )
    evaluations: int = Field(default=0, description="simulations so far, over all runs")
    generation: int = Field(default=0, description="generations so far of the run that is furthest")
    seconds_left: float | None = Field(
        default=None, description="estimated time to the end, s; null if unknown"
    )


class OutcomeOut(Answer):
    """Outcome of a job: that of its only run, or of the best one by RMS."""

    run: str = Field(description="identifier of the run")
    cell: Cell = Field(description="values of the sweep's axes, by their pointers")
    labels: Labels = Field(description="labels of the cell, such as a length")
    fit_estimation: float | None = Field(description="fit to the estimation data, %")
    fit_validation: float | None = Field(
        description="fit to the validation data, %; null without them"
    )
    trust: Trust = Field(
        description="limited: the estimates hold under the condition that the verdict names"
    )
    verdict: str = Field(description="the verdict in words")
    warnings: int = Field(description="number of its warnings, notes included")


class JobOut(Answer):
    """A job and its state."""

    id: str = Field(description="identifier, `job_…`")
    name: str = Field(description="name of the job")
    state: StateName = Field(
        description="state of the job; `incomplete`: it has ended, and some of its runs have failed"
    )
    cancel_requested: bool = Field(
        default=False, description="whether it was asked to stop, and has not yet"
    )
    created_at: datetime = Field(description="time of the submission, UTC")
    started_at: datetime | None = Field(default=None, description="time of the first start, UTC")
    finished_at: datetime | None = Field(default=None, description="time of the end, UTC")
    seconds: float | None = Field(
        default=None,
        description="wall time from the first start to the end, or to now; null while queued",
    )
    attempt: int = Field(description="number of starts, resumptions included")
    error: str | None = Field(default=None, description="why the job failed; null if it did not")
    model: str = Field(description="name of the model")
    note: str | None = Field(default=None, description="note of a user")
    tags: list[str] = Field(default=[], description="tags of users")
    version: str = Field(description="version of the program that computed the job, or took it")
    fingerprint: str | None = Field(
        default=None,
        description="digest of the kernels' program: equal ones give results equal bit for bit",
    )
    spec_hash: str = Field(description="digest of the request")
    priority: int = Field(description="jobs of higher priority come first")
    progress: ProgressOut = Field(description="progress of its runs")
    rms_unit: str | None = Field(
        default=None, description="unit of the best RMS; σ for several weighted outputs"
    )
    outcome: OutcomeOut | None = Field(
        default=None,
        description="outcome so far; null without a result, and of a batch, whose runs see "
        "different recordings",
    )
    request: Annotated[Any, DescribedBy(JobIn | None)] = Field(
        default=None, description="the request with every default; null in lists"
    )


class JobPage(Page[JobOut]):
    """Jobs, latest first."""


class ReferenceIn(Body):
    """Acceptance of a run as a reference; `by` and `note` are stored with it."""

    run: str = Field(max_length=100, description="id of the accepted run, which succeeded")
    by: str | None = Field(default=None, max_length=200, description="who accepts it")
    note: str | None = Field(default=None, max_length=2000, description="why it was accepted")


class AcceptanceOut(Answer):
    """One acceptance."""

    run: str = Field(description="id of the accepted run")
    by: str | None = Field(default=None, description="who accepted it")
    note: str | None = Field(default=None, description="why it was accepted")
    at: datetime = Field(description="time of the acceptance, UTC")


class ReferenceValueOut(Answer):
    """Estimate of one parameter of a reference."""

    value: float | None = Field(description="estimate, in the parameter's unit")
    stderr: float | None = Field(description="standard error, in the parameter's unit")


class ReferenceOut(Answer):
    """Reference: the run in use, its estimates, and earlier acceptances."""

    name: str = Field(description="name of the reference")
    run: str = Field(description="id of the run in use")
    job: str = Field(description="id of its job")
    by: str | None = Field(default=None, description="who accepted it")
    note: str | None = Field(default=None, description="why it was accepted")
    at: datetime = Field(description="time of the acceptance, UTC")
    tags: list[str] = Field(default=[], description="tags of users")
    labels: Labels = Field(default={}, description="labels of the run")
    estimates: dict[str, ReferenceValueOut] = Field(
        default={}, description="estimates by parameter, each in the parameter's unit"
    )
    history: list[AcceptanceOut] = Field(
        default=[], description="the previous acceptances (at most 1,000), latest first"
    )


class ReferencePage(Page[ReferenceOut]):
    """References in use, by name."""
