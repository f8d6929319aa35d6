"""The names of a generated program, and how it reads signals at each place of its time loop.

A program is a plain loop over integration steps (of a recursion, `k`). Each state has an array of
all its steps, so that the past is there to be read; what lies between two steps is interpolated
by a few small functions, which are written out only where they are called.
"""

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import Literal

from sysid.control.linear_form import Identified
from sysid.core.errors import InvalidSettings
from sysid.data.interpolation import DENSE, MOST_POINTS
from sysid.export.expressions import Language, Scope, number, source
from sysid.export.identifiers import Identifiers
from sysid.kernels.reads import averaged_inputs, is_difference
from sysid.language.functions import Level
from sysid.language.tree import Expression, Past, Symbol
from sysid.models.model import FixedInitial, MeasuredInitial, initial_name

Kind = Literal["slope", "update", "recursion", "output"]


@dataclass(slots=True)
class Program:
    """Identifiers for everything a program names; `lags` and `helpers` grow as it is written."""

    identified: Identified
    language: Language
    names: Identifiers
    prefix: str = ""
    parameters: dict[str, str] = field(default_factory=dict)
    inputs: dict[str, str] = field(default_factory=dict)
    outputs: dict[str, str] = field(default_factory=dict)
    now: dict[str, str] = field(default_factory=dict)
    every: dict[str, str] = field(default_factory=dict)
    following: dict[str, str] = field(default_factory=dict)
    starts: dict[str, str] = field(default_factory=dict)
    lags: dict[Expression, str] = field(default_factory=dict)
    helpers: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        model, of = self.identified.model, self.names.of
        self.inputs = {one.name: of(one.name) for one in model.inputs}
        self.parameters = {one.name: of(one.name) for one in model.parameters}
        self.now = {one.name: of(one.name) for one in model.states}
        self.starts = {one.name: of(f"{self.now[one.name]}_0") for one in model.states}
        self.every = {one.name: of(f"{self.now[one.name]}_all") for one in model.states}
        self.following = {one.name: of(f"{self.now[one.name]}_next") for one in model.states}
        states = set(self.now)
        self.outputs = {
            one.name: of(f"{one.name}_out" if one.name in states else one.name)
            for one in model.outputs
        }

    @property
    def is_recursion(self) -> bool:
        """Whether the model is a difference equation."""
        return is_difference(self.identified.model)

    @property
    def index(self) -> str:
        """The loop's variable."""
        return "k" if self.is_recursion else "step"

    @property
    def period(self) -> str:
        """The integration step in s; ``h`` is a word of the language in a recursion only."""
        return "h" if self.is_recursion else "dt"

    @property
    def substeps(self) -> int:
        """Integration steps in a sampling period."""
        return self.identified.model.solver.substeps

    @property
    def own_step(self) -> float | None:
        """Step of the simulation's own grid in s; None: that of the samples."""
        return None if self.is_recursion else self.identified.model.solver.step

    @property
    def memory(self) -> int:
        """Samples that are given, not computed."""
        return max(self.identified.model.memory, 1) if self.is_recursion else 1

    def start(self, state: int) -> float | None:
        """Where a state starts; None if it must be measured.

        Raises
        ------
        InvalidSettings
            If the value of an estimated start is missing.
        """
        model = self.identified.model
        name = initial_name(model.states[state].name, 0)
        value, initial = self.identified.find(name), model.initial[state]
        if value is not None:
            return value.value
        if isinstance(initial, FixedInitial):
            return initial.value
        if isinstance(initial, MeasuredInitial):
            return None
        raise InvalidSettings(f"/values/{name}", "a value is missing")

    def before(self, state: str) -> str:
        """What a state was before the start."""
        zero = self.identified.model.solver.history == "zero"
        return "0.0" if zero else f"{self.every[state]}[0]"

    def call(self, helper: str, *arguments: str) -> str:
        """A call of a helper, which is then written out."""
        self.helpers.add(helper)
        return f"{helper}({', '.join(arguments)})"

    def lag(self, expression: Expression) -> str:
        """The variable of a lag in integration steps."""
        if expression not in self.lags:
            self.lags[expression] = self.names.of(f"lag_{len(self.lags) + 1}")
        return self.lags[expression]

    def ramp(self) -> str:
        """Half the width of a held input's jump, in samples, as `FineInput` has it."""
        if self.own_step is not None:
            points = f"2*ceil({DENSE // 2}*ratio - 1e-3)"
            return f"ratio/{self.language.limited(points, 4, MOST_POINTS)}"
        points_ = min(max(2 * ceil(DENSE / self.substeps / 2 - 1e-3), 4), MOST_POINTS)
        return number(1.0 / (points_ * self.substeps))

    def half(self) -> str:
        """Half an integration step, in samples: a held input with a lag is a mean over a step."""
        return "0.5*ratio" if self.own_step is not None else number(0.5 / self.substeps)

    @property
    def averaged(self) -> frozenset[str]:
        """Inputs that are read as means over a step where they are held."""
        return averaged_inputs(self.identified.model)


@dataclass(frozen=True, slots=True)
class Place(Scope):
    """Where in the loop an expression is evaluated.

    ``slope``: `part` of a step after it began; ``update``: as it begins; ``recursion``: at sample
    k; ``output``: at a finished step. `equation` is the one that asks.
    """

    program: Program
    kind: Kind
    equation: int = -1

    def symbol(self, symbol: Symbol) -> str:
        """A parameter or a reserved name."""
        program = self.program
        if symbol.kind == "parameter":
            return program.prefix + program.parameters[symbol.name]
        if symbol.kind == "period":
            return program.period
        if symbol.kind == "index":
            return program.language.real(program.index)
        return f"({self._index()}*{program.period})"

    def past(self, past: Past) -> str:
        """A state or an input, now or in the past."""
        return self._input(past) if past.kind == "input" else self._state(past)

    def _index(self) -> str:
        return "(step + part)" if self.kind == "slope" else self.program.index

    def _back(self, past: Past) -> str:
        offset = f"-{past.offset}" if past.offset else ""
        lag = f" - {self.program.lag(past.lag)}" if past.lag is not None else ""
        return ("step + part" if self.kind == "slope" else self.program.index) + offset + lag

    # ---- inputs ---------------------------------------------------------------------------
    def _input(self, past: Past) -> str:
        program = self.program
        name, substeps = program.inputs[past.name], program.substeps
        held = program.identified.hold(past.name) == "zero"
        early = self.kind == "output" and past.offset > 0  # may lie before the record
        if past.lag is None and program.own_step is None and not early:
            if held:
                at = "step" if self.kind == "slope" else self._back(past)
                return program.language.element(name, at, substeps)
            if substeps == 1 and self.kind != "slope":
                return program.language.element(name, self._back(past), 1)
        place = self._samples(past)
        if held and past.name in program.averaged:
            program.helpers.add("averaged")
            after = " + half" if program.is_recursion else ""
            return program.language.read("averaged", name, place + after)
        if not held:
            program.helpers.add("between")
            return program.language.read("between", name, place)
        program.helpers.add("held")
        return program.language.read("held", name, place + self._beside(past))

    def _samples(self, past: Past) -> str:
        program, place = self.program, self._back(past)
        if program.own_step is not None:
            return f"({place})*ratio"
        if program.substeps == 1:
            return place
        return f"({place})/{number(program.substeps)}"

    def _beside(self, past: Past) -> str:
        """A recursion reads just behind a jump; a solver from behind one to before the next."""
        if self.program.is_recursion:
            return " + ramp"
        if past.lag is not None:
            return ""
        return " + ramp*(1.0 - 2.0*part)" if self.kind == "slope" else " + ramp"

    # ---- states ---------------------------------------------------------------------------
    def _state(self, past: Past) -> str:
        program = self.program
        if past.lag is None and past.offset == 0:
            return self._present(past.name)
        if self.kind == "recursion":
            return self._earlier(past)
        every, before = program.every[past.name], program.before(past.name)
        lag = self._steps(past)
        if self.kind == "slope":
            present = self._present(past.name)
            return program.call("lately", every, before, "step", "part", present, lag)
        if self.kind == "update" and self._is_updated(past.name):
            following = program.following[past.name]
            return program.call("lately", every, before, "step", "1.0", following, lag)
        return program.call("past", every, before, program.index, lag)

    def _earlier(self, past: Past) -> str:
        program = self.program
        every, before = program.every[past.name], program.before(past.name)
        if past.lag is None:
            return f"{every}[k-{past.offset}]"
        lag = program.lag(past.lag)
        if past.offset == 0:
            present = self._present(past.name)
            return program.call("lately", every, before, "k-1", "1.0", present, lag)
        whole = f"{number(past.offset - 1)} + " if past.offset > 1 else ""
        return program.call("past", every, before, "k-1", whole + lag)

    def _steps(self, past: Past) -> str:
        offset = number(past.offset) if past.offset else ""
        lag = self.program.lag(past.lag) if past.lag is not None else ""
        return " + ".join(part for part in (offset, lag) if part)

    def _present(self, name: str) -> str:
        program = self.program
        every = program.every[name]
        if self.kind == "slope":
            return program.now[name]
        if self.kind == "recursion":
            return program.now[name] if self._is_updated(name) else f"{every}[k-1]"
        if self.kind == "update" and self._is_updated(name):
            return program.following[name]
        return f"{every}[{program.index}]"

    def _is_updated(self, name: str) -> bool:
        """Whether the state's next value is known when the equation asks."""
        model = self.program.identified.model
        number_ = [state.name for state in model.states].index(name)
        if self.program.is_recursion:
            return model.order.index(number_) < model.order.index(self.equation)
        return model.solver.method == "semi-implicit" and number_ < self.equation


@dataclass(frozen=True, slots=True)
class Lag(Scope):
    """The scope of a lag: parameters and the sampling period."""

    program: Program

    def symbol(self, symbol: Symbol) -> str:
        """A parameter, or the sampling period."""
        return Place(self.program, "output").symbol(symbol)

    def past(self, past: Past) -> str:
        """Never asked: the language allows no signals in a lag."""
        raise AssertionError(f"a lag holds no signal such as {past.name}")


def lag_steps(program: Program, lag: Expression) -> str:
    """Text of a lag in integration steps."""
    if program.is_recursion:
        text = source(lag, program.language, Lag(program))
    else:
        text = f"{source(lag, program.language, Lag(program), Level.SIGN)}/{program.period}"
    is_whole = program.identified.model.solver.interpolation == "nearest"
    return program.language.lag(text, is_whole=is_whole)


# ---- what both languages write alike --------------------------------------------------------
def time_loop(program: Program, runge_kutta: Callable[[Program], list[str]]) -> list[str]:
    """The loop that computes the states; of a Runge-Kutta method each language has its own."""
    if program.is_recursion:
        return _recursion(program)
    if program.identified.model.solver.method == "rk4":
        return runge_kutta(program)
    return _euler(program)


def _recursion(program: Program) -> list[str]:
    model, language = program.identified.model, program.language
    body: list[str] = []
    for i in model.order:
        name = model.states[i].name
        now = program.now[name]
        body += language.assign(now, equation(program, "recursion", i), is_new=True)
        body += language.assign(f"{program.every[name]}[k]", now)
    head = language.open_loop("k", program.memory, to_last=True)
    return [head, *indented(body), *language.close_loop()]


def _euler(program: Program) -> list[str]:
    model, language = program.identified.model, program.language
    body: list[str] = []
    for i, state in enumerate(model.states):
        slope = equation(program, "update", i, Level.PRODUCT)
        text = f"{program.every[state.name]}[step] + dt*{slope}"
        body += language.assign(program.following[state.name], text, is_new=True)
    for state in model.states:
        target = f"{program.every[state.name]}[step + 1]"
        body += language.assign(target, program.following[state.name])
    head = language.open_loop("step", 0, to_last=False)
    return [head, *indented(body), *language.close_loop()]


def equation(program: Program, kind: Kind, number_: int, floor: int = 0) -> str:
    """Text of an equation's right-hand side; in parentheses if it binds less than `floor`."""
    tree = program.identified.model.equations[number_]
    return source(tree, program.language, Place(program, kind, number_), floor)


def indented(lines: Sequence[str], levels: int = 1) -> list[str]:
    """Lines (or several joined) moved to the right."""
    return [textwrap.indent(line, "    " * levels) for line in lines]


def needed_helpers(
    helpers: Mapping[str, str], used: Iterable[str], identified: Identified
) -> list[str]:
    """Texts of the helpers that are used or that those call, each before who calls it."""
    wanted = set(used)
    if "lately" in wanted:
        wanted.add("past")
    if "past" in wanted:
        wanted.add("sample")
    variants = _variants_of(identified)
    return [helpers[variants.get(name, name)] for name in helpers if name in wanted]


def _variants_of(identified: Identified) -> Mapping[str, str]:
    """Which helpers of a program are written in another way, by the solver of its model."""
    solver = identified.model.solver
    found = {"past": "past cubic"} if solver.interpolation == "cubic" else {}
    if identified.model.form == "differential" and solver.step is not None:
        found["held"] = "held on grid"  # its points need not meet the jumps
    return found
