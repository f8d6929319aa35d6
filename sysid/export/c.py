"""Export as self-contained C99: parameters in a struct, one function that simulates."""

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from string import Template
from typing import ClassVar

from sysid.control.linear_form import IdentifiedModel
from sysid.data.interpolation import MAX_POINTS_PER_STEP
from sysid.export.description import describe_model, describe_unit, describe_values, wrap_source
from sysid.export.expression_text import TargetLanguage, write_expression, write_number
from sysid.export.identifiers import Identifiers, escape_c_comment
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
from sysid.models.model import MeasuredInitial, ModelSignal, Output
from sysid.simulation.grid import GRID_TOLERANCE

_RESERVED_WORDS = (
    "auto break case char const continue default do double else enum extern float for goto if "
    "inline int long register restrict return short signed sizeof static struct switch typedef "
    "union unsigned void volatile while _Bool _Complex _Imaginary asm main errno "
    "pow floor ceil fmin fmax isnan isfinite NAN INFINITY HUGE_VAL NULL size_t malloc free "
    "between between_on_grid held sample past lately n t p step steps i part stage slope work "
    "points grid ratio ramp half width meets place whole averaged averaged_on_grid sample_time "
    "dt h k now y0 y1 yn j0 j1 jn gamma signgam unix linux i386 EOF stdin stdout stderr assert "
    "BUFSIZ RAND_MAX table_interval pchip_rise pchip_slope begin end behind duration number side"
)
_LINE_WIDTH = 92


@dataclass(slots=True)
class CLanguage(TargetLanguage):
    """C99 with math.h."""

    logical_operators: ClassVar[Mapping[str, str]] = {"and": "&&", "or": "||"}
    whole_division, length_argument = "/", "n, "
    called_functions: set[str] = field(default_factory=set)

    def write_negation(self, condition: str) -> str:
        """Write ``not (…)``, valid anywhere."""
        return f"!({condition})"

    def write_function_call(self, name: str, arguments: list[str]) -> str:
        """Write a call of a function of the model language."""
        function = FUNCTIONS[name].c
        self.called_functions.add(function)
        return f"{function}({', '.join(arguments)})"

    def write_table(self, name: str, argument: str, x: list[str], y: list[str]) -> str:
        """Write a call of a table with its points."""
        self.called_functions.add(name)
        points = [f"(const double[]){{{', '.join(values)}}}" for values in (x, y)]
        return f"{name}({argument}, {len(x)}, {', '.join(points)})"

    def write_power(self, base: str, exponent: str, whole: int | None) -> tuple[str, int]:
        """Write a power and its level."""
        return f"pow({base}, {exponent})", Level.ATOM

    def write_choice(self, condition: str, first: str, second: str) -> str:
        """Write ``where``, valid anywhere."""
        return f"({condition} ? {first} : {second})"

    def write_constant_dividend(self, above: str) -> str:
        """Write a dividend of numbers only: C needs nothing special."""
        return above

    def write_clamp(self, value: str, least: int, most: int) -> str:
        """Write a number limited to a range."""
        return f"fmin(fmax({value}, {least}.0), {most}.0)"

    def write_float(self, index: str) -> str:
        """Write a whole number as floating-point number."""
        return f"(double){index}"

    def write_delay(self, text: str, *, is_whole: bool) -> str:
        """Write a time lag that is not negative."""
        least = f"fmax({text}, 0.0)"
        return f"floor({least} + 0.5)" if is_whole else least

    def write_limit(self, delay: str) -> str:
        """Write a time lag that is at most 1e9 steps."""
        return f"fmin({delay}, 1e9)"

    def open_loop(self, index: str, first: str, *, to_last: bool) -> str:
        """Write the first line of a loop over the steps."""
        return (
            f"for (long {index} = {first}; {index} {'<=' if to_last else '<'} steps; ++{index}) {{"
        )

    def assign(self, name: str, text: str, *, is_new: bool = False) -> list[str]:
        """Write an assignment."""
        return _wrap_statement(f"const double {name} = " if is_new else f"{name} = ", text)

    def close_loop(self) -> list[str]:
        """Write the brace that ends a loop."""
        return ["}"]

    def open_parts(self, stem: str, most: int) -> list[str]:
        """Write the first lines of a loop over the parts of a step."""
        return [
            "double begin = 0.0;",
            "for (int number = 0; begin < 1.0; ++number) {",
            "    double end = 1.0, behind = 1.0;",
            f"    if (number < {most})",
            f"        end = {stem}_switch(p, dt, step, begin, &behind);",
            "    const double duration = (end - begin)*dt;",
        ]

    def close_parts(self) -> list[str]:
        """Write the step to the next part, and the brace."""
        return ["    begin = behind;", "}"]


def write_c_source(identified: IdentifiedModel, observer: Observer | None = None) -> str:
    """Write a C99 file: ``NAME_parameters``, ``NAME_identified`` and ``NAME_simulate``.

    An observer adds ``NAME_observer`` and its functions ``start``, ``advance`` and ``correct``.

    Raises
    ------
    InvalidSettings
        If a value is missing.
    """
    language = CLanguage()
    names = _make_identifiers()
    stem = names.make_identifier(identified.model.name)
    for suffix in ("parameters", "identified", "sides", "switch", "simulate", "observer"):
        names.make_identifier(f"{stem}_{suffix}")
    program = GeneratedProgram(identified, language, names, prefix="p->", stem=stem)
    loop = [*time_loop(program, _write_runge_kutta), *_write_outputs(program)]
    body = [
        *_write_checks(program),
        *_write_step_count(program),
        *_write_delays(program),
        *_write_state_arrays(program),
        *loop,
        "free(work);",
        "return 0;",
    ]
    switches = _write_switches(program)
    filtered = ""
    if observer is not None:
        own = GeneratedProgram(
            observer.identified,
            language,
            _make_identifiers("o", "factor", "innovation", "change"),
            prefix="p->",
            stem=f"{stem}_observer",
            first_step=f"steps - {observer.substeps}",
        )
        filtered = _write_observer(own, observer)
        program.helper_names |= own.helper_names
    helpers = list_needed_helpers(HELPERS, program)
    parts = [
        _write_header(identified, stem, has_observer=observer is not None),
        "#include <math.h>\n#include <stdlib.h>\n",
        _write_struct(program, stem),
        _write_identified_function(program, stem),
        *helpers,
        *switches,
        _write_simulate_comment(program),
        _write_signature(program, stem),
        "{",
        *indent_lines(body),
        "}",
        *(["", filtered] if filtered else []),
    ]
    return "\n".join(parts) + "\n"


def _make_identifiers(*reserved: str) -> Identifiers:
    """Make the identifiers of a program, without the words of C and those that are `reserved`."""
    functions = (function.c for function in FUNCTIONS.values())
    return Identifiers([*_RESERVED_WORDS.split(), *functions, *reserved])


def _write_header(identified: IdentifiedModel, stem: str, *, has_observer: bool) -> str:
    lines = [
        *describe_model(identified),
        "",
        f"{stem}_identified() returns the identified values.",
        f"{stem}_simulate() runs the model freely; link with -lm.",
    ]
    if has_observer:
        lines.append(f"{stem}_observer filters samples as they come; its functions are at the end.")
    comment = "\n".join(f" * {escape_c_comment(line)}".rstrip() for line in lines)
    return f"/*\n{comment}\n */"


def _write_struct(program: GeneratedProgram, stem: str) -> str:
    lines = ["typedef struct {"]
    for name, about in describe_values(
        program.identified, program.parameter_names, program.start_names
    ):
        lines.append(
            f"    double {name}{_write_array_size(program, name)}; /* {escape_c_comment(about)} */"
        )
    return "\n".join([*lines, f"}} {stem}_parameters;", ""])


def _write_array_size(program: GeneratedProgram, name: str) -> str:
    """Write the size of a start that needs several measured samples."""
    model = program.identified.model
    for state, initial in zip(model.states, model.initial, strict=True):
        if program.start_names[state.name] == name and isinstance(initial, MeasuredInitial):
            return f"[{program.n_start_samples}]" if program.n_start_samples > 1 else ""
    return ""


def _write_identified_function(program: GeneratedProgram, stem: str) -> str:
    identified = program.identified
    lines = [f"{stem}_parameters {stem}_identified(void)", "{", f"    {stem}_parameters p;"]
    numbers = identified.parameter_values
    lines += [
        f"    p.{program.parameter_names[item.name]} = {write_number(numbers[item.name])};"
        for item in identified.model.parameters
    ]
    for i, state in enumerate(identified.model.states):
        if not program.is_start_given(i):
            continue
        start, name = program.find_initial_value(i), program.start_names[state.name]
        value = write_number(0.0 if start is None else start)
        note = " /* give the measured value */" if start is None else ""
        elements = _list_elements(_write_array_size(program, name))
        lines += [f"    p.{name}{element} = {value};{note}" for element in elements]
    return "\n".join([*lines, "    return p;", "}", ""])


def _list_elements(size: str) -> list[str]:
    return [f"[{i}]" for i in range(int(size[1:-1]))] if size else [""]


def _write_simulate_comment(program: GeneratedProgram) -> str:
    model = program.identified.model
    lines = ["Free run of the model at n regular times t (s)."]
    for kind, names, signals in (
        ("Input", program.input_names, model.inputs),
        ("Output", program.output_names, model.outputs),
    ):
        lines += [
            f"{kind} {names[q.name]}: {q.name}, {describe_unit(program.identified.get_unit(q))}."
            for q in signals
        ]
    lines += ["Returns 0; 1 if n, the times or a time lag cannot be used; 2 if memory is short."]
    comment = "\n".join(f" * {escape_c_comment(line)}" for line in lines)
    return f"/*\n{comment}\n */"


def _write_signature(program: GeneratedProgram, stem: str) -> str:
    arguments = ["long n", "const double *t"]
    arguments += [f"const double *{name}" for name in program.input_names.values()]
    arguments += [f"const {stem}_parameters *p"]
    arguments += [f"double *{name}" for name in program.output_names.values()]
    head = f"int {stem}_simulate("
    lines = textwrap.wrap(", ".join(arguments), _LINE_WIDTH - 8)
    return head + "\n    " + "\n    ".join(lines) + ")"


def _write_checks(program: GeneratedProgram) -> list[str]:
    return [
        "if (n < 2 || !(t[n - 1] > t[0]))",
        "    return 1;",
        "const double sample_time = (t[n - 1] - t[0])/(double)(n - 1);",
        "for (long i = 1; i < n; ++i)",
        "    if (!(fabs(t[i] - t[i - 1] - sample_time) < 0.1*sample_time))",
        "        return 1;",
        "(void)p;",
    ]


def _write_step_count(program: GeneratedProgram) -> list[str]:
    period, substeps = program.step_variable, program.substeps
    if program.grid_step is None:
        count = f"(n - 1)*{substeps}" if substeps > 1 else "n - 1"
        divided = f"/{write_number(substeps)}" if substeps > 1 else ""
        lines = [f"const double {period} = sample_time{divided};", f"const long steps = {count};"]
    else:
        grid_step = write_number(program.grid_step)
        lines = [
            f"const double dt = {grid_step}/{write_number(substeps)};",
            f"const long points = (long)ceil((t[n - 1] - t[0])/{grid_step} - 0.01);",
            "if (points < 1)",
            "    return 1;",
            f"const long steps = points*{substeps};",
        ]
        if program.find_step_lengths():
            lines.append("const double ratio = dt/sample_time;")
    return [*lines, *_write_input_lengths(program), f"(void){period};"]


def _write_input_lengths(program: GeneratedProgram) -> list[str]:
    """Write the lengths that the reads of inputs need."""
    lines = []
    needed = program.find_step_lengths()
    if needed & {"ramp", "width"}:
        lines.append(
            f"const double ramp = {program.write_ramp_width()}; /* samples: half a jump's width */"
        )
    if "width" in needed:
        lines += [
            "double width = ramp; /* samples: between points of an input on lines */",
            f"for (long k = {MAX_POINTS_PER_STEP}; k > 0; k -= 2) {{ /* few that meet all */",
            "    int meets = 1;",
            "    for (long i = 1; i < n; ++i) {",
            "        const double place = (double)k*(t[i] - t[0])/dt;",
            "        if (!(fabs(place - floor(place + 0.5)) < 0.05))",
            "            meets = 0;",
            "    }",
            "    if (meets)",
            "        width = ratio/(double)k;",
            "}",
        ]
    if "half" in needed:
        lines.append(f"const double half = {program.write_half_step()}; /* samples: half a step */")
    return lines


def _write_delays(program: GeneratedProgram) -> list[str]:
    lines = []
    for delay, name in program.delay_names.items():
        lines += [
            f"const double {name} = {write_delay_steps(program, delay)}; /* integration steps */",
            f"if (!({name} < 1e9))",
            "    return 1;",
        ]
    return lines


def _write_state_arrays(program: GeneratedProgram) -> list[str]:
    states = program.identified.model.states
    arrays = [program.array_names[state.name] for state in states]
    arrays += [name for rises in program.rise_names.values() for name in rises]
    lines = [
        f"double *const work = malloc({len(arrays)}*((size_t)steps + 1)*sizeof *work);",
        "if (work == NULL)",
        "    return 2;",
    ]
    for i, name in enumerate(arrays):
        offset = f" + {i}*(steps + 1)" if i else ""
        lines.append(f"double *const {name} = work{offset};")
    for i, state in enumerate(states):
        every, start = program.array_names[state.name], program.write_start(i)
        size = _write_array_size(program, program.start_names[state.name])
        lines += [
            f"for (long i = 0; i < {program.n_start_samples} && i <= steps; ++i)",
            f"    {every}[i] = {start}{'[i]' if size else ''};",
        ]
    return lines


# ---- the time loop --------------------------------------------------------------------------
def _write_runge_kutta(program: GeneratedProgram) -> list[str]:
    """Write the steps, each with its four stages, or with those of each of its parts."""
    names = [state.name for state in program.identified.model.states]
    arrays = [program.array_names[name] for name in names]
    if not program.sides:
        body = [
            *_write_stages(program, ("0.0", "0.5", "1.0"), [f"{one}[step]" for one in arrays]),
            *_write_mean_slopes("dt", [(f"{one}[step + 1]", f"{one}[step]") for one in arrays]),
        ]
    else:
        now = [f"now[{i}]" for i in range(len(names))]
        body = [
            f"double now[{len(names)}];",
            *(f"{place} = {one}[step];" for place, one in zip(now, arrays, strict=True)),
            *program.language.open_parts(program.stem, len(program.sides)),
            *indent_lines(_write_stages(program, ("begin", "0.5*(begin + end)", "end"), now)),
            *indent_lines(_write_mean_slopes("duration", [(place, place) for place in now])),
            *program.language.close_parts(),
            *(f"{one}[step + 1] = {place};" for place, one in zip(now, arrays, strict=True)),
        ]
    head = program.language.open_loop("step", program.first_step, to_last=False)
    return [head, *indent_lines(body), *program.language.close_loop()]


def _write_stages(
    program: GeneratedProgram, places: tuple[str, str, str], now: list[str]
) -> list[str]:
    """Write the four stages as a loop; each starts from the slope of the one before."""
    states = program.identified.model.states
    first, middle, last = places
    moves = "(stage == 3 ? 1.0 : 0.5)*duration" if program.sides else "part*dt"
    lines = [
        f"double slope[4][{len(states)}];",
        "for (int stage = 0; stage < 4; ++stage) {",
        f"    const double part = stage == 0 ? {first} : stage == 3 ? {last} : {middle};",
    ]
    for i, state in enumerate(states):
        moved = f"{now[i]} + (stage == 0 ? 0.0 : {moves}*slope[stage - 1][{i}])"
        lines.append(f"    const double {program.present_names[state.name]} = {moved};")
    lines += [f"    (void){program.present_names[state.name]};" for state in states]
    for i in range(len(states)):
        lines += indent_lines(
            _wrap_statement(f"slope[stage][{i}] = ", equation(program, "slope", i))
        )
    if first_rises := program.assign_rises("first", "slope[0]"):
        when = "stage == 0 && number == 0" if program.sides else "stage == 0"
        lines += [f"    if ({when}) {{", *indent_lines(first_rises, 2), "    }"]
    return [*lines, "}", *program.assign_rises("last", "slope[3]")]


def _write_mean_slopes(width: str, moves: list[tuple[str, str]]) -> list[str]:
    """Write the end of a step of Runge and Kutta: each state's target and start."""
    lines = []
    for i, (target, start) in enumerate(moves):
        mean = f"slope[0][{i}] + 2.0*slope[1][{i}] + 2.0*slope[2][{i}] + slope[3][{i}]"
        lines += _wrap_statement(f"{target} = ", f"{start} + {width}/6.0*({mean})")
    return lines


def _write_switches(program: GeneratedProgram) -> list[str]:
    """Write the functions that find the switches in time of a step; none if there are none."""
    if not program.sides:
        return []
    sides = [
        line
        for i, side in enumerate(program.write_sides())
        for line in _wrap_statement(f"side[{i}] = ", side)
    ]
    return [
        _SWITCHES.substitute(
            stem=program.stem,
            sides="\n".join(indent_lines(sides)),
            most=len(program.sides),
            halvings=HALVINGS,
        )
    ]


def _write_outputs(program: GeneratedProgram) -> list[str]:
    if program.grid_step is not None:
        return _write_interpolated_outputs(program)
    model, substeps = program.identified.model, program.substeps
    position = f"i*{substeps}" if substeps > 1 else "i"
    lines = [
        "for (long i = 0; i < n; ++i) {",
        f"    const long {program.loop_variable} = {position};",
        f"    (void){program.loop_variable};",
    ]
    for output in model.outputs:
        text = write_expression(output.expression, program.language, LoopScope(program, "output"))
        lines += indent_lines(_wrap_statement(f"{program.output_names[output.name]}[i] = ", text))
    return [*lines, "}"]


def _write_interpolated_outputs(program: GeneratedProgram) -> list[str]:
    """Write outputs whose samples lie between the points of the simulation's own grid."""
    program.helper_names.add("between")
    model, grid_step = program.identified.model, write_number(program.grid_step or 1.0)
    lines = []
    for output in model.outputs:
        text = write_expression(output.expression, program.language, LoopScope(program, "output"))
        name = program.output_names[output.name]
        lines += [
            "{",
            "    double *const grid = malloc(((size_t)points + 1)*sizeof *grid);",
            "    if (grid == NULL) {",
            "        free(work);",
            "        return 2;",
            "    }",
            "    for (long i = 0; i <= points; ++i) {",
            f"        const long step = i*{program.substeps};",
            "        (void)step;",
            *indent_lines(_wrap_statement("grid[i] = ", text), 2),
            "    }",
            "    for (long i = 0; i < n; ++i) {",
            f"        const double place = (t[i] - t[0])/{grid_step}, whole = floor(place + 0.5);",
            f"        const int meets = fabs(place - whole) < {write_number(GRID_TOLERANCE)};",
            f"        {name}[i] = between(grid, points + 1, meets ? whole : place);",
            "    }",
            "    free(grid);",
            "}",
        ]
    return lines


# ---- the observer ---------------------------------------------------------------------------
def _write_observer(program: GeneratedProgram, observer: Observer) -> str:
    """Write ``STEM_start``, ``STEM_advance`` and ``STEM_correct``."""
    stem = program.stem
    now = [f"double {argument}" for _, argument in pair_arguments(program, program.input_names)]
    compared = [
        f"double {argument}, double *{program.name_argument(name, 'predicted')}"
        for name, argument in pair_arguments(program, program.output_names)
    ]
    functions = {
        "start": (now, _write_window_start(program, observer)),
        "advance": (
            now,
            [*_move_window(program, observer), *time_loop(program, _write_runge_kutta)],
        ),
        "correct": (compared, _write_corrections(program, observer)),
    }
    names = [*_name_observer_parts(program, observer), ("step", "const long step = steps;")]
    parts = [
        _write_observer_comment(program, observer),
        _write_struct(program, stem),
        _write_identified_function(program, stem),
        _write_window(program, observer),
    ]
    for name, (signals, body) in functions.items():
        arguments = [f"{stem} *o", f"const {stem}_parameters *p", *signals]
        known = names if name == "correct" else names[:-1]  # the others count their steps
        written = [*list_used_lines(known, body), *body]
        used = any("p->" in line for line in written)
        parts += [
            f"void {stem}_{name}(",
            *indent_lines(textwrap.wrap(", ".join(arguments), _LINE_WIDTH - 8)),
            ")",
            "{",
            *indent_lines([*written, *([] if used else ["(void)p;"])]),
            "}",
            "",
        ]
    return "\n".join(parts[:-1])


def _name_observer_parts(
    program: GeneratedProgram, observer: Observer
) -> Iterator[tuple[str, str]]:
    """Name what the functions of an observer may use: lengths, arrays, delays."""
    yield "sample_time", f"const double sample_time = {write_number(observer.sample_time)};"
    yield "dt", f"const double dt = sample_time/{write_number(observer.substeps)};"
    yield "n", f"const long n = {observer.samples};"
    yield "steps", f"const long steps = {observer.steps};"
    for line in _write_input_lengths(program):
        yield line.split(" = ")[0].split()[-1], line
    for name in [*program.input_names.values(), *list_window_arrays(program)]:
        yield name, f"double *const {name} = o->{name};"
    for delay, name in program.delay_names.items():
        steps = write_delay_steps(program, delay)
        yield name, f"const double {name} = {steps}; /* integration steps */"


def _write_observer_comment(program: GeneratedProgram, observer: Observer) -> str:
    identified, stem = observer.identified, program.stem
    lines = [
        f"Observer (Kalman filter) for samples each {observer.sample_time:.10g} s.",
        f"{stem}_start() begins at the first sample, with the inputs there.",
        f"{stem}_correct() predicts the outputs of a sample from those before, and then corrects",
        "the states by what was measured; NAN: not measured.",
        f"{stem}_advance() goes on to the next sample, with the inputs there. Without a correction",
        "it predicts further ahead; a copy of the struct keeps the present.",
        f"Time lags may be up to {observer.longest_lag:.6g} s.",
    ]
    signals: tuple[ModelSignal | Output, ...] = identified.model.inputs
    names = {**program.input_names, **program.output_names}
    for signal in (*signals, *identified.model.outputs):
        unit = describe_unit(identified.get_unit(signal))
        lines.append(f"{names[signal.name]}: {signal.name}, {unit}.")
    return "/*\n" + "\n".join(f" * {escape_c_comment(line)}" for line in lines) + "\n */"


def _write_window(program: GeneratedProgram, observer: Observer) -> str:
    lines = ["typedef struct { /* the last element of each array is that of the present */"]
    lines += [f"    double {name}[{observer.samples}];" for name in program.input_names.values()]
    lines += [f"    double {name}[{observer.steps + 1}];" for name in list_window_arrays(program)]
    return "\n".join([*lines, f"}} {program.stem};", ""])


def _write_window_start(program: GeneratedProgram, observer: Observer) -> list[str]:
    model = observer.identified.model
    lines = ["for (long i = 0; i < n; ++i) {"]
    arguments = pair_arguments(program, program.input_names)
    lines += [f"    {name}[i] = {argument};" for name, argument in arguments]
    lines += ["}", "for (long i = 0; i <= steps; ++i) {"]
    before = "i < steps ? 0.0 : " if model.solver.history == "zero" else ""
    for i, state in enumerate(model.states):
        name = program.array_names[state.name]
        lines += indent_lines(_wrap_statement(f"{name}[i] = ", f"{before}{program.write_start(i)}"))
    rises = list_window_arrays(program)[len(model.states) :]
    return [*lines, *(f"    {name}[i] = 0.0;" for name in rises), "}"]


def _move_window(program: GeneratedProgram, observer: Observer) -> list[str]:
    substeps, arguments = observer.substeps, pair_arguments(program, program.input_names)
    lines = ["for (long i = 1; i < n; ++i) {"]
    lines += [f"    {name}[i - 1] = {name}[i];" for name, _ in arguments]
    lines += ["}", *(f"{name}[n - 1] = {argument};" for name, argument in arguments)]
    lines.append(f"for (long i = {substeps}; i <= steps; ++i) {{")
    arrays = list_window_arrays(program)
    return [*lines, *(f"    {name}[i - {substeps}] = {name}[i];" for name in arrays), "}"]


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
        predicted = f"*{program.name_argument(name, 'predicted')}"
        text = write_expression(output.expression, language, scope)
        lines += _wrap_statement(f"{predicted} = ", text)
        own = write_expression(correction.variance, language, scope)
        sensor = write_number(observer.sensors[output.name])
        pairs = [*correction.gains, *correction.losses]
        changes = [write_expression(tree, language, scope) for _, tree in pairs]
        body = _wrap_statement("const double factor = ", f"1.0/({sensor} + {own})")
        body.append(f"const double innovation = {argument} - {predicted};")
        body.append(f"double change[{len(pairs)}];")
        for i, text in enumerate(changes):
            body += _wrap_statement(f"change[{i}] = ", text)
        for i, (state, _) in enumerate(pairs):
            by = "factor*innovation" if i < len(correction.gains) else "-factor"
            body.append(f"{program.array_names[state]}[step] += {by}*change[{i}];")
        lines += [f"if (!isnan({argument})) {{", *indent_lines(body), "}"]
    return lines


# ---- layout ---------------------------------------------------------------------------------
def _wrap_statement(before: str, text: str) -> list[str]:
    """Wrap a statement on as many lines as needed."""
    if len(before) + len(text) <= _LINE_WIDTH - 12:
        return [f"{before}{text};"]
    lines = wrap_source(text, _LINE_WIDTH - 16)
    return [before.rstrip(), *(f"    {line}" for line in lines[:-1]), f"    {lines[-1]};"]


# ---- functions that a program calls -----------------------------------------------------------
_SWITCHES = Template("""\
/* Whole numbers at `part` of a step, each of which changes at a switch in time. */
static void ${stem}_sides(
    const ${stem}_parameters *p, double dt, long step, double part, double *side)
{
    (void)p;
$sides
}

/* Place in a step just before the next switch after `begin`, and just behind it. */
static double ${stem}_switch(
    const ${stem}_parameters *p, double dt, long step, double begin, double *behind)
{
    double before[$most], side[$most], low = begin, high = 1.0;
    ${stem}_sides(p, dt, step, begin, before);
    for (int trial = 0; trial <= $halvings; ++trial) {
        const double part = trial == 0 ? high : 0.5*(low + high);
        int differs = 0;
        ${stem}_sides(p, dt, step, part, side);
        for (int i = 0; i < $most; ++i)
            differs |= side[i] != before[i];
        if (!differs)
            low = part;
        else
            high = part;
        if (low == 1.0)
            break;
    }
    *behind = high;
    return low;
}
""")
_BETWEEN = """\
/* Signal at a place in samples, on a line between them; its end values outside. */
static double between(const double *signal, long n, double place)
{
    const double inside = fmin(fmax(place, 0.0), (double)(n - 1));
    const long i = (long)inside < n - 2 ? (long)inside : n - 2;
    return signal[i] + (inside - (double)i)*(signal[i + 1] - signal[i]);
}
"""
_HELD = """\
/* Signal at a place in samples, held after each; a jump takes `ramp` to either side. */
static double held(const double *signal, long n, double place, double ramp)
{
    const double inside = fmin(fmax(place, -1.0), (double)n);
    const double nearest = floor(inside + 0.5);
    const double part = fmin(fmax((inside - nearest + ramp)/(2*ramp), 0.0), 1.0);
    const long i = (long)nearest;
    const double after = signal[i < 0 ? 0 : i < n ? i : n - 1];
    const double before = signal[i < 1 ? 0 : i <= n ? i - 1 : n - 1];
    return before + part*(after - before);
}
"""
_HELD_ON_GRID = """\
/* Signal at a place in samples, held after each; on lines between points `ramp` apart. */
static double held(const double *signal, long n, double place, double ramp)
{
    const double inside = fmin(fmax(place, -1.0), (double)n);
    const double first = floor(inside/ramp), part = inside/ramp - first;
    double value = 0.0;
    for (int j = 0; j < 2; ++j)
        for (int side = -1; side < 2; side += 2) { /* at a jump the mean of both sides */
            const long k = (long)floor((first + j)*ramp + 1e-6*side);
            value += 0.5*(j == 0 ? 1.0 - part : part)*signal[k < 0 ? 0 : k < n ? k : n - 1];
        }
    return value;
}
"""
_AVERAGED = """\
/* Mean of a held signal from `half` before a place, in samples, to `half` after it. */
static double averaged(const double *signal, long n, double place, double half)
{
    const double inside = fmin(fmax(place, -1.0 - half), (double)n + half);
    const double first = inside - half, last = inside + half;
    double total = 0.0;
    for (long k = (long)floor(first); (double)k < last; ++k) {
        const double width = fmin((double)(k + 1), last) - fmax((double)k, first);
        total += width*signal[k < 0 ? 0 : k < n ? k : n - 1];
    }
    return total/(2*half);
}
"""
_BETWEEN_ON_GRID = """\
/* What `between` gives at points `width` apart, on lines between them. */
static double between_on_grid(const double *signal, long n, double place, double width)
{
    const double i = floor(place/width), first = between(signal, n, i*width);
    return first + (place/width - i)*(between(signal, n, (i + 1.0)*width) - first);
}
"""
_AVERAGED_ON_GRID = """\
/* What `averaged` gives at points `ramp` apart, on lines between them. */
static double averaged_on_grid(const double *signal, long n, double place, double half, double ramp)
{
    const double i = floor(place/ramp), first = averaged(signal, n, i*ramp, half);
    return first + (place/ramp - i)*(averaged(signal, n, (i + 1.0)*ramp, half) - first);
}
"""
_SAMPLE = """\
/* Value at a step that may lie before the start. */
static double sample(const double *array, double before, long step)
{
    return step >= 0 ? array[step] : before;
}
"""
_PAST = """\
/* Value `delay` >= 0 steps before a finished step, linear; `before` the start. */
static double past(const double *array, double before, long step, double delay)
{
    const double whole = floor(-delay);
    const double older = sample(array, before, step + (long)whole);
    const double newer = sample(array, before, step + (long)fmin(whole + 1.0, 0.0));
    return older + (-delay - whole)*(newer - older);
}
"""
_PAST_CUBIC = """\
/* Value `delay` >= 0 steps before a finished step, on a cubic of four (last: three). */
static double past(const double *array, double before, long step, double delay)
{
    const double whole = floor(-delay), part = -delay - whole;
    const int last = whole <= -2.0 ? 2 : 1;
    double value = 0.0;
    for (int a = -1; a <= last; ++a) {
        double weight = 1.0;
        for (int b = -1; b <= last; ++b)
            if (b != a)
                weight *= (part - b)/(a - b);
        value += weight*sample(array, before, step + (long)fmin(whole + a, 0.0));
    }
    return value;
}
"""
_PAST_BY_SLOPES = """\
/* Value `delay` >= 0 steps before a finished step, on a cubic; `before` the start.
 * The cubic of a step has its values at both ends, and rises there at `first` and `last`. */
static double past(const double *array, const double *first, const double *last, double before,
                   long step, double delay)
{
    const double whole = floor(-delay), part = -delay - whole;
    const long i = step + (long)whole;
    const double older = sample(array, before, i);
    if (part == 0.0)
        return older;
    const double rise = sample(array, before, i + 1) - older;
    const double begin = sample(first, 0.0, i) - rise, end = sample(last, 0.0, i) - rise;
    return older + part*(rise + (1.0 - part)*((1.0 - part)*begin - part*end));
}
"""
_LATELY = """\
/* Value `delay` steps before the place `part` of a step after it began, where it is `there`. */
static double lately(const double *array, double before, long step, double part, double there,
                     double delay)
{
    if (delay < part)
        return array[step] + (part - delay)/part*(there - array[step]);
    return past(array, before, step, delay - part);
}
"""
_LATELY_BY_SLOPES = """\
/* Value `delay` steps before the place `part` of a step after it began, where it is `there`. */
static double lately(const double *array, const double *first, const double *last, double before,
                     long step, double part, double there, double delay)
{
    if (delay < part) {
        const double share = (part - delay)/part, tangent = part*first[step];
        return array[step] + share*(tangent + share*(there - array[step] - tangent));
    }
    return past(array, first, last, before, step, delay - part);
}
"""
_SIGN = """\
static double sign(double x)
{
    return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : x;
}
"""
_LEAST = """\
static double least(double a, double b)
{
    return isnan(a) || a < b ? a : b;
}
"""
_GREATEST = """\
static double greatest(double a, double b)
{
    return isnan(a) || a > b ? a : b;
}
"""
_CLIP = """\
static double clip(double x, double lower, double upper)
{
    return least(greatest(x, lower), upper);
}
"""
_MODULO = """\
/* Remainder of x/y with the sign of y. */
static double modulo(double x, double y)
{
    const double rest = fmod(x, y);
    return rest*y < 0.0 ? rest + y : rest;
}
"""
_TABLE_INTERVAL = """\
/* Number of the interval between points of a table, from 0, that has x. */
static int table_interval(double x, const double *xs)
{
    int i = 0;
    while (x >= xs[i + 1])
        ++i;
    return i;
}
"""
_TABLE = """\
/* Value of a table of n points at x, linear; its end values outside. */
static double table(double x, int n, const double *xs, const double *ys)
{
    if (!(x > xs[0]))
        return isnan(x) ? x : ys[0];
    if (x >= xs[n - 1])
        return ys[n - 1];
    const int i = table_interval(x, xs);
    return ys[i] + (x - xs[i])*((ys[i + 1] - ys[i])/(xs[i + 1] - xs[i]));
}
"""
_PCHIP = """\
static double pchip_rise(int i, const double *xs, const double *ys)
{
    return (ys[i + 1] - ys[i])/(xs[i + 1] - xs[i]);
}

/* Slope of a monotone cubic at its point i of n. */
static double pchip_slope(int i, int n, const double *xs, const double *ys)
{
    const int left = i == 0 ? 0 : i == n - 1 ? n - 2 : i - 1;
    const int right = i == 0 ? 1 : i == n - 1 ? n - 3 : i;
    if (n == 2)
        return pchip_rise(0, xs, ys);
    const double a = pchip_rise(left, xs, ys), b = pchip_rise(right, xs, ys);
    const double h = xs[left + 1] - xs[left], w = xs[right + 1] - xs[right];
    if (0 < i && i < n - 1)
        return a*b > 0.0 ? 3.0*(h + w)/((2.0*w + h)/a + (w + 2.0*h)/b) : 0.0;
    const double slope = ((2.0*h + w)*a - h*b)/(h + w);
    if (!(slope*a > 0.0))
        return 0.0;
    return !(a*b > 0.0) && fabs(slope) > 3.0*fabs(a) ? 3.0*a : slope;
}

/* Value at x of a monotone cubic through n points; its end values outside. */
static double pchip(double x, int n, const double *xs, const double *ys)
{
    if (!(x > xs[0] && x < xs[n - 1]))
        return table(x, n, xs, ys);
    const int i = table_interval(x, xs);
    const double h = xs[i + 1] - xs[i], part = x - xs[i], mean = pchip_rise(i, xs, ys);
    const double over = mean - pchip_slope(i, n, xs, ys);
    const double under = pchip_slope(i + 1, n, xs, ys) - mean;
    return ys[i] + part*(mean - over + part*((2.0*over - under)/h + part*(under - over)/(h*h)));
}
"""
HELPERS: Mapping[str, str] = {
    "sign": _SIGN,
    "least": _LEAST,
    "greatest": _GREATEST,
    "clip": _CLIP,
    "modulo": _MODULO,
    "table_interval": _TABLE_INTERVAL,
    "table": _TABLE,
    "pchip": _PCHIP,
    "between": _BETWEEN,
    "between_on_grid": _BETWEEN_ON_GRID,
    "held": _HELD,
    "held on grid": _HELD_ON_GRID,
    "averaged": _AVERAGED,
    "averaged_on_grid": _AVERAGED_ON_GRID,
    "sample": _SAMPLE,
    "past": _PAST,
    "past cubic": _PAST_CUBIC,
    "past by slopes": _PAST_BY_SLOPES,
    "lately": _LATELY,
    "lately by slopes": _LATELY_BY_SLOPES,
}
