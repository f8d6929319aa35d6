"""Measure whole searches on the paper's Example 1: the time in addition to simulations.

If the C reference is available (see `benchmarks/kernels.py`), figures are ratios to it, measured in
the same run.
"""

import time
from statistics import median

import numpy as np

from benchmarks import paper_example
from benchmarks.kernels import microseconds, reference
from benchmarks.table import Row, Skipped, parser, report
from sysid.core.settings import GeneticAlgorithm
from sysid.core.threads import use_one_thread
from sysid.core.types import FloatArray
from sysid.identification.run import advance_run, begin_run
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate

GENERATIONS, POPULATION = 400, 50
C_SHARE = 2.0 / 3.5
"""Of the C reference's evaluations in a CPU-second: the bar, free of the machine's own speed."""


def search_milliseconds(problem: Problem, algorithm: GeneticAlgorithm) -> tuple[float, int]:
    """CPU time and evaluations of one search, without its refinement."""
    state = begin_run(problem, algorithm, 1)
    start = time.process_time()
    state = advance_run(problem, algorithm, state)
    return 1e3 * (time.process_time() - start), state.evaluations


def draw_individuals(problem: Problem, count: int) -> FloatArray:
    """Candidates anywhere in the bounds."""
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    return lower + np.random.default_rng(0).random((count, lower.size)) * (upper - lower)


def searches(problem: Problem, repeats: int) -> tuple[list[Row], list[Skipped]]:
    """Each method's search beside its own simulations and beside C."""
    rows: list[Row] = []
    timed_c = reference()
    children = draw_individuals(problem, POPULATION // 2)
    for method in ("simple", "improved-paper", "improved"):
        algorithm = GeneticAlgorithm(
            method=method, population=POPULATION, generations=GENERATIONS, refine=False
        )
        spent = kernel = c = np.inf
        for _ in range(repeats):
            once, evaluations = search_milliseconds(problem, algorithm)
            spent = min(spent, once)
            kernel = min(kernel, microseconds(lambda: problem.evaluate_fitness(children), 3) / 1e3)
            if timed_c is not None:
                c = min(c, timed_c(48, paper_example.SAMPLES) / 1e3)
        rows.append(Row(f"{method}: whole search, {evaluations} evaluations", spent, "ms"))
        rate = evaluations / spent / 1e3
        rows.append(Row(f"{method}: evaluations a CPU-second", rate, "M"))
        if timed_c is not None:
            share = rate / (48 / c / 1e3)
            rows.append(Row(f"{method}: the same ÷ C reference", share, "", C_SHARE, ">="))
        if method == "simple":
            own = GENERATIONS * kernel
            name = "simple: time ÷ simulations of all children"  # most of them are known
            rows.append(Row(name, spent / own, "", 1.0))
            if timed_c is not None:
                rows.append(
                    Row("simple: time ÷ 400 populations of 48 in C", spent / (400 * c), "", 2.0)
                )
    skipped = [] if timed_c else [Skipped("beside C", "no C reference beside LAGID_DATA, or no cc")]
    return rows, skipped


def refinement(problem: Problem, repeats: int) -> Row:
    """Least squares from 2 % beside the estimate, and its standard errors."""
    start = 1.02 * np.array(list(paper_example.TRUTH.values()))

    def work() -> object:
        with use_one_thread():  # as where a run is concluded
            end = refine_candidates(problem, [start])[0]
            return analyse_estimate(problem, start if end is None else end.theta)

    work()
    spent = []
    for _ in range(5 * repeats):
        begun = time.process_time()
        work()
        spent.append(1e3 * (time.process_time() - begun))
    name = "refinement with standard errors, 4 parameters × 300 samples: median"
    return Row(name, median(spent), "ms of CPU", 2.0)


def main() -> None:
    """Measure and print."""
    options = parser(__doc__ or "").parse_args()
    repeats = 3 if options.quick else 10
    problem = paper_example.problem(seed=1)
    rows, skipped = searches(problem, repeats)
    rows.append(refinement(problem, repeats))
    report("Searches", rows, skipped, options)


if __name__ == "__main__":
    main()
