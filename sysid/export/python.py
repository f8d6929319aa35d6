"""Export as a Python module of one function that needs nothing but NumPy."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from sysid.control.linear_form import IdentifiedModel
from sysid.data.interpolation import MAX_POINTS_PER_STEP
from sysid.export.description import describe_model, describe_unit, describe_values, wrap_source
from sysid.export.expression_text import TargetLanguage, write_expression, write_number
from sysid.export.identifiers import Identifiers, escape_docstring
from sysid.export.observer import (
    Observer,
    list_used_lines,
    list_window_arrays,
    pair_arguments,
)
from sysid.export.program import (
    GeneratedProgram,
    LoopScope,
    equation,
    indent_lines,
    list_needed_helpers,
    time_loop,
    write_delay_steps,
)
from sysid.language.functions import FUNCTIONS, Level
from sysid.language.time_switches import HALVINGS
from sysid.models.model import ModelSignal, Output
from sysid.simulation.grid import GRID_TOLERANCE

_RESERVED_WORDS = (
    "False None True and as assert async await break class continue def del elif else except "
    "finally for from global if import in is lambda nonlocal not or pass raise return try while "
    "with match case type np t simulate rates step steps part dt h k now slope_1 slope_2 slope_3 "
    "slope_4 every points ratio ramp half width averaged averaged_on_grid sample_time range zip "
    "map max min int float abs len between between_on_grid held past lately grid print math erf "
    "pchip pchip_slope slice ValueError sides find_switch begin end behind duration number"
)
_LINE_WIDTH = 96


@dataclass(slots=True)
class PythonLanguage(TargetLanguage):
    """Python, with NumPy's functions on single numbers: overflow gives ``inf``, not an error."""

    logical_operators: ClassVar[Mapping[str, str]] = {}
    whole_division, length_argument = "//", ""
    called_functions: set[str] = field(default_factory=set)

    def write_negation(self, condition: str) -> str:
        """Write ``not (…)``, valid anywhere."""
        return f"(not ({condition}))"

    def write_function_call(self, name: str, arguments: list[str]) -> str:
        """Write a call of a function of the model language."""
        if name in HELPERS:
            self.called_functions.add(name)
            return f"{name}({', '.join(arguments)})"
        return f"np.{FUNCTIONS[name].numpy}({', '.join(arguments)})"

    def write_table(self, name: str, argument: str, x: list[str], y: list[str]) -> str:
        """Write a call of a table with its points."""
        points = f"{argument}, [{', '.join(x)}], [{', '.join(y)}]"
        return self.write_function_call(name, [points])

    def write_power(self, base: str, exponent: str, whole: int | None) -> tuple[str, int]:
        """Write a power and its level."""
        if whole is not None:
            return f"{base}**{whole}", Level.ATOM - 1
        return f"np.power({base}, {exponent})", Level.ATOM

    def write_choice(self, condition: str, first: str, second: str) -> str:
        """Write ``where``, valid anywhere."""
        return f"({first} if {condition} else {second})"

    def write_constant_dividend(self, above: str) -> str:
        """Write a dividend of numbers only."""
        return f"np.float64({above})"

    def write_clamp(self, value: str, least: int, most: int) -> str:
        """Write a number limited to a range."""
        return f"min(max({value.replace('ceil', 'np.ceil')}, {least}), {most})"

    def write_float(self, index: str) -> str:
        """Write a whole number as floating-point number."""
        return f"np.float64({index})"

    def write_delay(self, text: str, *, is_whole: bool) -> str:
        """Write a time lag that is not negative."""
        least = f"max(0.0, {text})"  # this order makes nan 0, as in a kernel
        return f"np.floor({least} + 0.5)" if is_whole else least

    def write_limit(self, delay: str) -> str:
        """Write a time lag that is at most 1e9 steps."""
        return f"min({delay}, 1e9)"

    def open_loop(self, index: str, first: str, *, to_last: bool) -> str:
        """Write the first line of a loop over the steps."""
        ends = f"{first}, " if first != "0" else ""
        return f"for {index} in range({ends}steps{' + 1' if to_last else ''}):"

    def assign(self, name: str, text: str, *, is_new: bool = False) -> list[str]:
        """Write an assignment; a new name is not declared."""
        return _wrap_statement(f"{name} = ", text)

    def close_loop(self) -> list[str]:
        """Return nothing: the loop ends with its indentation."""
        return []

    def open_parts(self, stem: str, most: int) -> list[str]:
        """Write the first lines of a loop over the parts of a step."""
        return [
            "begin, number = 0.0, 0",
            "while begin < 1.0:",
            f"    end, behind = find_switch(step, begin) if number < {most} else (1.0, 1.0)",
            "    duration = (end - begin)*dt",
        ]

    def close_parts(self) -> list[str]:
        """Write the step to the next part."""
        return ["    begin, number = behind, number + 1"]


def write_python_source(identified: IdentifiedModel, observer: Observer | None = None) -> str:
    """Write a module with one function ``simulate(t, u, …) -> y``.

    An observer adds a class ``Observer``.

    Raises
    ------
    InvalidSettings
        If a value is missing.
    """
    language = PythonLanguage()
    program = GeneratedProgram(identified, language, Identifiers(_RESERVED_WORDS.split()))
    loop = [
        *_write_switches(program),
        *time_loop(program, _write_runge_kutta),
        *_write_outputs(program),
    ]
    head = [
        *_write_arrays(program),
        *_write_step_count(program),
        *_write_delays(program),
        *_write_starts(program),
    ]
    filtered: list[str] = []
    if observer is not None:
        own = GeneratedProgram(
            observer.identified,
            language,
            Identifiers(
                [
                    *_RESERVED_WORDS.split(),
                    "self",
                    "factor",
                    "innovation",
                    "change",
                    "array",
                    "states",
                ]
            ),
            first_step=f"steps - {observer.substeps}",
        )
        filtered = _write_observer(own, observer)
        program.helper_names |= own.helper_names
    helpers = list_needed_helpers(HELPERS, program)
    body = [*head, 'with np.errstate(all="ignore"):  # what diverges becomes inf or nan']
    body += indent_lines(loop)
    parts = [
        _write_docstring(identified),
        ("import math\n\n" if "erf" in language.called_functions else "") + "import numpy as np\n",
        *(f"\n{helper}" for helper in helpers),
    ]
    arguments = ["t", *program.input_names.values()]
    parts.append("\n" + _write_signature(program, "simulate", arguments))
    parts += [textwrap.indent("\n".join(_write_function_docstring(program)), "    ")]
    parts += [textwrap.indent("\n".join(body), "    "), *filtered]
    return "\n".join(parts) + "\n"


def _write_docstring(identified: IdentifiedModel) -> str:
    lines = [escape_docstring(line) for line in describe_model(identified)]
    return "\n".join(['"""' + lines[0], "", *lines[1:], '"""', ""])


def _write_signature(program: GeneratedProgram, name: str, first: Sequence[str]) -> str:
    """Write the head of a function: its first arguments, then starts and parameters as keywords."""
    identified = program.identified
    numbers = identified.parameter_values
    required = [
        program.start_names[state.name]
        for i, state in enumerate(identified.model.states)
        if program.is_start_given(i) and program.find_initial_value(i) is None
    ]
    defaults = [
        f"{program.parameter_names[parameter.name]}={write_number(numbers[parameter.name])}"
        for parameter in identified.model.parameters
    ]
    starts = [
        f"{program.start_names[state.name]}={write_number(start)}"
        for i, state in enumerate(identified.model.states)
        if (start := program.find_initial_value(i)) is not None
    ]
    named = [*required, *defaults, *starts]
    arguments = [*first, *(["*"] if named else []), *named]
    return f"def {name}(\n" + _wrap_lines(", ".join(arguments) + ",", "    ") + "\n):"


def _write_function_docstring(program: GeneratedProgram) -> list[str]:
    model = program.identified.model
    lines = [
        '"""Free run of the model from its start.',
        "",
        "Parameters",
        "----------",
        "t : array (N,)",
        "    Times in s, one sampling period apart.",
    ]
    for signal in model.inputs:
        lines += _describe_signal(program, program.input_names[signal.name], "Input", signal)
    for name, line in describe_values(
        program.identified, program.parameter_names, program.start_names
    ):
        lines += [f"{name} : float", f"    {line}"]
    lines += ["", "Returns", "-------"]
    for output in model.outputs:
        lines += _describe_signal(program, program.output_names[output.name], "Output", output)
    return [lines[0], *map(_escape_line, lines[1:]), '"""']


def _describe_signal(
    program: GeneratedProgram, identifier: str, kind: str, signal: ModelSignal | Output
) -> list[str]:
    unit = describe_unit(program.identified.get_unit(signal))
    about = f"    {kind} {signal.name}, {unit}."
    return [f"{identifier} : array (N,)", about]


def _escape_line(line: str) -> str:
    indent = len(line) - len(line.lstrip())
    return " " * indent + escape_docstring(line)


def _write_arrays(program: GeneratedProgram) -> list[str]:
    lines = ["t = np.asarray(t, dtype=np.float64)"]
    signals = program.input_names.values()
    lines += [f"{name} = np.asarray({name}, dtype=np.float64)" for name in signals]
    shapes = [f"{name}.shape != t.shape" for name in signals]
    wrong = " or ".join(["t.ndim != 1", "t.size < 2", *shapes])
    lines += [
        *_wrap_statement("if ", wrong, ":"),
        '    raise ValueError("t and the inputs must have one shape (N,), N > 1")',
        "sample_time = (t[-1] - t[0])/(t.size - 1)",
        "if not np.max(np.abs(np.diff(t) - sample_time)) < 0.1*sample_time:",
        '    raise ValueError("t must be regular; resample the inputs first")',
    ]
    if program.parameter_names:
        targets = ", ".join(program.parameter_names.values())
        both = _wrap_lines(targets + ",", "    ")
        lines += ["(", both, ") = map(np.float64, (", both, "))"]
    return lines


def _write_step_count(program: GeneratedProgram) -> list[str]:
    period, substeps = program.step_variable, program.substeps
    if program.grid_step is None:
        divided = f"/{substeps}" if substeps > 1 else ""
        times = f"*{substeps}" if substeps > 1 else ""
        count = f"(t.size - 1){times}" if substeps > 1 else "t.size - 1"
        lines = [f"{period} = sample_time{divided}", f"steps = {count}"]
    else:
        grid_step = write_number(program.grid_step)
        lines = [
            f"dt = {grid_step}/{substeps}" if substeps > 1 else f"dt = {grid_step}",
            f"points = int(np.ceil((t[-1] - t[0])/{grid_step} - 0.01))",
            f"steps = points*{substeps}",
            "ratio = dt/sample_time",
        ]
    needed = program.find_step_lengths()
    if needed & {"ramp", "width"}:
        lines.append(f"ramp = {program.write_ramp_width()}  # samples: half the width of a jump")
    if "width" in needed:
        lines += [
            "width = ramp  # samples: from point to point of an input on lines, few that meet all",
            f"for k in range({MAX_POINTS_PER_STEP}, 0, -2):",
            "    if np.max(np.abs(k*(t - t[0])/dt - np.round(k*(t - t[0])/dt))) < 0.05:",
            "        width = ratio/k",
        ]
    if "half" in needed:
        lines.append(f"half = {program.write_half_step()}  # samples: half an integration step")
    return lines


def _write_delays(program: GeneratedProgram) -> list[str]:
    delays = program.delay_names.items()
    return [
        f"{name} = {write_delay_steps(program, delay)}  # integration steps"
        for delay, name in delays
    ]


def _write_starts(program: GeneratedProgram) -> list[str]:
    lines = []
    for i, state in enumerate(program.identified.model.states):
        every, start = program.array_names[state.name], program.write_start(i)
        lines += [
            f"{every} = np.empty(steps + 1)",
            f"{every}[:{program.n_start_samples}] = {start}",
        ]
    for rises in program.rise_names.values():
        lines += [f"{name} = np.empty(steps)" for name in rises]
    return lines


# ---- the time loop --------------------------------------------------------------------------
def _write_runge_kutta(program: GeneratedProgram) -> list[str]:
    model = program.identified.model
    states = [program.present_names[state.name] for state in model.states]
    slopes: list[str] = []
    for i in range(len(model.states)):
        slopes += indent_lines(_wrap_statement("", equation(program, "slope", i), ","), 2)
    every = [program.array_names[state.name] for state in model.states]
    now = ", ".join(f"{name}[step]" for name in every)
    following = [f"{name}[step + 1]" for name in every]
    target = ", ".join(following) if len(following) > 1 else f"({following[0]},)"
    lines = [
        f"def rates(step, part, {', '.join(states)}):  # at `part` of a step after it began",
        "    return np.array([",
        *slopes,
        "    ])",
        "",
        program.language.open_loop("step", program.first_step, to_last=False),
        f"    now = np.array([{now}])",
    ]
    if program.sides:
        parts = [
            *program.language.open_parts(program.stem, len(program.sides)),
            "    slope_1 = rates(step, begin, *now)",
            *_write_first_rises(program),
            "    slope_2 = rates(step, 0.5*(begin + end), *(now + duration/2*slope_1))",
            "    slope_3 = rates(step, 0.5*(begin + end), *(now + duration/2*slope_2))",
            "    slope_4 = rates(step, end, *(now + duration*slope_3))",
            *indent_lines(program.assign_rises("last", "slope_4")),
            "    now = now + duration/6*(slope_1 + 2*slope_2 + 2*slope_3 + slope_4)",
            *program.language.close_parts(),
            f"{target} = now",
        ]
        return [*lines, *indent_lines(parts)]
    return [
        *lines,
        "    slope_1 = rates(step, 0.0, *now)",
        *indent_lines(program.assign_rises("first", "slope_1")),
        "    slope_2 = rates(step, 0.5, *(now + dt/2*slope_1))",
        "    slope_3 = rates(step, 0.5, *(now + dt/2*slope_2))",
        "    slope_4 = rates(step, 1.0, *(now + dt*slope_3))",
        *indent_lines(program.assign_rises("last", "slope_4")),
        *indent_lines(
            _wrap_statement(
                f"{target} = ", "now + dt/6*(slope_1 + 2*slope_2 + 2*slope_3 + slope_4)"
            )
        ),
    ]


def _write_first_rises(program: GeneratedProgram) -> list[str]:
    """Write the rises by the first slope of a step, in its first part."""
    rises = program.assign_rises("first", "slope_1")
    return ["    if number == 0:", *indent_lines(rises, 2)] if rises else []


def _write_switches(program: GeneratedProgram) -> list[str]:
    """Write the functions that find the switches in time of a step; none if there are none."""
    if not program.sides:
        return []
    sides = [_wrap_statement("", side, ",") for side in program.write_sides()]
    return [
        "def sides(step, part):  # whole numbers, each of which changes at a switch in time",
        "    return np.array([",
        *indent_lines([line for side in sides for line in side], 2),
        "    ])",
        "",
        "def find_switch(step, begin):  # just before and just behind the next one in a step",
        "    before, low, high = sides(step, begin), begin, 1.0",
        "    if np.array_equal(before, sides(step, high)):",
        "        return high, high",
        f"    for _ in range({HALVINGS}):",
        "        middle = 0.5*(low + high)",
        "        if np.array_equal(before, sides(step, middle)):",
        "            low = middle",
        "        else:",
        "            high = middle",
        "    return low, high",
        "",
    ]


def _write_outputs(program: GeneratedProgram) -> list[str]:
    model, substeps = program.identified.model, program.substeps
    by = f"0, steps + 1, {substeps}" if substeps > 1 else "steps + 1"
    lines = []
    if program.grid_step is not None:
        whole = f"np.abs(grid - np.round(grid)) < {write_number(GRID_TOLERANCE)}"
        lines += [
            f"grid = (t - t[0])/{write_number(program.grid_step)}",
            f"grid = np.where({whole}, np.round(grid), grid)",
        ]
    for output in model.outputs:
        text = write_expression(output.expression, program.language, LoopScope(program, "output"))
        loop = f"for {program.loop_variable} in range({by})"
        target = program.output_names[output.name]
        lines += [
            f"{target} = np.array([",
            *indent_lines(_wrap_statement("", text)),
            f"    {loop}",
            "], dtype=np.float64)",
        ]
        if program.grid_step is not None:
            lines.append(f"{target} = np.interp(grid, np.arange(points + 1), {target})")
    return [*lines, f"return {', '.join(program.output_names.values())}"]


# ---- the observer ---------------------------------------------------------------------------
def _write_observer(program: GeneratedProgram, observer: Observer) -> list[str]:
    """Write the class ``Observer`` with its methods ``advance`` and ``correct``."""
    inputs, outputs = (
        [argument for _, argument in pair_arguments(program, names)]
        for names in (program.input_names, program.output_names)
    )
    loop = [
        *_move_window(program, observer),
        'with np.errstate(all="ignore"):',
        *indent_lines(time_loop(program, _write_runge_kutta)),
    ]
    corrections = _write_corrections(program, observer)
    names = list(_name_observer_parts(program, observer))
    present = [*names, ("step", "step = steps")]
    start = _write_window_start(program, observer)
    before = [(name, line) for name, line in names if " = self." not in line]
    return [
        "",
        "",
        "class Observer:",
        *indent_lines(_write_observer_docstring(program, observer)),
        "",
        *indent_lines([_write_signature(program, "__init__", ["self", *inputs])]),
        *indent_lines([*list_used_lines(before, start), *start], 2),
        "",
        f"    def advance({', '.join(['self', *inputs])}):",
        '        """Go on to the next sample, with the inputs there."""',
        *indent_lines([*list_used_lines(names, loop), *loop], 2),
        "",
        f"    def correct({', '.join(['self', *outputs])}):",
        '        """Predict the outputs now, then correct the states by what was measured."""',
        *indent_lines([*list_used_lines(present, corrections), *corrections], 2),
    ]


def _write_observer_docstring(program: GeneratedProgram, observer: Observer) -> list[str]:
    model = observer.identified.model
    lines = [
        '"""Observer (Kalman filter): predictions of the outputs from the samples before.',
        "",
        f"Samples are {observer.sample_time:.10g} s apart. It begins at the first one, with the "
        "inputs there.",
        "`correct` returns what is predicted for the present sample, and then takes what was",
        "measured; nan: not measured. Without it `advance` predicts further ahead, on a copy",
        f"(copy.deepcopy) if need be. Time lags may be up to {observer.longest_lag:.6g} s.",
        "`states` has the arrays of the last steps; the last element of each is the present one.",
        "",
        "Parameters",
        "----------",
    ]
    for signal in model.inputs:
        unit = describe_unit(program.identified.get_unit(signal))
        argument = program.name_argument(program.input_names[signal.name], "now")
        lines += [f"{argument} : float", f"    {signal.name}, {unit}."]
    for name, line in describe_values(
        program.identified, program.parameter_names, program.start_names
    ):
        lines += [f"{name} : float", f"    {line}"]
    return [lines[0], *map(_escape_line, lines[1:]), '"""']


def _name_observer_parts(
    program: GeneratedProgram, observer: Observer
) -> Iterator[tuple[str, str]]:
    """Name what the methods of an observer may use: lengths, parameters, arrays, delays."""
    parameters = [*program.parameter_names.values()]
    yield from ((name, f"{name} = self.parameters[{i}]") for i, name in enumerate(parameters))
    yield "sample_time", f"sample_time = {write_number(observer.sample_time)}"
    yield "dt", f"dt = sample_time/{observer.substeps}"
    yield "steps", f"steps = {observer.steps}"
    if "half" in program.find_step_lengths():
        yield "half", f"half = {program.write_half_step()}  # samples: half an integration step"
    if "ramp" in program.find_step_lengths():
        yield "ramp", f"ramp = {program.write_ramp_width()}  # samples: half the width of a jump"
    for i, name in enumerate(program.input_names.values()):
        yield name, f"{name} = self.inputs[{i}]"
    for i, name in enumerate(list_window_arrays(program)):
        yield name, f"{name} = self.states[{i}]"
    for delay, name in program.delay_names.items():
        yield name, f"{name} = {write_delay_steps(program, delay)}  # integration steps"


def _write_window_start(program: GeneratedProgram, observer: Observer) -> list[str]:
    model, inputs = observer.identified.model, [*program.input_names.values()]
    parameters, lines = [*program.parameter_names.values()], list[str]()
    if parameters:
        targets = _wrap_lines(", ".join(parameters) + ",", "    ")
        lines += ["self.parameters = tuple(map(np.float64, (", targets, ")))"]
    lines += [
        f"{name} = np.full({observer.samples}, {argument}, np.float64)"
        for name, argument in pair_arguments(program, program.input_names)
    ]
    for i, state in enumerate(model.states):
        name = program.array_names[state.name]
        lines += _wrap_statement(
            f"{name} = np.full(steps + 1, ", program.write_start(i), ", np.float64)"
        )
        if model.solver.history == "zero":
            lines.append(f"{name}[:-1] = 0.0")
    arrays = list_window_arrays(program)
    lines += [f"{name} = np.zeros(steps + 1)" for name in arrays[len(model.states) :]]
    return [
        *lines,
        f"self.inputs = [{', '.join(inputs)}]",
        *_wrap_statement("self.states = ", f"[{', '.join(arrays)}]"),
    ]


def _move_window(program: GeneratedProgram, observer: Observer) -> list[str]:
    substeps = observer.substeps
    lines = []
    for i, (_, argument) in enumerate(pair_arguments(program, program.input_names)):
        window = f"self.inputs[{i}]"
        lines += [f"{window}[:-1] = {window}[1:]", f"{window}[-1] = {argument}"]
    return [
        *lines,
        "for array in self.states:",
        f"    array[:-{substeps}] = array[{substeps}:]",
    ]


def _write_corrections(program: GeneratedProgram, observer: Observer) -> list[str]:
    """Write the outputs one after the other; each corrects the states before the next is predicted.

    All changes of an output follow from the states before it.
    """
    model, language = observer.identified.model, program.language
    scope = LoopScope(program, "output")
    lines: list[str] = []
    arguments = pair_arguments(program, program.output_names)
    for (name, argument), output, correction in zip(
        arguments, model.outputs, model.corrections, strict=True
    ):
        lines += _wrap_statement(f"{name} = ", write_expression(output.expression, language, scope))
        own = write_expression(correction.variance, language, scope)
        sensor = write_number(observer.sensors[output.name])
        pairs = [*correction.gains, *correction.losses]
        body = _wrap_statement("factor = ", f"1.0/({sensor} + {own})")
        body += [f"innovation = {argument} - {name}", "change = np.array(["]
        for _, tree in pairs:
            body += indent_lines(_wrap_statement("", write_expression(tree, language, scope), ","))
        body.append("])")
        for i, (state, _) in enumerate(pairs):
            by = "factor*innovation" if i < len(correction.gains) else "-factor"
            body.append(f"{program.array_names[state]}[step] += {by}*change[{i}]")
        lines += [f"if not np.isnan({argument}):", *indent_lines(body)]
    return [*lines, f"return {', '.join(program.output_names.values())}"]


# ---- layout ---------------------------------------------------------------------------------
def _wrap_statement(before: str, text: str, after: str = "") -> list[str]:
    """Wrap a statement on as many lines as needed, in parentheses if on several."""
    if len(before) + len(text) + len(after) <= _LINE_WIDTH - 12:
        return [f"{before}{text}{after}"]
    return [f"{before}(", _wrap_lines(text, "    "), f"){after}"]


def _wrap_lines(text: str, indent: str) -> str:
    return textwrap.indent("\n".join(wrap_source(text, _LINE_WIDTH - 16)), indent)


# ---- functions that a program calls -----------------------------------------------------------
_BETWEEN = '''def between(signal, place):
    """Signal at a place in samples, on a line between them; its end values outside."""
    place = min(max(place, 0.0), signal.size - 1.0)
    i = min(int(place), signal.size - 2)
    return signal[i] + (place - i)*(signal[i + 1] - signal[i])
'''
_HELD = '''def held(signal, place, ramp):
    """Signal at a place in samples, held after each; a jump takes `ramp` to either side."""
    i = int(np.floor(place + 0.5))
    part = min(max((place - i + ramp)/(2*ramp), 0.0), 1.0)
    before = signal[min(max(i - 1, 0), signal.size - 1)]
    return before + part*(signal[min(max(i, 0), signal.size - 1)] - before)
'''
_HELD_ON_GRID = '''def held(signal, place, ramp):
    """Signal at a place in samples, held after each; on lines between points `ramp` apart."""
    i = int(np.floor(place/ramp))
    part = place/ramp - i
    value = 0.0
    for j, weight in ((i, 1.0 - part), (i + 1, part)):
        for side in (-1e-6, 1e-6):  # at a jump the mean of both sides
            k = int(np.floor(j*ramp + side))
            value += 0.5*weight*signal[min(max(k, 0), signal.size - 1)]
    return value
'''
_AVERAGED = '''def averaged(signal, place, half):
    """Mean of a held signal from `half` before a place, in samples, to `half` after it."""
    first, last = place - half, place + half
    total = 0.0
    for k in range(int(np.floor(first)), int(np.ceil(last))):
        width = min(k + 1.0, last) - max(float(k), first)
        total += width*signal[min(max(k, 0), signal.size - 1)]
    return total/(2*half)
'''
_BETWEEN_ON_GRID = '''def between_on_grid(signal, place, width):
    """What `between` gives at points `width` apart, on lines between them."""
    i = np.floor(place/width)
    first, last = between(signal, i*width), between(signal, (i + 1.0)*width)
    return first + (place/width - i)*(last - first)
'''
_AVERAGED_ON_GRID = '''def averaged_on_grid(signal, place, half, ramp):
    """What `averaged` gives at points `ramp` apart, on lines between them."""
    i = np.floor(place/ramp)
    first, last = averaged(signal, i*ramp, half), averaged(signal, (i + 1.0)*ramp, half)
    return first + (place/ramp - i)*(last - first)
'''
_PAST = '''def past(array, before, step, delay):
    """Value `delay` >= 0 steps before a finished step, linear; `before` the start."""
    i = int(np.floor(-delay))
    part = -delay - i
    older, newer = (
        array[step + j] if step + j >= 0 else before for j in (i, min(i + 1, 0))
    )
    return older + part*(newer - older)
'''
_PAST_CUBIC = '''def past(array, before, step, delay):
    """Value `delay` >= 0 steps before a finished step, on a cubic of four (last: three)."""
    i = int(np.floor(-delay))
    part = -delay - i
    nodes = (-1, 0, 1, 2) if i <= -2 else (-1, 0, 1)
    value = 0.0
    for a in nodes:
        j = step + min(i + a, 0)
        weight = np.prod([(part - b)/(a - b) for b in nodes if b != a])
        value += weight*(array[j] if j >= 0 else before)
    return value
'''
_PAST_BY_SLOPES = '''def past(array, first, last, before, step, delay):
    """Value `delay` >= 0 steps before a finished step, on a cubic; `before` the start.

    The cubic of a step has its values at both ends, and rises there at `first` and `last`.
    """
    i = int(np.floor(-delay))
    part, i = -delay - i, step + i
    older, newer = (array[j] if j >= 0 else before for j in (i, min(i + 1, step)))
    if part == 0.0:
        return older
    rise = newer - older
    begin, end = (first[i] - rise, last[i] - rise) if i >= 0 else (-rise, -rise)
    return older + part*(rise + (1.0 - part)*((1.0 - part)*begin - part*end))
'''
_LATELY = '''def lately(array, before, step, part, there, delay):
    """Value `delay` steps before the place `part` of a step after it began, where it is `there`."""
    if delay < part:
        return array[step] + (part - delay)/part*(there - array[step])
    return past(array, before, step, delay - part)
'''
_LATELY_BY_SLOPES = '''def lately(array, first, last, before, step, part, there, delay):
    """Value `delay` steps before the place `part` of a step after it began, where it is `there`."""
    if delay < part:
        share, tangent = (part - delay)/part, part*first[step]
        return array[step] + share*(tangent + share*(there - array[step] - tangent))
    return past(array, first, last, before, step, delay - part)
'''
_ERF = '''def erf(x):
    """Error function."""
    return np.float64(math.erf(x))
'''
_PCHIP = '''def pchip_slope(i, x, y):
    """Slope of a monotone cubic at its point i."""
    rise = np.diff(y)/np.diff(x)
    if len(rise) == 1:
        return rise[0]
    if 0 < i < len(rise):
        (a, b), (h, w) = rise[i - 1:i + 1], np.diff(x[i - 1:i + 2])
        return 3*(h + w)/((2*w + h)/a + (w + 2*h)/b) if a*b > 0 else 0.0
    ends = slice(0, 2) if i == 0 else slice(-1, -3, -1)
    (a, b), (h, w) = rise[ends], np.diff(x)[ends]
    slope = ((2*h + w)*a - h*b)/(h + w)
    if not slope*a > 0:
        return 0.0
    return 3*a if not a*b > 0 and abs(slope) > 3*abs(a) else slope


def pchip(place, x, y):
    """Value of a monotone cubic through points x, y; its end values outside."""
    if not x[0] < place < x[-1]:
        return np.interp(place, x, y)
    i = int(np.searchsorted(x, place, "right")) - 1
    h, part, mean = x[i + 1] - x[i], place - x[i], (y[i + 1] - y[i])/(x[i + 1] - x[i])
    over, under = mean - pchip_slope(i, x, y), pchip_slope(i + 1, x, y) - mean
    return y[i] + part*(mean - over + part*((2*over - under)/h + part*(under - over)/h**2))
'''
HELPERS: Mapping[str, str] = {
    "pchip": _PCHIP,
    "erf": _ERF,
    "between": _BETWEEN,
    "between_on_grid": _BETWEEN_ON_GRID,
    "held": _HELD,
    "held on grid": _HELD_ON_GRID,
    "averaged": _AVERAGED,
    "averaged_on_grid": _AVERAGED_ON_GRID,
    "past": _PAST,
    "past cubic": _PAST_CUBIC,
    "past by slopes": _PAST_BY_SLOPES,
    "lately": _LATELY,
    "lately by slopes": _LATELY_BY_SLOPES,
}
