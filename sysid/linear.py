"""The linear model of the output around an estimate: by what part Σe² grows for a move."""

from dataclasses import dataclass

import numpy as np

from sysid.pulls import AT_BOUND
from sysid.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """The sum of squares that linear outputs would have around an estimate.

    A parameter on a plateau is held: from plateau to plateau the outputs are no line.

    Attributes
    ----------
    covariance : FloatArray, shape (D, D)
        s²(SᵀS)⁻¹, whatever the colour of the residuals; 0 for those held.
    root : FloatArray, shape (k, D)
        With abs(root · move)² = abs(S · move)².
    slope : FloatArray, shape (D,)
        Sᵀe of those at a bound that the data pull beyond it; 0 for the others.
    error : float
        Σe².
    share : FloatArray, shape (D,)
        Variance by s²(SᵀS)⁻¹ over the one stated; nan for those held and for those not told.
    """

    covariance: FloatArray
    root: FloatArray
    slope: FloatArray
    error: float
    share: FloatArray

    def excess(self, moves: FloatArray) -> FloatArray:
        """By what part of itself the sum grows for moves (P, D) of the parameters, (P,)."""
        turned = moves @ self.root.T
        gains = np.einsum("pk,pk->p", turned, turned) + 2.0 * moves @ self.slope
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(gains / self.error)


def linear_model(
    error: FloatArray, columns: FloatArray, held: BoolArray, place: FloatArray,
    stated: FloatArray, scale: FloatArray, rank: float,
) -> Linear:  # fmt: skip
    """The linear model in the parameters' units.

    Parameters
    ----------
    error : FloatArray, shape (n,)
        Weighted residuals.
    columns : FloatArray, shape (n, D)
        Their slopes over the places.
    held : BoolArray, shape (D,)
        On a plateau.
    place : FloatArray, shape (D,)
    stated : FloatArray, shape (D,)
        Variances of the places, without the width of a plateau.
    scale : FloatArray, shape (D,)
        ∂θ/∂p.
    rank : float
        Of the largest singular value: below, slopes are rounding.
    """
    n, d = columns.shape
    total = float(error @ error)
    variance = total / (n - d)
    told = (stated > 0) & ~held
    white = variance * np.diag(_inverse(columns, rank)[0])
    sloping = np.where(held, 0.0, columns)
    inverse, root = _inverse(sloping, rank)
    slope = sloping.T @ error
    leads_out = ((place < AT_BOUND) & (slope > 0)) | ((place > 1.0 - AT_BOUND) & (slope < 0))
    unit = np.where(scale > 0, scale, 1.0)
    return Linear(
        covariance=variance * inverse * np.outer(scale, scale),
        root=root / unit,
        slope=np.where(leads_out, slope, 0.0) / unit,
        error=total,
        share=np.where(told, white, np.nan) / np.where(told, stated, 1.0),
    )


def _inverse(columns: FloatArray, rank: float) -> tuple[FloatArray, FloatArray]:
    """(SᵀS)⁻¹ over what moves the output, and R (D, D) of SᵀS = RᵀR."""
    singular, rows = np.linalg.svd(columns, full_matrices=False)[1:]
    kept = singular > rank * max(singular[0], np.finfo(float).tiny)
    return (rows[kept].T / singular[kept] ** 2) @ rows[kept], singular[:, None] * rows
