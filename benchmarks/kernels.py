"""Compare the speed of compiled kernels with C, and measure the cost of their calls.

The C reference of the paper's recursion is in the folder ``bench`` next to the measured data
(`LAGID_DATA`). C code of other models is in ``benchmarks/c``. This program compiles both.
"""

import importlib.util
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.equivalents import (
    EXAMPLES,
    Compiled,
    build_problem,
    operations_a_step,
    operations_of_peak,
)
from benchmarks.equivalents import (
    individuals as candidates,
)
from benchmarks.table import Row, Skipped, parser, report
from sysid.core.code_cache import load_code, store_code
from sysid.data.records import Channel, Record
from sysid.kernels.compilation.build import compute_kernel_key
from sysid.kernels.compilation.machine_code import compile_assembly
from sysid.kernels.kernel import emit_kernel
from sysid.kernels.layout import KernelVariant
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem

DATA = Path(os.environ.get("LAGID_DATA", Path(__file__).parents[2] / "shared" / "data"))

BOUNDS = {"c": [0, 1], "L": [0, 1], "b": [0, 10], "a": [0, 5]}
FORCE = "c*(x(k-1 - L/h) - x(k-2 - L/h))/h + b*x(k-2) + a*x(k-2)**3 - q(k-2)"
RATE = "q(t) - c*v(t - L) - b*x - a*x**3"


def duffing(form: str) -> Model:
    """The paper's Example 1 as recursion (Eq. 16) or as differential equation (Eq. 13)."""
    recursion = {"x": f"2*x(k-1) - x(k-2) - h**2*({FORCE})"}
    equations = recursion if form == "difference" else {"x": "v", "v": RATE}
    parameters = {name: {"lower": low, "upper": high} for name, (low, high) in BOUNDS.items()}
    return parse_model(
        {
            "name": "duffing",
            "form": form,
            "inputs": {"q": "N"},
            "states": dict.fromkeys(equations, "m"),
            "parameters": parameters,
            "equations": equations,
            "outputs": {"y": "x"},
            "initial": dict.fromkeys(equations, 0),
        }
    )


def problem(model: Model, samples: int) -> Problem:
    """The model on the reference's record."""
    period, k = 0.02, np.arange(samples)
    force = Channel("q", period * k, 10 * np.cos(5 * period * k), "N")
    measured = Channel("y", period * k, np.sin(period * k), "m")
    return Problem.build(model, [Record((force,), (measured,))])


def individuals(count: int) -> np.ndarray:
    """Candidates inside the bounds."""
    return np.random.default_rng(0).random((count, 4)) * [1, 1, 10, 5]


def microseconds(work: Callable[[], object], repeats: int) -> float:
    """Least time of some repeats of ten calls each."""
    work()
    least = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        for _ in range(10):
            work()
        least = min(least, (time.perf_counter() - start) / 10)
    return 1e6 * least


def reference() -> Callable[[int, int], float] | None:
    """The C reference's own timing program, or None where it or a compiler is absent."""
    path = DATA.parent / "bench" / "kernel_speed.py"
    specification = importlib.util.spec_from_file_location("kernel_speed", path)
    if not path.is_file() or shutil.which("cc") is None or specification is None:
        return None
    module = importlib.util.module_from_spec(specification)
    if specification.loader is None:
        return None
    specification.loader.exec_module(module)
    function: Callable[[int, int], float] = module.reference_microseconds
    return function


def against_c(repeats: int) -> tuple[list[Row], list[Skipped]]:
    """Time of a population, call and allocation included, beside C; both the least of several."""
    rows: list[Row] = []
    skipped: list[Skipped] = []
    timed_c = reference()
    for count in (48, 512):
        example, theta = problem(duffing("difference"), 300), individuals(count)
        ours, c = np.inf, np.inf
        for _ in range(3):  # in turns, so that a disturbance meets both
            ours = min(
                ours, microseconds(lambda e=example, t=theta: e.evaluate_fitness(t), repeats)
            )
            if timed_c is not None:
                c = min(c, timed_c(count, 300))
        name = f"duffing-eq16, {count} individuals × 300 samples"
        rows.append(Row(name, ours, "µs"))
        if timed_c is None:
            skipped.append(Skipped(f"{name}: C", "no C reference beside LAGID_DATA, or no cc"))
        else:
            rows.append(Row(f"{name}: time ÷ C reference", ours / c, "", 1.3))
    return rows, skipped


def against_own_c(repeats: int) -> tuple[list[Row], list[Skipped]]:
    """Models that users write, 48 × 300, beside C written by hand; both the least of several."""
    if shutil.which("cc") is None:
        return [], [Skipped("models beside C", "no C compiler (cc)")]
    compiled, rows = Compiled(), []
    turns = 10_000
    peak = operations_of_peak(turns) / microseconds(compiled.peak(turns), 5) / 1000
    for name, example in EXAMPLES.items():
        built, theta = build_problem(example, 300), candidates(example, 48)
        call, fitness = compiled.call(example, built, theta)
        call()
        if not np.allclose(fitness, built.evaluate_fitness(theta), rtol=1e-9):
            raise SystemExit(f"{name}: the C code does not compute what the kernel computes")
        ours = c = np.inf
        for _ in range(3):
            ours = min(ours, microseconds(lambda e=built, t=theta: e.evaluate_fitness(t), repeats))
            c = min(c, microseconds(call, repeats))
        share = operations_a_step(built) * 48 * 300 * example.steps / ours / 1000 / peak
        rows += [
            Row(f"{name}: time ÷ C by hand", ours / c, "", 1.5),
            Row(
                f"{name}: per individual, sample and stage",
                ours * 1000 / 48 / 300 / example.stages,
                "ns",
            ),
            Row(f"{name}: share of the peak of {peak:.0f} GFLOP/s", 100 * share, "%"),
        ]
    return rows, []


def growth(repeats: int) -> list[Row]:
    """Whether the time is linear: a straight line through it, and how far the worst lies off."""
    rows = []
    sizes = {"sample": (300, 1000, 3000, 10_000), "individual": (48, 96, 480, 960)}
    for what, counts in sizes.items():
        times = []
        for count in counts:
            samples, many = (count, 48) if what == "sample" else (300, count)
            example, theta = problem(duffing("difference"), samples), individuals(many)
            times.append(microseconds(lambda e=example, t=theta: e.evaluate_fitness(t), repeats))
        n, t = np.array(counts, float), np.array(times)
        slope, start = np.polyfit(n, t, 1, w=1 / t)  # relative departures count
        off = float(np.max(np.abs((start + slope * n) / t - 1)))
        span = f"{counts[0]} to {counts[-1]} {what}s"
        rows.append(
            Row(
                f"{span}: line {start:.1f} µs + {1e3 * slope:.1f} ns a {what}, worst off",
                100 * off,
                "%",
                20.0,
            )
        )
    return rows


def others(repeats: int) -> list[Row]:
    """The differential form, a long record, and what a new model costs."""
    model = duffing("differential")
    lagged, long = problem(model, 300), problem(duffing("difference"), 20_000)
    few, one_block = individuals(48), individuals(16)
    rows = [
        Row(
            "duffing-delay (RK4), 48 × 300",
            microseconds(lambda: lagged.evaluate_fitness(few), repeats),
            "µs",
        ),
        Row(
            "duffing-eq16, 16 × 20,000 samples",
            microseconds(lambda: long.evaluate_fitness(one_block), max(repeats // 5, 2)) / 1000,
            "ms",
        ),
    ]
    start = time.perf_counter()
    code = emit_kernel(model, KernelVariant())
    written = time.perf_counter()
    compiled = compile_assembly(code)
    done = time.perf_counter()
    rows.append(Row("write the code of a new model", 1e3 * (written - start), "ms"))
    rows.append(Row("compile it", 1e3 * (done - written), "ms"))
    with TemporaryDirectory() as folder:
        os.environ["LAGID_CACHE_DIR"] = folder
        key = compute_kernel_key(model, KernelVariant())
        store_code(key, compiled)
        start = time.perf_counter()
        load_code(key)
        rows.append(Row("find it again on disk", 1e3 * (time.perf_counter() - start), "ms", 10.0))
    return rows


def main() -> None:
    """Measure and print."""
    options = parser(__doc__ or "").parse_args()
    repeats = 10 if options.quick else 50
    rows, skipped = against_c(repeats)
    own, absent = against_own_c(repeats)
    rows += [*own, *growth(repeats), *others(repeats)]
    report("Kernels", rows, [*skipped, *absent], options)


if __name__ == "__main__":
    main()
