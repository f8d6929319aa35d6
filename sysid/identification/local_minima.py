"""Minima beside an estimate: where the loss is rough, least squares ends at one of many.

Switches such as dry friction make the loss jump, so that minima lie side by side inside the
statistical ellipsoid, with losses that the noise hardly tells apart. Places are drawn along
s²(SᵀS)⁻¹, in which the likelihood ratio of squares is measured whatever the residuals' colour; if
the loss there is what the linear model says, nothing more is done. Else least squares goes on
from those that lie lowest under the linear model's loss, and again from around a better minimum
(basin hopping, Wales and Doye, J. Phys. Chem. A 101 (1997) 5111).

Such a minimum often lies on the edge of a jump, along which no slope leads. So at last an evolution
strategy follows it: the best of a batch of places around the best one takes its place, their
spread grows by a gain and shrinks by none (Rechenberg, Evolutionsstrategie, 1973).

A minimum whose likelihood ratio n ln(Σe²/Σe²₀) is below the square of the interval's quantile is
inside the profile likelihood region (Venzon and Moolgavkar, Appl. Statist. 37 (1988) 87). With the
curvature of the best, each such minimum holds the values within √(q² − ratio) standard errors, and
the interval is from the least of all these to the largest. Of coloured residuals the ratio is too
large by as much as the variance by s²(SᵀS)⁻¹ is too small.

A lag that is rounded to samples stays where it is: its standard error is from plateau to plateau,
and where on one a search ends says nothing.
"""

from dataclasses import dataclass, replace

import numpy as np

from sysid.core.types import FloatArray
from sysid.search.refine import Refined, refine_one
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.linear_model import Linear, drawn_along, moves_of

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
_MOST = 1800  # simulations
_WORK = 50_000_000  # steps of integration or recursion: on long records simulations are fewer
_LATE = 5_000_000  # as many when the time of the run is over
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


def affordable(problem: Problem, is_late: bool) -> int:
    """Simulations that may be spent beside an estimate, fewer the longer one takes.

    By the steps of a simulation, not by the clock, so that the same run has the same result.
    """
    steps = sum(one.grid.points * one.grid.substeps for one in problem.experiments)
    most = min(_MOST, (_LATE if is_late else _WORK) // max(steps, 1))
    return most if most >= _LOOK else 0


def neighbourhood(
    problem: Problem, theta: FloatArray, rms: float, linear: Linear, seed: int,
    left: int | None = None,
) -> Neighbourhood:  # fmt: skip
    """Look for minima around an estimate (D,) with a linear model, in at most `left` runs."""
    look = _Look(problem, linear, seed, 2**62 if left is None else left)
    first = best = Refined(theta, rms, 0)
    found = [first]
    if rms > 0 and look.root.any() and look.is_rough(best):
        for _ in range(_ROUNDS):
            ends = look.minima(best)
            found += ends
            reached = min((best, *ends), key=lambda one: one.rms)
            gains = reached.rms < best.rms * (1.0 - _BETTER)
            best = reached  # also where it is lower by rounding only: what follows ends the lowest
            if not gains or best.rms == 0:
                break
        found.append(look.followed(best) if best.rms > 0 else best)
        best = found[-1]
    better = best if best.rms < rms * (1.0 - _BETTER) else None
    return Neighbourhood(
        better, np.array([one.theta for one in found]), np.array([one.rms for one in found]),
        look.spent,
    )  # fmt: skip


class _Look:
    """Places drawn around an estimate and what is found from there, counting simulations."""

    def __init__(self, problem: Problem, linear: Linear, seed: int, budget: int) -> None:
        self._problem, self._budget, self.spent = problem, budget, 0
        self._linear = linear
        self._random = moves_of(seed)
        self.root = drawn_along(linear.covariance)

    def is_rough(self, centre: Refined) -> bool:
        """Whether losses around differ from those of the linear model; no, if none can be had."""
        if self._budget - self.spent < _LOOK:
            return False
        _, _, expected, beyond = self._drawn(centre, _LOOK)
        return bool(np.any(~(np.abs(beyond) <= _LINEAR * np.maximum(expected, 1.0))))

    def minima(self, centre: Refined) -> list[Refined]:
        """What least squares makes of the most promising places around."""
        count = min(_DRAWN, (self._budget - self.spent) // 2)
        if count < _LOOK:
            return []
        starts, values, _, beyond = self._drawn(centre, count)
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
            starts, values = self._simulated(theta, sizes)
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
        starts, values = self._simulated(centre.theta, _SIZES[np.arange(count) % _SIZES.size])
        n = self._problem.n_scored
        expected = n * np.log1p(self._linear.excess(starts - centre.theta))
        with np.errstate(divide="ignore"):
            ratio = 2.0 * n * np.log(values / centre.rms)
        return starts, values, expected, ratio - expected

    def _simulated(self, theta: FloatArray, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places that many standard errors away, inside the bounds, and their RMS."""
        moves = sizes[:, None] * self._random.standard_normal((sizes.size, theta.size))
        evaluator = self._problem.evaluator
        starts = np.maximum(theta + moves @ self.root.T, evaluator.lower)
        starts = np.minimum(starts, evaluator.upper)  # quicker than clip for so few
        self.spent += sizes.size
        return starts, self._problem.fitness(starts)


def widened(
    estimates: tuple[Estimate, ...], names: tuple[str, ...], n: int, found: Neighbourhood,
    share: FloatArray,
) -> tuple[Estimate, ...]:  # fmt: skip
    """Estimates whose intervals hold those of all minima that the data do not rule out.

    `share` (D,) is that of `Linear`, of the parameters of these names.
    """
    least = found.rms.min()
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = 2.0 * n * np.log(np.where(found.rms > least, found.rms / least, 1.0))
    changed = []
    told = {name: d for d, name in enumerate(names) if np.isfinite(share[d])}
    for one in estimates:
        if one.name in told and one.stderr and one.interval95 is not None:
            d = told[one.name]
            lower, upper = one.interval95
            quantile, own = (upper - lower) / (2.0 * one.stderr), ratio * share[d]
            kept = own <= quantile**2
            half = one.stderr * np.sqrt(quantile**2 - own[kept])
            middle = found.values[kept, d]
            low, high = float(np.min(middle - half)), float(np.max(middle + half))
            one = replace(one, interval95=(min(lower, low), max(upper, high)))
        changed.append(one)
    return tuple(changed)
