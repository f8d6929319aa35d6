"""Bounds that hold an estimate back: which of them to widen, so that the data are followed.

Each bound for itself would not do. Where two parameters have much the same effect both are pulled,
and once one is free the other may well lie inside its bounds, or be wanted on the other side. So
bounds are released one after the other, each time the one whose release removes most of the
squared error in a linear step of all parameters together, inside bounds and what is possible.
"""

from typing import NamedTuple

import numpy as np

from sysid.core.types import BoolArray, FloatArray, Interval
from sysid.core.units import format_unit
from sysid.models.parameters import Parameter
from sysid.simulation.scaling import is_at_bounds

_LEAST_SHARE = 0.05  # of the squared error that the release of this bound would remove
_LEAST_SIGNIFICANCE = (
    16.0  # times what a parameter without effect would seem to remove: four standard errors
)
_TIE_TOLERANCE = (
    1e-9  # of the squared error: what leaves as little differs by rounding, and the first is taken
)
_LEAST_ROOM = 0.01  # of the interval: a bound that can be moved by less is as far out as it can be


class ActiveBound(NamedTuple):
    """A bound to be widened; `share` of the squared error is what it costs.

    `limit` is how far out it may be moved; None: there is no limit.
    """

    name: str
    side: str
    bound: float
    unit: str
    share: float
    limit: float | None = None

    def __str__(self) -> str:
        return f"{self.name} beyond its {self.side} bound {self.bound:g}{format_unit(self.unit)}"

    @property
    def advice(self) -> str:
        """What to do about it."""
        lower = self.side == "lower"
        text = f"{'lower' if lower else 'raise'} the bound of {self.name}"
        if self.limit is None:
            return text
        most = "least" if lower else "most"
        return f"{text}, to {self.limit:.4g}{format_unit(self.unit)} at the {most}"


def is_active(influence: FloatArray, columns: FloatArray, place: FloatArray) -> BoolArray:
    """Which parameters the data pull beyond their bounds, each looked at alone, (D,).

    Parameters
    ----------
    influence : FloatArray, shape (n,)
        Weighted residuals, model minus data, as the loss sees them.
    columns : FloatArray, shape (n, D)
        Slopes of the outputs over the places.
    place : FloatArray, shape (D,)
        In [0, 1].
    """
    total = float(influence @ influence)
    if total == 0.0:
        return np.zeros(place.size, dtype=np.bool_)
    downhill = -(columns.T @ influence)
    size = np.einsum("nd,nd->d", columns, columns)
    share = downhill**2 / np.where(size > 0, size * total, np.inf)
    low, high = is_at_bounds(place)
    out = (low & (downhill < 0)) | (high & (downhill > 0))
    return np.asarray(out & (share > _LEAST_SHARE) & (share * influence.size > _LEAST_SIGNIFICANCE))


def rank_active_bounds(
    space: tuple[Parameter, ...],
    reaches: tuple[Interval, ...],
    influence: FloatArray,
    columns: FloatArray,
    place: FloatArray,
) -> tuple[ActiveBound, ...]:
    """Which bounds to widen together, the costliest first; arrays as in `is_active`.

    Parameters
    ----------
    space : tuple of Parameter
        The free ones, D.
    reaches : tuple of (float, float)
        For each the lowest and the highest value that its bounds may be given.
    """
    step = _LinearStep.from_place(space, reaches, influence, columns, place)
    low, high = is_at_bounds(place)
    room = np.where(low, -step.outer_moves[0] - place, step.outer_moves[1] - (1.0 - place))
    candidates = [int(d) for d in np.flatnonzero((low | high) & (room > _LEAST_ROOM))]
    shares: dict[int, float] = {}
    loss, total = step.solve_released(())[1], float(influence @ influence)
    while left := [d for d in candidates if d not in shares]:
        tried = [(step.solve_released((*shares, d))[1], d) for d in left]
        least = min(tried)[0] + _TIE_TOLERANCE * total
        reached, best = next(one for one in tried if one[0] <= least)
        share = (loss - reached) / total
        if not (share > _LEAST_SHARE and share * influence.size > _LEAST_SIGNIFICANCE):
            break
        shares[best], loss = share, reached
    moved = place + step.solve_released(tuple(shares))[0]
    found = [
        _make_active_bound(space[d], reaches[d], bool(low[d]), share)
        for d, share in shares.items()
        if (moved[d] < 0.0 if low[d] else moved[d] > 1.0)
    ]
    return tuple(sorted(found, key=lambda one: -one.share))


def _make_active_bound(one: Parameter, reach: Interval, is_low: bool, share: float) -> ActiveBound:
    limit = reach[0] if is_low else reach[1]
    known = limit if np.isfinite(limit) else None
    bound, side = (one.lower, "lower") if is_low else (one.upper, "upper")
    return ActiveBound(one.name, side, bound, one.unit, share, known)


class _LinearStep(NamedTuple):
    """A linear step of all parameters: abs(root · move - target)² + rest is the squared error.

    `inner` and `outer` (2, D) are the moves to the bounds, and to as far as these can be moved.
    """

    root: FloatArray
    target: FloatArray
    rest: float
    inner_moves: FloatArray
    outer_moves: FloatArray

    @classmethod
    def from_place(
        cls,
        space: tuple[Parameter, ...],
        reaches: tuple[Interval, ...],
        influence: FloatArray,
        columns: FloatArray,
        place: FloatArray,
    ) -> "_LinearStep":
        """The step from a place (D,)."""
        basis, root = np.linalg.qr(columns)
        target = -(basis.T @ influence)
        rest = float(influence @ influence - target @ target)
        ends = [
            [_to_unit_value(one, end) for end in reach]
            for one, reach in zip(space, reaches, strict=True)
        ]
        return cls(root, target, rest, np.array([-place, 1.0 - place]), np.array(ends).T - place)

    def solve_released(self, released: tuple[int, ...]) -> tuple[FloatArray, float]:
        """The best move (D,) with some bounds released, and the squared error it leaves."""
        # Here, as it takes a tenth of a second to import and few results need it.
        from scipy.optimize import lsq_linear

        ends = self.inner_moves.copy()
        ends[:, list(released)] = self.outer_moves[:, list(released)]
        found = lsq_linear(self.root, self.target, (ends[0], ends[1]), method="bvls")
        return found.x, self.rest + 2.0 * float(found.cost)


def _to_unit_value(parameter: Parameter, value: float) -> float:
    """Where a value lies: 0 at the lower bound, 1 at the upper one."""
    if parameter.scale == "log":
        if value <= 0.0:
            return -np.inf
        return float(np.log(value / parameter.lower) / np.log(parameter.upper / parameter.lower))
    return (value - parameter.lower) / (parameter.upper - parameter.lower)
