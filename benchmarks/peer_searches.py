"""Run other optimisers on the same records and count their simulations.

SciPy: differential evolution, dual annealing, and least squares (MINPACK) from random starts.
pygmo: de1220, sade and CMA-ES, as in `bench/peers`. On the paper's examples they use a compiled
simulation of one individual. For them it is faster than lagid's kernel of sixteen lanes.
"""

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from scipy.optimize import differential_evolution, dual_annealing, leastsq

from benchmarks.searches import BUDGET, Goal
from benchmarks.systems import STEP, System
from sysid.core.types import FloatArray
from sysid.simulation.problem import Problem

HAS_PYGMO = importlib.util.find_spec("pygmo") is not None
_CAP = 1e3  # loss and residual of a diverged simulation
_POPULATION = 50


class Enough(Exception):
    """The target is hit, or the budget used up."""


@dataclass
class Counter:
    """Counts simulations and says when the target is hit."""

    goal: Goal
    count: int = 0
    is_hit: bool = False

    def note(self, rms: float, theta: FloatArray) -> None:
        """One more simulation."""
        self.count += 1
        self.is_hit = self.goal.hit(rms, theta)
        if self.is_hit or self.count >= BUDGET:
            raise Enough


@njit(cache=True, error_model="numpy")
def _simulated(theta: FloatArray, friction: bool, drive: FloatArray, x: FloatArray) -> None:
    """Eq. 16 for one individual: x(k) from the past, from rest."""
    lag = theta[1] / STEP
    whole = int(np.floor(lag))
    rest = lag - whole
    for k in range(x.size):
        if k < 2:
            x[k] = 0.0
            continue
        j = k - 1 - whole
        a = x[j] if j > 0 else 0.0
        b = x[j - 1] if j > 1 else 0.0
        c = x[j - 2] if j > 2 else 0.0
        rate = ((1.0 - rest) * (a - b) + rest * (b - c)) / STEP
        spring = theta[2] * x[k - 2]
        if friction:
            spring += theta[3] * np.sign(x[k - 1] - x[k - 2])
        else:
            spring += theta[3] * x[k - 2] ** 3
        force = theta[0] * rate + spring - drive[k - 2]
        x[k] = 2.0 * x[k - 1] - x[k - 2] - STEP * STEP * force


@njit(cache=True, error_model="numpy")
def _errors(
    theta: FloatArray, friction: bool, drive: FloatArray, y: FloatArray
) -> tuple[FloatArray, float]:
    """Residuals of one individual, cut off where it diverges, and their RMS."""
    x = np.empty(y.size)
    _simulated(theta, friction, drive, x)
    total = 0.0
    for k in range(x.size):
        x[k] -= y[k]
        if not abs(x[k]) < _CAP:
            x[k] = _CAP
        total += x[k] * x[k]
    return x, np.sqrt(total / y.size)


Errors = Callable[[FloatArray], tuple[FloatArray, float]]


def errors_of(system: System, problem: Problem) -> Errors:
    """Residuals and RMS of one individual, by the fastest means a peer can have here."""
    y, weight = problem.evaluator.measured, problem.evaluator.weight
    if system.model in ("duffing-eq16", "coulomb-eq16") and system.drive is not None:
        friction = system.model == "coulomb-eq16"
        drive = system.drive(STEP * np.arange(y.size))
        return lambda theta: _errors(theta, friction, drive, y)

    def general(theta: FloatArray) -> tuple[FloatArray, float]:
        with np.errstate(all="ignore"):
            error = weight * (problem.predict(theta[None])[0] - y)
            error = np.where(np.abs(error) < _CAP, error, _CAP)
            return error, min(float(np.sqrt(np.mean(error**2))), _CAP)

    return general


@dataclass
class Task:
    """What a peer minimises: the unit cube of the free parameters' ranges."""

    errors: Errors
    counter: Counter
    lower: FloatArray
    upper: FloatArray
    seed: int

    def residuals(self, unit: FloatArray) -> FloatArray:
        """Residuals at a place, reflected into the box."""
        turned = np.abs(np.asarray(unit, dtype=float)) % 2.0
        inside = np.where(turned > 1.0, 2.0 - turned, turned)
        theta = self.lower + inside * (self.upper - self.lower)
        error, rms = self.errors(theta)
        self.counter.note(rms, theta)
        return error

    def fitness(self, unit: FloatArray) -> float:
        """RMS at a place in the unit cube."""
        theta = self.lower + np.asarray(unit) * (self.upper - self.lower)
        rms = self.errors(theta)[1]
        self.counter.note(rms, theta)
        return rms


def _evolution(task: Task) -> None:
    n = task.lower.size
    differential_evolution(
        task.fitness,
        [(0.0, 1.0)] * n,
        popsize=15,
        maxiter=BUDGET,
        tol=1e-6,
        atol=0,
        rng=task.seed,
        polish=True,
    )


def _annealing(task: Task) -> None:
    bounds = [(0.0, 1.0)] * task.lower.size
    dual_annealing(task.fitness, bounds, maxfun=BUDGET, maxiter=10**6, rng=task.seed)


def _starts(task: Task) -> None:
    rng = np.random.default_rng(task.seed)
    while True:  # until the counter says that it is enough
        leastsq(
            task.residuals, rng.random(task.lower.size), epsfcn=1e-10, maxfev=500, full_output=True
        )


class _Pygmo:
    """A task in the form that pygmo asks for."""

    def __init__(self, task: Task) -> None:
        self.task = task

    def fitness(self, unit: FloatArray) -> list[float]:
        return [self.task.fitness(unit)]

    def get_bounds(self) -> tuple[list[float], list[float]]:
        n = self.task.lower.size
        return [0.0] * n, [1.0] * n

    def __deepcopy__(self, memo: object) -> "_Pygmo":
        return self


def _pygmo(name: str, **options: Any) -> Callable[[Task], None]:
    def run(task: Task) -> None:
        import pygmo

        generations = BUDGET // _POPULATION
        algorithm = pygmo.algorithm(getattr(pygmo, name)(gen=generations, **options))
        algorithm.set_seed(task.seed)
        problem = pygmo.problem(_Pygmo(task))
        algorithm.evolve(pygmo.population(problem, _POPULATION, seed=task.seed))

    return run


PEERS: dict[str, Callable[[Task], None]] = {
    "SciPy leastsq, random starts": _starts,
    "SciPy differential_evolution": _evolution,
    "SciPy dual_annealing": _annealing,
}
if HAS_PYGMO:
    PEERS |= {
        "pygmo de1220": _pygmo("de1220", ftol=1e-12, xtol=1e-12),
        "pygmo sade": _pygmo("sade", ftol=1e-12, xtol=1e-12),
        "pygmo cmaes": _pygmo("cmaes", sigma0=0.3, force_bounds=True, ftol=1e-12, xtol=1e-12),
    }


def run_peer(name: str, system: System, seed: int, goal: Goal) -> tuple[int | None, float]:
    """Simulations until the target is hit (None: never within the budget) and CPU seconds."""
    problem = system.problem(seed)
    errors = errors_of(system, problem)
    errors(system.place(problem))  # compiles, outside the clock
    lower = np.array([p.lower for p in problem.free_parameters])
    upper = np.array([p.upper for p in problem.free_parameters])
    task = Task(errors, Counter(goal), lower, upper, seed % 2**31 + 1)
    start = time.process_time()
    try:
        PEERS[name](task)
    except Exception:  # each library wraps the counter's own way out in an error of its own
        if not (task.counter.is_hit or task.counter.count >= BUDGET):
            raise
    seconds = time.process_time() - start
    return (task.counter.count if task.counter.is_hit else None), seconds
