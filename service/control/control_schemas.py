"""Bodies and answers of simulations of an identified model."""

from pydantic import Field

from service.core.bodies.wire import Answer, Body, Finite
from service.datasets.dataset_schemas import (
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

    gain: float = Field(default=1.0, description="gain of the transport")
    time_constant: float = Field(default=0.0, ge=0, description="time constant, s")
    delay: float = Field(default=0.0, ge=0, description="dead time, s")


class TuningIn(Body):
    """Rule that chooses gain and times of the controller, for linear differential models.

    `closed_loop_time_constant` (τ_c in s) is that of SIMC. By default it is the effective dead
    time. A longer one gives a slower and more robust loop.
    """

    rule: TuningRule = Field(default="simc", description="tuning rule")
    controller: ControllerKind = Field(default="PI", description="kind of the controller")
    closed_loop_time_constant: float | None = Field(
        default=None, gt=0, examples=[0.5], description="time constant of the closed loop (τ_c), s"
    )


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

    input: str = Field(description="input of the model that the controller moves")
    output: str = Field(description="output of the model that it controls")
    gain: float | None = Field(
        default=None, description="gain, in units of the input per unit of the output"
    )
    integral_time: float | None = Field(
        default=None, gt=0, examples=[1.5], description="integral time, s; null: none"
    )
    derivative_time: float = Field(default=0.0, ge=0, description="derivative time, s")
    derivative_filter: float = Field(
        default=10.0, gt=0, description="ratio of the derivative time to that of its filter"
    )
    derivative_on: DerivativeOn = Field(
        default="measurement", description="what the derivative acts on"
    )
    setpoint_weight: float = Field(
        default=1.0, description="weight of the reference in the proportional part"
    )
    limit: float | None = Field(
        default=None, gt=0, description="largest magnitude of the command, in the input's unit"
    )
    lower: float | None = Field(default=None, description="least command, in the input's unit")
    upper: float | None = Field(default=None, description="largest command, in the input's unit")
    anti_windup: AntiWindup = Field(
        default="back-calculation", description="what happens to the integral at a limit"
    )
    tracking_time: float | None = Field(
        default=None, gt=0, description="time that resets the integral at a limit, s"
    )
    tuning: TuningIn | None = Field(default=None, description="rule that chooses gain and times")
    transport: TransportIn | None = Field(
        default=None, description="transfer function between controller and plant"
    )
    reference: RunInputIn = Field(description="waveform of the reference")


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

    inputs: dict[str, RunInputIn] = Field(default={}, description="waveform of each input")
    control: ControlIn | None = Field(
        default=None, examples=[_EXAMPLE_CONTROL], description="controller of a closed loop"
    )
    parameters: dict[str, float] = Field(
        default={}, description="values that replace estimates, in their units"
    )
    samples: int = Field(ge=2, le=MAX_SERIES_SAMPLES, description="number of samples")
    sample_time: SampleTime | None = Field(default=None, description="sampling period, s")
    store: bool = Field(default=False, description="whether the result is stored as a dataset")
    name: str | None = Field(default=None, max_length=200, description="name of that dataset")


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

    output: str = Field(description="controlled output")
    unit: str = Field(description="unit of the output")
    rise_time: Finite = Field(description="time from 10 to 90 % of the change, s")
    overshoot_percent: Finite = Field(description="overshoot over the reference, %")
    overshoot_of_final_percent: Finite = Field(description="overshoot over the final value, %")
    settling_time: Finite = Field(description="time when the output last enters the band, s")
    band: float = Field(description="half width of the band, in `unit`")
    steady_error: Finite = Field(description="reference minus final value, in `unit`")
    final_value: Finite = Field(description="mean of the last tenth of the record, in `unit`")
    runs_away: bool = Field(
        default=False,
        description="whether the output leaves the reference further and further behind",
    )
    is_settled: bool = Field(
        default=True, description="whether the output stays in the band to the end"
    )
    iae: Finite = Field(default=None, description="integral of |e|, in `unit` times s")
    itae: Finite = Field(default=None, description="integral of t |e|, in `unit` times s²")
    swing: Finite = Field(
        default=None, description="sustained oscillation, peak to peak, in `unit`"
    )
    swing_period: Finite = Field(default=None, description="period of that oscillation, s")


class ControllerOut(Answer):
    """Controller as it was used, set by hand or by a rule, and its command.

    Times are in s. `tracking_time` is null without anti-windup. `saturated_percent` is the share of
    samples at a limit.
    """

    gain: float = Field(description="gain, in units of the input per unit of the output")
    integral_time: float | None = Field(description="integral time, s; null without integral")
    derivative_time: float = Field(description="derivative time, s")
    derivative_filter: float = Field(
        description="ratio of the derivative time to that of its filter"
    )
    derivative_on: str = Field(description="what the derivative acts on")
    setpoint_weight: float = Field(description="weight of the reference in the proportional part")
    lower: float | None = Field(description="least command, in the input's unit")
    upper: float | None = Field(description="largest command, in the input's unit")
    tracking_time: float | None = Field(description="time that resets the integral at a limit, s")
    command_min: float = Field(description="least command that occurred, in the input's unit")
    command_max: float = Field(description="largest command that occurred, in the input's unit")
    saturated_percent: float = Field(description="share of the samples at a limit, %")


class TuningOut(Answer):
    """Process that a tuning rule used, and the rule's source.

    The process is gain e^(-delay s)/((time_constant s + 1)(second_time_constant s + 1)). Further
    time constants are included by the half rule. Without `time_constant` the process integrates,
    and `process_gain` is per s.
    """

    rule: str = Field(description="tuning rule")
    controller: str = Field(description="kind of the controller")
    closed_loop_time_constant: float | None = Field(
        description="time constant of the closed loop (τ_c), s"
    )
    process_gain: float = Field(description="gain of the process; per s if it integrates")
    process_delay: float = Field(description="dead time of the process, s")
    process_time_constant: Finite = Field(
        description="time constant of the process, s; null if it integrates"
    )
    process_second_time_constant: float = Field(
        description="second time constant of the process, s"
    )
    formulas: list[str] = Field(description="formulas of the rule with their values")
    reference: str = Field(description="where the rule was published")


class MarginsOut(Answer):
    """Stability and margins of the loop without limits and with exact dead times.

    Null means that there is no such margin. `gain_margin` is a factor; below 1 the loop needs its
    gain to be stable. `phase_margin` is in degrees, `delay_margin` in s, `crossover_frequency` in
    rad/s. `sensitivity_peak` (M_s) is usually 1.2 to 2.
    """

    is_stable: bool = Field(description="whether the loop is stable")
    gain_margin: Finite = Field(description="gain margin, a factor")
    phase_margin: Finite = Field(description="phase margin, degrees")
    delay_margin: Finite = Field(description="delay margin, s")
    crossover_frequency: Finite = Field(description="crossover frequency, rad/s")
    sensitivity_peak: Finite = Field(description="largest sensitivity (M_s)")


class RunSimulationOut(Answer):
    """Simulated signals of a run's model, reduced so that extremes stay visible."""

    id: str = Field(description="identifier of the run")
    parameters: dict[str, float] = Field(description="values of the parameters, in their units")
    outputs: list[SeriesOut] = Field(description="simulated outputs")
    inputs: list[SeriesOut] = Field(description="inputs of the model")
    reference: SeriesOut | None = Field(default=None, description="reference of the loop")
    command: SeriesOut | None = Field(default=None, description="command of the controller")
    metrics: StepMetricsOut | None = Field(default=None, description="metrics of the step response")
    controller: ControllerOut | None = Field(default=None, description="controller that was used")
    tuning: TuningOut | None = Field(
        default=None, description="process and source of the tuning rule"
    )
    margins: MarginsOut | None = Field(default=None, description="stability of the loop")
    notes: list[str] = Field(default=[], description="what was assumed")
    dataset: DatasetOut | None = Field(
        default=None, description="stored result; null if it was not stored"
    )
