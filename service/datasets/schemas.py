"""Wire types of datasets."""

from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from service.core.wire import Answer, Body, NoiseIn, Seed
from sysid.data.records import Hold

MAX_SIMULATED_SAMPLES = 10_000_000

SampleTime = Annotated[float, Field(ge=1e-9, le=1e9)]
"""In s; its bounds keep the longest record finite and the times of its samples distinct."""


class WaveInput(Body):
    """offset + amplitude · cos(omega·t + phase); `omega` in rad/s or `frequency` in Hz."""

    kind: Literal["cosine", "sine"]
    amplitude: float = 1.0
    omega: float | None = Field(default=None, ge=0)
    frequency: float | None = Field(default=None, ge=0)
    phase: float = 0.0
    offset: float = 0.0

    @model_validator(mode="after")
    def _check_frequency(self) -> Self:
        if (self.omega is None) == (self.frequency is None):
            raise PydanticCustomError("one_of", "give either 'omega' (rad/s) or 'frequency' (Hz)")
        return self


class StepInput(Body):
    """`offset` before `time` (s), `offset` + `amplitude` from then on."""

    kind: Literal["step"]
    amplitude: float = 1.0
    time: float = 0.0
    offset: float = 0.0


class BinaryInput(Body):
    """A held random binary signal: ± `amplitude` around `offset`, drawn every `period` (s)."""

    kind: Literal["binary"]
    amplitude: float = 1.0
    period: float = Field(gt=0)
    offset: float = 0.0
    seed: Seed = 0


class ExpressionInput(Body):
    """An expression of ``t`` (s) in the model language, such as ``10*cos(5*t)``."""

    kind: Literal["expression"]
    expression: str = Field(max_length=4000)


class DatasetInput(Body):
    """A channel of a stored dataset."""

    kind: Literal["dataset"]
    dataset: str
    channel: str


InputIn = Annotated[
    WaveInput | StepInput | BinaryInput | ExpressionInput | DatasetInput,
    Field(discriminator="kind"),
]


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

    name: str | None = Field(default=None, max_length=200)
    model: Any = None
    plant: Literal["actuator", "tube"] | None = None
    parameters: dict[str, float] = Field(default={})
    inputs: dict[str, InputIn] = Field(default={})
    samples: int | None = Field(default=None, ge=2, le=MAX_SIMULATED_SAMPLES)
    sample_time: SampleTime | None = None
    noise: NoiseIn = NoiseIn()

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if (self.model is None) == (self.plant is None):
            raise PydanticCustomError("one_of", "give either 'model' or 'plant'")
        return self


class DeriveIn(Body):
    """A dataset derived from another by steps; each is an object with one key, the step name."""

    name: str | None = Field(default=None, max_length=200)
    steps: list[dict[str, Any]] = Field(min_length=1, max_length=32)


class ChannelOut(Answer):
    """One channel of a dataset. `sample_time` is null if the sampling is irregular.

    `history_samples` were recorded before `start`, from `history_start` (s) on; delayed inputs read
    them.
    """

    name: str
    unit: str
    hold: str
    samples: int
    start: float
    stop: float
    sample_time: float | None
    missing: int
    history_samples: int
    history_start: float | None


class DatasetOut(Answer):
    """A stored recording."""

    id: str
    name: str
    kind: str
    sha256: str
    size_bytes: int
    channels: list[ChannelOut]
    samples: int
    duration: float
    sample_time: float | None
    started_at: str | None = Field(
        default=None,
        description="time 0 s on the clock that recorded, ISO 8601; without a zone it is local",
    )
    segments: list[dict[str, Any]]
    warnings: list[str]
    details: dict[str, Any]
    note: str | None = None
    tags: list[str] = Field(default=[])
    created_at: datetime


class SeriesOut(Answer):
    """One line of a plot, with at most the requested number of points."""

    name: str
    unit: str
    times: list[float]
    values: list[float | None]
    samples: int


class SignalsOut(Answer):
    """Channels of a dataset, reduced so that extremes stay visible.

    `history` has their samples from before the start of the record.
    """

    id: str
    channels: list[SeriesOut]
    history: list[SeriesOut] = Field(default=[])


class LineageEdgeOut(Answer):
    """`child` was made from `parent`."""

    parent: str
    child: str
    relation: str


class TombstoneOut(Answer):
    """What is left of a deleted item."""

    id: str
    name: str
    deleted_at: datetime | None


class LineageOut(Answer):
    """Everything that a dataset was made from, and everything made from it.

    `deleted` lists the items of the edges that were deleted since.
    """

    id: str
    edges: list[LineageEdgeOut]
    deleted: list[TombstoneOut] = Field(default=[])


MAX_SERIES_SAMPLES = 1_000_000


class SeriesInput(Body):
    """Samples in the request; before the first and after the last sample the value is constant."""

    kind: Literal["series"]
    times: list[float] = Field(min_length=1, max_length=MAX_SERIES_SAMPLES)
    values: list[float] = Field(min_length=1, max_length=MAX_SERIES_SAMPLES)
    hold: Hold = "first"

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
