"""Likelihood of parameters that assumes the same noise as their standard errors.

With white Gaussian noise of unknown variance σ² and the prior 1/σ, the integral over σ leaves
S^(-n/2), where S is the sum of squares (Box and Tiao, Bayesian Inference, 1973, ch. 2). In a linear
model this is the t distribution with n - D degrees of freedom, covariance s²(SᵀS)⁻¹ and the
reported intervals.

Reported covariances V = B⁻¹ΩB⁻¹ of another form (coloured residuals, soft-l1) are used as follows.
B = SᵀKS is half the curvature of the loss R. A change δ of the residuals is divided into the part
that a move a of the linear model makes, and the rest. The first is measured by V, the rest by a
multiple κ of the loss:

    Q = κ(R - R₀) + aᵀ(V⁻¹ - κB)a,  log p = -(ν + D)/2 ln(1 + Q/ν)

κ is the least eigenvalue of V⁻¹ relative to B: the rest never counts more than any direction does.
In a linear model Q = aᵀV⁻¹a. With white noise κ = 1/s², and the second term vanishes. ν is the
least number of degrees of freedom of all intervals.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sysid.core.linear_algebra import compute_truncated_svd
from sysid.core.types import FloatArray
from sysid.residuals.whitening import Whitening
from sysid.simulation.loss import compute_loss, compute_loss_weight
from sysid.simulation.problem import Problem

_ROUNDING = 1e-9  # of the largest variance: smaller ones are rounding


@dataclass(frozen=True, slots=True, eq=False)
class LikelihoodModel:
    """Local quantities of an estimate that determine the likelihood far from it.

    Attributes
    ----------
    residuals : FloatArray, shape (n,)
        Weighted residuals at the estimate, whitened if there is a whitening.
    columns : FloatArray, shape (n, D)
        Their slopes in unit coordinates p.
    middle : FloatArray, shape (D, D), or None
        Ω, widened for the degrees of freedom; None for white residuals of squares.
    degrees : float
        Degrees of freedom.
    quantiles : FloatArray, shape (D,)
        Of the t distribution, for the 95 % interval of each parameter.
    whitening : Whitening or None
    """

    residuals: FloatArray
    columns: FloatArray
    middle: FloatArray | None
    degrees: float
    quantiles: FloatArray
    whitening: Whitening | None = None


class LinearRatio(NamedTuple):
    """Q around a point: ratio + abs(residuals + columns · move)² - abs(residuals)².

    Attributes
    ----------
    ratio : float
        Q at the point.
    residuals : FloatArray, shape (m,)
    columns : FloatArray, shape (m, D)
    """

    ratio: float
    residuals: FloatArray
    columns: FloatArray


class Likelihood:
    """Logarithm of the likelihood of parameters, 0 at the estimate."""

    def __init__(self, problem: Problem, model: LikelihoodModel) -> None:
        self._problem, self._model = problem, model
        self._loss = float(np.sum(compute_loss(model.residuals, problem.loss_scale)))
        n, d = model.columns.shape
        self._share = (n - d) / self._loss
        self._projection, self._correction = np.zeros((0, n)), np.zeros(0)
        if model.middle is not None:
            self._measure_moves(model.middle)

    def _measure_moves(self, middle: FloatArray) -> None:
        """Find κ, and the part of Q that measures moves of the linear model by V.

        In the left singular vectors of √K S, B is the identity.
        """
        size = self._model.residuals.size
        weight = compute_loss_weight(self._model.residuals, self._problem.loss_scale) ** 1.5
        weight = weight * np.ones(size)
        left, singular, rows, retained = compute_truncated_svd(
            weight[:, None] * self._model.columns
        )
        root = rows[retained] / singular[retained, None]
        variance, turn = np.linalg.eigh(root @ middle @ root.T)
        varies = variance > _ROUNDING * variance[-1]
        self._share = 1.0 / float(variance[-1])
        self._projection = (left[:, retained] @ turn[:, varies]).T * weight
        self._correction = 1.0 / variance[varies] - self._share

    def compute_ratios(self, theta: FloatArray) -> FloatArray:
        """Compute Q (P,) of parameters (P, D): a likelihood ratio; ``inf`` where one diverges."""
        if self._model.middle is None and self._model.whitening is None:
            loss = self._problem.n_scored * self._problem.evaluate_fitness(theta) ** 2
            return np.asarray(self._share * (loss - self._loss))
        with np.errstate(all="ignore"):  # diverged simulations
            residuals = self._problem.compute_residuals(theta)
            if self._model.whitening is not None:
                residuals = self._model.whitening.whiten(residuals)
            loss = np.sum(compute_loss(residuals, self._problem.loss_scale), axis=1)
            moves = (residuals - self._model.residuals) @ self._projection.T
            ratios = self._share * (loss - self._loss) + np.square(moves) @ self._correction
        return np.where(np.isfinite(ratios), ratios, np.inf)

    def linearise_ratio(self, residuals: FloatArray, columns: FloatArray) -> LinearRatio:
        """Linearise Q at a point with these weighted residuals (n,) and slopes (n, D).

        They are not whitened yet. Soft-l1 counts by its weights there.
        """
        whitening, scale = self._model.whitening, self._problem.loss_scale
        if whitening is not None:
            residuals, columns = whitening.whiten(residuals), whitening.whiten(columns.T).T
        moves = self._projection @ (residuals - self._model.residuals)
        loss = float(np.sum(compute_loss(residuals, scale)))
        root = np.sqrt(self._share * compute_loss_weight(residuals, scale)) * np.ones(
            len(residuals)
        )
        own = np.sqrt(self._correction)
        return LinearRatio(
            self._share * (loss - self._loss) + float(self._correction @ np.square(moves)),
            np.concatenate([root * residuals, own * moves]),
            np.vstack([root[:, None] * columns, own[:, None] * (self._projection @ columns)]),
        )

    def to_logarithms(self, ratios: FloatArray) -> FloatArray:
        """Convert Q (P,) to the logarithm of the likelihood; below 0 by its tangent there."""
        degrees, d = self._model.degrees, self._model.columns.shape[1]
        growth = np.where(
            ratios > 0.0, np.log1p(np.maximum(ratios, 0.0) / degrees), ratios / degrees
        )
        return np.asarray(-0.5 * (degrees + d) * growth)
