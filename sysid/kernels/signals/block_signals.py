"""Signals of one block of individuals: experiment head, states and delays."""

from dataclasses import dataclass
from typing import NamedTuple

from sysid.kernels.expression_code import Environment, emit_expression
from sysid.kernels.layout import (
    FLOAT_FIELDS,
    HEAD_FIELDS,
    INPUT_FIELDS,
    OUTPUT_FIELDS,
    STATE_FIELDS,
    ExperimentLayout,
)
from sysid.kernels.signals import past_reads
from sysid.kernels.signals.delayed_reads import StateHistory
from sysid.kernels.vectors import DOUBLE, IrValue, KernelLoop, VectorBuilder
from sysid.language.tree import Expression, PastValue, Symbol
from sysid.models.model import Model

_WITH_RISES = 3
"""Columns of a history of samples with the rises of the steps that end there."""


class ExperimentHead:
    """Head of an experiment's numbers, loaded at the kernel's entry."""

    def __init__(
        self, lanes: VectorBuilder, layout: ExperimentLayout, ints: IrValue, floats: IrValue
    ) -> None:
        self.ints, self.floats = ints, floats
        self._head = {
            name: lanes.load_integer(ints, lanes.make_integer(i))
            for i, name in enumerate(HEAD_FIELDS)
        }
        self._numbers = {
            name: lanes.load_double(floats, lanes.make_integer(i))
            for i, name in enumerate(FLOAT_FIELDS)
        }
        self._states = [
            {
                f: lanes.load_integer(ints, lanes.make_integer(layout.locate_state(i, f)))
                for f in STATE_FIELDS
            }
            for i in range(layout.states)
        ]
        self._inputs = [
            {
                f: lanes.load_integer(ints, lanes.make_integer(layout.locate_input(i, f)))
                for f in INPUT_FIELDS
            }
            for i in range(layout.inputs)
        ]
        self._outputs = [
            {
                f: lanes.load_integer(ints, lanes.make_integer(layout.locate_output(i, f)))
                for f in OUTPUT_FIELDS
            }
            for i in range(layout.outputs)
        ]
        self.initial = [
            lanes.load_double(floats, lanes.make_integer(layout.locate_initial(i)))
            for i in range(layout.states)
        ]
        self.first_inputs = [
            lanes.load_double(floats, lanes.make_integer(layout.locate_first_input(i)))
            for i in range(layout.inputs)
        ]

    def get_head(self, field: str) -> IrValue:
        """Return a whole number of the experiment."""
        return self._head[field]

    def get_number(self, field: str) -> IrValue:
        """Return a real number of the experiment."""
        return self._numbers[field]

    def get_state_field(self, i: int, field: str) -> IrValue:
        """Return a field of the i-th state."""
        return self._states[i][field]

    def get_input_field(self, i: int, field: str) -> IrValue:
        """Return a field of the i-th input."""
        return self._inputs[i][field]

    def get_output_field(self, i: int, field: str) -> IrValue:
        """Return a field of the i-th output."""
        return self._outputs[i][field]


@dataclass(frozen=True, slots=True)
class ParameterEnvironment(Environment):
    """Environment of a delay: parameters and the sampling period."""

    values: dict[str, IrValue]
    period: IrValue

    def emit_symbol(self, symbol: Symbol) -> IrValue:
        """Emit the value of a parameter, or h."""
        return self.values[symbol.name] if symbol.kind == "parameter" else self.period

    def emit_past_value(self, past: PastValue) -> IrValue:
        """Raise: the language allows no signals in a delay."""
        raise AssertionError(f"a delay contains no signal such as {past.name}")


@dataclass(frozen=True, slots=True)
class StartEnvironment(ParameterEnvironment):
    """Environment of an initial value: parameters, inputs and earlier states at the start."""

    first_values: dict[str, IrValue]

    def emit_past_value(self, past: PastValue) -> IrValue:
        """Emit the value of an input or a state at the start."""
        return self.first_values[past.name]


@dataclass(frozen=True, slots=True)
class HistoryEnvironment(ParameterEnvironment):
    """Environment of a history function: parameters, and a time before the start."""

    time: IrValue

    def emit_symbol(self, symbol: Symbol) -> IrValue:
        """Emit the time, or the value of a parameter."""
        if symbol.kind == "time":
            return self.time
        return ParameterEnvironment.emit_symbol(self, symbol)


class Delays:
    """Delays in integration steps; each expression is emitted once."""

    def __init__(
        self, lanes: VectorBuilder, model: Model, scope: ParameterEnvironment, step: IrValue
    ) -> None:
        self._lanes, self._model, self._scope, self._step = lanes, model, scope, step
        self._steps: dict[Expression, IrValue] = {}

    def to_steps(self, delay: Expression) -> IrValue:
        """Convert a delay to steps, rounded if the model interpolates by ``nearest``."""
        if delay not in self._steps:
            self._steps[delay] = self.to_present_steps(delay, self._scope)
        return self._steps[delay]

    def to_present_steps(self, delay: Expression, scope: Environment) -> IrValue:
        """Convert a delay to steps, with the names as they are at one point of the simulation."""
        lanes = self._lanes
        value = lanes.splat(emit_expression(lanes, delay, scope))
        if not past_reads.is_difference(self._model):
            value = lanes.div(value, self._step)
        if self._model.solver.interpolation == "nearest":
            value = lanes.call_intrinsic("floor", lanes.add(value, lanes.make_number(0.5)))
        return value


class FinishedStep(NamedTuple):
    """Last finished step of a state: its value at the start, and first and last slope times h."""

    start: IrValue
    first_rise: IrValue
    last_rise: IrValue


class States:
    """States: their last samples in registers, and the history if delays need it.

    `first_rises` and `last_rises` are set in a Runge-Kutta step: its first and last slope, times
    the step. They are kept of `with_rises`, the states that are read on cubics.
    """

    def __init__(
        self,
        lanes: VectorBuilder,
        model: Model,
        experiment: ExperimentHead,
        work: IrValue,
        start: list[IrValue],
        scope: ParameterEnvironment,
    ) -> None:
        self._lanes, self._model = lanes, model
        self.names = [state.name for state in model.states]
        self.now = dict(zip(self.names, (lanes.splat(v) for v in start), strict=True))
        zero = model.solver.history == "zero"
        self._before = {
            n: lanes.splat(lanes.make_number(0.0)) if zero else v for n, v in self.now.items()
        }
        for history in model.histories:
            # A cubic through four samples after the start has at most one before it.
            last = lanes.sub(lanes.make_number(0.0), scope.period)
            environment = HistoryEnvironment(scope.values, scope.period, last)
            value = emit_expression(lanes, history.expression, environment)
            self._before[history.state] = lanes.splat(value)
        self._reach, self._rows = experiment.get_head("reach"), experiment.get_head("rows")
        size = lanes.builder.mul(self._rows, lanes.make_integer(lanes.width))
        self._histories: dict[tuple[str, Expression | None], StateHistory] = {}
        first_column = 0
        for stored in past_reads.list_stored_histories(model):
            offset = lanes.builder.mul(size, lanes.make_integer(first_column))
            base = lanes.builder.gep(work, [offset], source_etype=DOUBLE)
            self._histories[stored.state, stored.delay] = StateHistory(base, stored.columns)
            first_column += stored.columns
        self.line: dict[str, list[IrValue]] = {}
        with_rises = self._histories if past_reads.reads_cubics(model) else {}
        self.with_rises = tuple(dict.fromkeys(name for name, _ in with_rises))
        level = lanes.splat(lanes.make_number(0.0))  # slope before the start
        self.first_rises: dict[str, IrValue] = dict.fromkeys(self.with_rises, level)
        self.last_rises: dict[str, IrValue] = dict.fromkeys(self.with_rises, level)
        self._finished = {
            name: FinishedStep(self._before[name], level, level) for name in self.with_rises
        }

    def get_history(self, name: str, delay: Expression | None = None) -> StateHistory:
        """Return the history of a state, or of its reads at a delay."""
        return self._histories[name, delay]

    def get_value_before(self, name: str) -> IrValue:
        """Return the value of a state before the start."""
        return self._before[name]

    def get_finished_step(self, name: str) -> FinishedStep:
        """Return the last finished step of a state that is read on cubics."""
        return self._finished[name]

    def fill_history(self) -> IrValue:
        """Store the history before the start and the start itself; return the start's row."""
        lanes, b = self._lanes, self._lanes.builder
        if self._histories:
            loop = KernelLoop(lanes)
            row = loop.carry(lanes.make_integer(0))
            for (name, _), history in self._histories.items():
                if history.columns == _WITH_RISES:
                    index = b.mul(row, lanes.make_integer(lanes.width))
                    rises = self.first_rises[name], self.last_rises[name]
                    self._store_row(history, index, (self._before[name], *rises))
                    continue
                index = b.mul(row, lanes.make_integer(history.columns * lanes.width))
                values = [self._before[name]] * history.columns
                lanes.store_columns(values, history.base, index)
            following = b.add(row, lanes.make_integer(1))
            loop.update(row, following)
            loop.leave_if(b.icmp_signed(">=", following, self._reach))
            loop.repeat()
            self._store_finished_step(self._reach)
        return self._reach

    def store_states(self, row: IrValue) -> None:
        """Store the present states in a row of their samples."""
        index = self._lanes.builder.mul(row, self._lanes.make_integer(self._lanes.width))
        for (name, delay), history in self._histories.items():
            if delay is None:
                self._store_row(history, index, (self.now[name],))

    def _store_finished_step(self, row: IrValue) -> None:
        """Store the present states, and the rises of the step that ends there."""
        self.store_states(row)
        for (name, _), history in self._histories.items():
            if history.columns == _WITH_RISES:
                index = self._lanes.builder.mul(row, self._lanes.make_integer(self._lanes.width))
                values = self.now[name], self.first_rises[name], self.last_rises[name]
                self._store_row(history, index, values)

    def _store_row(
        self, history: StateHistory, index: IrValue, values: tuple[IrValue, ...]
    ) -> None:
        """Store the first columns of a row, whose index counts rows of one column."""
        b, lanes = self._lanes.builder, self._lanes
        if history.columns > 1:
            index = b.mul(index, lanes.make_integer(history.columns))
        for column, value in enumerate(values):
            place = b.add(index, lanes.make_integer(column * lanes.width)) if column else index
            lanes.store_row(value, history.base, place)

    def load_far_sample(self, name: str, back: int, row: IrValue) -> IrValue:
        """Load the sample a fixed number of steps before the last finished one."""
        b = self._lanes.builder
        index = b.mul(
            b.sub(row, self._lanes.make_integer(back)), self._lanes.make_integer(self._lanes.width)
        )
        return self._lanes.load_row(self.get_history(name).base, index)

    def open_loop(self, loop: KernelLoop) -> None:
        """Carry the states and their earlier samples through the time loop."""
        for name in self.names:
            first = loop.carry(self.now[name])
            before = self._before[name]
            rest = [
                loop.carry(before)
                for _ in range(past_reads.count_register_samples(self._model, name))
            ]
            self.line[name] = [first, *rest]
            self.now[name] = first
        for name, step in self._finished.items():
            self._finished[name] = FinishedStep(*(loop.carry(value) for value in step))

    def end_step(self, loop: KernelLoop, following: dict[str, IrValue]) -> None:
        """Update the carried states; measurements may have replaced `now`."""
        for name in self.names:
            carried = self.line[name]
            values = [following[name], self.now[name], *carried[1:]]
            for phi, value in zip(carried, values, strict=False):
                loop.update(phi, value)
        for name, step in self._finished.items():
            finished = (self.now[name], self.first_rises[name], self.last_rises[name])
            for phi, value in zip(step, finished, strict=True):
                loop.update(phi, self._lanes.splat(value))
        self.now = following

    def advance_row(self, row: IrValue) -> IrValue:
        """Advance the row of the history; at the buffer's end, move its last rows to the front."""
        lanes, b = self._lanes, self._lanes.builder
        following = b.add(row, lanes.make_integer(1))
        if not self._histories:
            return following
        self._store_finished_step(following)

        def emit_slide() -> list[IrValue]:
            first = b.sub(following, self._reach)
            rows = b.add(self._reach, lanes.make_integer(1))
            for history in self._histories.values():
                width = lanes.make_integer(history.columns * lanes.width)
                source, size = b.mul(first, width), b.mul(rows, width)
                lanes.copy_rows(history.base, lanes.make_integer(0), source, size)
            return [self._reach]

        is_last = b.icmp_signed("==", following, b.sub(self._rows, lanes.make_integer(1)))
        return lanes.branch(is_last, emit_slide, [following])[0]
