"""Export as a Python module of one function that needs nothing but NumPy."""

import textwrap
from collections.abc import Sequence

from sysid.control.linear_form import Identified
from sysid.export.description import facts, unit_text, value_lines, wrapped
from sysid.export.expressions import number, source
from sysid.export.identifiers import Identifiers, in_docstring
from sysid.export.program import Kind, Place, Program, lag_steps
from sysid.export.python_helpers import HELPERS, PythonLanguage, with_needed
from sysid.models.model import Output, Quantity

_WORDS = (
    "False None True and as assert async await break class continue def del elif else except "
    "finally for from global if import in is lambda nonlocal not or pass raise return try while "
    "with match case type np t simulate rates step steps part dt h k now slope_1 slope_2 slope_3 "
    "slope_4 every points ratio ramp half averaged sample_time lag range zip map max min int float "
    "abs len y before between held past lately sign signal array grid print math ValueError"
)
_WIDTH = 96


def python_source(identified: Identified) -> str:
    """A module with one function ``simulate(t, u, …) -> y``.

    Parameters
    ----------
    identified : Identified

    Raises
    ------
    InvalidSettings
        If a value is missing.
    """
    names = [output.name for output in identified.model.outputs]
    taken = [word for word in _WORDS.split() if word not in names]
    program = Program(identified, PythonLanguage(), Identifiers(taken))
    loop = [*_loop(program), *_outputs(program)]
    head = [*_arrays(program), *_steps(program), *_lags(program), *_starts(program)]
    helpers = [HELPERS[name] for name in with_needed(program.helpers, identified)]
    body = [*head, 'with np.errstate(all="ignore"):  # what diverges becomes inf or nan']
    body += _indented(loop)
    parts = [_docstring(identified), "import numpy as np\n", *(f"\n{one}" for one in helpers)]
    parts.append("\n" + _signature(program))
    parts += [textwrap.indent("\n".join(_inner_docstring(program)), "    ")]
    parts += [textwrap.indent("\n".join(body), "    ")]
    return "\n".join(parts) + "\n"


def _docstring(identified: Identified) -> str:
    lines = [in_docstring(line) for line in facts(identified)]
    return "\n".join(['"""' + lines[0], "", *lines[1:], '"""', ""])


def _signature(program: Program) -> str:
    found = program.identified
    numbers = found.numbers
    required = [
        program.starts[state.name]
        for i, state in enumerate(found.model.states) if program.start(i) is None
    ]  # fmt: skip
    given = [
        f"{program.parameters[one.name]}={number(numbers[one.name])}"
        for one in found.model.parameters
    ]
    starts = [
        f"{program.starts[state.name]}={number(start)}"
        for i, state in enumerate(found.model.states)
        if (start := program.start(i)) is not None
    ]
    named = [*required, *given, *starts]
    arguments = ["t", *program.inputs.values(), *(["*"] if named else []), *named]
    return "def simulate(\n" + _wrapped(", ".join(arguments) + ",", "    ") + "\n):"


def _inner_docstring(program: Program) -> list[str]:
    model = program.identified.model
    lines = ['"""Free run of the model from its start.', "", "Parameters", "----------",
             "t : array (N,)", "    Times in s, one sampling period apart."]  # fmt: skip
    for one in model.inputs:
        lines += _described(program.inputs[one.name], "Input", one)
    for name, line in value_lines(program.identified, program.parameters, program.starts):
        lines += [f"{name} : float", f"    {line}"]
    lines += ["", "Returns", "-------"]
    for output in model.outputs:
        lines += _described(program.outputs[output.name], "Output", output)
    return [lines[0], *map(_kept, lines[1:]), '"""']


def _described(identifier: str, kind: str, signal: Quantity | Output) -> list[str]:
    about = f"    {kind} {signal.name}, {unit_text(signal.unit)}."
    return [f"{identifier} : array (N,)", about]


def _kept(line: str) -> str:
    indent = len(line) - len(line.lstrip())
    return " " * indent + in_docstring(line)


def _arrays(program: Program) -> list[str]:
    lines = ["t = np.asarray(t, dtype=np.float64)"]
    signals = program.inputs.values()
    lines += [f"{name} = np.asarray({name}, dtype=np.float64)" for name in signals]
    shapes = [f"{name}.shape != t.shape" for name in signals]
    wrong = " or ".join(["t.ndim != 1", "t.size < 2", *shapes])
    lines += [*_statement("if ", wrong, ":"),
              '    raise ValueError("t and the inputs must have one shape (N,), N > 1")',
              "sample_time = (t[-1] - t[0])/(t.size - 1)",
              "if not np.max(np.abs(np.diff(t) - sample_time)) < 0.1*sample_time:",
              '    raise ValueError("t must be regular; resample the inputs first")']  # fmt: skip
    if program.parameters:
        targets = ", ".join(program.parameters.values())
        both = _wrapped(targets + ",", "    ")
        lines += ["(", both, ") = map(np.float64, (", both, "))"]
    return lines


def _steps(program: Program) -> list[str]:
    period, substeps = program.period, program.substeps
    if program.own_step is None:
        divided = f"/{substeps}" if substeps > 1 else ""
        times = f"*{substeps}" if substeps > 1 else ""
        count = f"(t.size - 1){times}" if substeps > 1 else "t.size - 1"
        lines = [f"{period} = sample_time{divided}", f"steps = {count}"]
    else:
        own = number(program.own_step)
        lines = [f"dt = {own}/{substeps}" if substeps > 1 else f"dt = {own}",
                 f"points = int(np.ceil((t[-1] - t[0])/{own} - 0.01))",
                 f"steps = points*{substeps}", "ratio = dt/sample_time"]  # fmt: skip
    if "held" in program.helpers:
        lines.append(f"ramp = {program.ramp()}  # samples: half the width of a jump")
    if "averaged" in program.helpers:
        lines.append(f"half = {program.half()}  # samples: half an integration step")
    return lines


def _lags(program: Program) -> list[str]:
    lines = []
    for lag, name in program.lags.items():
        text = f"max({lag_steps(program, lag)}, 0.0)"
        if program.identified.model.solver.interpolation == "nearest":
            text = f"np.floor({text} + 0.5)"
        lines.append(f"{name} = {text}  # integration steps")
    return lines


def _starts(program: Program) -> list[str]:
    lines = []
    for state in program.identified.model.states:
        every, start = program.every[state.name], program.starts[state.name]
        lines += [f"{every} = np.empty(steps + 1)", f"{every}[:{program.memory}] = {start}"]
    return lines


# ---- the time loop --------------------------------------------------------------------------
def _loop(program: Program) -> list[str]:
    if program.is_recursion:
        return _recursion(program)
    if program.identified.model.solver.method == "rk4":
        return _runge_kutta(program)
    return _euler(program)


def _equation(program: Program, kind: Kind, number_: int) -> str:
    tree = program.identified.model.equations[number_]
    return source(tree, program.language, Place(program, kind, number_))


def _recursion(program: Program) -> list[str]:
    model = program.identified.model
    lines = [f"for k in range({program.memory}, steps + 1):"]
    for i in model.order:
        name = model.states[i].name
        text = _equation(program, "recursion", i)
        lines += _indented(_statement(f"{program.now[name]} = ", text))
        lines.append(f"    {program.every[name]}[k] = {program.now[name]}")
    return lines


def _euler(program: Program) -> list[str]:
    model = program.identified.model
    lines = ["for step in range(steps):"]
    for i, state in enumerate(model.states):
        slope = source(model.equations[i], program.language, Place(program, "update", i), 6)
        text = f"{program.every[state.name]}[step] + dt*{slope}"
        lines += _indented(_statement(f"{program.following[state.name]} = ", text))
    return lines + [
        f"    {program.every[s.name]}[step + 1] = {program.following[s.name]}" for s in model.states
    ]


def _runge_kutta(program: Program) -> list[str]:
    model = program.identified.model
    states = [program.now[state.name] for state in model.states]
    slopes: list[str] = []
    for i in range(len(model.states)):
        slopes += _indented(_statement("", _equation(program, "slope", i), ","), 2)
    every = [program.every[state.name] for state in model.states]
    now = ", ".join(f"{name}[step]" for name in every)
    following = [f"{name}[step + 1]" for name in every]
    target = ", ".join(following) if len(following) > 1 else f"({following[0]},)"
    return [
        f"def rates(step, part, {', '.join(states)}):  # at `part` of a step after it began",
        "    return np.array([", *slopes, "    ])", "",
        "for step in range(steps):",
        f"    now = np.array([{now}])",
        "    slope_1 = rates(step, 0.0, *now)",
        "    slope_2 = rates(step, 0.5, *(now + dt/2*slope_1))",
        "    slope_3 = rates(step, 0.5, *(now + dt/2*slope_2))",
        "    slope_4 = rates(step, 1.0, *(now + dt*slope_3))",
        *_indented(_statement(
            f"{target} = ", "now + dt/6*(slope_1 + 2*slope_2 + 2*slope_3 + slope_4)"
        )),
    ]  # fmt: skip


def _outputs(program: Program) -> list[str]:
    model, substeps = program.identified.model, program.substeps
    by = f"0, steps + 1, {substeps}" if substeps > 1 else "steps + 1"
    lines = []
    for output in model.outputs:
        text = source(output.expression, program.language, Place(program, "output"))
        loop = f"for {program.index} in range({by})"
        target = program.outputs[output.name]
        lines += [f"{target} = np.array([", *_indented(_statement("", text)), f"    {loop}",
                  "], dtype=np.float64)"]  # fmt: skip
        if program.own_step is not None:
            grid = f"t[0] + {number(program.own_step)}*np.arange(points + 1)"
            lines.append(f"{target} = np.interp(t, {grid}, {target})")
    return [*lines, f"return {', '.join(program.outputs.values())}"]


# ---- layout ---------------------------------------------------------------------------------
def _statement(before: str, text: str, after: str = "") -> list[str]:
    """A statement on as many lines as it needs, in parentheses if on several."""
    if len(before) + len(text) + len(after) <= _WIDTH - 12:
        return [f"{before}{text}{after}"]
    return [f"{before}(", _wrapped(text, "    "), f"){after}"]


def _wrapped(text: str, indent: str) -> str:
    return textwrap.indent("\n".join(wrapped(text, _WIDTH - 16)), indent)


def _indented(lines: Sequence[str], levels: int = 1) -> list[str]:
    return [textwrap.indent(line, "    " * levels) for line in lines]
