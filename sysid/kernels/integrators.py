"""One integration step: recursion, Euler, semi-implicit Euler or Runge-Kutta."""

from dataclasses import dataclass
from typing import Protocol

from sysid.kernels.expression_code import Environment, emit_expression
from sysid.kernels.signals import past_reads
from sysid.kernels.signals.block_signals import HistoryEnvironment, ParameterEnvironment, States
from sysid.kernels.signals.delayed_reads import TimeStep
from sysid.kernels.signals.signal_readers import SignalReaders
from sysid.kernels.vectors import DOUBLE, IrValue, VectorBuilder
from sysid.language.delays import has_varying_delay
from sysid.language.tree import Expression, PastValue, Symbol
from sysid.models.model import Model


@dataclass(frozen=True, slots=True)
class StepEnvironment(Environment):
    """Meaning of names at `half_steps` half steps after the last finished step.

    `values` are the states there. `equation` is the number of the equation being emitted, because
    the semi-implicit method reads some states at the end of the step. It is -1 for outputs.
    """

    lanes: VectorBuilder
    model: Model
    parameters: ParameterEnvironment
    states: States
    signals: SignalReaders
    time_step: TimeStep
    half_steps: int
    values: dict[str, IrValue]
    equation: int = 0

    def emit_symbol(self, symbol: Symbol) -> IrValue:
        """Emit a parameter, the sampling period, the sample number or the time."""
        if symbol.kind in ("parameter", "period"):
            return self.parameters.emit_symbol(symbol)
        steps = self.lanes.builder.sitofp(self.time_step.index, DOUBLE)
        if self.half_steps:
            steps = self.lanes.add(steps, self.lanes.make_number(self.half_steps / 2))
        if symbol.kind == "index":
            return steps
        return self.lanes.mul(steps, self.parameters.period)

    def emit_past_value(self, past: PastValue) -> IrValue:
        """Emit a state or an input, now or in the past."""
        if past.kind == "input":
            return self._emit_input(past)
        if past.delay is None and past.offset == 0:
            return self.values[past.name]
        number = self.states.names.index(past.name)
        position = self.half_steps
        if self.is_in_equation:
            position = past_reads.find_state_position(self.model, position, self.equation, number)
        halves = position - 2 * past.offset
        if past.delay is None:
            return self._emit_sample(past.name, -halves // 2)
        now = self.states.now[past.name]
        reader = self.signals.get_reader(past, halves)
        value = reader.read_value(halves, now, self.values.get(past.name, now))
        history = self.model.find_history(past.name)
        return value if history is None else self._emit_history(past, halves, history, value)

    def _emit_history(
        self, past: PastValue, halves: int, history: Expression, value: IrValue
    ) -> IrValue:
        """Emit a delayed state: its history function before the start, else `value`."""
        lanes, delay = self.lanes, self.signals.get_state_delay(past)
        steps = lanes.builder.sitofp(self.time_step.index, DOUBLE)
        position = lanes.add(steps, lanes.make_number(halves / 2))
        is_before = lanes.compare("<", position, delay)

        def emit_before() -> list[IrValue]:
            time = lanes.mul(lanes.sub(position, delay), self.parameters.period)
            scope = HistoryEnvironment(self.parameters.values, self.parameters.period, time)
            return [lanes.select(is_before, emit_expression(lanes, history, scope), value)]

        return lanes.branch(lanes.test_any(is_before), emit_before, [value])[0]

    @property
    def is_in_equation(self) -> bool:
        """Whether an equation is emitted; an output is evaluated at a finished step."""
        return self.equation >= 0

    def _emit_sample(self, name: str, back: int) -> IrValue:
        if back > past_reads.MAX_REGISTER_OFFSET:
            return self.states.load_far_sample(name, back, self.time_step.row)
        return self.states.now[name] if back == 0 else self.states.line[name][back]

    def _emit_input(self, past: PastValue) -> IrValue:
        halves = self.half_steps - 2 * past.offset
        if past.delay is None:
            return self.signals.load_input(past.name, halves, self.time_step.index)
        if has_varying_delay(past):
            return self.signals.read_varying_input(past, halves, self.time_step, self)
        zero = self.lanes.make_number(0.0)
        return self.signals.get_reader(past, halves).read_value(halves, zero, zero)


class EnvironmentBuilder(Protocol):
    """Function that builds the environment at a position, from the states' values there."""

    def __call__(
        self, halves: int, values: dict[str, IrValue], equation: int = 0
    ) -> StepEnvironment:
        """Build the environment."""


def emit_next_states(
    lanes: VectorBuilder,
    model: Model,
    step: IrValue,
    states: States,
    build_environment: EnvironmentBuilder,
) -> dict[str, IrValue]:
    """Emit the states one step later."""
    if past_reads.is_difference(model):
        return _emit_recursion(lanes, model, build_environment)
    if model.solver.method == "rk4":
        return _emit_runge_kutta(lanes, model, step, states, build_environment)
    return _emit_euler(lanes, model, step, states, build_environment)


def _emit_recursion(
    lanes: VectorBuilder, model: Model, build_environment: EnvironmentBuilder
) -> dict[str, IrValue]:
    """Emit x(k) = f(x(k-1), …), in the order of the equations' dependencies."""
    values: dict[str, IrValue] = {}
    for i in model.order:
        result = emit_expression(lanes, model.equations[i], build_environment(2, values, i))
        values[model.states[i].name] = lanes.splat(result)
    return values


def _emit_euler(
    lanes: VectorBuilder,
    model: Model,
    step: IrValue,
    states: States,
    build_environment: EnvironmentBuilder,
) -> dict[str, IrValue]:
    """Emit Euler's x + h f(x); semi-implicit: each f uses the states already updated."""
    semi_implicit = model.solver.method == "semi-implicit"
    values, updated = dict(states.now), {}
    for i, (state, equation) in enumerate(zip(model.states, model.equations, strict=True)):
        slope = emit_expression(lanes, equation, build_environment(0, values, i))
        updated[state.name] = lanes.add(states.now[state.name], lanes.mul(step, slope))
        if semi_implicit:
            values[state.name] = updated[state.name]
    return updated


def _emit_runge_kutta(
    lanes: VectorBuilder,
    model: Model,
    step: IrValue,
    states: States,
    build_environment: EnvironmentBuilder,
) -> dict[str, IrValue]:
    """Emit the classical Runge-Kutta method of order four."""
    half = lanes.mul(step, lanes.make_number(0.5))

    def emit_slopes(halves: int, values: dict[str, IrValue]) -> dict[str, IrValue]:
        return {
            state.name: emit_expression(lanes, equation, build_environment(halves, values, i))
            for i, (state, equation) in enumerate(zip(model.states, model.equations, strict=True))
        }

    def shift_states(width: IrValue, slope: dict[str, IrValue]) -> dict[str, IrValue]:
        return {n: lanes.add(x, lanes.mul(width, slope[n])) for n, x in states.now.items()}

    first = emit_slopes(0, dict(states.now))
    states.first_rises = {n: lanes.mul(step, first[n]) for n in states.with_rises}
    second = emit_slopes(1, shift_states(half, first))
    third = emit_slopes(1, shift_states(half, second))
    fourth = emit_slopes(2, shift_states(step, third))
    states.last_rises = {n: lanes.mul(step, fourth[n]) for n in states.with_rises}
    two = lanes.make_number(2.0)
    mean = {
        n: lanes.add(lanes.add(first[n], fourth[n]), lanes.mul(two, lanes.add(second[n], third[n])))
        for n in states.names
    }
    return shift_states(lanes.mul(step, lanes.make_number(1.0 / 6.0)), mean)
