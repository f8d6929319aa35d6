"""Bounds that hold an estimate back: parameters the data pull out of their interval."""

from typing import NamedTuple

import numpy as np

from sysid.parameters import Parameter
from sysid.types import FloatArray

AT_BOUND = 1e-6
"""Of the interval: an estimate nearer to its end than that lies at its bound."""

_SHARE = 0.05  # of the squared error that moving this parameter alone would remove
_SURE = 16.0  # times what a parameter without effect would seem to remove: four standard errors


class Pull(NamedTuple):
    """A parameter that would leave its bounds; `share` of the squared error is what they cost."""

    name: str
    side: str
    bound: float
    unit: str
    share: float

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.name} beyond its {self.side} bound {self.bound:g}{unit}"


def pulls(
    space: tuple[Parameter, ...], influence: FloatArray, columns: FloatArray, place: FloatArray
) -> tuple[Pull, ...]:
    """What the data pull beyond its bounds, the strongest first.

    Parameters
    ----------
    space : tuple of Parameter
        The free ones, D.
    influence : FloatArray, shape (n,)
        Weighted residuals, model minus data, as the loss sees them.
    columns : FloatArray, shape (n, D)
        Slopes of the outputs over the places.
    place : FloatArray, shape (D,)
        In [0, 1].
    """
    total = float(influence @ influence)
    if total == 0.0:
        return ()
    downhill = -(columns.T @ influence)
    size = np.einsum("nd,nd->d", columns, columns)
    share = downhill**2 / np.where(size > 0, size * total, np.inf)
    low, high = place < AT_BOUND, place > 1.0 - AT_BOUND
    out = (low & (downhill < 0)) | (high & (downhill > 0))
    out &= (share > _SHARE) & (share * influence.size > _SURE)
    found = [
        Pull(one.name, "lower" if low[d] else "upper", one.lower if low[d] else one.upper,
             one.unit, float(share[d]))
        for d, one in enumerate(space)
        if out[d]
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda one: -one.share))
