"""Linear model of the output around an estimate: relative growth of Σe² for a move."""

from dataclasses import dataclass

import numpy as np

from sysid.core.linear_algebra import compute_truncated_svd
from sysid.core.types import BoolArray, FloatArray
from sysid.simulation.scaling import is_at_bounds
from sysid.uncertainty.local_algebra import compute_descent, scale_matrix

_RANDOM_STREAM = 2**63


@dataclass(frozen=True, slots=True, eq=False)
class LinearOutputModel:
    """Sum of squares around an estimate, if the outputs are linear.

    A parameter on a plateau is held, because the outputs jump from plateau to plateau.

    Attributes
    ----------
    covariance : FloatArray, shape (D, D)
        s²(SᵀS)⁻¹, for residuals of any colour; 0 for parameters held.
    information_root : FloatArray, shape (k, D)
        With abs(root · move)² = abs(S · move)².
    outward_slope : FloatArray, shape (D,)
        Sᵀe of parameters that the data pull beyond a bound; 0 for the others.
    sum_of_squares : float
        Σe².
    variance_ratio : FloatArray, shape (D,)
        Variance by s²(SᵀS)⁻¹ over the reported one; nan for parameters held or without variance.
    """

    covariance: FloatArray
    information_root: FloatArray
    outward_slope: FloatArray
    sum_of_squares: float
    variance_ratio: FloatArray

    def predict_relative_increase(self, moves: FloatArray) -> FloatArray:
        """Predict the relative growth (P,) of the sum for moves (P, D) of the parameters."""
        turned = moves @ self.information_root.T
        gains = np.einsum("pk,pk->p", turned, turned) + 2.0 * moves @ self.outward_slope
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(gains / self.sum_of_squares)


def factor_covariance(covariance: FloatArray) -> FloatArray:
    """Factor a covariance RRᵀ; R (D, D) times standard normal numbers gives such moves.

    The eigenvalues of the correlation are used. If units differ by many decades, eigenvalues of
    the covariance would be rounding in all directions but the largest.
    """
    variance = np.diag(covariance)
    deviation = np.sqrt(np.where(variance > 0, variance, 1.0))
    size, rows = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    return np.asarray(deviation[:, None] * rows * np.sqrt(np.maximum(size, 0.0)))


def make_move_generator(seed: int) -> np.random.Generator:
    """Make a random generator for moves, independent of the noise of the same seed.

    `sysid.data.noise` numbers its streams by channels.
    """
    return np.random.Generator(np.random.Philox(key=[seed, _RANDOM_STREAM]))


def linearise_outputs(
    error: FloatArray,
    columns: FloatArray,
    on_plateau: BoolArray,
    point: FloatArray,
    stated: FloatArray,
    scale: FloatArray,
    inverse: FloatArray,
    root: FloatArray,
) -> LinearOutputModel:
    """Make the linear model in the parameters' units.

    Parameters
    ----------
    error : FloatArray, shape (n,)
        Weighted residuals.
    columns : FloatArray, shape (n, D)
        Their slopes in unit coordinates p.
    on_plateau : BoolArray, shape (D,)
        Parameters that are held.
    point : FloatArray, shape (D,)
        The estimate in unit coordinates.
    stated : FloatArray, shape (D,)
        Reported variances in unit coordinates, without the width of a plateau.
    scale : FloatArray, shape (D,)
        ∂θ/∂p.
    inverse : FloatArray, shape (D, D)
        (SᵀS)⁻¹ in the directions that move the output.
    root : FloatArray, shape (k, D)
        R of SᵀS = RᵀR.
    """
    n, d = columns.shape
    total = float(error @ error)
    variance = total / (n - d)
    is_stated = (stated > 0) & ~on_plateau
    white = variance * np.diag(inverse)
    slope = -compute_descent(columns, error)
    if on_plateau.any():
        slope[on_plateau] = 0.0
        inverse, root = _remove_parameters(root, on_plateau)
    at_lower, at_upper = is_at_bounds(point)
    leads_out = (at_lower & (slope > 0)) | (at_upper & (slope < 0))
    unit = np.where(scale > 0, scale, 1.0)
    return LinearOutputModel(
        covariance=scale_matrix(variance * inverse, scale),
        information_root=root / unit,
        outward_slope=np.where(leads_out, slope, 0.0) / unit,
        sum_of_squares=total,
        variance_ratio=np.where(is_stated, white, np.nan) / np.where(is_stated, stated, 1.0),
    )


def _remove_parameters(root: FloatArray, held: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Remove the parameters held from (SᵀS)⁻¹ and its root."""
    root = np.where(held, 0.0, root)
    _, singular, rows, retained = compute_truncated_svd(root)
    return (rows[retained].T / singular[retained] ** 2) @ rows[retained], root
