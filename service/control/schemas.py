"""Bodies and answers of simulations of an identified model."""

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
    """Transfer function between controller and plant, gain · e^(-delay s) / (time_constant s + 1).

    Times are in s.
    """

    gain: float = 1.0
    time_constant: float = Field(default=0.0, ge=0)
    delay: float = Field(default=0.0, ge=0)


class TuningIn(Body):
    """Rule that chooses gain and times of the controller, for linear differential models.

    `closed_loop_time_constant` (τ_c in s) is that of SIMC. By default it is the effective dead
    time. A longer one gives a slower and more robust loop.
    """

    rule: TuningRule = "simc"
    controller: ControllerKind = "PI"
    closed_loop_time_constant: float | None = Field(default=None, gt=0, examples=[0.5])


class ControlIn(Body):
    """Controller in the standard (ISA) form, with r the `reference` and y the `output`.

    v = gain · (setpoint_weight · r - y + 1/integral_time ∫(r - y) dt + derivative). The `input` is
    v, limited to ± `limit`, or to `lower` … `upper`. Times are in s. Without `integral_time` and
    `derivative_time` it is proportional control.

    The derivative is derivative_time · s/(1 + s · derivative_time/derivative_filter) of -y. With
    `derivative_on` error it acts on r - y. At a limit `tracking_time` resets the integral. Its
    default is √(integral_time · derivative_time), or integral_time without derivative.

    Instead of gain and times, `tuning` names a rule. Around a differential model the controller is
    continuous. Around a recursion it acts once a step.
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


class RunSimulationIn(Body):
    """Simulation of a run's model with new inputs or in a closed loop, from t = 0.

    `parameters` replace estimates. An initial state is given as ``x(0)``. Initial states that the
    model does not fix are zero by default. The default `sample_time` is that of the run's first
    dataset.
    """

    inputs: dict[str, RunInputIn] = Field(default={})
    control: ControlIn | None = Field(default=None, examples=[_EXAMPLE_CONTROL])
    parameters: dict[str, float] = Field(default={})
    samples: int = Field(ge=2, le=MAX_SERIES_SAMPLES)
    sample_time: SampleTime | None = None
    store: bool = False
    name: str | None = Field(default=None, max_length=200)


class StepMetricsOut(Answer):
    """Metrics of a step response; null where the event never happens.

    `settling_time` is when the output last enters `band` (2 % of the step) around `final_value`.
    This is the mean over the last tenth of the record. `is_settled` is false if the output leaves
    the band within that tenth; `settling_time` is then null. `steady_error` is the reference minus
    `final_value`.

    `overshoot_percent` refers to the reference. `overshoot_of_final_percent` and `rise_time` (10 to
    90 %) refer to the change from the initial output to `final_value`. They are null for a loop
    that `runs_away`, that is, leaves the reference further and further behind.

    `iae` and `itae` are ∫|e| dt and ∫t |e| dt of the error e from the step to the end. Their units
    are `unit` times s and s². `swing` (peak to peak) and `swing_period` (s) describe a sustained
    oscillation.
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
    """Controller as it was used, set by hand or by a rule, and its command.

    Times are in s. `tracking_time` is null without anti-windup. `saturated_percent` is the share of
    samples at a limit.
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
    """Process that a tuning rule used, and the rule's source.

    The process is gain e^(-delay s)/((time_constant s + 1)(second_time_constant s + 1)). Further
    time constants are included by the half rule. Without `time_constant` the process integrates,
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
    """Stability and margins of the loop without limits and with exact dead times.

    Null means that there is no such margin. `gain_margin` is a factor; below 1 the loop needs its
    gain to be stable. `phase_margin` is in degrees, `delay_margin` in s, `crossover_frequency` in
    rad/s. `sensitivity_peak` (M_s) is usually 1.2 to 2.
    """

    is_stable: bool
    gain_margin: Finite
    phase_margin: Finite
    delay_margin: Finite
    crossover_frequency: Finite
    sensitivity_peak: Finite


class RunSimulationOut(Answer):
    """Simulated signals of a run's model, reduced so that extremes stay visible."""

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
