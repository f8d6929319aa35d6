"""Export as self-contained C99: parameters in a struct, one function that simulates."""

import textwrap
from collections.abc import Sequence

from sysid.control.linear_form import Identified
from sysid.export.c_helpers import HELPERS, CLanguage, with_needed
from sysid.export.description import facts, unit_text, value_lines, wrapped
from sysid.export.expressions import number, source
from sysid.export.identifiers import Identifiers, in_c_comment
from sysid.export.program import Kind, Place, Program, lag_steps
from sysid.language.functions import FUNCTIONS
from sysid.models.model import MeasuredInitial

_WORDS = (
    "auto break case char const continue default do double else enum extern float for goto if "
    "inline int long register restrict return short signed sizeof static struct switch typedef "
    "union unsigned void volatile while _Bool _Complex _Imaginary asm main errno "
    "pow floor ceil fmin fmax isnan isfinite NAN INFINITY HUGE_VAL NULL size_t malloc free "
    "between held sample past lately n t p "
    "step steps i part stage slope work points grid ratio ramp half averaged sample_time "
    "dt h k now y0 y1 yn j0 j1 jn gamma signgam unix linux i386 EOF stdin stdout stderr assert "
    "BUFSIZ RAND_MAX"
)
_WIDTH = 92


def c_source(identified: Identified) -> str:
    """A C99 file: ``NAME_parameters``, ``NAME_identified`` and ``NAME_simulate``.

    Parameters
    ----------
    identified : Identified

    Raises
    ------
    InvalidSettings
        If a value is missing.
    """
    language = CLanguage()
    names = Identifiers([*_WORDS.split(), *(one.c for one in FUNCTIONS.values())])
    stem = names.of(identified.model.name)
    for suffix in ("parameters", "identified", "simulate"):
        names.of(f"{stem}_{suffix}")
    program = Program(identified, language, names, prefix="p->")
    loop = [*_loop(program), *_outputs(program)]
    body = [*_checks(program), *_steps(program), *_lags(program), *_states(program), *loop,
            "free(work);", "return 0;"]  # fmt: skip
    helpers = with_needed(program.helpers | language.called, identified)
    parts = [
        _header(identified, stem), "#include <math.h>\n#include <stdlib.h>\n",
        _struct(program, stem), _defaults(program, stem), *(HELPERS[name] for name in helpers),
        _about_simulate(program), _signature(program, stem), "{", *_indented(body), "}",
    ]  # fmt: skip
    return "\n".join(parts) + "\n"


def _header(identified: Identified, stem: str) -> str:
    lines = [*facts(identified), "", f"{stem}_identified() gives the values that were found.",
             f"{stem}_simulate() runs the model freely; link with -lm."]  # fmt: skip
    told = "\n".join(f" * {in_c_comment(line)}".rstrip() for line in lines)
    return f"/*\n{told}\n */"


def _struct(program: Program, stem: str) -> str:
    lines = ["typedef struct {"]
    for name, about in value_lines(program.identified, program.parameters, program.starts):
        lines.append(f"    double {name}{_size(program, name)}; /* {in_c_comment(about)} */")
    return "\n".join([*lines, f"}} {stem}_parameters;", ""])


def _size(program: Program, name: str) -> str:
    """Several first samples are to be given where they are measured."""
    model = program.identified.model
    for state, initial in zip(model.states, model.initial, strict=True):
        if program.starts[state.name] == name and isinstance(initial, MeasuredInitial):
            return f"[{program.memory}]" if program.memory > 1 else ""
    return ""


def _defaults(program: Program, stem: str) -> str:
    found = program.identified
    lines = [f"{stem}_parameters {stem}_identified(void)", "{", f"    {stem}_parameters p;"]
    numbers = found.numbers
    lines += [
        f"    p.{program.parameters[one.name]} = {number(numbers[one.name])};"
        for one in found.model.parameters
    ]
    for i, state in enumerate(found.model.states):
        start, name = program.start(i), program.starts[state.name]
        value = number(0.0 if start is None else start)
        note = " /* give the measured value */" if start is None else ""
        elements = _elements(_size(program, name))
        lines += [f"    p.{name}{element} = {value};{note}" for element in elements]
    return "\n".join([*lines, "    return p;", "}", ""])


def _elements(size: str) -> list[str]:
    return [f"[{i}]" for i in range(int(size[1:-1]))] if size else [""]


def _about_simulate(program: Program) -> str:
    model = program.identified.model
    lines = ["Free run of the model at n regular times t (s)."]
    for kind, names, signals in (
        ("Input", program.inputs, model.inputs),
        ("Output", program.outputs, model.outputs),
    ):
        lines += [f"{kind} {names[q.name]}: {q.name}, {unit_text(q.unit)}." for q in signals]
    lines += ["Gives 0; 1 if n, the times or a lag cannot be used; 2 if memory is short."]
    told = "\n".join(f" * {in_c_comment(line)}" for line in lines)
    return f"/*\n{told}\n */"


def _signature(program: Program, stem: str) -> str:
    arguments = ["long n", "const double *t"]
    arguments += [f"const double *{name}" for name in program.inputs.values()]
    arguments += [f"const {stem}_parameters *p"]
    arguments += [f"double *{name}" for name in program.outputs.values()]
    head = f"int {stem}_simulate("
    lines = textwrap.wrap(", ".join(arguments), _WIDTH - 8)
    return head + "\n    " + "\n    ".join(lines) + ")"


def _checks(program: Program) -> list[str]:
    return [
        "if (n < 2 || !(t[n - 1] > t[0]))",
        "    return 1;",
        "const double sample_time = (t[n - 1] - t[0])/(double)(n - 1);",
        "for (long i = 1; i < n; ++i)",
        "    if (!(fabs(t[i] - t[i - 1] - sample_time) < 0.1*sample_time))",
        "        return 1;",
        "(void)p;",
    ]


def _steps(program: Program) -> list[str]:
    period, substeps = program.period, program.substeps
    if program.own_step is None:
        count = f"(n - 1)*{substeps}" if substeps > 1 else "n - 1"
        divided = f"/{number(substeps)}" if substeps > 1 else ""
        lines = [f"const double {period} = sample_time{divided};",
                 f"const long steps = {count};"]  # fmt: skip
    else:
        own = number(program.own_step)
        lines = [f"const double dt = {own}/{number(substeps)};",
                 f"const long points = (long)ceil((t[n - 1] - t[0])/{own} - 0.01);",
                 "if (points < 1)", "    return 1;",
                 f"const long steps = points*{substeps};"]  # fmt: skip
        if program.helpers & {"between", "held", "averaged"}:
            lines.append("const double ratio = dt/sample_time;")
    if "held" in program.helpers:
        lines.append(f"const double ramp = {program.ramp()}; /* samples: half a jump's width */")
    if "averaged" in program.helpers:
        lines.append(f"const double half = {program.half()}; /* samples: half a step */")
    return [*lines, f"(void){period};"]


def _lags(program: Program) -> list[str]:
    lines = []
    for lag, name in program.lags.items():
        text = f"fmax({lag_steps(program, lag)}, 0.0)"
        if program.identified.model.solver.interpolation == "nearest":
            text = f"floor({text} + 0.5)"
        lines += [f"const double {name} = {text}; /* integration steps */",
                  f"if (!({name} < 1e9))", "    return 1;"]  # fmt: skip
    return lines


def _states(program: Program) -> list[str]:
    states = program.identified.model.states
    lines = [f"double *const work = malloc({len(states)}*((size_t)steps + 1)*sizeof *work);",
             "if (work == NULL)", "    return 2;"]  # fmt: skip
    for i, state in enumerate(states):
        offset = f" + {i}*(steps + 1)" if i else ""
        lines.append(f"double *const {program.every[state.name]} = work{offset};")
    for state in states:
        every, start = program.every[state.name], program.starts[state.name]
        size = _size(program, start)
        lines += [f"for (long i = 0; i < {program.memory} && i <= steps; ++i)",
                  f"    {every}[i] = p->{start}{'[i]' if size else ''};"]  # fmt: skip
    return lines


# ---- the time loop --------------------------------------------------------------------------
def _loop(program: Program) -> list[str]:
    if program.is_recursion:
        return _recursion(program)
    if program.identified.model.solver.method == "rk4":
        return _runge_kutta(program)
    return _euler(program)


def _equation(program: Program, kind: Kind, number_: int, floor: int = 0) -> str:
    tree = program.identified.model.equations[number_]
    return source(tree, program.language, Place(program, kind, number_), floor)


def _recursion(program: Program) -> list[str]:
    model = program.identified.model
    lines = [f"for (long k = {program.memory}; k <= steps; ++k) {{"]
    for i in model.order:
        name = model.states[i].name
        now = program.now[name]
        lines += _indented(_statement(f"const double {now} = ", _equation(program, "recursion", i)))
        lines.append(f"    {program.every[name]}[k] = {now};")
    return [*lines, "}"]


def _euler(program: Program) -> list[str]:
    model = program.identified.model
    lines = ["for (long step = 0; step < steps; ++step) {"]
    for i, state in enumerate(model.states):
        text = f"{program.every[state.name]}[step] + dt*{_equation(program, 'update', i, 6)}"
        lines += _indented(_statement(f"const double {program.following[state.name]} = ", text))
    lines += [
        f"    {program.every[s.name]}[step + 1] = {program.following[s.name]};"
        for s in model.states
    ]
    return [*lines, "}"]


def _runge_kutta(program: Program) -> list[str]:
    """The four stages as a loop: each begins where the slope of the one before it leads."""
    states = program.identified.model.states
    lines = [
        "for (long step = 0; step < steps; ++step) {",
        f"    double slope[4][{len(states)}];",
        "    for (int stage = 0; stage < 4; ++stage) {",
        "        const double part = stage == 0 ? 0.0 : stage == 3 ? 1.0 : 0.5;",
    ]
    for i, state in enumerate(states):
        every, now = program.every[state.name], program.now[state.name]
        moved = f"{every}[step] + (stage == 0 ? 0.0 : part*dt*slope[stage - 1][{i}])"
        lines.append(f"        const double {now} = {moved};")
    lines += [f"        (void){program.now[state.name]};" for state in states]
    for i in range(len(states)):
        lines += _indented(_statement(f"slope[stage][{i}] = ", _equation(program, "slope", i)), 2)
    lines.append("    }")
    for i, state in enumerate(states):
        every = program.every[state.name]
        mean = f"slope[0][{i}] + 2.0*slope[1][{i}] + 2.0*slope[2][{i}] + slope[3][{i}]"
        lines += _indented(_statement(f"{every}[step + 1] = ", f"{every}[step] + dt/6.0*({mean})"))
    return [*lines, "}"]


def _outputs(program: Program) -> list[str]:
    if program.own_step is not None:
        return _outputs_between(program)
    model, substeps = program.identified.model, program.substeps
    place = f"i*{substeps}" if substeps > 1 else "i"
    lines = ["for (long i = 0; i < n; ++i) {", f"    const long {program.index} = {place};",
             f"    (void){program.index};"]  # fmt: skip
    for output in model.outputs:
        text = source(output.expression, program.language, Place(program, "output"))
        lines += _indented(_statement(f"{program.outputs[output.name]}[i] = ", text))
    return [*lines, "}"]


def _outputs_between(program: Program) -> list[str]:
    """The samples lie between the points of the simulation's own grid."""
    program.helpers.add("between")
    model, own = program.identified.model, number(program.own_step or 1.0)
    lines = []
    for output in model.outputs:
        text = source(output.expression, program.language, Place(program, "output"))
        name = program.outputs[output.name]
        lines += [
            "{",
            "    double *const grid = malloc(((size_t)points + 1)*sizeof *grid);",
            "    if (grid == NULL) {", "        free(work);", "        return 2;", "    }",
            "    for (long i = 0; i <= points; ++i) {",
            f"        const long step = i*{program.substeps};", "        (void)step;",
            *_indented(_statement("grid[i] = ", text), 2), "    }",
            "    for (long i = 0; i < n; ++i)",
            f"        {name}[i] = between(grid, points + 1, (t[i] - t[0])/{own});",
            "    free(grid);", "}",
        ]  # fmt: skip
    return lines


# ---- layout ---------------------------------------------------------------------------------
def _statement(before: str, text: str) -> list[str]:
    """A statement on as many lines as it needs."""
    if len(before) + len(text) <= _WIDTH - 12:
        return [f"{before}{text};"]
    lines = wrapped(text, _WIDTH - 16)
    return [before.rstrip(), *(f"    {line}" for line in lines[:-1]), f"    {lines[-1]};"]


def _indented(lines: Sequence[str], levels: int = 1) -> list[str]:
    return [textwrap.indent(line, "    " * levels) for line in lines]
