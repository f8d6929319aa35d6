"""What is sent and told about datasets."""

from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from service.core.wire import Answer, Body, NoiseIn, Seed
from sysid.data.records import Hold

MAX_SIMULATED_SAMPLES = 10_000_000

SampleTime = Annotated[float, Field(ge=1e-9, le=1e9)]
"""In s; the longest record then lasts a finite time, and no two of its samples share one."""


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
    """A dataset made from a model or a plant: parameters, inputs, the noise on its outputs.

    A state's start may be given among the parameters as ``x(0)``; a state that the model does not
    start itself starts at zero. A plant has values of its own for all that is not given:

    - ``actuator``: the vane actuator with stick-slip friction, exact between its events; input P_a
      in Pa, parameters J, F_c, F_max, k_a, k_b, k_c, A_m, B, theta_s in SI units.
    - ``tube``: a pneumatic tube with a regulator before and a volume behind it; parameters
      ``pattern`` (1 or 2, the excitation), length_m, bore_m, volume_m3, temperature, and
      ``gauges`` (a seed: the pressures as gauges with noise and 12 bit tell them).
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
    """A dataset made from another by steps, each an object with one key: the step's name."""

    name: str | None = Field(default=None, max_length=200)
    steps: list[dict[str, Any]] = Field(min_length=1, max_length=32)


class ChannelOut(Answer):
    """One channel of a dataset. `sample_time` is None where the sampling is irregular.

    `history_samples` were recorded before `start`, from `history_start` (s) on: lags read them.
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
    segments: list[dict[str, Any]]
    warnings: list[str]
    details: dict[str, Any]
    created_at: datetime


class SeriesOut(Answer):
    """One line of a plot: at most as many points as were asked for."""

    name: str
    unit: str
    times: list[float]
    values: list[float | None]
    samples: int


class SignalsOut(Answer):
    """Channels of a dataset, reduced so that extremes stay visible.

    `history` has what is known of them from before their first samples.
    """

    id: str
    channels: list[SeriesOut]
    history: list[SeriesOut] = Field(default=[])


class LineageEdgeOut(Answer):
    """`child` was made from `parent`."""

    parent: str
    child: str
    relation: str


class LineageOut(Answer):
    """Everything a dataset was made from and everything made from it."""

    id: str
    edges: list[LineageEdgeOut]


MAX_SERIES_SAMPLES = 1_000_000


class SeriesInput(Body):
    """Samples given in the request; before the first and after the last they keep their values."""

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
                "there are {times} times and {values} values; need as many",
                {"times": times, "values": values},
            )
        return self


RunInputIn = Annotated[
    WaveInput | StepInput | BinaryInput | ExpressionInput | DatasetInput | SeriesInput,
    Field(discriminator="kind"),
]
