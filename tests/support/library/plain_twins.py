"""Plain twins of compiled code: slow, short, and written from the definition alone.

The twin of a kernel walks the expression tree for one individual, one sample at a time, with
floats. It shares with the kernel how records are laid out, and nothing else.
"""

import math
from collections.abc import Mapping
from itertools import combinations
from math import floor

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.interpolation import FineInput
from sysid.language.delays import mentions_time
from sysid.language.tree import (
    Binary,
    Expression,
    FunctionCall,
    Number,
    PastValue,
    Symbol,
    Unary,
    walk,
)
from sysid.models.model import (
    DerivedInitial,
    EstimatedInitial,
    MeasuredInitial,
    Model,
    name_initial_state,
)
from sysid.simulation.experiments import GridExperiment
from sysid.simulation.problem import Problem
from tests.support.library.expression_values import interpolate_pchip

_FUNCTIONS = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "abs": np.abs,
    "sign": np.sign,
    "min": np.minimum,
    "max": np.maximum,
    "tanh": np.tanh,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "log10": np.log10,
    "erf": np.vectorize(math.erf),
    "floor": np.floor,
    "mod": np.mod,
    "clip": np.clip,
    "table": lambda at, *points: np.interp(at, *np.reshape(points, (2, -1))),
    "pchip": lambda at, *points: interpolate_pchip(at, *np.reshape(points, (2, -1))),
}
_SIDES = {
    "sign": lambda x: (_tell(x, 0), _tell(0, x)),
    "abs": lambda x: (_tell(x, 0), _tell(0, x)),
    "floor": lambda x: (np.floor(x),),
    "min": lambda *x: tuple(_tell(a, b) for a, b in combinations(x, 2)),
    "max": lambda *x: tuple(_tell(a, b) for a, b in combinations(x, 2)),
    "clip": lambda x, *limits: tuple(_tell(x, limit) for limit in limits),
}
"""On which sides of their switches the functions that jump or bend are, at their arguments."""


def _tell(a: float, b: float) -> float:
    return np.nan if np.isnan(a + b) else float(a > b)


_OPERATORS = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    "**": np.power,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
    "==": np.equal,
    "!=": np.not_equal,
    "and": np.logical_and,
    "or": np.logical_or,
}


def predictions(problem: Problem, theta: FloatArray, one_step: bool = False) -> FloatArray:
    """Simulated values (M,) of one individual (D,), their errors standardised by a filter."""
    values, deviations = predictions_ahead(problem, theta, one_step)
    weight, measured = problem.evaluator.weight, problem.evaluator.measured
    mean = np.exp(np.mean(np.log(deviations[weight > 0])))
    standard = measured + (values - measured) * mean / deviations
    return np.where((weight > 0) & (deviations != mean), standard, values)


def predictions_ahead(
    problem: Problem, theta: FloatArray, one_step: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Simulated values (M,) of one individual (D,), and deviations of their innovations."""
    free = iter(theta)
    values = {
        p.name: float(next(free)) if p.is_free else p.fixed or 0.0 for p in problem.all_parameters
    }
    parts: list[FloatArray] = []
    deviations: list[FloatArray] = []
    with np.errstate(all="ignore"):
        for e, experiment in enumerate(problem.experiments):
            twin = ModelTwin(problem.model, experiment, e, values, one_step)
            grid = twin.outputs()
            for i, samples in enumerate(experiment.outputs):
                places = np.arange(experiment.grid.points)
                parts.append(np.interp(samples.positions, places, grid[i]))
                spread = np.array(twin.deviations[i :: len(experiment.outputs)])
                deviations.append(np.interp(samples.positions, places, spread))
    return np.concatenate(parts), np.concatenate(deviations)


def fitness(problem: Problem, theta: FloatArray) -> float:
    """J of one individual (Eq. 10), by squares."""
    weight, measured = problem.evaluator.weight, problem.evaluator.measured
    error = weight * (predictions(problem, theta) - measured)
    value = float(np.sqrt(np.sum(error**2) / np.count_nonzero(weight)))
    return value if np.isfinite(value) else np.inf


class ModelTwin:
    """One individual in one experiment."""

    def __init__(
        self,
        model: Model,
        experiment: GridExperiment,
        number: int,
        values: Mapping[str, float],
        one_step: bool,
    ) -> None:
        self.model, self.experiment, self.values = model, experiment, values
        self.one_step = one_step
        self.difference = model.form != "differential"
        self.step = experiment.grid.integration_step
        self.names = [state.name for state in model.states]
        self.started = False
        self.deviations: list[float] = []
        nodes = dict.fromkeys(node for equation in model.equations for node in walk(equation))
        self.timely = [node for node in nodes if mentions_time(node)]
        self.past: dict[str, list[float]] = {}
        self.slopes: list[tuple[dict[str, float], dict[str, float]]] = []
        self.given: dict[str, list[float]] = {}
        for i, start in enumerate(model.initial):
            name = self.names[i]
            given = experiment.starts[i].first_values
            if isinstance(start, DerivedInitial):
                begun = {name: past[0] for name, past in self.past.items()}
                given = np.array([self._value(start.expression, 0, 0.0, begun, 0)])
            if isinstance(start, EstimatedInitial):
                given = np.array([values[name_initial_state(name, number)]])
            self.past[name] = [float(given[0])]
            later = given[1:] if isinstance(start, MeasuredInitial) else given[:0]
            self.given[name] = [float(v) for v in later]
        self.started = True
        self.first = {name: past[0] for name, past in self.past.items()}
        self.histories = {one.state: one.expression for one in model.histories}
        zero = model.solver.history == "zero"
        self.before = dict.fromkeys(self.names, 0.0) if zero else self.first

    # ---- the walk through time ------------------------------------------------------------
    def outputs(self) -> FloatArray:
        """Each output at each grid point."""
        grid, found = self.experiment.grid, []
        for m in range(grid.last_step + 1):
            if m % grid.substeps == 0:
                found.append([self._compare(i, m) for i in range(len(self.model.outputs))])
                if self.one_step:
                    self._replace(m // grid.substeps)
            if m < grid.last_step:
                for name, value in self._next(m).items():
                    self.past[name].append(value)
        return np.array(found).T

    def _compare(self, i: int, m: int) -> float:
        """An output, whose sample then corrects the states."""
        now, output = self._now(), self.model.outputs[i]
        value = self._value(output.expression, m, 0.0, now, -1)
        samples = self.experiment.outputs[i]
        places = samples.positions * self.experiment.grid.substeps == m
        weight = float(np.sum(samples.precision[places]))
        variance = 1.0
        for one in self.model.corrections:
            if one.output == output.name and weight:
                variance += weight**2 * self._value(one.variance, m, 0.0, now, -1)
                innovation = float(samples.values[places][0]) - value
                for state, tree in one.gains:
                    gain = self._value(tree, m, 0.0, now, -1) * weight**2 / variance
                    self.past[state][-1] += gain * innovation
                for state, tree in one.losses:
                    loss = self._value(tree, m, 0.0, now, -1) * weight**2 / variance
                    self.past[state][-1] -= loss
        self.deviations.append(float(np.sqrt(variance)))
        return value

    def _now(self) -> dict[str, float]:
        return {name: past[-1] for name, past in self.past.items()}

    def _replace(self, n: int) -> None:
        for output, samples in zip(self.model.outputs, self.experiment.outputs, strict=True):
            match output.expression:
                case PastValue(name, "state", 0, None):
                    self.past[name][-1] = float(samples.grid_values[n])

    def _next(self, m: int) -> dict[str, float]:
        if not self.difference:
            return self._integrate(m)
        if m + 1 < self.model.memory and not self.model.corrections:
            return {n: self.given[n][m] if self.given[n] else self.first[n] for n in self.names}
        values: dict[str, float] = {}
        for i in self.model.order:
            values[self.names[i]] = self._value(self.model.equations[i], m, 1.0, values, i)
        return values

    def _integrate(self, m: int) -> dict[str, float]:
        """One step, in parts between the times at which an equation switches."""
        values, begin, switches = self._now(), 0.0, self._count_switches()
        for number in range(switches + 1):
            end, following = self._find_switch(m, begin) if number < switches else (1.0, 1.0)
            values = self._integrate_part(m, begin, end, values)
            if following >= 1.0:
                break
            begin = following
        return values

    def _integrate_part(
        self, m: int, begin: float, end: float, now: dict[str, float]
    ) -> dict[str, float]:
        h, middle, method = self.step * (end - begin), (begin + end) / 2, self.model.solver.method
        if method == "rk4":
            a = self._slopes(m, begin, now)
            if begin == 0.0:
                self.present = a
            b = self._slopes(m, middle, self._move(now, h / 2, a))
            c = self._slopes(m, middle, self._move(now, h / 2, b))
            d = self._slopes(m, end, self._move(now, h, c))
            self.slopes = [*self.slopes[:m], (self.present, d)]
            return {n: now[n] + h / 6 * (a[n] + 2 * b[n] + 2 * c[n] + d[n]) for n in now}
        values = dict(now)
        updated = {}
        self.end = end
        for i, equation in enumerate(self.model.equations):
            name = self.names[i]
            updated[name] = now[name] + h * self._value(equation, m, begin, values, i)
            if method == "semi-implicit":
                values[name] = updated[name]
        return updated

    # ---- switches in time -----------------------------------------------------------------
    def _count_switches(self) -> int:
        return len(self._tell_sides(0, 0.0))

    def _find_switch(self, m: int, begin: float) -> tuple[float, float]:
        """Just before and just behind the next switch in a step."""
        before = self._tell_sides(m, begin)
        if self._tell_sides(m, 1.0) == before:
            return 1.0, 1.0
        low, high = begin, 1.0
        for _ in range(52):
            middle = (low + high) / 2
            if self._tell_sides(m, middle) == before:
                low = middle
            else:
                high = middle
        return low, high

    def _tell_sides(self, m: int, c: float) -> list[float]:
        """On which side of each of its switches in time the equations are."""
        told: list[float] = []
        for node in self.timely:
            arguments = node.arguments if isinstance(node, FunctionCall) else ()
            ends = [self._value_in_time(argument, m, c) for argument in arguments]
            match node:
                case Binary("<" | "<=" | ">" | ">="):
                    told.append(self._value_in_time(node, m, c))
                case FunctionCall("mod"):
                    told.append(np.round((ends[0] - np.mod(ends[0], ends[1])) / ends[1]))
                case FunctionCall(function) if function in _SIDES:
                    told += _SIDES[function](*ends)
        return [float(side) for side in told if not np.isnan(side)]

    def _value_in_time(self, e: Expression, m: int, c: float) -> float:
        """An expression without signals; nan of any other."""
        if any(isinstance(part, PastValue) for part in walk(e)):
            return math.nan
        return float(self._value(e, m, c, {}, 0))

    def _slopes(self, m: int, c: float, values: dict[str, float]) -> dict[str, float]:
        return {
            name: self._value(equation, m, c, values, i)
            for i, (name, equation) in enumerate(zip(self.names, self.model.equations, strict=True))
        }

    @staticmethod
    def _move(now: dict[str, float], h: float, slope: dict[str, float]) -> dict[str, float]:
        return {n: now[n] + h * slope[n] for n in now}

    # ---- expressions ----------------------------------------------------------------------
    def _value(
        self, e: Expression, m: int, c: float, values: dict[str, float], equation: int
    ) -> float:
        """An expression `c` steps after step m, where the states have `values`."""

        def value(one: Expression) -> float:
            return self._value(one, m, c, values, equation)

        match e:
            case PastValue(_, "input", _, _):
                return self._input(e, m, c)
            case PastValue():
                return self._state(e, m, c, values, equation)
            case Unary(operator, operand):
                return -value(operand) if operator == "-" else not value(operand)
            case Binary(operator, left, right):
                return _OPERATORS[operator](np.float64(value(left)), np.float64(value(right)))
            case FunctionCall("where", (condition, a, b)):
                return value(a) if value(condition) else value(b)
            case FunctionCall(function, arguments):
                return _FUNCTIONS[function](*(np.float64(value(a)) for a in arguments))
        return self._leaf(e, m + c)

    def _leaf(self, e: Number | Symbol, place: float) -> float:
        match e:
            case Number(number):
                return number
            case Symbol(name, "parameter"):
                return self.values[name]
            case Symbol(_, "period"):
                return self.step
            case Symbol(_, "index"):
                return place
        return place * self.step

    def _lag(self, past: PastValue, m: int, c: float) -> float:
        lag = self._value(past.delay, m, c, {}, 0) if past.delay is not None else 0.0
        lag = max(lag, 0.0) if self.difference else max(lag, 0.0) / self.step
        return float(floor(lag + 0.5)) if self.model.solver.interpolation == "nearest" else lag

    def _state(
        self, past: PastValue, m: int, c: float, values: dict[str, float], equation: int
    ) -> float:
        if past.delay is None and past.offset == 0:
            return values[past.name]
        semi = not self.difference and self.model.solver.method == "semi-implicit"
        if semi and self.names.index(past.name) < equation:
            c = self.end  # already updated: as it is at the end of the part
        place = c - past.offset
        at = place - self._lag(past, m, c)
        if m + at < 0 and past.name in self.histories:
            return self._value(self.histories[past.name], m, at, {}, 0)
        now = self.past[past.name][m]
        rise = values.get(past.name, now) - now
        if at > 0 and self._has_slopes():
            tangent = place * self.step * self.present[past.name]
            return now + at / place * tangent + (at / place) ** 2 * (rise - tangent)
        if at > 0:
            return now + at / place * rise
        return self._between(past.name, m, at)

    def _has_slopes(self) -> bool:
        solver = self.model.solver
        return not self.difference and (solver.method, solver.interpolation) == ("rk4", "cubic")

    def _between(self, name: str, m: int, at: float) -> float:
        """A state `at` steps after step m (at ≤ 0), between its finished samples."""
        i = floor(at)
        f = at - i

        def sample(steps: int) -> float:
            place = m + min(steps, 0)
            if place < 0 and name in self.histories:
                return self._value(self.histories[name], place, 0.0, {}, 0)
            return self.past[name][place] if place >= 0 else self.before[name]

        if self._has_slopes() and f > 0:
            slopes = self.slopes[m + i] if m + i >= 0 else 2 * (dict.fromkeys(self.names, 0.0),)
            first, last = (self.step * slope[name] for slope in slopes)
            return float(
                (1 - f) ** 2 * (1 + 2 * f) * sample(i)
                + f**2 * (3 - 2 * f) * sample(i + 1)
                + f * (1 - f) ** 2 * first
                - f**2 * (1 - f) * last
            )
        if f == 0 or self.model.solver.interpolation != "cubic":
            return sample(i) + f * (sample(i + 1) - sample(i))
        nodes = (-1, 0, 1, 2) if i <= -2 else (-1, 0, 1)
        weights = [np.prod([(f - o) / (n - o) for o in nodes if o != n]) for n in nodes]
        return float(sum(w * sample(i + n) for w, n in zip(weights, nodes, strict=True)))

    def _input(self, past: PastValue, m: int, c: float) -> float:
        names = [quantity.name for quantity in self.model.inputs]
        if not self.started:
            return self.experiment.first_inputs[names.index(past.name)]
        fine = self.experiment.inputs[names.index(past.name)]
        start = fine.begin if self.difference else 0
        place = m + c - past.offset
        if past.delay is None and not self.difference:
            return self._between_points(fine, m * fine.points_per_step + _inside(fine, c))
        return self._between_points(
            fine, start + (place - self._lag(past, m, c)) * fine.points_per_step
        )

    @staticmethod
    def _between_points(fine: FineInput, place: float) -> float:
        i = fine.start_index + floor(place)
        part = place - floor(place)
        return float(fine.values[i] + part * (fine.values[i + 1] - fine.values[i]))


def _inside(fine: FineInput, c: float) -> float:
    return fine.begin + c * (fine.end - fine.begin)
