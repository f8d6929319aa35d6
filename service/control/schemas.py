"""What is sent and told when an identified model is simulated."""

from pydantic import Field

from service.core.wire import Answer, Body, Finite
from service.datasets.schemas import (
    MAX_SERIES_SAMPLES,
    DatasetOut,
    RunInputIn,
    SampleTime,
    SeriesOut,
)
from sysid.control.controllers import AntiWindup, DerivativeOn
from sysid.control.tuning import ControllerKind, TuningRule


class TransportIn(Body):
    """gain · e^(-delay s) / (time_constant s + 1) between controller and plant; times in s."""

    gain: float = 1.0
    time_constant: float = Field(default=0.0, ge=0)
    delay: float = Field(default=0.0, ge=0)


class TuningIn(Body):
    """A rule that chooses gain and times: for linear models in the differential form.

    `closed_loop_time_constant` (τ_c in s) is that of SIMC, the effective dead time if it is not
    given: longer is slower and more robust.
    """

    rule: TuningRule = "simc"
    controller: ControllerKind = "PI"
    closed_loop_time_constant: float | None = Field(default=None, gt=0, examples=[0.5])


class ControlIn(Body):
    """A controller in the standard (ISA) form, r the `reference` and y the `output`.

    v = gain · (setpoint_weight · r - y + 1/integral_time ∫(r - y) dt + derivative), `input` := v
    within ± `limit`, or from `lower` to `upper`. Times in s; without `integral_time` and
    `derivative_time` it is proportional control. The derivative is
    derivative_time · s/(1 + s · derivative_time/derivative_filter) of -y, or of r - y with
    `derivative_on` error. At a limit the integral is led back with `tracking_time`, by default
    √(integral_time · derivative_time), or integral_time without derivative. Instead of gain and
    times give `tuning`. Around a model in the differential form the controller is continuous,
    around a recursion it acts once a step.
    """

    input: str
    output: str
    gain: float | None = None
    integral_time: float | None = Field(default=None, gt=0, examples=[1.5])
    derivative_time: float = Field(default=0.0, ge=0)
    derivative_filter: float = Field(default=10.0, gt=0)
    derivative_on: DerivativeOn = "measurement"
    setpoint_weight: float = 1.0
    limit: float | None = Field(default=None, gt=0)
    lower: float | None = None
    upper: float | None = None
    anti_windup: AntiWindup = "back-calculation"
    tracking_time: float | None = Field(default=None, gt=0)
    tuning: TuningIn | None = None
    transport: TransportIn | None = None
    reference: RunInputIn


_EXAMPLE_CONTROL = {
    "input": "u",
    "output": "y",
    "gain": 0.5,
    "integral_time": 1.0,
    "lower": 0,
    "upper": 0.7,
    "reference": {"kind": "step", "amplitude": 1},
}


class RunSimulateIn(Body):
    """A run's model on new inputs or in a closed loop, from t = 0 on.

    `parameters` replace what was identified; a state's start may be given as ``x(0)``, and one
    that the model does not start itself starts at zero. `sample_time` is that of the run's first
    dataset if it is not given.
    """

    inputs: dict[str, RunInputIn] = Field(default={})
    control: ControlIn | None = Field(default=None, examples=[_EXAMPLE_CONTROL])
    parameters: dict[str, float] = Field(default={})
    samples: int = Field(ge=2, le=MAX_SERIES_SAMPLES)
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
    which leaves the reference farther and farther behind, none of these is told. `iae` and `itae`
    are ∫|e| dt and ∫t |e| dt of the error e from the step to the end, in `unit` times s and s².
    `swing` (peak to peak) and `swing_period` (s) tell of an output that keeps swinging.
    """

    output: str
    unit: str
    rise_time: Finite
    overshoot_percent: Finite
    overshoot_of_final_percent: Finite
    settling_time: Finite
    band: float
    steady_error: Finite
    final_value: Finite
    runs_away: bool = False
    is_settled: bool = True
    iae: Finite = None
    itae: Finite = None
    swing: Finite = None
    swing_period: Finite = None


class ControllerOut(Answer):
    """The controller as it was used, chosen by hand or by a rule, and what it gave.

    Times in s. `tracking_time` is null where nothing winds up; `saturated_percent` of the samples
    are at a limit.
    """

    gain: float
    integral_time: float | None
    derivative_time: float
    derivative_filter: float
    derivative_on: str
    setpoint_weight: float
    lower: float | None
    upper: float | None
    tracking_time: float | None
    command_min: float
    command_max: float
    saturated_percent: float


class TuningOut(Answer):
    """What a tuning rule was given and where it was published.

    The process is gain e^(-delay s)/((time_constant s + 1)(second_time_constant s + 1)), where
    more time constants are halved into these (half rule); without `time_constant` it integrates,
    and `process_gain` is per s.
    """

    rule: str
    controller: str
    closed_loop_time_constant: float | None
    process_gain: float
    process_delay: float
    process_time_constant: Finite
    process_second_time_constant: float
    formulas: list[str]
    reference: str


class MarginsOut(Answer):
    """Stability and margins of the loop without limits, dead times as they are; null: none.

    `gain_margin` is a factor, below 1 of a loop that needs its gain, `phase_margin` in degrees,
    `delay_margin` in s, `crossover_frequency` in rad/s, `sensitivity_peak` (M_s) usually 1.2 to 2.
    """

    is_stable: bool
    gain_margin: Finite
    phase_margin: Finite
    delay_margin: Finite
    crossover_frequency: Finite
    sensitivity_peak: Finite


class RunSimulationOut(Answer):
    """What a run's model does: signals reduced so that extremes stay visible."""

    id: str
    parameters: dict[str, float]
    outputs: list[SeriesOut]
    inputs: list[SeriesOut]
    reference: SeriesOut | None = None
    command: SeriesOut | None = None
    metrics: StepMetricsOut | None = None
    controller: ControllerOut | None = None
    tuning: TuningOut | None = None
    margins: MarginsOut | None = None
    notes: list[str] = Field(default=[])
    dataset: DatasetOut | None = None
