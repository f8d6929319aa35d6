"""Wire types of datasets."""

from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from service.core.bodies.derived_bodies import take_setting
from service.core.bodies.value_schemas import describe_value
from service.core.bodies.wire import Answer, Body, DescribedBy, Labels, Page, Seed
from sysid.core.findings import Finding
from sysid.data.noise import Noise, NoisePlace
from sysid.data.records import Hold

MAX_SIMULATED_SAMPLES = 10_000_000

SampleTime = Annotated[float, Field(ge=1e-9, le=1e9)]
"""In s; its bounds keep the longest record finite and the times of its samples distinct."""


class WaveInput(Body):
    """offset + amplitude · cos(omega·t + phase); `omega` in rad/s or `frequency` in Hz."""

    kind: Literal["cosine", "sine"] = Field(description="cosine or sine")
    amplitude: float = Field(default=1.0, description="amplitude, in the input's unit")
    omega: float | None = Field(default=None, ge=0, description="angular frequency, rad/s")
    frequency: float | None = Field(default=None, ge=0, description="frequency, Hz")
    phase: float = Field(default=0.0, description="phase, rad")
    offset: float = Field(default=0.0, description="mean value, in the input's unit")

    @model_validator(mode="after")
    def _check_frequency(self) -> Self:
        if (self.omega is None) == (self.frequency is None):
            raise PydanticCustomError("one_of", "give either 'omega' (rad/s) or 'frequency' (Hz)")
        return self


class StepInput(Body):
    """`offset` before `time` (s), `offset` + `amplitude` from then on."""

    kind: Literal["step"] = Field(description="a step")
    amplitude: float = Field(default=1.0, description="height of the step, in the input's unit")
    time: float = Field(default=0.0, description="time of the step, s")
    offset: float = Field(default=0.0, description="value before the step, in the input's unit")


class BinaryInput(Body):
    """A held random binary signal: ± `amplitude` around `offset`, drawn every `period` (s)."""

    kind: Literal["binary"] = Field(description="a random binary signal")
    amplitude: float = Field(
        default=1.0, description="distance from the offset, in the input's unit"
    )
    period: float = Field(gt=0, description="time between two draws, s")
    offset: float = Field(default=0.0, description="mean value, in the input's unit")
    seed: Seed = Field(default=0, description="seed of the draws")


class ExpressionInput(Body):
    """An expression of ``t`` (s) in the model language, such as ``10*cos(5*t)``."""

    kind: Literal["expression"] = Field(description="an expression")
    expression: str = Field(
        max_length=4000, description="expression of t in s, in the model language"
    )


class DatasetInput(Body):
    """A channel of a stored dataset."""

    kind: Literal["dataset"] = Field(description="a recorded channel")
    dataset: str = Field(description="identifier of a stored dataset")
    channel: str = Field(description="name of the channel")


InputIn = Annotated[
    WaveInput | StepInput | BinaryInput | ExpressionInput | DatasetInput,
    Field(discriminator="kind"),
]


class NoiseIn(Body):
    """Noise added to the measured outputs before fitting, for sensitivity studies."""

    sigma: float = take_setting(Noise, "sigma")
    seed: Seed = take_setting(Noise, "seed")


class PlacedNoiseIn(NoiseIn):
    """Noise added before fitting: to the measured outputs, or inside the plant.

    For noise inside the plant the records are simulated again, from their inputs and true
    `parameters`. It enters where the model's document says (`noise: {plant: …}`).
    """

    place: NoisePlace = take_setting(Noise, "place")
    parameters: dict[str, float] = Field(
        default={}, description="true values of the simulation with noise inside the plant, by name"
    )


class SimulateIn(Body):
    """A dataset simulated from a model or a plant: parameters, inputs, and noise on its outputs.

    The initial value of a state may be given among the parameters as ``x(0)``. A state without an
    initial value in the model starts at zero. A plant has default values for everything that is not
    given:

    - ``actuator``: the vane actuator with stick-slip friction, exact between its events. Its input
      is P_a in Pa. Its parameters are J, F_c, F_max, k_a, k_b, k_c, A_m, B and theta_s in SI units.
    - ``tube``: a pneumatic tube with a regulator before and a volume behind it. Its parameters are
      ``pattern`` (1 or 2, the excitation), length_m, bore_m, volume_m3, temperature and ``gauges``
      (a seed: pressures are read by gauges with noise and 12 bit).
    """

    name: str | None = Field(
        default=None,
        max_length=200,
        description="name of the dataset; by default that of the model or plant",
    )
    model: Any = Field(
        default=None, description="name of a model, `name@version`, or a whole model document"
    )
    plant: Literal["actuator", "tube"] | None = Field(
        default=None, description="reference plant instead of a model"
    )
    parameters: dict[str, float] = Field(
        default={}, description="true values by name, in the units of the model"
    )
    inputs: dict[str, InputIn] = Field(default={}, description="waveform of each input")
    samples: int | None = Field(
        default=None, ge=2, le=MAX_SIMULATED_SAMPLES, description="number of samples"
    )
    sample_time: SampleTime | None = Field(default=None, description="sampling period, s")
    noise: NoiseIn = Field(default=NoiseIn(), description="noise that is added to the outputs")

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if (self.model is None) == (self.plant is None):
            raise PydanticCustomError("one_of", "give either 'model' or 'plant'")
        return self


class DeriveIn(Body):
    """A dataset derived from another by steps; each is an object with one key, the step name."""

    name: str | None = Field(default=None, max_length=200, description="name of the new dataset")
    steps: list[dict[str, Any]] = Field(
        min_length=1,
        max_length=32,
        description="steps in order; each is an object with one key, the name of the step",
    )


class JoinIn(Body):
    """Recordings of several loggers on one clock; each channel keeps its own times."""

    name: str | None = Field(default=None, max_length=200, description="name of the new dataset")
    datasets: list[str] = Field(
        min_length=2, max_length=100, description="ids or names of the recordings"
    )


class ChannelOut(Answer):
    """One channel of a dataset. `sample_time` is null if the sampling is irregular.

    `history_samples` were recorded before `start`, from `history_start` (s) on; delayed inputs read
    them.
    """

    name: str = Field(description="name of the channel")
    unit: str = Field(description="unit of its values; empty if unknown")
    hold: str = Field(description="how it is read between its samples")
    samples: int = Field(description="number of samples")
    start: float = Field(description="time of the first sample, s")
    stop: float = Field(description="time of the last sample, s")
    sample_time: float | None = Field(description="sampling period, s; null if irregular")
    missing: int = Field(description="samples without a value")
    history_samples: int = Field(description="samples before `start`")
    history_start: float | None = Field(
        description="time of the first of them, s; null if there is none"
    )


class SegmentOut(Answer):
    """Part of a recording that is identified as a separate experiment."""

    start: float = Field(description="time of its start, s")
    stop: float = Field(description="time of its end, s")
    origin: float | None = Field(description="time that its own time 0 is, s")
    labels: Labels = Field(description="values of the label columns")


class SubtractedOut(Answer):
    """What `detrend` subtracted from a channel: `value` + `slope`·(t − `time`)."""

    channel: str = Field(description="name of the channel at that step")
    unit: str = Field(description="unit of the value; `slope` is in this unit per second")
    time: float = Field(description="time of the first sample, s")
    value: float = Field(description="value at that time: the mean, or the start of the line")
    slope: float = Field(description="slope of the line; 0 for a mean")


class DatasetDetailsOut(Answer):
    """How a dataset was made: the file, the simulation, or the steps."""

    model_config = ConfigDict(extra="allow")

    source: Any = Field(default=None, description="file that was read, and how")
    steps: list[dict[str, Any]] | None = Field(default=None, description="steps of a derivation")
    subtracted: list[SubtractedOut] | None = Field(
        default=None, description="what the steps `detrend` subtracted, in their order"
    )
    known_before: float | None = Field(
        default=None, description="recorded time before the start, s"
    )
    outages: dict[str, list[tuple[float, float]]] = Field(
        default={},
        description="where a channel may have moved unseen, s: as an input it is cut there",
    )


class DatasetOut(Answer):
    """A stored recording."""

    id: str = Field(description="identifier, `ds_…`")
    name: str = Field(description="name of the dataset")
    kind: str = Field(description="how it was made: upload, simulate or derive")
    sha256: str = Field(description="SHA-256 of the stored MCAP file, in hexadecimal")
    size_bytes: int = Field(description="size of the stored MCAP file, bytes")
    channels: list[ChannelOut] = Field(description="channels of the recording")
    samples: int = Field(description="samples of the longest channel")
    duration: float = Field(description="time from the first to the last sample, s")
    sample_time: float | None = Field(
        description="sampling period of all channels, s; null if irregular"
    )
    started_at: str | None = Field(
        default=None,
        description="time 0 s on the clock that recorded, ISO 8601; without a zone it is local",
    )
    segments: list[SegmentOut] = Field(
        description="parts that are identified as separate experiments"
    )
    warnings: list[str] = Field(description="what was guessed or is doubtful")
    details: Annotated[Any, DescribedBy(DatasetDetailsOut)] = Field(description="how it was made")
    note: str | None = Field(default=None, description="note of a user")
    tags: list[str] = Field(default=[], description="tags of users")
    created_at: datetime = Field(description="time of the upload, UTC")


class DatasetPage(Page[DatasetOut]):
    """Datasets, latest first."""


class SeriesOut(Answer):
    """One line of a plot, with at most the requested number of points."""

    name: str = Field(description="name of the signal")
    unit: str = Field(description="unit of the values")
    times: list[float] = Field(description="times, s")
    values: list[float | None] = Field(description="values, in `unit`; null where there is none")
    samples: int = Field(description="samples before the reduction")


class SignalsOut(Answer):
    """Channels of a dataset, reduced so that extremes stay visible.

    `history` has their samples from before the start of the record.
    """

    id: str = Field(description="identifier of the dataset")
    channels: list[SeriesOut] = Field(description="samples of each channel")
    history: list[SeriesOut] = Field(
        default=[], description="samples from before the start of the record"
    )


class DatasetCheckOut(Answer):
    """What happened to a recording: gaps, stamps, repeated and coarse values, limits and more.

    It is found without a model. An empty list is a sound recording.
    """

    id: str = Field(description="identifier of the dataset")
    findings: Annotated[Any, DescribedBy(list[describe_value(Finding)])] = Field(
        description="what was found, each with its channels and where it is"
    )


class LineageEdgeOut(Answer):
    """`child` was made from `parent`."""

    parent: str = Field(description="identifier of the source")
    child: str = Field(description="identifier of what was made from it")
    relation: str = Field(description="how it was made")


class TombstoneOut(Answer):
    """What is left of a deleted item."""

    id: str = Field(description="identifier of the item")
    name: str = Field(description="name that it had")
    deleted_at: datetime | None = Field(description="time of its deletion, UTC")


class LineageOut(Answer):
    """Everything that a dataset was made from, and everything made from it.

    `deleted` lists the items of the edges that were deleted since.
    """

    id: str = Field(description="identifier of the dataset")
    edges: list[LineageEdgeOut] = Field(description="all steps to it and from it")
    deleted: list[TombstoneOut] = Field(default=[], description="items that were deleted since")


MAX_SERIES_SAMPLES = 1_000_000


class SeriesInput(Body):
    """Samples in the request; before the first and after the last sample the value is constant."""

    kind: Literal["series"] = Field(description="samples in the request")
    times: list[float] = Field(
        min_length=1, max_length=MAX_SERIES_SAMPLES, description="times, s, ascending"
    )
    values: list[float] = Field(
        min_length=1, max_length=MAX_SERIES_SAMPLES, description="values, in the input's unit"
    )
    hold: Hold = Field(default="first", description="how it is read between its samples")

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        times, values = len(self.times), len(self.values)
        if times != values:
            raise PydanticCustomError(
                "lengths",
                "there are {times} times and {values} values; need the same number",
                {"times": times, "values": values},
            )
        return self


RunInputIn = Annotated[
    WaveInput | StepInput | BinaryInput | ExpressionInput | DatasetInput | SeriesInput,
    Field(discriminator="kind"),
]
