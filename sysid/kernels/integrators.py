"""One integration step: recursion, Euler, semi-implicit Euler or Runge-Kutta.

A step in which an equation switches in time is divided there, for each individual at its own time.
A part of it ends just before the switch, and the next begins just behind it. So the simulated
output is as accurate and as smooth in the time of a switch as the solution is, and differences
include the jump's own term in the sensitivities (Rozenvasser 1967; Hiskens and Pai 2000).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple, Protocol

from sysid.kernels.expression_code import Environment, emit_expression
from sysid.kernels.signals import past_reads
from sysid.kernels.signals.block_signals import HistoryEnvironment, ParameterEnvironment, States
from sysid.kernels.signals.delayed_reads import TimeStep
from sysid.kernels.signals.signal_readers import SignalReaders
from sysid.kernels.vectors import DOUBLE, IrValue, KernelLoop, VectorBuilder
from sysid.language.delays import has_varying_delay
from sysid.language.time_switches import HALVINGS
from sysid.language.tree import Expression, PastValue, Symbol
from sysid.models.model import Model


@dataclass(frozen=True, slots=True)
class StepEnvironment(Environment):
    """Meaning of names at `half_steps` half steps after the last finished step.

    `values` are the states there. `equation` is the number of the equation being emitted, because
    the semi-implicit method reads some states at the end of the step. It is -1 for outputs.

    If the step is divided, `parts` says where half steps of a part lie, in steps for each lane.
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
    parts: Mapping[int, IrValue] | None = None

    def emit_symbol(self, symbol: Symbol) -> IrValue:
        """Emit a parameter, the sampling period, the sample number or the time."""
        if symbol.kind in ("parameter", "period"):
            return self.parameters.emit_symbol(symbol)
        steps = self._emit_position(self.half_steps)
        if symbol.kind == "index":
            return steps
        return self.lanes.mul(steps, self.parameters.period)

    def _emit_position(self, halves: int) -> IrValue:
        """Emit a position in steps from the start of the simulation."""
        steps = self.lanes.builder.sitofp(self.time_step.index, DOUBLE)
        if self.parts is not None:
            return self.lanes.add(steps, self.parts[halves])
        if halves:
            steps = self.lanes.add(steps, self.lanes.make_number(halves / 2))
        return steps

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
        there = self.values.get(past.name, now)
        if self.parts is None:
            value = self.signals.get_reader(past, halves).read_value(halves, now, there)
        else:
            value = self.signals.read_state_part(past, self.parts[halves], now, there)
        history = self.model.find_history(past.name)
        return value if history is None else self._emit_history(past, halves, history, value)

    def _emit_history(
        self, past: PastValue, halves: int, history: Expression, value: IrValue
    ) -> IrValue:
        """Emit a delayed state: its history function before the start, else `value`."""
        lanes, delay = self.lanes, self.signals.get_state_delay(past)
        position = self._emit_position(halves)
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
        if self.parts is not None:
            part = self.parts[halves]
            return self.signals.read_input_part(past, part, self.time_step, self)
        if past.delay is None:
            return self.signals.load_input(past.name, halves, self.time_step.index)
        if has_varying_delay(past):
            return self.signals.read_varying_input(past, halves, self.time_step, self)
        zero = self.lanes.make_number(0.0)
        return self.signals.get_reader(past, halves).read_value(halves, zero, zero)


class EnvironmentBuilder(Protocol):
    """Function that builds the environment at a position, from the states' values there."""

    def __call__(
        self,
        halves: int,
        values: dict[str, IrValue],
        equation: int = 0,
        parts: Mapping[int, IrValue] | None = None,
    ) -> StepEnvironment:
        """Build the environment."""


class StepPart(NamedTuple):
    """A part of an integration step, or the whole of it.

    Attributes
    ----------
    width : IrValue
        In s.
    start : dict of str to IrValue
        States where it begins.
    places : mapping of int to IrValue or None
        Where its half steps lie, in steps; None: it is the whole step.
    """

    width: IrValue
    start: dict[str, IrValue]
    places: Mapping[int, IrValue] | None = None


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
    integration = _Integration(lanes, model, step, states, build_environment)
    whole = integration.emit_part(StepPart(step, dict(states.now)))
    sides = past_reads.list_switch_sides(model)
    return integration.divide_step(sides, whole) if sides else whole


def _emit_recursion(
    lanes: VectorBuilder, model: Model, build_environment: EnvironmentBuilder
) -> dict[str, IrValue]:
    """Emit x(k) = f(x(k-1), …), in the order of the equations' dependencies."""
    values: dict[str, IrValue] = {}
    for i in model.order:
        result = emit_expression(lanes, model.equations[i], build_environment(2, values, i))
        values[model.states[i].name] = lanes.splat(result)
    return values


@dataclass(frozen=True, slots=True)
class _Integration:
    """Integration of a differential model over one step."""

    lanes: VectorBuilder
    model: Model
    step: IrValue
    states: States
    build_environment: EnvironmentBuilder

    def emit_part(self, part: StepPart) -> dict[str, IrValue]:
        """Emit the states at the end of a part."""
        if self.model.solver.method == "rk4":
            return self._emit_runge_kutta(part)
        return self._emit_euler(part)

    def _emit_slope(
        self, part: StepPart, halves: int, values: dict[str, IrValue], number: int
    ) -> IrValue:
        scope = self.build_environment(halves, values, number, part.places)
        return emit_expression(self.lanes, self.model.equations[number], scope)

    def _emit_euler(self, part: StepPart) -> dict[str, IrValue]:
        """Emit Euler's x + h f(x); semi-implicit: each f uses the states already updated."""
        lanes, semi_implicit = self.lanes, self.model.solver.method == "semi-implicit"
        values, updated = dict(part.start), {}
        for i, state in enumerate(self.model.states):
            slope = self._emit_slope(part, 0, values, i)
            updated[state.name] = lanes.add(part.start[state.name], lanes.mul(part.width, slope))
            if semi_implicit:
                values[state.name] = updated[state.name]
        return updated

    def _emit_runge_kutta(self, part: StepPart) -> dict[str, IrValue]:
        """Emit the classical Runge-Kutta method of order four."""
        lanes, states, width = self.lanes, self.states, part.width
        half = lanes.mul(width, lanes.make_number(0.5))

        def emit_slopes(halves: int, values: dict[str, IrValue]) -> dict[str, IrValue]:
            return {
                state.name: self._emit_slope(part, halves, values, i)
                for i, state in enumerate(self.model.states)
            }

        def shift_states(width: IrValue, slope: dict[str, IrValue]) -> dict[str, IrValue]:
            return {n: lanes.add(x, lanes.mul(width, slope[n])) for n, x in part.start.items()}

        first = emit_slopes(0, dict(part.start))
        if part.places is None:
            states.first_rises = {n: lanes.mul(width, first[n]) for n in states.with_rises}
        second = emit_slopes(1, shift_states(half, first))
        third = emit_slopes(1, shift_states(half, second))
        fourth = emit_slopes(2, shift_states(width, third))
        states.last_rises = {n: lanes.mul(self.step, fourth[n]) for n in states.with_rises}
        two = lanes.make_number(2.0)
        mean = {
            n: lanes.add(
                lanes.add(first[n], fourth[n]), lanes.mul(two, lanes.add(second[n], third[n]))
            )
            for n in states.names
        }
        return shift_states(lanes.mul(width, lanes.make_number(1.0 / 6.0)), mean)

    # ---- switches in time -----------------------------------------------------------------
    def divide_step(
        self, sides: tuple[Expression, ...], whole: dict[str, IrValue]
    ) -> dict[str, IrValue]:
        """Emit the step in parts for lanes that switch in it; `whole` stays in other lanes."""
        lanes, states = self.lanes, self.states
        begin, end = (lanes.splat(lanes.make_number(place)) for place in (0.0, 1.0))
        last = self._emit_sides(sides, end)
        is_divided = self._differ(self._emit_sides(sides, begin), last)
        undivided = [lanes.splat(value) for value in (*whole.values(), *states.last_rises.values())]

        def emit_parts() -> list[IrValue]:
            pairs = zip(self._emit_parts(sides, last, undivided), undivided, strict=True)
            return [lanes.select(is_divided, divided, value) for divided, value in pairs]

        merged = lanes.branch(lanes.test_any(is_divided), emit_parts, undivided)
        states.last_rises = dict(zip(states.with_rises, merged[len(whole) :], strict=True))
        return dict(zip(whole, merged, strict=False))

    def _emit_parts(
        self, sides: tuple[Expression, ...], last: list[IrValue], whole: list[IrValue]
    ) -> list[IrValue]:
        """Emit the parts of a step, one after the other: at most as many switches as sides.

        They give the states, and their rises by the last slope, as `whole` does of the whole step.
        """
        lanes, b, states = self.lanes, self.lanes.builder, self.states
        end = lanes.splat(lanes.make_number(1.0))
        loop = KernelLoop(lanes)
        number = loop.carry(lanes.make_integer(0))
        begin = loop.carry(lanes.splat(lanes.make_number(0.0)))
        starts = [*states.now.values(), *whole[len(states.names) :]]
        carried = [loop.carry(value) for value in starts]
        before = self._emit_sides(sides, begin)
        may_divide = b.icmp_signed("<", number, lanes.make_integer(len(sides)))
        switches = b.and_(self._differ(before, last), lanes.splat(may_divide))
        low, high = lanes.branch(
            lanes.test_any(switches), lambda: self._locate_switch(sides, before, begin), [end, end]
        )
        stop = lanes.select(switches, low, end)
        places = {0: begin, 1: lanes.mul(lanes.make_number(0.5), lanes.add(begin, stop)), 2: stop}
        width = lanes.mul(lanes.sub(stop, begin), self.step)
        now = dict(zip(states.names, carried, strict=False))
        moved = [*self.emit_part(StepPart(width, now, places)).values()]
        moved += states.last_rises.values()
        is_finished = lanes.compare(">=", begin, end)
        following = [
            lanes.select(is_finished, old, new) for old, new in zip(carried, moved, strict=True)
        ]
        resumed = lanes.select(switches, high, end)
        loop.leave_if(b.not_(lanes.test_any(lanes.compare("<", resumed, end))))
        for value, new in zip(carried, following, strict=True):
            loop.update(value, new)
        loop.update(begin, resumed)
        loop.update(number, b.add(number, lanes.make_integer(1)))
        loop.repeat()
        return following

    def _locate_switch(
        self, sides: tuple[Expression, ...], before: list[IrValue], begin: IrValue
    ) -> list[IrValue]:
        """Bisect for the next switch: the places just before and just behind it, in steps."""
        lanes, b = self.lanes, self.lanes.builder
        loop = KernelLoop(lanes)
        count = loop.carry(lanes.make_integer(0))
        low, high = loop.carry(begin), loop.carry(lanes.splat(lanes.make_number(1.0)))
        loop.leave_if(b.icmp_signed(">=", count, lanes.make_integer(HALVINGS)))
        middle = lanes.mul(lanes.make_number(0.5), lanes.add(low, high))
        is_behind = self._differ(before, self._emit_sides(sides, middle))
        loop.update(low, lanes.select(is_behind, low, middle))
        loop.update(high, lanes.select(is_behind, middle, high))
        loop.update(count, b.add(count, lanes.make_integer(1)))
        loop.repeat()
        return [low, high]

    def _emit_sides(self, sides: tuple[Expression, ...], place: IrValue) -> list[IrValue]:
        scope = self.build_environment(0, {}, 0, {0: place})
        return [self.lanes.splat(emit_expression(self.lanes, side, scope)) for side in sides]

    def _differ(self, some: list[IrValue], others: list[IrValue]) -> IrValue:
        """Emit whether any of two lists of sides differ, in each lane."""
        pairs = zip(some, others, strict=True)
        differences = [self.lanes.compare("!=", first, second) for first, second in pairs]
        return reduce(self.lanes.builder.or_, differences)
