"""Users' models and their equivalents in hand-written C (`benchmarks/c/equivalents.c`)."""

import ctypes
import re
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sysid import load_model
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Hold, Record
from sysid.kernels.abi import LANES
from sysid.kernels.kernel import emit_kernel
from sysid.kernels.layout import ExperimentLayout, KernelVariant
from sysid.simulation.problem import Problem

SOURCE = Path(__file__).parent / "c" / "equivalents.c"
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp-simd", f"-DW={LANES}", "-shared", "-fPIC")
HISTORY = 512
"""Rows of history before and after the record's own, that the C code may touch."""

TERMS = [
    "y(k-1)",
    "y(k-2)",
    "u(k)",
    "u(k-1)",
    "y(k-1)**2",
    "y(k-1)*y(k-2)",
    "y(k-1)**3",
    "y(k-1)**2*y(k-2)",
    "y(k-1)*y(k-2)**2",
    "y(k-2)**3",
    "y(k-1)*u(k)",
    "y(k-1)**2*u(k)",
    "y(k-2)**2",
]
NARX: Mapping[str, Any] = {
    "name": "narx-13",
    "form": "polynomial",
    "output": "y",
    "inputs": {"u": "1"},
    "terms": TERMS,
    "coefficients": {"lower": -2, "upper": 2},
}


@dataclass(frozen=True)
class Example:
    """A model, the sampling of its record, and individuals for which the C code is right too."""

    function: str
    model: str | Mapping[str, Any]
    sample_time: float
    lower: Sequence[float]
    upper: Sequence[float]
    stages: int
    hold: Hold = "first"
    input_scale: float = 0.1
    steps: int = 1  # of the simulation in a sample


EXAMPLES = {
    "tube (RK4)": Example("tube", "tube", 0.01, [0.9, 0.2, 0.0], [1.1, 0.5, 0.3], 4),
    "silverbox (RK4, 2 steps a sample)": Example(
        "silverbox",
        "silverbox",
        1 / 610.35,
        [1e5, 20, 1e5, -1e4, 0, -1e3, 0],
        [3e5, 80, 3e5, 1e4, 1e6, 1e3, 3e-3],
        8,
        "band-limited",
        steps=2,
    ),
    "coulomb-eq16": Example("coulomb", "coulomb-eq16", 0.02, [0] * 4, [1, 0.9, 10, 2], 1),
    "actuator (8 steps a sample)": Example(
        "actuator",
        "actuator",
        0.01,
        [3e-4, 1e-2, 2e-2, 60, 3e5, -0.1],
        [4e-4, 2e-2, 5e-2, 100, 6e5, 0.1],
        8,
        input_scale=2e5,
        steps=8,
    ),
    "narx, 13 terms": Example(
        "narx", NARX, 1.0, [0.5, -0.5, *[-0.01] * 11], [0.9, 0.05, *[0.01] * 11], 1
    ),
    "mackey-glass (RK4)": Example(
        "mackey", "mackey-glass", 0.5, [0.1, 0.05, 2, 1], [0.3, 0.2, 12, 20], 4
    ),
}


def build_problem(example: Example, samples: int) -> Problem:
    """The model on a smooth record of its sampling."""
    model = load_model(example.model)
    times = example.sample_time * np.arange(samples)
    phase = np.arange(samples) / 8
    inputs = [
        Channel(
            channel.name,
            times,
            example.input_scale * np.cos(phase),
            channel.unit,
            hold=example.hold,
        )
        for channel in model.inputs
    ]
    output = model.outputs[0]
    measured = Channel(output.name, times, 0.8 + 0.05 * np.sin(phase), output.unit)
    return Problem.build(model, [Record(tuple(inputs), (measured,))])


def individuals(example: Example, count: int) -> FloatArray:
    """Candidates (P, D) with lags that the C code bears."""
    lower, upper = np.array(example.lower), np.array(example.upper)
    uniform = np.random.default_rng(0).random((count, lower.size))
    return np.ascontiguousarray(lower + uniform * (upper - lower))


class Compiled:
    """The C file, compiled with the machine's own compiler."""

    def __init__(self) -> None:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "equivalents.so"
            subprocess.run(["cc", *FLAGS, str(SOURCE), "-o", str(path), "-lm"], check=True)
            self._library = ctypes.CDLL(str(path))

    def call(
        self, example: Example, problem: Problem, theta: FloatArray
    ) -> tuple[Callable[[], object], FloatArray]:
        """A call of one model's function, and where it leaves J (P,)."""
        evaluator, layout = problem.evaluator, ExperimentLayout.from_model(problem.model)
        has_input = bool(problem.model.inputs)
        zero, points = (
            (int(evaluator.ints[layout.locate_input(0, field)]) if has_input else 0)
            for field in ("zero", "points")
        )
        rows = np.ascontiguousarray(theta.T)
        samples = evaluator.n_measured
        work = np.zeros(2 * (samples + HISTORY) * LANES)
        fitness = np.empty(theta.shape[0])

        def address(values: FloatArray) -> ctypes.c_void_p:
            return ctypes.c_void_p(values.ctypes.data)

        arguments = (
            address(rows),
            ctypes.c_long(theta.shape[0]),
            address(evaluator.floats),
            ctypes.c_long(zero),
            ctypes.c_long(points),
            address(evaluator.measured),
            ctypes.c_long(samples),
            ctypes.c_double(example.sample_time),
            address(work),
            address(fitness),
        )
        function = getattr(self._library, example.function)
        buffers = (rows, work)  # ctypes holds addresses only

        def timed() -> object:
            return function(*arguments), buffers

        return timed, fitness

    def peak(self, turns: int) -> Callable[[], object]:
        """Independent multiply-adds: `operations_of_peak(turns)` operations."""
        function = self._library.peak
        function.restype = ctypes.c_double
        return lambda: function(ctypes.c_long(turns))


def operations_of_peak(turns: int) -> float:
    """Floating point operations of `Compiled.peak`."""
    return 2.0 * LANES * 8 * turns


def operations_a_step(problem: Problem) -> int:
    """Vector arithmetic in the kernel's code: close to what one step does for one individual."""
    code = emit_kernel(problem.model, KernelVariant())
    single = re.findall(rf"= f(?:add|sub|mul|div)\b.*<{LANES} x double>", code)
    fused = re.findall(rf"= call .*@\"?llvm\.fmuladd\.v{LANES}f64", code)
    return len(single) + len(fused)  # the product that is fused stands among the single ones
