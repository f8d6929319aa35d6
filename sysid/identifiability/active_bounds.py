"""Active bounds: bounds that hold the estimate back, and which of them to widen.

The bounds cannot be examined one by one. If two parameters have nearly the same effect, the data
pull both. Once one is free, the other may lie inside its bounds, or move to the other side.

So bounds are released in turn. Each step releases the bound whose release removes most of the
squared error. The error is that of a linear step of all parameters, inside the possible bounds.
"""

from collections.abc import Callable
from math import log
from typing import NamedTuple

import numpy as np

from sysid.core.types import BoolArray, FloatArray
from sysid.core.units import format_unit
from sysid.language.functions import Interval
from sysid.models.parameters import Parameter
from sysid.simulation.scaling import is_at_bounds

_MIN_SHARE = 0.05  # of the squared error: the release of a bound must remove as much
_MIN_SIGNIFICANCE = 16.0  # times the gain of a parameter without effect: four standard errors
_STRONG_ODDS = 20.0
_TIE_TOLERANCE = 1e-9  # of the squared error: smaller differences are rounding, the first wins
_MIN_ROOM = 0.01  # of the interval: a bound with less room is at its limit


class ActiveBound(NamedTuple):
    """A bound to be widened; it costs the `share` of the squared error.

    `limit` is the farthest value that the bound may have; None: no limit.
    """

    name: str
    side: str
    bound: float
    unit: str
    share: float
    limit: float | None = None

    def __str__(self) -> str:
        return f"{self.name} is at its {self.side} bound {self.bound:g}{format_unit(self.unit)}"

    @property
    def advice(self) -> str:
        """Advice in words: how to move the bound."""
        lower = self.side == "lower"
        text = f"{'lower' if lower else 'raise'} the bound of {self.name}"
        if self.limit is None:
            return text
        most = "least" if lower else "most"
        return f"{text}, to {self.limit:.4g}{format_unit(self.unit)} at the {most}"


def is_active(influence: FloatArray, columns: FloatArray, point: FloatArray) -> BoolArray:
    """Return which parameters (D,) the data pull beyond their bounds, each considered alone.

    Parameters
    ----------
    influence : FloatArray, shape (n,)
        Influence of the weighted residuals (model minus data) on the loss.
    columns : FloatArray, shape (n, D)
        Sensitivities of the outputs to the point.
    point : FloatArray, shape (D,)
        In [0, 1].
    """
    low, high = is_at_bounds(point)
    total = float(influence @ influence)
    if total == 0.0 or not np.any(low | high):
        return np.zeros(point.size, dtype=np.bool_)
    downhill = -(columns.T @ influence)
    size = np.einsum("nd,nd->d", columns, columns)
    share = downhill**2 / np.where(size > 0, size * total, np.inf)
    out = (low & (downhill < 0)) | (high & (downhill > 0))
    return np.asarray(out & (share > _MIN_SHARE) & (share * influence.size > _MIN_SIGNIFICANCE))


def rank_active_bounds(
    space: tuple[Parameter, ...],
    limits: tuple[Interval, ...],
    influence: FloatArray,
    columns: FloatArray,
    point: FloatArray,
) -> tuple[ActiveBound, ...]:
    """Rank the bounds to widen together, the costliest first; arrays as in `is_active`.

    Parameters
    ----------
    space : tuple of Parameter
        The free parameters, D.
    limits : tuple of (float, float)
        Lowest and highest value that the bounds of each may have.
    """
    total = float(influence @ influence)

    def is_worth(before: float, after: float) -> bool:
        share = (before - after) / total
        return share > _MIN_SHARE and share * influence.size > _MIN_SIGNIFICANCE

    return _release_in_turn(space, limits, influence, columns, point, is_worth)


def find_holding_bounds(
    space: tuple[Parameter, ...],
    limits: tuple[Interval, ...],
    influence: FloatArray,
    columns: FloatArray,
    point: FloatArray,
) -> tuple[ActiveBound, ...]:
    """Find the bounds that hold a search in a corner of the box; arrays as in `is_active`.

    There starts end in different corners, and what is left is not noise. Another seed does not
    help. A bound counts even if it costs a small share, as long as the data show it: by the
    criterion of Schwarz, odds of 20 : 1 for the release (Kass and Raftery 1995). Neighbouring
    residuals count by the equivalent number of independent ones (Bayley and Hammersley 1946).

    Parameters
    ----------
    space : tuple of Parameter
        The free parameters, D.
    limits : tuple of (float, float)
        Lowest and highest value that the bounds of each may have.
    """
    total = float(influence @ influence)
    if total == 0.0:
        return ()
    correlation = max(float(influence[1:] @ influence[:-1]) / total, 0.0)
    samples = influence.size * (1.0 - correlation) / (1.0 + correlation)
    needed = log(_STRONG_ODDS) + 0.5 * log(max(samples, 1.0))

    def is_worth(before: float, after: float) -> bool:
        gain = 0.5 * samples * log(before / max(after, _TIE_TOLERANCE * total))
        return gain > needed

    return _release_in_turn(space, limits, influence, columns, point, is_worth)


def _release_in_turn(
    space: tuple[Parameter, ...],
    limits: tuple[Interval, ...],
    influence: FloatArray,
    columns: FloatArray,
    point: FloatArray,
    is_worth: Callable[[float, float], bool],
) -> tuple[ActiveBound, ...]:
    """Release the costliest bound, and so on, while the squared error before and after is worth it.

    Bounds are left out that a parameter does not pass once all of them are released.
    """
    step = _LinearStep.from_point(space, limits, influence, columns, point)
    low, high = is_at_bounds(point)
    room = np.where(low, -step.outer_moves[0] - point, step.outer_moves[1] - (1.0 - point))
    candidates = [int(d) for d in np.flatnonzero((low | high) & (room > _MIN_ROOM))]
    shares: dict[int, float] = {}
    loss, total = step.solve_released(())[1], float(influence @ influence)
    while remaining := [d for d in candidates if d not in shares]:
        trials = [(step.solve_released((*shares, d))[1], d) for d in remaining]
        least = min(trials)[0] + _TIE_TOLERANCE * total
        reached, best = next(trial for trial in trials if trial[0] <= least)
        if not is_worth(loss, reached):
            break
        shares[best], loss = (loss - reached) / total, reached
    moved = point + step.solve_released(tuple(shares))[0]
    active = [
        _make_active_bound(space[d], limits[d], bool(low[d]), share)
        for d, share in shares.items()
        if (moved[d] < 0.0 if low[d] else moved[d] > 1.0)
    ]
    return tuple(sorted(active, key=lambda trial: -trial.share))


def _make_active_bound(
    parameter: Parameter, limits: Interval, is_low: bool, share: float
) -> ActiveBound:
    limit = limits[0] if is_low else limits[1]
    finite_limit = limit if np.isfinite(limit) else None
    bound, side = (parameter.lower, "lower") if is_low else (parameter.upper, "upper")
    return ActiveBound(parameter.name, side, bound, parameter.unit, share, finite_limit)


class _LinearStep(NamedTuple):
    """A linear step of all parameters: abs(root · move - target)² + rest is the squared error.

    `inner_moves` and `outer_moves` (2, D) lead to the bounds and to their limits.
    """

    root: FloatArray
    target: FloatArray
    rest: float
    inner_moves: FloatArray
    outer_moves: FloatArray

    @classmethod
    def from_point(
        cls,
        space: tuple[Parameter, ...],
        limits: tuple[Interval, ...],
        influence: FloatArray,
        columns: FloatArray,
        point: FloatArray,
    ) -> "_LinearStep":
        """Set up the step from a point (D,)."""
        basis, root = np.linalg.qr(columns)
        target = -(basis.T @ influence)
        rest = float(influence @ influence - target @ target)
        ends = [
            [_to_unit_value(parameter, end) for end in interval]
            for parameter, interval in zip(space, limits, strict=True)
        ]
        return cls(root, target, rest, np.array([-point, 1.0 - point]), np.array(ends).T - point)

    def solve_released(self, released: tuple[int, ...]) -> tuple[FloatArray, float]:
        """Compute the best move (D,) with some bounds released, and the remaining squared error."""
        # Imported late: it takes a tenth of a second, and few results need it.
        from scipy.optimize import lsq_linear

        ends = self.inner_moves.copy()
        ends[:, list(released)] = self.outer_moves[:, list(released)]
        solution = lsq_linear(self.root, self.target, (ends[0], ends[1]), method="bvls")
        return solution.x, self.rest + 2.0 * float(solution.cost)


def _to_unit_value(parameter: Parameter, value: float) -> float:
    """Convert a value to the unit interval: 0 at the lower bound, 1 at the upper one."""
    if parameter.scale == "log":
        if value <= 0.0:
            return -np.inf
        return float(np.log(value / parameter.lower) / np.log(parameter.upper / parameter.lower))
    return (value - parameter.lower) / (parameter.upper - parameter.lower)
