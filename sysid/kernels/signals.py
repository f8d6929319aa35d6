"""Signals of one block of individuals: experiment head, states, inputs and delays."""

from dataclasses import dataclass

from sysid.kernels import reads
from sysid.kernels.delayed_reads import (
    DelayedReader,
    DirectReader,
    InputReader,
    LinearReader,
    StateHistory,
    TimeStep,
)
from sysid.kernels.expressions import Environment, emit_expression
from sysid.kernels.layout import (
    FLOAT_FIELDS,
    HEAD_FIELDS,
    INPUT_FIELDS,
    OUTPUT_FIELDS,
    STATE_FIELDS,
    ExperimentLayout,
)
from sysid.kernels.vectors import DOUBLE, IrValue, KernelLoop, VectorBuilder
from sysid.language.tree import Expression, PastValue, Symbol
from sysid.models.model import Model


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
    """Environment of an initial value: parameters and the inputs' values at the start."""

    first_inputs: dict[str, IrValue]

    def emit_past_value(self, past: PastValue) -> IrValue:
        """Emit the value of an input at the start."""
        return self.first_inputs[past.name]


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
            lanes = self._lanes
            value = lanes.splat(emit_expression(lanes, delay, self._scope))
            if not reads.is_difference(self._model):
                value = lanes.div(value, self._step)
            if self._model.solver.interpolation == "nearest":
                value = lanes.call_intrinsic("floor", lanes.add(value, lanes.make_number(0.5)))
            self._steps[delay] = value
        return self._steps[delay]


class States:
    """States: their last samples in registers, and the history if delays need it."""

    def __init__(
        self,
        lanes: VectorBuilder,
        model: Model,
        experiment: ExperimentHead,
        work: IrValue,
        start: list[IrValue],
    ) -> None:
        self._lanes, self._model = lanes, model
        self.names = [state.name for state in model.states]
        self.now = dict(zip(self.names, (lanes.splat(v) for v in start), strict=True))
        zero = model.solver.history == "zero"
        self._before = {
            n: lanes.splat(lanes.make_number(0.0)) if zero else v for n, v in self.now.items()
        }
        self._reach, self._rows = experiment.get_head("reach"), experiment.get_head("rows")
        size = lanes.builder.mul(self._rows, lanes.make_integer(lanes.width))
        self._histories = {
            name: StateHistory(
                lanes.builder.gep(
                    work, [lanes.builder.mul(size, lanes.make_integer(i))], source_etype=DOUBLE
                )
            )
            for i, name in enumerate(reads.list_states_with_history(model))
        }
        self.line: dict[str, list[IrValue]] = {}

    def get_history(self, name: str) -> StateHistory:
        """Return the history of a state."""
        return self._histories[name]

    def fill_history(self) -> IrValue:
        """Store the history before the start and the start itself; return the start's row."""
        lanes, b = self._lanes, self._lanes.builder
        if self._histories:
            loop = KernelLoop(lanes)
            row = loop.carry(lanes.make_integer(0))
            for name, history in self._histories.items():
                lanes.store_row(
                    self._before[name], history.base, b.mul(row, lanes.make_integer(lanes.width))
                )
            following = b.add(row, lanes.make_integer(1))
            loop.update(row, following)
            loop.leave_if(b.icmp_signed(">=", following, self._reach))
            loop.repeat()
            self.store_states(self._reach)
        return self._reach

    def store_states(self, row: IrValue) -> None:
        """Store the present states in a row of the history."""
        index = self._lanes.builder.mul(row, self._lanes.make_integer(self._lanes.width))
        for name, history in self._histories.items():
            self._lanes.store_row(self.now[name], history.base, index)

    def load_far_sample(self, name: str, back: int, row: IrValue) -> IrValue:
        """Load the sample a fixed number of steps before the last finished one."""
        b = self._lanes.builder
        index = b.mul(
            b.sub(row, self._lanes.make_integer(back)), self._lanes.make_integer(self._lanes.width)
        )
        return self._lanes.load_row(self._histories[name].base, index)

    def open_loop(self, loop: KernelLoop) -> None:
        """Carry the states and their earlier samples through the time loop."""
        for name in self.names:
            first = loop.carry(self.now[name])
            before = self._before[name]
            rest = [
                loop.carry(before) for _ in range(reads.count_register_samples(self._model, name))
            ]
            self.line[name] = [first, *rest]
            self.now[name] = first

    def end_step(self, loop: KernelLoop, following: dict[str, IrValue]) -> None:
        """Update the carried states; measurements may have replaced `now`."""
        for name in self.names:
            carried = self.line[name]
            values = [following[name], self.now[name], *carried[1:]]
            for phi, value in zip(carried, values, strict=False):
                loop.update(phi, value)
        self.now = following

    def advance_row(self, row: IrValue) -> IrValue:
        """Advance the row of the history; at the buffer's end, move its last rows to the front."""
        lanes, b = self._lanes, self._lanes.builder
        following = b.add(row, lanes.make_integer(1))
        if not self._histories:
            return following
        self.store_states(following)

        def emit_slide() -> list[IrValue]:
            first = b.sub(following, self._reach)
            size = b.mul(b.add(self._reach, lanes.make_integer(1)), lanes.make_integer(lanes.width))
            source = b.mul(first, lanes.make_integer(lanes.width))
            for history in self._histories.values():
                lanes.copy_rows(history.base, lanes.make_integer(0), source, size)
            return [self._reach]

        is_last = b.icmp_signed("==", following, b.sub(self._rows, lanes.make_integer(1)))
        return lanes.branch(is_last, emit_slide, [following])[0]


class SignalReaders:
    """Readers of all delayed signals of a model, and the inputs without delay."""

    def __init__(
        self,
        lanes: VectorBuilder,
        model: Model,
        experiment: ExperimentHead,
        states: States,
        delays: Delays,
        one_step: bool,
    ) -> None:
        self._lanes, self._model, self._experiment = lanes, model, experiment
        self._inputs = {signal.name: i for i, signal in enumerate(model.inputs)}
        self._readers: dict[tuple[str, Expression, int], DelayedReader] = {}
        self._owners: list[tuple[str, DelayedReader]] = []
        cubic = model.solver.interpolation == "cubic"
        for past, places in _group_delayed_reads(model, "state").items():
            delay = lanes.clamp(delays.to_steps(past[1]), experiment.get_number("cap"))
            history = states.get_history(past[0])
            if one_step or cubic:
                self._add_reader(past, places, DirectReader(lanes, history, delay, cubic))
                continue
            for chain in _group_state_places(places):
                reader = LinearReader(lanes, history, delay, chain, experiment.get_head("reach"))
                served = places if chain[0] > 0 else set()
                self._add_reader(past, {*chain, *(p for p in served if p > 0)}, reader)
        for past, places in _group_delayed_reads(model, "input").items():
            for chain in reads.group_places(places):
                self._add_reader(
                    past,
                    {*chain},
                    self._build_input_reader(past[0], delays.to_steps(past[1]), chain),
                )

    def _add_reader(
        self, past: tuple[str, Expression], places: set[int], reader: DelayedReader
    ) -> None:
        for place in places:
            self._readers[*past, place] = reader
        self._owners.append((past[0], reader))

    def _build_input_reader(self, name: str, delay: IrValue, chain: list[int]) -> InputReader:
        lanes, number, experiment = self._lanes, self._inputs[name], self._experiment
        points = experiment.get_input_field(number, "points")
        fine = lanes.mul(delay, lanes.builder.sitofp(points, DOUBLE))
        cap = lanes.builder.sitofp(experiment.get_input_field(number, "cap"), DOUBLE)
        zero = self._find_input_start(number)
        return InputReader(lanes, experiment.floats, zero, points, lanes.clamp(fine, cap), chain)

    def _find_input_start(self, number: int) -> IrValue:
        """Find the place of an input at step 0; difference equations read just after a jump."""
        zero = self._experiment.get_input_field(number, "zero")
        if not reads.is_difference(self._model):
            return zero
        return self._lanes.builder.add(zero, self._experiment.get_input_field(number, "begin"))

    def get_reader(self, past: PastValue, halves: int) -> DelayedReader:
        """Return the reader of a delayed signal at a place."""
        if past.delay is None:
            raise AssertionError(f"{past.name} is read without delay")
        return self._readers[past.name, past.delay, halves]

    def load_input(self, name: str, halves: int, step: IrValue) -> IrValue:
        """Load an input without delay: the same for all individuals."""
        b, lanes, number = self._lanes.builder, self._lanes, self._inputs[name]
        points = self._experiment.get_input_field(number, "points")
        start = b.add(self._find_input_start(number), b.mul(step, points))
        if reads.is_difference(self._model):
            shift = b.mul(points, lanes.make_integer(halves // 2))
        elif halves == 1:
            shift = b.ashr(points, lanes.make_integer(1))
        else:
            shift = self._experiment.get_input_field(number, "end" if halves == 2 else "begin")
        return lanes.load_double(self._experiment.floats, b.add(start, shift))

    def open_loop(self, loop: KernelLoop) -> None:
        """Open the readers at the head of the time loop."""
        for _, reader in self._owners:
            reader.open_loop(loop)

    def begin_step(self, time_step: TimeStep) -> None:
        """Begin a step of all readers."""
        for _, reader in self._owners:
            reader.begin_step(time_step)

    def end_step(self, loop: KernelLoop, following: dict[str, IrValue]) -> None:
        """End a step of all readers."""
        for name, reader in self._owners:
            reader.end_step(loop, following.get(name, self._lanes.make_number(0.0)))


def _group_delayed_reads(model: Model, kind: str) -> dict[tuple[str, Expression], set[int]]:
    places: dict[tuple[str, Expression], set[int]] = {}
    for read in reads.collect_reads(model):
        if read.past.kind == kind and read.past.delay is not None:
            places.setdefault((read.past.name, read.past.delay), set()).add(read.half_steps)
    return places


def _group_state_places(places: set[int]) -> list[list[int]]:
    """Group whole steps into chains; one that reaches the present step has its start too."""
    forward = {0, 2} if any(place > 0 for place in places) else set()
    return reads.group_places({place for place in places if place % 2 == 0} | forward)
