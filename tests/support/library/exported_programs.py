"""Exported programs, run: Python in this process, C compiled and called, scripts with a stub."""

import ctypes
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Hold
from sysid.models.model import Model
from sysid.simulation.simulate import simulate
from tests.support.limits import LIMIT_SECONDS
from tests.support.requirements import report_missing

FLAGS = ("-O1", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC")


def find_compiler() -> str:
    """The C compiler; without one the test is skipped, at the gate it fails."""
    found = shutil.which("cc")
    if found is None:
        report_missing("compiler", "there is no C compiler (cc)")
    return str(found)


def simulate_outputs(
    model: Model,
    values: Mapping[str, float],
    times: FloatArray,
    inputs: Mapping[str, FloatArray],
    hold: Hold,
) -> list[FloatArray]:
    """What the model does by `sysid.simulate`, output by output."""
    channels = [Channel(name, times, signal, hold=hold) for name, signal in inputs.items()]
    found = simulate(model, channels, values, times=times)
    return [found.channel(output.name).values for output in model.outputs]


def run_python(source: str, times: FloatArray, inputs: Sequence[FloatArray], **given: Any) -> Any:
    """Outputs of an exported Python module."""
    module: dict[str, Any] = {}
    exec(compile(source, "exported", "exec"), module)
    found = module["simulate"](times, *inputs, **given)
    return list(found) if isinstance(found, tuple) else [found]


def add_entry(source: str, entry: str, inputs: int, outputs: int) -> str:
    """The C source with a function that takes its signals as arrays of arrays."""
    stem = source.split("_identified(void)")[0].split()[-1]
    signals = [f"u[{i}]" for i in range(inputs)]
    arguments = ["n", "t", *signals, "&p", *(f"y[{i}]" for i in range(outputs))]
    return source + (
        f"int {entry}(long n, const double *t, const double **u, double **y);\n"
        f"int {entry}(long n, const double *t, const double **u, double **y)\n{{\n"
        f"    const {stem}_parameters p = {stem}_identified();\n    (void)u;\n"
        f"    return {stem}_simulate({', '.join(arguments)});\n}}\n"
    )


def add_observer_entry(source: str, entry: str, inputs: int, outputs: int) -> str:
    """The C source with a function that filters signals given as arrays of arrays."""
    stem = source.split("_identified(void)")[-2].split()[-1]
    now = "".join(f", u[{i}][k]" for i in range(inputs))
    compared = "".join(f", y[{i}][k], &predicted[{i}][k]" for i in range(outputs))
    arguments = "long n, double **u, double **y, double **predicted"
    return source + (
        f"int {entry}({arguments});\n"
        f"int {entry}({arguments})\n{{\n"
        f"    const {stem}_parameters p = {stem}_identified();\n    static {stem} o;\n"
        "    for (long k = 0; k < n; ++k) {\n"
        f"        if (k == 0)\n            {stem}_start(&o, &p{now});\n"
        f"        else\n            {stem}_advance(&o, &p{now});\n"
        f"        {stem}_correct(&o, &p{compared});\n"
        "    }\n    return 0;\n}\n"
    )


def observe_python(
    source: str, inputs: Sequence[FloatArray], outputs: Sequence[FloatArray], **given: Any
) -> list[FloatArray]:
    """Predictions of an exported Python observer, output by output."""
    module: dict[str, Any] = {}
    exec(compile(source, "exported", "exec"), module)
    observer, predicted = None, []
    for now, measured in zip(zip(*inputs, strict=True), zip(*outputs, strict=True), strict=True):
        if observer is None:
            observer = module["Observer"](*now, **given)
        else:
            observer.advance(*now)
        predicted.append(np.atleast_1d(observer.correct(*measured)))
    return list(np.array(predicted).T)


def observe_c(
    library: ctypes.CDLL, entry: str, inputs: Sequence[FloatArray], outputs: Sequence[FloatArray]
) -> list[FloatArray]:
    """Predictions of an exported C observer, output by output."""
    pointer = ctypes.POINTER(ctypes.c_double)
    found = [np.full(y.size, np.nan) for y in outputs]
    arrays = [
        (pointer * len(signals))(
            *(np.ascontiguousarray(signal).ctypes.data_as(pointer) for signal in signals)
        )
        for signals in (inputs, outputs, found)
    ]
    assert library[entry](ctypes.c_long(outputs[0].size), *arrays) == 0
    return found


def compile_library(folder: Path, sources: Mapping[str, str]) -> ctypes.CDLL:
    """A library of C sources, with every warning an error."""
    paths = []
    for name, source in sources.items():
        paths.append(folder / f"{name}.c")
        paths[-1].write_text(source, encoding="utf-8")
    library = folder / "exported.so"
    done = subprocess.run(
        [find_compiler(), *FLAGS, *map(str, paths), "-o", str(library), "-lm"],
        capture_output=True,
        text=True,
        timeout=LIMIT_SECONDS,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return ctypes.CDLL(str(library))


def run_c(
    library: ctypes.CDLL, entry: str, times: FloatArray, inputs: Sequence[FloatArray], outputs: int
) -> list[FloatArray]:
    """Outputs of an exported C program."""
    pointer = ctypes.POINTER(ctypes.c_double)

    def address(values: FloatArray) -> Any:
        return values.ctypes.data_as(pointer)

    found = [np.full(times.size, np.nan) for _ in range(outputs)]
    u = (pointer * max(len(inputs), 1))(*map(address, inputs))
    y = (pointer * outputs)(*map(address, found))
    assert library[entry](ctypes.c_long(times.size), address(times), u, y) == 0
    return found


class Rational:
    """A transfer function that can be added, multiplied and evaluated; no more."""

    def __init__(self, numerator: Any, denominator: Any, period: float | None = None) -> None:
        self.numerator, self.denominator = np.atleast_1d(numerator), np.atleast_1d(denominator)
        self.period = period

    def __mul__(self, other: "Rational") -> "Rational":
        return Rational(
            np.polymul(self.numerator, other.numerator),
            np.polymul(self.denominator, other.denominator),
        )

    def __add__(self, other: "Rational") -> "Rational":
        first = np.polymul(self.numerator, other.denominator)
        second = np.polymul(other.numerator, self.denominator)
        return Rational(np.polyadd(first, second), np.polymul(self.denominator, other.denominator))

    def at(self, s: complex) -> complex:
        return complex(np.polyval(self.numerator, s) / np.polyval(self.denominator, s))


def _feedback(forward: Rational, back: Rational) -> Rational:
    numerator = np.polymul(forward.numerator, back.denominator)
    opened = np.polymul(forward.denominator, back.denominator)
    closed = np.polyadd(opened, np.polymul(forward.numerator, back.numerator))
    return Rational(numerator, closed)


def _pade(delay: float, order: int) -> tuple[list[float], list[float]]:
    """Diagonal Padé approximation of e^(-s delay), in falling powers of s."""
    rising = [1.0]
    for k in range(1, order + 1):
        rising.append(rising[-1] * delay * (order - k + 1) / (k * (2 * order - k + 1)))
    falling = rising[::-1]
    return [c * (-1) ** (order - i) for i, c in enumerate(falling)], falling


def run_control(source: str) -> dict[str, Any]:
    """The names of an exported script, run with a stub in the place of python-control."""
    script: dict[str, Any] = {}
    stub = SimpleNamespace(tf=Rational, pade=_pade, feedback=_feedback)
    script["control"] = stub
    assert source.count("\nimport control\n") == 1
    exec(compile(source.replace("\nimport control\n", "\n"), "exported", "exec"), script)
    return script
