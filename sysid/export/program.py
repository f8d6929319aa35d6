"""Names of a generated program, and its reads of signals in the time loop.

A program is a plain loop over integration steps (of a recursion, `k`). Each state has an array of
all its steps, so past values can be read. Values between two steps are interpolated by a few small
functions, which are written only if they are called.
"""

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import ceil
from typing import Literal

from sysid.control.linear_form import IdentifiedModel
from sysid.core.errors import InvalidSettings
from sysid.data.interpolation import MAX_POINTS_PER_STEP, POINTS_PER_SAMPLE
from sysid.export.expression_text import (
    HELPER_ARGUMENTS,
    ExportScope,
    TargetLanguage,
    write_expression,
    write_number,
)
from sysid.export.identifiers import Identifiers
from sysid.kernels.signals.past_reads import (
    find_averaged_inputs,
    is_difference,
    list_stored_histories,
    list_switch_sides,
    reads_cubics,
)
from sysid.language.delays import has_varying_delay
from sysid.language.functions import Level
from sysid.language.tree import Expression, PastValue, Symbol
from sysid.models.model import DerivedInitial, FixedInitial, MeasuredInitial, name_initial_state

EvaluationStage = Literal["slope", "update", "recursion", "output"]


@dataclass(slots=True)
class GeneratedProgram:
    """Identifiers of a program; `delay_names` and `helper_names` grow as it is written.

    `first_step` is that of the loop over integration steps.
    """

    identified: IdentifiedModel
    language: TargetLanguage
    identifiers: Identifiers
    prefix: str = ""
    stem: str = ""
    parameter_names: dict[str, str] = field(default_factory=dict)
    input_names: dict[str, str] = field(default_factory=dict)
    output_names: dict[str, str] = field(default_factory=dict)
    present_names: dict[str, str] = field(default_factory=dict)
    array_names: dict[str, str] = field(default_factory=dict)
    next_names: dict[str, str] = field(default_factory=dict)
    start_names: dict[str, str] = field(default_factory=dict)
    rise_names: dict[str, tuple[str, str]] = field(default_factory=dict)
    delay_names: dict[Expression, str] = field(default_factory=dict)
    helper_names: set[str] = field(default_factory=set)
    argument_names: dict[tuple[str, str], str] = field(default_factory=dict)
    first_step: str = "0"

    def __post_init__(self) -> None:
        model, make_identifier = self.identified.model, self.identifiers.make_identifier
        self.input_names = {item.name: make_identifier(item.name) for item in model.inputs}
        self.parameter_names = {item.name: make_identifier(item.name) for item in model.parameters}
        self.present_names = {item.name: make_identifier(item.name) for item in model.states}
        self.start_names = {
            item.name: make_identifier(f"{self.present_names[item.name]}_0")
            for item in model.states
        }
        self.array_names = {
            item.name: make_identifier(f"{self.present_names[item.name]}_all")
            for item in model.states
        }
        self.next_names = {
            item.name: make_identifier(f"{self.present_names[item.name]}_next")
            for item in model.states
        }
        if reads_cubics(model):
            self.rise_names = {
                stored.state: (
                    make_identifier(f"{self.present_names[stored.state]}_first"),
                    make_identifier(f"{self.present_names[stored.state]}_last"),
                )
                for stored in list_stored_histories(model)
            }
        states = set(self.present_names)
        self.output_names = {
            item.name: make_identifier(f"{item.name}_out" if item.name in states else item.name)
            for item in model.outputs
        }

    @property
    def is_recursion(self) -> bool:
        """Whether the model is a difference equation."""
        return is_difference(self.identified.model)

    @property
    def loop_variable(self) -> str:
        """The loop's variable."""
        return "k" if self.is_recursion else "step"

    @property
    def step_variable(self) -> str:
        """The integration step in s; ``h`` is a word of the language in a recursion only."""
        return "h" if self.is_recursion else "dt"

    @property
    def substeps(self) -> int:
        """Integration steps in a sampling period."""
        return self.identified.model.solver.substeps

    @property
    def grid_step(self) -> float | None:
        """Step of the simulation's own grid in s; None: the grid of the samples."""
        return None if self.is_recursion else self.identified.model.solver.step

    @property
    def sides(self) -> tuple[Expression, ...]:
        """Sides of the switches in time; if there are any, steps are divided."""
        return list_switch_sides(self.identified.model)

    def write_sides(self) -> list[str]:
        """Write the sides at a `part` of a step."""
        scope = LoopScope(self, "slope")
        return [write_expression(side, self.language, scope) for side in self.sides]

    @property
    def n_start_samples(self) -> int:
        """Number of first samples that are inputs of the program, not computed."""
        return max(self.identified.model.memory, 1) if self.is_recursion else 1

    def find_initial_value(self, state: int) -> float | None:
        """Find the start of a state; None if it must be measured, or is computed.

        Raises
        ------
        InvalidSettings
            If the value of an estimated start is missing.
        """
        model = self.identified.model
        name = name_initial_state(model.states[state].name, 0)
        value, initial = self.identified.find_value(name), model.initial[state]
        if value is not None:
            return value.value
        if isinstance(initial, FixedInitial):
            return initial.value
        if isinstance(initial, MeasuredInitial | DerivedInitial):
            return None
        raise InvalidSettings(f"/values/{name}", "a value is missing")

    def is_start_given(self, state: int) -> bool:
        """Whether the start of a state is given to the program, not computed by it."""
        return not isinstance(self.identified.model.initial[state], DerivedInitial)

    def write_start(self, state: int) -> str:
        """Write the start of a state: its name, or what it follows from."""
        model = self.identified.model
        initial = model.initial[state]
        if isinstance(initial, DerivedInitial):
            return write_expression(initial.expression, self.language, StartScope(self))
        return self.prefix + self.start_names[model.states[state].name]

    def write_history(self, state: str) -> str:
        """Write the value of a state before the start.

        Of a history function only the last step may be needed, by a cubic through four samples.
        """
        model = self.identified.model
        history = model.find_history(state)
        is_read = model.solver.interpolation == "cubic" and not reads_cubics(model)
        if history is not None and is_read:
            scope = HistoryScope(self, f"(-{self.step_variable})")
            return write_expression(history, self.language, scope)
        zero = model.solver.history == "zero"
        return "0.0" if zero else f"{self.array_names[state]}[0]"

    def list_arrays(self, state: str) -> tuple[str, ...]:
        """List the arrays that past values are read from: the state's, and those of its rises."""
        return self.array_names[state], *self.rise_names.get(state, ())

    def assign_rises(self, which: Literal["first", "last"], slopes: str) -> list[str]:
        """Write the rises of a step by its first or last slopes, of the states that need them."""
        states = [state.name for state in self.identified.model.states]
        column = 0 if which == "first" else 1
        return [
            line
            for name, rises in self.rise_names.items()
            for line in self.language.assign(
                f"{rises[column]}[step]", f"dt*{slopes}[{states.index(name)}]"
            )
        ]

    def write_helper_call(self, helper: str, *arguments: str) -> str:
        """Write a call of a helper, and include its text in the program."""
        self.helper_names.add(helper)
        return f"{helper}({', '.join(arguments)})"

    def name_delay(self, expression: Expression) -> str:
        """Name the variable of a time lag in integration steps."""
        if expression not in self.delay_names:
            self.delay_names[expression] = self.identifiers.make_identifier(
                f"delay_{len(self.delay_names) + 1}"
            )
        return self.delay_names[expression]

    def name_argument(self, signal: str, role: str) -> str:
        """Name an argument of one sample of a signal: ``u_now``."""
        if (signal, role) not in self.argument_names:
            name = self.identifiers.make_identifier(f"{signal}_{role}")
            self.argument_names[signal, role] = name
        return self.argument_names[signal, role]

    def write_ramp_width(self) -> str:
        """Write half the width of a held input's jump, in samples, as in `FineInput`."""
        if self.grid_step is not None:
            points = f"2*ceil({POINTS_PER_SAMPLE // 2}*ratio - 1e-3)"
            return f"ratio/{self.language.write_clamp(points, 4, MAX_POINTS_PER_STEP)}"
        n_points = min(
            max(2 * ceil(POINTS_PER_SAMPLE / self.substeps / 2 - 1e-3), 4), MAX_POINTS_PER_STEP
        )
        return write_number(1.0 / (n_points * self.substeps))

    def find_step_lengths(self) -> set[str]:
        """Find the lengths that the helpers of the program need: ramp, width, half."""
        arguments = ", ".join(HELPER_ARGUMENTS.get(name, "") for name in self.helper_names)
        return {name for name in ("ramp", "width", "half") if name in arguments}

    def write_half_step(self) -> str:
        """Write half an integration step in samples: a delayed held input is a mean over a step."""
        return "0.5*ratio" if self.grid_step is not None else write_number(0.5 / self.substeps)

    @property
    def mean_input_names(self) -> frozenset[str]:
        """Inputs that are read as means over a step if they are held."""
        return find_averaged_inputs(self.identified.model)


@dataclass(frozen=True, slots=True)
class LoopScope(ExportScope):
    """Position in the loop where an expression is evaluated.

    ``slope``: `part` of a step after its start; ``update``: at its start, or where a part of it
    begins; ``recursion``: at sample k; ``output``: at a finished step. `equation` is the number of
    the equation.
    """

    program: GeneratedProgram
    stage: EvaluationStage
    equation: int = -1

    def write_symbol(self, symbol: Symbol) -> str:
        """Write a parameter or a reserved name."""
        program = self.program
        if symbol.kind == "parameter":
            return program.prefix + program.parameter_names[symbol.name]
        if symbol.kind == "period":
            return program.step_variable
        if symbol.kind == "index":
            return program.language.write_float(program.loop_variable)
        return f"({self._write_index()}*{program.step_variable})"

    def write_past_value(self, past: PastValue) -> str:
        """Write a state or an input, now or in the past."""
        return self._write_input(past) if past.kind == "input" else self._write_state(past)

    @property
    def _part(self) -> str:
        """Place in the present step; empty: at a finished step."""
        is_divided = self.stage == "update" and bool(self.program.sides)
        return "begin" if is_divided else "part" if self.stage == "slope" else ""

    def _write_index(self) -> str:
        return f"(step + {self._part})" if self._part else self.program.loop_variable

    def _write_position(self, past: PastValue) -> str:
        offset = f"-{past.offset}" if past.offset else ""
        delay = f" - {self._write_delay(past)}" if past.delay is not None else ""
        place = f"step + {self._part}" if self._part else self.program.loop_variable
        return place + offset + delay

    def _write_delay(self, past: PastValue) -> str:
        """Write a time lag in steps: its variable, or what it is now if it changes with inputs."""
        if past.delay is None:
            return ""
        if has_varying_delay(past):
            return write_delay_steps(self.program, past.delay, self)
        return self.program.name_delay(past.delay)

    # ---- inputs ---------------------------------------------------------------------------
    def _write_input(self, past: PastValue) -> str:
        program = self.program
        name, substeps = program.input_names[past.name], program.substeps
        held = program.identified.get_hold(past.name) not in ("first", "band-limited")
        early = self.stage == "output" and past.offset > 0  # may lie before the record
        if past.delay is None and program.grid_step is None and not early:
            if held:
                index = "step" if self._part else self._write_position(past)
                return program.language.write_element(name, index, substeps)
            if substeps == 1 and not self._part:
                return program.language.write_element(name, self._write_position(past), 1)
        position = self._write_sample_position(past)
        on_grid = "" if program.grid_step is None else "_on_grid"
        if held and past.name in program.mean_input_names:
            helper = f"averaged{on_grid}"
            position += " + half" if program.is_recursion else ""
        elif held:
            helper = "held"
            position += self._write_jump_offset(past)
        else:
            helper = f"between{on_grid}"
        program.helper_names.add(helper)
        return program.language.write_signal_read(helper, name, position)

    def _write_sample_position(self, past: PastValue) -> str:
        program, position = self.program, self._write_position(past)
        if program.grid_step is not None:
            return f"({position})*ratio"
        if program.substeps == 1:
            return position
        return f"({position})/{write_number(program.substeps)}"

    def _write_jump_offset(self, past: PastValue) -> str:
        """Offset at a jump: a recursion reads after it, a solver from one jump to the next."""
        if self.program.is_recursion:
            return " + ramp"
        if past.delay is not None:
            return ""
        return f" + ramp*(1.0 - 2.0*{self._part})" if self._part else " + ramp"

    # ---- states ---------------------------------------------------------------------------
    def _write_state(self, past: PastValue) -> str:
        program = self.program
        if past.delay is None and past.offset == 0:
            return self._write_present_state(past.name)
        if self.stage == "recursion":
            return self._write_earlier_state(past)
        history = program.identified.model.find_history(past.name)
        value = self._write_delayed_state(past)
        if history is None or past.delay is None:
            return value
        delay, position = program.name_delay(past.delay), self._write_state_position(past.name)
        time = f"(({position} - {delay})*{program.step_variable})"
        before = write_expression(history, program.language, HistoryScope(program, time))
        return program.language.write_choice(f"{position} < {delay}", before, value)

    def _write_state_position(self, name: str) -> str:
        """Write the position in steps from which a delay of a state counts."""
        place = self._write_state_part(name)
        return f"step + {place}" if place else self.program.loop_variable

    def _write_state_part(self, name: str) -> str:
        """Write the place in the present step at which a state is read; empty: its start."""
        if self.stage == "update" and self._is_updated(name):
            return "end" if self._part else "1.0"
        return self._part

    def _write_delayed_state(self, past: PastValue) -> str:
        program = self.program
        every, before = program.list_arrays(past.name), program.write_history(past.name)
        delay = self._write_state_delay(past)
        if place := self._write_state_part(past.name):
            there = self._write_present_state(past.name)
            return program.write_helper_call("lately", *every, before, "step", place, there, delay)
        return program.write_helper_call("past", *every, before, program.loop_variable, delay)

    def _write_earlier_state(self, past: PastValue) -> str:
        program = self.program
        every, before = program.array_names[past.name], program.write_history(past.name)
        if past.delay is None:
            return f"{every}[k-{past.offset}]"
        delay = program.name_delay(past.delay)
        if past.offset == 0:
            present = self._write_present_state(past.name)
            return program.write_helper_call("lately", every, before, "k-1", "1.0", present, delay)
        whole = f"{write_number(past.offset - 1)} + " if past.offset > 1 else ""
        return program.write_helper_call("past", every, before, "k-1", whole + delay)

    def _write_state_delay(self, past: PastValue) -> str:
        offset = write_number(past.offset) if past.offset else ""
        delay = self.program.name_delay(past.delay) if past.delay is not None else ""
        return " + ".join(part for part in (offset, delay) if part)

    def _write_present_state(self, name: str) -> str:
        program = self.program
        every = program.array_names[name]
        if self.stage == "slope":
            return program.present_names[name]
        if self.stage == "recursion":
            return program.present_names[name] if self._is_updated(name) else f"{every}[k-1]"
        if self.stage == "update" and self._is_updated(name):
            return program.next_names[name]
        return f"{every}[{program.loop_variable}{' + 1' if self._part else ''}]"

    def _is_updated(self, name: str) -> bool:
        """Whether the state's next value is computed before the equation."""
        model = self.program.identified.model
        index = [state.name for state in model.states].index(name)
        if self.program.is_recursion:
            return model.order.index(index) < model.order.index(self.equation)
        return model.solver.method == "semi-implicit" and index < self.equation


@dataclass(frozen=True, slots=True)
class DelayScope(ExportScope):
    """Scope of a time lag: parameters and the sampling period."""

    program: GeneratedProgram

    def write_symbol(self, symbol: Symbol) -> str:
        """Write a parameter or the sampling period."""
        return LoopScope(self.program, "output").write_symbol(symbol)

    def write_past_value(self, past: PastValue) -> str:
        """Never called: the language allows no signals in a time lag."""
        raise AssertionError(f"a time lag contains no signal such as {past.name}")


@dataclass(frozen=True, slots=True)
class StartScope(DelayScope):
    """Scope of a start: parameters, the sampling period and the inputs' first values."""

    def write_past_value(self, past: PastValue) -> str:
        """Write the first value of an input."""
        return f"{self.program.input_names[past.name]}[0]"


@dataclass(frozen=True, slots=True)
class HistoryScope(DelayScope):
    """Scope of a history function: parameters, and a time before the start."""

    time: str

    def write_symbol(self, symbol: Symbol) -> str:
        """Write the time, or a parameter."""
        return self.time if symbol.kind == "time" else DelayScope.write_symbol(self, symbol)


def write_delay_steps(
    program: GeneratedProgram, delay: Expression, scope: ExportScope | None = None
) -> str:
    """Write a time lag in integration steps; `scope`: where in the loop, if it changes there."""
    names = DelayScope(program) if scope is None else scope
    if program.is_recursion:
        text = write_expression(delay, program.language, names)
    else:
        seconds = write_expression(delay, program.language, names, Level.SIGN)
        text = f"{seconds}/{program.step_variable}"
    is_whole = program.identified.model.solver.interpolation == "nearest"
    written = program.language.write_delay(text, is_whole=is_whole)
    return written if scope is None else program.language.write_limit(written)


# ---- common to both languages ---------------------------------------------------------------
def time_loop(
    program: GeneratedProgram, runge_kutta: Callable[[GeneratedProgram], list[str]]
) -> list[str]:
    """Write the loop that computes the states; the Runge-Kutta loop differs by language."""
    if program.is_recursion:
        return _write_recursion(program)
    if program.identified.model.solver.method == "rk4":
        return runge_kutta(program)
    return _write_euler(program)


def _write_recursion(program: GeneratedProgram) -> list[str]:
    model, language = program.identified.model, program.language
    body: list[str] = []
    for i in model.order:
        name = model.states[i].name
        now = program.present_names[name]
        body += language.assign(now, equation(program, "recursion", i), is_new=True)
        body += language.assign(f"{program.array_names[name]}[k]", now)
    head = language.open_loop("k", str(program.n_start_samples), to_last=True)
    return [head, *indent_lines(body), *language.close_loop()]


def _write_euler(program: GeneratedProgram) -> list[str]:
    """Write Euler's methods; the states of a divided step are those of the next as they come."""
    model, language, most = program.identified.model, program.language, len(program.sides)
    present, width = ("step + 1", "duration") if most else ("step", "dt")
    body: list[str] = []
    for i, state in enumerate(model.states):
        slope = equation(program, "update", i, Level.PRODUCT)
        text = f"{program.array_names[state.name]}[{present}] + {width}*{slope}"
        body += language.assign(program.next_names[state.name], text, is_new=True)
    for state in model.states:
        target = f"{program.array_names[state.name]}[step + 1]"
        body += language.assign(target, program.next_names[state.name])
    if most:
        parts = [
            *language.open_parts(program.stem, most),
            *indent_lines(body),
            *language.close_parts(),
        ]
        arrays = [program.array_names[state.name] for state in model.states]
        copies = [language.assign(f"{name}[step + 1]", f"{name}[step]") for name in arrays]
        body = [*chain.from_iterable(copies), *parts]
    head = language.open_loop("step", program.first_step, to_last=False)
    return [head, *indent_lines(body), *language.close_loop()]


def equation(program: GeneratedProgram, kind: EvaluationStage, index: int, floor: int = 0) -> str:
    """Write an equation's right-hand side; in parentheses if it binds less than `floor`."""
    tree = program.identified.model.equations[index]
    return write_expression(tree, program.language, LoopScope(program, kind, index), floor)


def indent_lines(lines: Sequence[str], levels: int = 1) -> list[str]:
    """Indent lines (or several joined)."""
    return [textwrap.indent(line, "    " * levels) for line in lines]


_CALLED_HELPERS = {
    "lately": ("past",),
    "past": ("sample",),
    "clip": ("least", "greatest"),
    "pchip": ("table",),
    "table": ("table_interval",),
}
"""Helpers that helpers call, each caller before those that it calls; a language may have fewer."""


def list_needed_helpers(helpers: Mapping[str, str], program: GeneratedProgram) -> list[str]:
    """List the texts of used helpers and those they call, each before its caller."""
    wanted = program.helper_names | program.language.called_functions
    wanted |= {name.removesuffix("_on_grid") for name in wanted}
    for caller, called in _CALLED_HELPERS.items():
        if caller in wanted:
            wanted |= set(called)
    variants = _find_variants(program.identified)
    return [helpers[variants.get(name, name)] for name in helpers if name in wanted]


def _find_variants(identified: IdentifiedModel) -> Mapping[str, str]:
    """Find the helpers with a variant for the solver of the model."""
    solver = identified.model.solver
    variants = {"past": "past cubic"} if solver.interpolation == "cubic" else {}
    if reads_cubics(identified.model):
        variants = {"past": "past by slopes", "lately": "lately by slopes"}
    if identified.model.form == "differential" and solver.step is not None:
        variants["held"] = "held on grid"  # its points need not meet the jumps
    return variants
