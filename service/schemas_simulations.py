"""What is sent and told when an identified model is simulated."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from service.schemas import Answer, Body
from service.schemas_datasets import (
    BinaryInput,
    DatasetInput,
    DatasetOut,
    ExpressionInput,
    SampleTime,
    Series,
    StepInput,
    Wave,
)

MAX_SIMULATED = 1_000_000


class SeriesInput(Body):
    """Samples given in the request; before the first and after the last they keep their values."""

    kind: Literal["series"]
    times: list[float] = Field(min_length=1, max_length=MAX_SIMULATED)
    values: list[float] = Field(min_length=1, max_length=MAX_SIMULATED)
    hold: Literal["zero", "first", "band-limited"] = "first"

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        times, values = len(self.times), len(self.values)
        if times != values:
            raise PydanticCustomError(
                "lengths", "there are {times} times and {values} values; need as many",
                {"times": times, "values": values},
            )  # fmt: skip
        return self


RunInputIn = Annotated[
    Wave | StepInput | BinaryInput | ExpressionInput | DatasetInput | SeriesInput,
    Field(discriminator="kind"),
]


class TransportIn(Body):
    """gain · e^(-delay s) / (time_constant s + 1) between controller and plant; times in s."""

    gain: float = 1.0
    time_constant: float = Field(default=0.0, ge=0)
    delay: float = Field(default=0.0, ge=0)


class ControlIn(Body):
    """Proportional control: `input` := ± `limit` at most of `gain` · (`reference` - `output`)."""

    input: str
    output: str
    gain: float
    limit: float | None = Field(default=None, gt=0)
    transport: TransportIn | None = None
    reference: RunInputIn


class RunSimulateIn(Body):
    """A run's model on new inputs or in a closed loop, from t = 0 on.

    `parameters` replace what was identified; a state's start may be given as ``x(0)``, and one
    that the model does not start itself starts at zero. `sample_time` is that of the run's first
    dataset if it is not given.
    """

    inputs: dict[str, RunInputIn] = Field(default={})
    control: ControlIn | None = None
    parameters: dict[str, float] = Field(default={})
    samples: int = Field(ge=2, le=MAX_SIMULATED)
    sample_time: SampleTime | None = None
    store: bool = False
    name: str | None = Field(default=None, max_length=200)


class StepMetricsOut(Answer):
    """What the response to a step of the reference is judged by; null where it never happens.

    `settling_time` is when the output last enters `band` (2 % of the step) around its mean over
    the last tenth of the record (`final_value`), and null where `is_settled` is false: it leaves
    the band in that tenth still. `steady_error` is the reference minus that mean.
    `overshoot_percent` is told of the reference, `overshoot_of_final_percent` and `rise_time`
    (10 to 90 %) of the way from where the output stood to that mean. Of a loop that `runs_away`,
    which leaves the reference farther and farther behind, none of these is told.
    """

    output: str
    unit: str
    rise_time: float | None
    overshoot_percent: float | None
    overshoot_of_final_percent: float | None
    settling_time: float | None
    band: float
    steady_error: float | None
    final_value: float | None
    runs_away: bool = False
    is_settled: bool = True


class RunSimulationOut(Answer):
    """What a run's model does: signals reduced so that extremes stay visible."""

    id: str
    parameters: dict[str, float]
    outputs: list[Series]
    inputs: list[Series]
    reference: Series | None = None
    command: Series | None = None
    metrics: StepMetricsOut | None = None
    notes: list[str] = Field(default=[])
    dataset: DatasetOut | None = None
