"""Cramér–Rao bound: least error of an unbiased estimate under white Gaussian noise.

Let S = ∂ŷ/∂θ at the true parameters, and let every scored sample have noise of deviation σ. Then no
unbiased estimate of θ has a covariance below σ²(SᵀS)⁻¹ (Cramér 1946; Rao 1945). An estimate that
reaches the bound moves the response by σ√(r/n) in RMS, where r is the number of identifiable
directions. Both grow in proportion to σ, so they are computed for σ = 1. If σ is large, limits on
the parameters can keep estimates below the bound, which ignores such limits.

Noise inside a recursion, φ of Eq. 16, is the error of predictions one step ahead if its state is
measured without noise. Then S is their sensitivity, and the bound is the same.

The bound applies to the noise that a job adds. `sysid.data.noise` draws it independently for each
output. A measured record may have noise of its own, also correlated between outputs
(`sysid.residuals.sandwich`). That noise is in the standard errors, not in the bound.
"""

from dataclasses import dataclass

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.linear_algebra import compute_truncated_svd
from sysid.core.types import FloatArray
from sysid.identifiability.combinations import NULL_SHARE
from sysid.identifiability.scaling_symmetries import find_scalings
from sysid.identifiability.translations import find_translations
from sysid.kernels.signals.past_reads import is_difference
from sysid.language.tree import match_plain_state
from sysid.models.model import Model
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
        In each parameter's unit per unit of the output. ``inf`` if the data do not identify the
        parameter by itself, or if the output changes with it in jumps only.
    response_rms : float
        RMS difference between the response and the true one: √(r/n), without unit.
    samples : int
        n scored samples.
    """

    names: tuple[str, ...]
    stderr: FloatArray
    response_rms: float
    samples: int


def measures_its_recursion(model: Model) -> bool:
    """Whether a model is a recursion of one state, and an output measures it."""
    names = [state.name for state in model.states]
    measured = [match_plain_state(output.expression) for output in model.outputs]
    return is_difference(model) and measured == names and len(names) == 1


def cramer_rao_bound(problem: Problem, theta: FloatArray) -> CramerRaoBound:
    """Compute the bound at true parameters (D,), inside their limits.

    The problem must weigh every output with 1, because the noise is the same on each.

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
    decomposition = compute_truncated_svd(sensitivities.columns)
    shifts, _ = find_translations(problem, theta, decomposition, scale)
    columns, n_symmetries = remove_symmetries(
        sensitivities.columns, np.vstack([powers * theta, shifts]) / scale
    )
    n, d = columns.shape
    # Rows of zeros make the directions complete where there are fewer samples than parameters.
    square = np.vstack([columns, np.zeros((max(d - n, 0), d))])
    _, singular, rows, retained = compute_truncated_svd(square)
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
