"""The Cramér–Rao floor: how exact an unbiased estimate can be under white Gaussian noise.

With S = ∂ŷ/∂θ at the true parameters and noise of deviation σ on every scored sample, no unbiased
estimate of θ has a covariance below σ²(SᵀS)⁻¹ (Cramér 1946; Rao 1945). An estimate that reaches it
moves the response by σ√(r/n) in RMS, r the number of directions that the data tell. Both grow in
proportion to σ, so they are given for σ = 1. Bounds on the parameters hold estimates below the
floor where σ is large: it knows no bounds.

It is the floor of the noise that a job adds, which `sysid.data.noise` draws for each output by
itself: outputs are independent there, whatever noise a measured record has of its own. That one,
which outputs may have in common (`sysid.residuals.correlated_outputs`), is in the standard errors
and not in the floor.
"""

from dataclasses import dataclass

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.linear_algebra import truncated_svd
from sysid.core.types import FloatArray
from sysid.identifiability.combinations import NULL_SHARE
from sysid.identifiability.scaling import find_scalings
from sysid.identifiability.translations import find_translations
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import compute_physical_scale, remove_symmetries
from sysid.uncertainty.sensitivities import compute_sensitivities


@dataclass(frozen=True, slots=True, eq=False)
class CramerRaoBound:
    """Least standard deviations for noise of σ = 1.

    Attributes
    ----------
    names : tuple of str
        The D free parameters.
    stderr : FloatArray, shape (D,)
        In each parameter's unit by that of the output; ``inf`` where these data tell nothing of
        the parameter by itself, or the output moves with it in jumps only.
    response : float
        RMS by which the response then differs from the true one: √(r/n), without unit.
    samples : int
        n scored samples.
    """

    names: tuple[str, ...]
    stderr: FloatArray
    response_rms: float
    samples: int


def cramer_rao_bound(problem: Problem, theta: FloatArray) -> CramerRaoBound:
    """The floor at true parameters (D,), inside their bounds.

    The problem must weigh every output with 1, since the noise is the same on each.

    Raises
    ------
    InvalidSettings
        If an output has another weight.
    """
    odd = [name for name, weight in problem.output_weights.items() if weight != 1.0]
    if odd:
        raise InvalidSettings(
            f"/weights/{odd[0]}", "the Cramér–Rao bound needs weight 1 for every output"
        )
    sensitivities = compute_sensitivities(problem, theta)
    scale = compute_physical_scale(problem, theta)
    powers = find_scalings(problem.model, problem.all_parameters)
    shifts, _ = find_translations(problem, theta, sensitivities.columns, scale)
    columns, n_symmetries = remove_symmetries(
        sensitivities.columns, np.vstack([powers * theta, shifts]) / scale
    )
    n, d = columns.shape
    # Rows of zeros make the directions complete where there are fewer samples than parameters.
    square = np.vstack([columns, np.zeros((max(d - n, 0), d))])
    _, singular, rows, retained = truncated_svd(square)
    retained[d - n_symmetries :] = False
    variance = np.sum((rows[retained] / singular[retained, None]) ** 2, axis=0)
    is_undetermined = np.any(rows[~retained] ** 2 > NULL_SHARE, axis=0) | sensitivities.one_sided
    is_undetermined |= (
        np.any(powers != 0.0, axis=0)
        | np.any(shifts != 0.0, axis=0)
        | (sensitivities.plateau_width > 0)
    )
    stderr = np.where(is_undetermined, np.inf, np.sqrt(variance) * np.abs(scale))
    return CramerRaoBound(
        problem.free_names, stderr, float(np.sqrt(np.count_nonzero(retained) / n)), n
    )
