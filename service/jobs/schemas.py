"""Body of a job, and answers about jobs and accepted references.

Names, defaults and bounds are those of `sysid.core.settings`. A narrower bound here limits what one
request may ask of a server.
"""

from datetime import datetime
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from service.core.states import StateName
from service.core.wire import Answer, Body, NoiseIn, Pointer, Seed
from service.items.reference_names import REFERENCE_PREFIX, RUN_PREFIX
from sysid.core.settings import (
    MAX_BITS,
    MAX_EVALUATIONS,
    MAX_GENERATIONS,
    MIN_POPULATION,
    GeneticAlgorithm,
    Loss,
    LossKind,
    NoiseModel,
    PredictionKind,
    SearchMethod,
    SequenceKind,
    TopologyName,
)
from sysid.data.records import HoldSetting
from sysid.models.parameters import ParameterScale

SEARCH, LOSS = GeneticAlgorithm(), Loss()
"""Core settings, which provide the defaults."""

WholeNumber = Annotated[int, Field(gt=-(2**62), lt=2**62)]
PositiveCount = Annotated[int, Field(ge=1, le=MAX_GENERATIONS)]
EvaluationLimit = Annotated[int, Field(ge=1, le=MAX_EVALUATIONS)]
GenerationNumber = Annotated[int, Field(ge=0, le=MAX_GENERATIONS)]
Bits = Annotated[int, Field(ge=1, le=MAX_BITS)]
MAX_INDIVIDUALS = 100_000
MutationSchedule = Annotated[
    list[tuple[GenerationNumber, float]], Field(min_length=1, max_length=1000)
]


class ParameterIn(Body):
    """Changes of one parameter of the model."""

    lower: float | None = None
    upper: float | None = None
    scale: ParameterScale | None = None
    fixed: float | None = None
    tied: str | None = Field(default=None, max_length=1000)


class ValidationIn(Body):
    """Validation data: other datasets, or the last fraction of each record."""

    datasets: list[str] | None = Field(default=None, min_length=1)
    fraction: float | None = Field(default=None, gt=0, lt=1)

    @model_validator(mode="after")
    def _check_one_source(self) -> Self:
        if (self.datasets is None) == (self.fraction is None):
            raise PydanticCustomError("one_of", "give either 'datasets' or 'fraction'")
        return self


class LossIn(Body):
    """Loss function: squares, or soft-l1 with a scale in the output's unit.

    The noise model ar1 gives generalised least-squares estimates. auto selects ar1 if the residuals
    are coloured and the model integrates (initial errors persist), else white.
    """

    kind: LossKind = LOSS.kind
    scale: float = Field(default=LOSS.scale, gt=0)
    noise_model: NoiseModel = LOSS.noise_model


class SequenceIn(Body):
    """The sequence search."""

    kind: SequenceKind = SEARCH.sequence.kind
    beta: float = Field(default=SEARCH.sequence.beta, gt=0, lt=1)
    relative: bool = SEARCH.sequence.relative


class MigrationIn(Body):
    """Exchange between islands."""

    every: PositiveCount = SEARCH.migration.every
    topology: TopologyName = SEARCH.migration.topology
    migrants: int = Field(default=SEARCH.migration.migrants, ge=0, le=MAX_INDIVIDUALS)


class StopIn(Body):
    """End conditions in addition to the generations.

    `settled`: `improved` stops once independent restarts have confirmed the best individual. This
    takes `settled` + 2 confirmations, and a third of all restarts. Restarts begin at random places
    and near the best individual. The fewer of the random ones agree, the more confirmations are
    needed. Those near it are enough if its residuals look like noise. If the fitness has jumps
    nearby, `settled` of either kind and nearly all restarts must agree. Null disables it.
    """

    evaluations: EvaluationLimit | None = SEARCH.stop.evaluations
    seconds: float | None = Field(default=SEARCH.stop.seconds, gt=0)
    rms: float | None = Field(default=SEARCH.stop.rms, gt=0)
    settled: int | None = Field(default=SEARCH.stop.settled, ge=1, le=1_000_000)


class IslandIn(Body):
    """Settings in which one island differs."""

    method: SearchMethod | None = None
    bits: Bits | None = None
    mutation: MutationSchedule | None = None


class AlgorithmIn(Body):
    """Settings of the search."""

    method: SearchMethod = SEARCH.method
    population: int = Field(default=SEARCH.population, ge=MIN_POPULATION, le=MAX_INDIVIDUALS)
    generations: int = Field(default=SEARCH.generations, ge=1, le=10_000_000)
    bits: Bits = SEARCH.bits
    selection_rate: float = Field(default=SEARCH.selection_rate, gt=0, lt=1)
    mutation: MutationSchedule = Field(default=[*SEARCH.mutation])
    stagnation: PositiveCount = SEARCH.stagnation
    sequence: SequenceIn = SequenceIn()
    islands: int | list[IslandIn] | None = None
    migration: MigrationIn = MigrationIn()
    refine: bool = SEARCH.refine
    safe_limit: float | None = Field(default=SEARCH.safe_limit, gt=0)
    stop: StopIn = StopIn()


MAX_AXIS_VALUES = 1_000_000
AxisLabels = Annotated[dict[str, float | str], Field(max_length=32)]


class SweepAxisIn(Body):
    """One axis of a sweep: the field it changes and its values.

    Give exactly one of `values`, `range` and `log`. `range` is start, stop[, step] in whole
    numbers, without stop. `log` is start, stop, count, with both ends. Axes with the same `zip`
    name step together; all others are crossed. `labels` belong to the values, one each.
    """

    path: Pointer
    values: list[Any] | None = Field(default=None, min_length=1, max_length=MAX_AXIS_VALUES)
    range: list[WholeNumber] | None = Field(default=None, min_length=2, max_length=3)
    log: tuple[float, float, int] | None = None
    zip: str | None = Field(default=None, max_length=100)
    labels: list[AxisLabels] | None = Field(default=None, max_length=MAX_AXIS_VALUES)

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

    axes: list[SweepAxisIn] = Field(default=[], max_length=16)


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

    x: str = Field(min_length=1, max_length=64)
    parameters: list[str] = Field(default=[], max_length=100)
    predict: list[TrendX] = Field(default=[], max_length=100)
    reference: Annotated[str, Field(max_length=300), AfterValidator(_check_reference)] | None = None


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

    name: str | None = Field(default=None, max_length=200)
    model: Annotated[Any, AfterValidator(check_model_reference)]
    channels: dict[str, str] = Field(default={})
    hold: dict[str, HoldSetting] = Field(default={})
    parameters: dict[str, ParameterIn] = Field(default={})
    prediction: PredictionKind = "simulation"
    loss: LossIn = LossIn()
    weights: dict[str, float] | None = None
    skip: int = Field(default=0, ge=0)
    algorithm: AlgorithmIn = AlgorithmIn()
    priority: int = Field(default=0, ge=-100, le=100)
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

    datasets: list[str] = Field(min_length=1, max_length=1000)
    validation: ValidationIn | None = None
    noise: NoiseIn = NoiseIn()
    seed: Seed = 1
    sweep: SweepIn = SweepIn()
    warm_start: Annotated[str, Field(max_length=300), AfterValidator(_check_warm_start)] | None = (
        None
    )
    trend: TrendIn | None = None
    posterior: bool = Field(
        default=False, description="sample the posterior distribution of the free parameters"
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

    runs: int
    finished: int
    failed: int
    reused: int = Field(default=0, description="runs taken over from earlier runs")
    best_rms: float | None = Field(
        default=None,
        description="of the best run. Not comparable between runs on other data or noise",
    )
    evaluations: int = 0
    generation: int = 0
    seconds_left: float | None = None


class JobOut(Answer):
    """A job and its state."""

    id: str
    name: str
    state: StateName
    cancel_requested: bool = False
    created_at: datetime
    started_at: datetime | None = None
    finished_at: datetime | None = None
    seconds: float | None = Field(
        default=None,
        description="wall time from the first start to the end, or to now; null while queued",
    )
    attempt: int = Field(description="number of starts, resumptions included")
    error: str | None = None
    model: str
    note: str | None = None
    tags: list[str] = Field(default=[])
    version: str | None = Field(
        default=None, description="version of the program that computed the job, or took it"
    )
    fingerprint: str | None = Field(
        default=None,
        description="digest of the kernels' program: equal ones give results equal bit for bit",
    )
    spec_hash: str | None = Field(default=None, description="digest of the request")
    priority: int
    progress: ProgressOut
    rms_unit: str | None = Field(
        default=None, description="unit of the best RMS; σ for several weighted outputs"
    )
    request: dict[str, Any] | None = None


class ReferenceIn(Body):
    """Acceptance of a run as a reference; `by` and `note` are stored with it."""

    run: str = Field(max_length=100)
    by: str | None = Field(default=None, max_length=200)
    note: str | None = Field(default=None, max_length=2000)


class AcceptanceOut(Answer):
    """One acceptance."""

    run: str
    by: str | None = None
    note: str | None = None
    at: datetime


class ReferenceOut(Answer):
    """Reference: the run in use, its estimates, and earlier acceptances."""

    name: str
    run: str
    job: str
    by: str | None = None
    note: str | None = None
    at: datetime
    tags: list[str] = Field(default=[])
    labels: dict[str, Any] = Field(default={})
    estimates: dict[str, dict[str, float | None]] = Field(default={})
    history: list[AcceptanceOut] = Field(
        default=[], description="the previous acceptances (at most 1,000), latest first"
    )
