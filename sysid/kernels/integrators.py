"""One step of the simulation: recursions, Euler, semi-implicit Euler and Runge-Kutta."""

from dataclasses import dataclass
from typing import Protocol

from sysid.kernels import reads as demand
from sysid.kernels.delayed_reads import Turn
from sysid.kernels.expressions import Scope, emit
from sysid.kernels.signals import Parameters, Signals, States
from sysid.kernels.vectors import DOUBLE, Lanes, Value
from sysid.language.tree import Past, Symbol
from sysid.models.model import Model


@dataclass(frozen=True, slots=True)
class Place(Scope):
    """What names stand for at `halves` half steps after the last finished step.

    `values` are the states there; `equation` is the number of the equation that asks, as the
    semi-implicit method reads some states at the end of the step.
    """

    lanes: Lanes
    model: Model
    parameters: Parameters
    states: States
    signals: Signals
    turn: Turn
    halves: int
    values: dict[str, Value]
    equation: int = 0

    def symbol(self, symbol: Symbol) -> Value:
        """A parameter, the sampling period, the sample number or the time."""
        if symbol.kind in ("parameter", "period"):
            return self.parameters.symbol(symbol)
        steps = self.lanes.builder.sitofp(self.turn.step, DOUBLE)
        if self.halves:
            steps = self.lanes.add(steps, self.lanes.number(self.halves / 2))
        if symbol.kind == "index":
            return steps
        return self.lanes.mul(steps, self.parameters.period)

    def past(self, past: Past) -> Value:
        """A state or an input, now or in the past."""
        if past.kind == "input":
            return self._input(past)
        if past.lag is None and past.offset == 0:
            return self.values[past.name]
        number = self.states.names.index(past.name)
        place = self.halves
        if self.is_inside:
            place = demand.state_place(self.model, place, self.equation, number)
        halves = place - 2 * past.offset
        if past.lag is None:
            return self._sample(past.name, -halves // 2)
        now = self.states.now[past.name]
        reader = self.signals.reader(past, halves)
        return reader.read(halves, now, self.values.get(past.name, now))

    @property
    def is_inside(self) -> bool:
        """Whether an equation asks; an output is evaluated at a finished step."""
        return self.equation >= 0

    def _sample(self, name: str, back: int) -> Value:
        if back > demand.NEAR:
            return self.states.far(name, back, self.turn.row)
        return self.states.now[name] if back == 0 else self.states.line[name][back]

    def _input(self, past: Past) -> Value:
        halves = self.halves - 2 * past.offset
        if past.lag is None:
            return self.signals.input(past.name, halves, self.turn.step)
        zero = self.lanes.number(0.0)
        return self.signals.reader(past, halves).read(halves, zero, zero)


class Placing(Protocol):
    """Makes the scope at a place, for an equation, given the states' values there."""

    def __call__(self, halves: int, values: dict[str, Value], equation: int = 0) -> Place:
        """The scope."""


def next_states(
    lanes: Lanes, model: Model, step: Value, states: States, at: Placing
) -> dict[str, Value]:
    """The states one step later."""
    if demand.is_difference(model):
        return _recursion(lanes, model, at)
    if model.solver.method == "rk4":
        return _runge_kutta(lanes, model, step, states, at)
    return _euler(lanes, model, step, states, at)


def _recursion(lanes: Lanes, model: Model, at: Placing) -> dict[str, Value]:
    """x(k) = f(x(k-1), …), in the order in which the equations need one another."""
    values: dict[str, Value] = {}
    for i in model.order:
        result = emit(lanes, model.equations[i], at(2, values, i))
        values[model.states[i].name] = lanes.splat(result)
    return values


def _euler(
    lanes: Lanes, model: Model, step: Value, states: States, at: Placing
) -> dict[str, Value]:
    """Euler: x + h f(x); in the semi-implicit method, each f with the states already updated."""
    semi_implicit = model.solver.method == "semi-implicit"
    values, updated = dict(states.now), {}
    for i, (state, equation) in enumerate(zip(model.states, model.equations, strict=True)):
        slope = emit(lanes, equation, at(0, values, i))
        updated[state.name] = lanes.add(states.now[state.name], lanes.mul(step, slope))
        if semi_implicit:
            values[state.name] = updated[state.name]
    return updated


def _runge_kutta(
    lanes: Lanes, model: Model, step: Value, states: States, at: Placing
) -> dict[str, Value]:
    """The classical method of order four."""
    half = lanes.mul(step, lanes.number(0.5))

    def slopes(halves: int, values: dict[str, Value]) -> dict[str, Value]:
        return {
            state.name: emit(lanes, equation, at(halves, values, i))
            for i, (state, equation) in enumerate(zip(model.states, model.equations, strict=True))
        }

    def moved(width: Value, slope: dict[str, Value]) -> dict[str, Value]:
        return {n: lanes.add(x, lanes.mul(width, slope[n])) for n, x in states.now.items()}

    first = slopes(0, dict(states.now))
    second = slopes(1, moved(half, first))
    third = slopes(1, moved(half, second))
    fourth = slopes(2, moved(step, third))
    two = lanes.number(2.0)
    mean = {
        n: lanes.add(lanes.add(first[n], fourth[n]), lanes.mul(two, lanes.add(second[n], third[n])))
        for n in states.names
    }
    return moved(lanes.mul(step, lanes.number(1.0 / 6.0)), mean)
