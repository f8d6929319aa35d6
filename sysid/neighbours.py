"""Minima beside an estimate: where the loss is rough, least squares ends at one of many.

Switches such as dry friction make the loss jump, so that minima lie side by side inside the
statistical ellipsoid, with losses that the noise hardly tells apart. Places are drawn along the
estimate's covariance; if the loss there is what the linear model says, nothing more is done. Else
least squares goes on from those that lie lowest under the linear model's loss, and again from
around a better minimum (basin hopping, Wales and Doye, J. Phys. Chem. A 101 (1997) 5111).

Such a minimum often lies on the edge of a jump, along which no slope leads. So at last an evolution
strategy follows it: the best of a batch of places around the best one takes its place, their
spread grows by a gain and shrinks by none (Rechenberg, Evolutionsstrategie, 1973).

A minimum whose likelihood ratio n ln(Σe²/Σe²₀) is below the square of the interval's quantile is
inside the profile likelihood region (Venzon and Moolgavkar, Appl. Statist. 37 (1988) 87). With the
curvature of the best, each such minimum holds the values within √(q² − ratio) standard errors, and
the interval is from the least of all these to the largest.
"""

from dataclasses import dataclass, replace

import numpy as np

from sysid.problem import Problem
from sysid.refinement import Refined, refine_one
from sysid.result import Estimate
from sysid.types import FloatArray

_SIZES = np.array([0.5, 1.0, 2.0, 3.0])  # standard errors
_LOOK = 24  # places that tell whether the loss is rough
_DRAWN = 192  # places in a round
_POLISHED = 8  # of these: the lowest under the linear model
_ROUNDS = 2
_STEPS = 12  # of least squares from each place
_LINEAR = 0.5  # of the linear model's likelihood ratio: deviations that are no roughness
_BATCH = 32  # places around the best one
_FIRST, _LAST = 0.5, 1e-3  # their spread at the beginning and at the end, standard errors
_MORE, _LESS = 1.1, 0.7  # spread after a gain, after none
_LONG = 2_000_000  # measured values times parameters: from here on, nothing is looked for
_BETTER = 1e-9  # relative


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """What was found beside an estimate.

    Attributes
    ----------
    best : Refined or None
        A better minimum; None where the estimate is the best.
    values : FloatArray, shape (m, D)
        All minima, the estimate first; no others where the loss is as the linear model says.
    rms : FloatArray, shape (m,)
    evaluations : int
    """

    best: Refined | None
    values: FloatArray
    rms: FloatArray
    evaluations: int


def neighbourhood(
    problem: Problem, theta: FloatArray, rms: float, covariance: FloatArray, seed: int,
    left: int | None = None,
) -> Neighbourhood:  # fmt: skip
    """Look for minima around an estimate (D,) of a covariance (D, D), in at most `left` runs."""
    look = _Look(problem, covariance, seed, 2**62 if left is None else left)
    first = best = Refined(theta, rms, 0)
    found = [first]
    long = problem.evaluator.n_measured * theta.size > _LONG
    if rms > 0 and look.root.any() and not long and look.is_rough(best):
        for _ in range(_ROUNDS):
            ends = look.minima(best)
            found += ends
            reached = min((best, *ends), key=lambda one: one.rms)
            if not reached.rms < best.rms * (1.0 - _BETTER):
                break
            best = reached
        found.append(look.followed(best))
        best = found[-1]
    better = best if best.rms < rms * (1.0 - _BETTER) else None
    return Neighbourhood(
        better, np.array([one.theta for one in found]), np.array([one.rms for one in found]),
        look.spent,
    )  # fmt: skip


class _Look:
    """Places drawn along a covariance and what is found from there, counting simulations."""

    def __init__(self, problem: Problem, covariance: FloatArray, seed: int, budget: int) -> None:
        self._problem, self._budget, self.spent = problem, budget, 0
        self._random = np.random.Generator(np.random.Philox(key=seed))
        size, rows = np.linalg.eigh(covariance)
        self.root = np.asarray(rows * np.sqrt(np.maximum(size, 0.0)))

    def is_rough(self, centre: Refined) -> bool:
        """Whether losses around differ from those of the linear model; no, if none can be had."""
        if self._budget - self.spent < _LOOK:
            return False
        _, _, expected, beyond = self._drawn(centre, _LOOK)
        return bool(np.any(~(np.abs(beyond) <= _LINEAR * np.maximum(expected, 1.0))))

    def minima(self, centre: Refined) -> list[Refined]:
        """What least squares makes of the most promising places around."""
        if self._budget - self.spent < _DRAWN:
            return []
        starts, values, _, beyond = self._drawn(centre, _DRAWN)
        ends = []
        for i in np.argsort(beyond, kind="stable")[:_POLISHED]:
            left = self._budget - self.spent
            end = refine_one(self._problem, starts[i], float(values[i]), left, _STEPS)
            if end is None or not np.isfinite(end.rms):
                break
            self.spent += end.evaluations
            ends.append(end)
        return ends

    def followed(self, centre: Refined) -> Refined:
        """The best that batches of places around the best one lead to."""
        theta, rms, size = centre.theta, centre.rms, _FIRST
        while size > _LAST and self._budget - self.spent >= _BATCH:
            sizes = size * np.exp(self._random.uniform(-1.5, 0.5, _BATCH))
            starts, values, _ = self._simulated(theta, sizes)
            best = int(np.argmin(values))
            gains = bool(values[best] < rms)
            if gains:
                theta, rms = starts[best], float(values[best])
            size *= _MORE if gains else _LESS
        return Refined(theta, rms, 0)

    def _drawn(
        self, centre: Refined, count: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Places, their RMS, the likelihood ratio expected there, and by how much it is more."""
        starts, values, expected = self._simulated(
            centre.theta, _SIZES[np.arange(count) % _SIZES.size]
        )
        with np.errstate(divide="ignore"):
            ratio = 2.0 * self._problem.n_scored * np.log(values / centre.rms)
        return starts, values, expected, ratio - expected

    def _simulated(
        self, theta: FloatArray, sizes: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Places that many standard errors away, their RMS, and their squared distances."""
        moves = sizes[:, None] * self._random.standard_normal((sizes.size, theta.size))
        evaluator = self._problem.evaluator
        starts = np.clip(theta + moves @ self.root.T, evaluator.lower, evaluator.upper)
        self.spent += sizes.size
        return starts, self._problem.fitness(starts), np.einsum("pd,pd->p", moves, moves)


def widened(
    estimates: tuple[Estimate, ...], names: tuple[str, ...], n: int, found: Neighbourhood
) -> tuple[Estimate, ...]:
    """Estimates whose intervals hold those of all minima that the data do not rule out."""
    least = found.rms.min()
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = 2.0 * n * np.log(np.where(found.rms > least, found.rms / least, 1.0))
    changed = []
    for one in estimates:
        if one.name in names and one.stderr and one.interval95 is not None:
            # On a plateau the interval is around its middle; of noiseless data it has no width.
            lower, upper = one.interval95
            quantile, aside = (upper - lower) / (2.0 * one.stderr), (lower + upper) / 2 - one.value
            kept = ratio <= quantile**2
            half = one.stderr * np.sqrt(quantile**2 - ratio[kept])
            middle = found.values[kept, names.index(one.name)] + aside
            low = min(one.interval95[0], float(np.min(middle - half)))
            high = max(one.interval95[1], float(np.max(middle + half)))
            one = replace(one, interval95=(low, high))
        changed.append(one)
    return tuple(changed)
