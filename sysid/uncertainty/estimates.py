"""Estimates: standard errors, intervals, statuses, information criteria, posterior."""

from dataclasses import dataclass, field
from math import inf
from typing import Literal

from sysid.core.findings import EstimateStatus
from sysid.core.types import FloatArray
from sysid.identifiability.combinations import IdentifiableCombination

NoiseColour = Literal["white", "first-order", "coloured", "drifting", "clustered"]
IntervalEnd = Literal["lower", "upper"]
AT_LIMIT = "it lies at its bound, a limit of the quantity"
"""Reason of an estimate that the data determine, and that a physical limit ends."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter's estimate.

    Attributes
    ----------
    name : str
        Name of the parameter, or of an initial state such as ``x(0)``.
    unit : str
        Unit of its values.
    value : float
        Estimate, in `unit`.
    lower : float
        Lower bound of the search, in `unit`.
    upper : float
        Upper bound of the search, in `unit`.
    stderr : float or None
        Standard error, in `unit`. If there is none, `reason` says why.
    interval95 : tuple of float or None
        Both ends of the 95 % interval, in `unit`.
    status : EstimateStatus
        Identified, or why the value is not to be relied on.
    reason : str
        Reason of the status, or of a missing standard error; empty if there is nothing to say.
    open_ends : tuple of IntervalEnd
        Ends of the interval up to which the data speak for any value; there it ends at the bound.

    Examples
    --------
    >>> lag = Estimate("L", "s", 0.52, 0.0, 5.0, 0.01, (0.50, 0.54), "identified")
    >>> f"{lag.name} = {lag.value} ± {lag.stderr} {lag.unit}"
    'L = 0.52 ± 0.01 s'
    """

    name: str
    unit: str
    value: float
    lower: float
    upper: float
    stderr: float | None
    interval95: tuple[float, float] | None
    status: EstimateStatus
    reason: str = ""
    open_ends: tuple[IntervalEnd, ...] = ()

    @property
    def is_free(self) -> bool:
        """Whether it was estimated, that is, neither fixed nor tied."""
        return self.status not in ("fixed", "tied")

    def may_be(self, value: float) -> bool:
        """Whether another value is inside the bounds of the search."""
        return self.lower <= value <= self.upper

    def excludes(self, value: float) -> bool:
        """Whether another value is outside the 95 % interval; False without one."""
        interval = self.interval95
        return interval is not None and not interval[0] <= value <= interval[1]


@dataclass(frozen=True, slots=True)
class Criteria:
    """Information criteria, smaller is better; compare only models of the same samples.

    The log-likelihood is that of independent Gaussian residuals. Their variance is estimated with
    the parameters: ln ℓ = -n/2 (ln(2π Σe²/n) + 1), e weighted. With κ = D + 1 (the variance
    counts): AIC = 2κ - 2 ln ℓ, AICc = AIC + 2κ(κ + 1)/(n - κ - 1), BIC = κ ln n - 2 ln ℓ
    (Akaike 1974; Hurvich and Tsai 1989; Schwarz 1978).

    Attributes
    ----------
    aic : float
        Criterion of Akaike; minus infinity where the residuals vanish.
    aicc : float or None
        The same, corrected for few samples; missing if there are not more than κ + 1.
    bic : float
        Criterion of Schwarz; minus infinity where the residuals vanish.
    samples : int
        Number n of scored samples.
    parameters : int
        Number D of free parameters.
    """

    aic: float
    aicc: float | None
    bic: float
    samples: int
    parameters: int


@dataclass(frozen=True, slots=True, eq=False)
class CorrelationMatrix:
    """Correlation matrix; its rows and columns are `names`.

    Attributes
    ----------
    names : tuple of str
        Free parameters of the rows and columns.
    matrix : FloatArray, shape (D, D)
        Rows of the matrix.
    """

    names: tuple[str, ...]
    matrix: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Local analysis at the estimate; rows and columns are the free parameters `names`.

    `noise_colour` is the colour of residuals that the covariance assumes. If they drift over the
    whole record, the covariance is a lower bound. `correlation` belongs to this covariance.
    `sensitivity_correlation` belongs to (SᵀS)⁻¹: it compares the sensitivities S, for residuals of
    any colour. `degrees` is the least number of degrees of freedom of all intervals.
    """

    names: tuple[str, ...]
    covariance: FloatArray
    correlation: FloatArray
    sensitivity_correlation: FloatArray
    condition: float
    singular_values: FloatArray
    noise_sd: float
    groups: tuple[IdentifiableCombination, ...] = ()
    noise_colour: NoiseColour = "white"
    degrees: float = inf


@dataclass(frozen=True, slots=True)
class PosteriorParameter:
    """Posterior distribution of one parameter.

    Attributes
    ----------
    name : str
        Name of the parameter.
    unit : str
        Unit of its values.
    median : float
        Median, in `unit`.
    interval95 : tuple of float
        The 2.5 and 97.5 % quantiles, in `unit`.
    effective_samples : float
        Number of independent samples that would estimate the mean as well.
    """

    name: str
    unit: str
    median: float
    interval95: tuple[float, float]
    effective_samples: float


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Samples of the posterior, or the reason why there are none.

    Attributes
    ----------
    parameters : tuple of PosteriorParameter
        The free parameters; empty without samples.
    samples : FloatArray, shape (m, D)
        At most 1,000 of the samples, chosen at random, in the parameters' units; not in lists.
    correlation : CorrelationMatrix
        Correlation of the samples.
    walkers : int
        Walkers of the chain.
    steps : int
        Steps of each walker, with those that are left out.
    acceptance : float
        Share of the proposed moves that were accepted.
    evaluations : int
        Simulations of the chain.
    converged : bool
        Whether the chain has converged.
    reason : str
        Why the chain has not converged, or why there is none; empty if it has.
    gain : float
        Likelihood ratio of the best sample to the estimate; 0 if none is better.
    """

    parameters: tuple[PosteriorParameter, ...]
    samples: FloatArray = field(metadata={"digits": 8})
    correlation: CorrelationMatrix
    walkers: int
    steps: int
    acceptance: float
    evaluations: int
    converged: bool
    reason: str
    gain: float = 0.0
