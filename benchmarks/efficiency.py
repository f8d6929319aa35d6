"""Measure the default method's estimates and intervals over many draws of the noise.

Examples 1 and 2 of the paper, with measurement noise of sd 0.01. Every draw is a whole
identification from the catalogue's bounds with its own search seed. For every parameter the
program prints three figures: the root mean square error over the Cramér-Rao bound, the bias in
standard deviations, and the coverage of the 95 % interval. The bound is sd²(SᵀS)⁻¹ with the
sensitivities S at the true values.

L = 0.5 s is exactly 25 samples, a knot of the interpolated past. The slopes on its two sides differ
by 0.7 %; S is their mean.
"""

import argparse
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.table import Row, parser, report
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import to_unit
from sysid.uncertainty.sensitivities import compute_sensitivities

STEP, SAMPLES, SD = 0.02, 300, 0.01
DRAWS, QUICK = 1000, 100
EXAMPLES = {
    "duffing-eq16": {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0},
    "coulomb-eq16": {"c": 0.2, "L": 0.5, "b": 5.0, "mu": 0.5},
}


@dataclass(frozen=True)
class Draws:
    """Estimates and interval ends of many draws, (draws, D); NaN where there is no interval."""

    names: tuple[str, ...]
    truth: NDArray[np.float64]
    bound: NDArray[np.float64]
    values: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def rows(self, label: str) -> list[Row]:
        """One row a figure and parameter."""
        error = self.values - self.truth
        size = np.sqrt(np.mean(error**2, axis=0)) / self.bound
        bias = np.abs(np.mean(error, axis=0)) / np.std(error, axis=0)
        held = 100 * np.mean((self.low <= self.truth) & (self.truth <= self.high), axis=0)
        draws = error.shape[0]
        rows = [
            Row(f"{label}: sampling error of an RMS error", 1 / np.sqrt(2 * draws), "of itself"),
            Row(f"{label}: sampling error of a bias", 1 / np.sqrt(draws), "sd"),
            Row(f"{label}: binomial error of 95 %", 100 * np.sqrt(0.05 * 0.95 / draws), "%"),
        ]
        for i, name in enumerate(self.names):
            what = f"{label}, {name}"
            rows += [
                Row(f"{what}: RMS error", float(size[i]), "of the bound", 1.10),
                Row(f"{what}: bias", float(bias[i]), "sd", 0.2),
                Row(f"{what}: interval holds truth", float(held[i]), "%", 93, ">="),
                Row(f"{what}: interval holds truth", float(held[i]), "%", 97),
            ]
        return rows


def record(y: NDArray[np.float64]) -> Record:
    """The paper's experiment: 10 cos 5t for 6 s, h = 0.02 s."""
    times = STEP * np.arange(SAMPLES)
    force = Channel("q", times, 10.0 * np.cos(5.0 * times), "N", hold="zero")
    return Record((force,), (Channel("y", times, y, "m"),))


def identify_draws(model: Model, truth: dict[str, float], draws: int) -> Draws:
    """Identify every draw."""
    problem = Problem.build(model, [record(np.zeros(SAMPLES))])
    names = problem.free_names
    theta = np.array([truth[name] for name in names])
    clean = problem.predict(theta[None])[0]
    rows = []
    for draw in range(draws):
        noise = SD * np.random.default_rng([7, draw]).standard_normal(SAMPLES)
        estimates = identify(model, record(clean + noise), seed=draw + 1).parameters
        ends = [estimate.interval95 or (np.nan, np.nan) for estimate in estimates]
        rows.append([[estimate.value, *end] for estimate, end in zip(estimates, ends, strict=True)])
    table = np.array(rows)
    return Draws(names, theta, bound(problem, theta), table[..., 0], table[..., 1], table[..., 2])


def bound(problem: Problem, theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cramér-Rao bound of each parameter's standard deviation."""
    columns = compute_sensitivities(problem, theta).columns
    place = to_unit(problem.evaluator, theta[None])[0]
    assert np.all((place > 0) & (place < 1))
    ranges = problem.evaluator.upper - problem.evaluator.lower
    slopes = columns / ranges
    return np.asarray(SD * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes))))


def main(options: argparse.Namespace) -> None:
    """Measure both examples."""
    draws = QUICK if options.quick else DRAWS
    rows = []
    for name, truth in EXAMPLES.items():
        rows += identify_draws(load_model(name), truth, draws).rows(name)
    report(f"Efficiency over {draws} noise draws (sd {SD:g})", rows, [], options)


if __name__ == "__main__":
    main(parser(__doc__ or "").parse_args())
