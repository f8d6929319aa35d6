"""The signals of one block of individuals: states in registers and history, inputs, lags.

What a kernel knows of the experiment it simulates: the numbers of its head, once loaded.
"""

from dataclasses import dataclass

from sysid.kernels import reads as demand
from sysid.kernels.delayed_reads import (
    FreshReader,
    History,
    InputReader,
    LinearReader,
    Reader,
    Turn,
)
from sysid.kernels.expressions import Scope, emit
from sysid.kernels.layout import HEAD, INPUT, NUMBERS, OUTPUT, STATE, Layout
from sysid.kernels.vectors import DOUBLE, Lanes, Loop, Value
from sysid.language.tree import Expression, Past, Symbol
from sysid.models.model import Model


class Experiment:
    """The head of an experiment's numbers, loaded where it is made: at the kernel's entry."""

    def __init__(self, lanes: Lanes, layout: Layout, ints: Value, floats: Value) -> None:
        self.ints, self.floats = ints, floats
        self._head = {name: lanes.load_int(ints, lanes.integer(i)) for i, name in enumerate(HEAD)}
        self._numbers = {
            name: lanes.load(floats, lanes.integer(i)) for i, name in enumerate(NUMBERS)
        }
        self._states = [
            {f: lanes.load_int(ints, lanes.integer(layout.state(i, f))) for f in STATE}
            for i in range(layout.states)
        ]
        self._inputs = [
            {f: lanes.load_int(ints, lanes.integer(layout.input(i, f))) for f in INPUT}
            for i in range(layout.inputs)
        ]
        self._outputs = [
            {f: lanes.load_int(ints, lanes.integer(layout.output(i, f))) for f in OUTPUT}
            for i in range(layout.outputs)
        ]
        self.initial = [
            lanes.load(floats, lanes.integer(layout.initial(i))) for i in range(layout.states)
        ]

    def head(self, field: str) -> Value:
        """A number of the experiment as a whole."""
        return self._head[field]

    def number(self, field: str) -> Value:
        """A real number of the experiment as a whole."""
        return self._numbers[field]

    def state(self, i: int, field: str) -> Value:
        """A number of the i-th state."""
        return self._states[i][field]

    def input(self, i: int, field: str) -> Value:
        """A number of the i-th input."""
        return self._inputs[i][field]

    def output(self, i: int, field: str) -> Value:
        """A number of the i-th output."""
        return self._outputs[i][field]


@dataclass(frozen=True, slots=True)
class Parameters(Scope):
    """The scope of a lag: parameters and the sampling period."""

    values: dict[str, Value]
    period: Value

    def symbol(self, symbol: Symbol) -> Value:
        """Value of a parameter, or h."""
        return self.values[symbol.name] if symbol.kind == "parameter" else self.period

    def past(self, past: Past) -> Value:
        """Never asked: the language allows no signals in a lag."""
        raise AssertionError(f"a lag holds no signal such as {past.name}")


class Lags:
    """Lags in integration steps, each expression written once."""

    def __init__(self, lanes: Lanes, model: Model, scope: Parameters, step: Value) -> None:
        self._lanes, self._model, self._scope, self._step = lanes, model, scope, step
        self._known: dict[Expression, Value] = {}

    def steps(self, lag: Expression) -> Value:
        """The lag in steps; to the nearest whole one where the model asks for that."""
        if lag not in self._known:
            lanes = self._lanes
            value = lanes.splat(emit(lanes, lag, self._scope))
            if not demand.is_difference(self._model):
                value = lanes.div(value, self._step)
            if self._model.solver.interpolation == "nearest":
                value = lanes.intrinsic("floor", lanes.add(value, lanes.number(0.5)))
            self._known[lag] = value
        return self._known[lag]


class States:
    """The states: their last samples in registers, and in the history where lags need it."""

    def __init__(
        self, lanes: Lanes, model: Model, experiment: Experiment, work: Value, start: list[Value]
    ) -> None:
        self._lanes, self._model = lanes, model
        self.names = [state.name for state in model.states]
        self.now = dict(zip(self.names, (lanes.splat(v) for v in start), strict=True))
        zero = model.solver.history == "zero"
        self._before = {
            n: lanes.splat(lanes.number(0.0)) if zero else v for n, v in self.now.items()
        }
        self._reach, self._rows = experiment.head("reach"), experiment.head("rows")
        size = lanes.builder.mul(self._rows, lanes.integer(lanes.width))
        self._histories = {
            name: History(
                lanes.builder.gep(
                    work, [lanes.builder.mul(size, lanes.integer(i))], source_etype=DOUBLE
                )
            )
            for i, name in enumerate(demand.with_history(model))
        }
        self.line: dict[str, list[Value]] = {}

    def history(self, name: str) -> History:
        """Where the past of a state is kept."""
        return self._histories[name]

    def fill_history(self) -> Value:
        """Write what was before the start and the start itself; gives the row of the start."""
        lanes, b = self._lanes, self._lanes.builder
        if self._histories:
            loop = Loop(lanes)
            row = loop.carry(lanes.integer(0))
            for name, history in self._histories.items():
                lanes.store_row(
                    self._before[name], history.base, b.mul(row, lanes.integer(lanes.width))
                )
            following = b.add(row, lanes.integer(1))
            loop.update(row, following)
            loop.leave_if(b.icmp_signed(">=", following, self._reach))
            loop.repeat()
            self.store(self._reach)
        return self._reach

    def store(self, row: Value) -> None:
        """Write the present states into a row of the history."""
        index = self._lanes.builder.mul(row, self._lanes.integer(self._lanes.width))
        for name, history in self._histories.items():
            self._lanes.store_row(self.now[name], history.base, index)

    def far(self, name: str, back: int, row: Value) -> Value:
        """A sample a fixed number of steps before the last finished one."""
        b = self._lanes.builder
        index = b.mul(b.sub(row, self._lanes.integer(back)), self._lanes.integer(self._lanes.width))
        return self._lanes.load_row(self._histories[name].base, index)

    def open(self, loop: Loop) -> None:
        """Carry the states, and those before them, through the time loop."""
        for name in self.names:
            first = loop.carry(self.now[name])
            before = self._before[name]
            rest = [loop.carry(before) for _ in range(demand.depth(self._model, name))]
            self.line[name] = [first, *rest]
            self.now[name] = first

    def end(self, loop: Loop, following: dict[str, Value]) -> None:
        """Hand the next states over; `now` may have been replaced by measurements."""
        for name in self.names:
            carried = self.line[name]
            values = [following[name], self.now[name], *carried[1:]]
            for phi, value in zip(carried, values, strict=False):
                loop.update(phi, value)
        self.now = following

    def end_row(self, row: Value) -> Value:
        """Row of the next step: one further, or, at the end of the buffer, back at its front."""
        lanes, b = self._lanes, self._lanes.builder
        following = b.add(row, lanes.integer(1))
        if not self._histories:
            return following
        self.store(following)

        def slide() -> list[Value]:
            first = b.sub(following, self._reach)
            size = b.mul(b.add(self._reach, lanes.integer(1)), lanes.integer(lanes.width))
            source = b.mul(first, lanes.integer(lanes.width))
            for history in self._histories.values():
                lanes.copy_rows(history.base, lanes.integer(0), source, size)
            return [self._reach]

        is_last = b.icmp_signed("==", following, b.sub(self._rows, lanes.integer(1)))
        return lanes.branch(is_last, slide, [following])[0]


class Signals:
    """Readers of all lagged signals of a model, and the inputs without lag."""

    def __init__(
        self, lanes: Lanes, model: Model, experiment: Experiment, states: States, lags: Lags,
        fresh: bool,
    ) -> None:  # fmt: skip
        self._lanes, self._model, self._experiment = lanes, model, experiment
        self._inputs = {quantity.name: i for i, quantity in enumerate(model.inputs)}
        self._readers: dict[tuple[str, Expression, int], Reader] = {}
        self._owners: list[tuple[str, Reader]] = []
        cubic = model.solver.interpolation == "cubic"
        for past, places in _lagged(model, "state").items():
            lag = lanes.clamped(lags.steps(past[1]), experiment.number("cap"))
            history = states.history(past[0])
            if fresh or cubic:
                self._add(past, places, FreshReader(lanes, history, lag, cubic))
                continue
            for chain in _state_chains(places):
                reader = LinearReader(lanes, history, lag, chain, experiment.head("reach"))
                served = places if chain[0] > 0 else set()
                self._add(past, {*chain, *(p for p in served if p > 0)}, reader)
        for past, places in _lagged(model, "input").items():
            for chain in demand.chains(places):
                self._add(past, {*chain}, self._input_reader(past[0], lags.steps(past[1]), chain))

    def _add(self, past: tuple[str, Expression], places: set[int], reader: Reader) -> None:
        for place in places:
            self._readers[*past, place] = reader
        self._owners.append((past[0], reader))

    def _input_reader(self, name: str, lag: Value, chain: list[int]) -> InputReader:
        lanes, number, experiment = self._lanes, self._inputs[name], self._experiment
        points = experiment.input(number, "points")
        fine = lanes.mul(lag, lanes.builder.sitofp(points, DOUBLE))
        cap = lanes.builder.sitofp(experiment.input(number, "cap"), DOUBLE)
        zero = self._zero(number)
        return InputReader(lanes, experiment.floats, zero, points, lanes.clamped(fine, cap), chain)

    def _zero(self, number: int) -> Value:
        """Place of the input at step 0; difference equations read just behind a jump."""
        zero = self._experiment.input(number, "zero")
        if not demand.is_difference(self._model):
            return zero
        return self._lanes.builder.add(zero, self._experiment.input(number, "begin"))

    def reader(self, past: Past, halves: int) -> Reader:
        """Who reads that lagged signal at that place."""
        if past.lag is None:
            raise AssertionError(f"{past.name} is read without lag")
        return self._readers[past.name, past.lag, halves]

    def input(self, name: str, halves: int, step: Value) -> Value:
        """An input without lag: the same for all individuals."""
        b, lanes, number = self._lanes.builder, self._lanes, self._inputs[name]
        points = self._experiment.input(number, "points")
        start = b.add(self._zero(number), b.mul(step, points))
        if demand.is_difference(self._model):
            shift = b.mul(points, lanes.integer(halves // 2))
        elif halves == 1:
            shift = b.ashr(points, lanes.integer(1))
        else:
            shift = self._experiment.input(number, "end" if halves == 2 else "begin")
        return lanes.load(self._experiment.floats, b.add(start, shift))

    def open(self, loop: Loop) -> None:
        """Begin the time loop."""
        for _, reader in self._owners:
            reader.open(loop)

    def begin(self, turn: Turn) -> None:
        """Begin one turn of it."""
        for _, reader in self._owners:
            reader.begin(turn)

    def end(self, loop: Loop, following: dict[str, Value]) -> None:
        """End one turn of it."""
        for name, reader in self._owners:
            reader.end(loop, following.get(name, self._lanes.number(0.0)))


def _lagged(model: Model, kind: str) -> dict[tuple[str, Expression], set[int]]:
    places: dict[tuple[str, Expression], set[int]] = {}
    for read in demand.reads(model):
        if read.past.kind == kind and read.past.lag is not None:
            places.setdefault((read.past.name, read.past.lag), set()).add(read.halves)
    return places


def _state_chains(places: set[int]) -> list[list[int]]:
    """Chains of whole steps; a reader that looks into the present step holds its start too."""
    forward = {0, 2} if any(place > 0 for place in places) else set()
    return demand.chains({place for place in places if place % 2 == 0} | forward)
