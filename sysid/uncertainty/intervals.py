"""The 95 % interval of an estimate: the only module that makes one or changes it.

`compose_interval` takes what is known of an estimate, one source after the other:

`LocalInterval`
    The interval of the t distribution, from the standard error of the local analysis.
`Plateau`
    Values that all give the same output: where the search ended among them has no meaning.
`CompatibleMinima`
    Other minima that the data do not rule out (Venzon and Moolgavkar 1988).
`IntegrationError`
    The move by half an integration step, beside which the noise is small.
`ProfileEnds`
    The ends of the profile likelihood, where a local interval does not hold. An end may be open.
`Mixture`
    Alternatives with their weights, such as other explanations of the residuals (Bayesian model
    averaging; Hoeting, Madigan, Raftery and Volinsky, Statist. Sci. 14 (1999) 382).
`AverageOverNoise`
    The same over sizes of noise inside the plant (`sysid.uncertainty.noise_sizes`).
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import hypot, inf, log, sqrt
from typing import Protocol, get_args

import numpy as np

from sysid.core.distributions import student_limit, student_tail
from sysid.core.findings import EstimateStatus
from sysid.core.text import split_estimate
from sysid.core.types import FloatArray
from sysid.core.units import format_unit
from sysid.language.functions import Interval
from sysid.models.parameters import Parameter
from sysid.uncertainty.estimates import AT_LIMIT, Estimate, IntervalEnd

_TAIL = 0.025  # of the distribution, beyond each end of an interval
_POOR_SHARE = 1 / 3  # of a range: an interval around 0 that covers more says little
_ROUNDING = 1e-9  # of a range: an interval that is as wide
_ENDS: tuple[IntervalEnd, ...] = get_args(IntervalEnd)
_HALVINGS = 60  # of the range of a quantile: to the resolution of a number


class IntervalSource(Protocol):
    """What is known of an estimate, and what follows for its interval."""

    @abstractmethod
    def apply(self, estimate: Estimate) -> Estimate:
        """Return the estimate with the interval that follows."""


def compose_interval(estimate: Estimate, *sources: IntervalSource) -> Estimate:
    """Compose the interval of an estimate from these sources, in their order.

    Each source changes the interval that those before it have left.
    """
    for source in sources:
        estimate = source.apply(estimate)
    return estimate


def compose_intervals(
    estimates: Sequence[Estimate], *sources: Mapping[str, IntervalSource]
) -> tuple[Estimate, ...]:
    """Compose the intervals of the estimates that have such sources, by name."""
    return tuple(
        compose_interval(one, *(by_name[one.name] for by_name in sources if one.name in by_name))
        for one in estimates
    )


@dataclass(frozen=True, slots=True)
class LocalInterval:
    """The interval of the local analysis, by Wald: value ± quantile · standard error.

    Attributes
    ----------
    quantile : float
        Of the t distribution, for 95 %.
    """

    quantile: float

    def apply(self, estimate: Estimate) -> Estimate:
        """Give an estimate that has a standard error its interval."""
        if estimate.stderr is None:
            return estimate
        half = self.quantile * estimate.stderr
        return replace(estimate, interval95=(estimate.value - half, estimate.value + half))


@dataclass(frozen=True, slots=True)
class Plateau:
    """Values on which the output does not change.

    Attributes
    ----------
    offset : float
        Distance from the estimate up to the middle of the plateau, in the parameter's unit.
    """

    offset: float

    def apply(self, estimate: Estimate) -> Estimate:
        """Centre the interval on the plateau."""
        if estimate.interval95 is None:
            return estimate
        lower, upper = estimate.interval95
        return replace(estimate, interval95=(lower + self.offset, upper + self.offset))


@dataclass(frozen=True, slots=True, eq=False)
class CompatibleMinima:
    """Minima beside the estimate, which may be as likely.

    Attributes
    ----------
    values : FloatArray, shape (m,)
        The parameter's values there, in its unit.
    ratios : FloatArray, shape (m,)
        Likelihood ratios to the best of them, scaled to follow χ² with one degree of freedom.
    quantile : float
        Of the t distribution, for 95 %.
    """

    values: FloatArray
    ratios: FloatArray
    quantile: float

    def select_beyond(self, ends: Interval) -> "CompatibleMinima":
        """Select the minima outside an interval."""
        is_beyond = (self.values < ends[0]) | (self.values > ends[1])
        return replace(self, values=self.values[is_beyond], ratios=self.ratios[is_beyond])

    def apply(self, estimate: Estimate) -> Estimate:
        """Widen the interval by those of the minima whose ratio is below the quantile squared.

        With the curvature of the best minimum, each one covers √(quantile² - ratio) standard
        errors.
        """
        is_compatible = self.ratios <= self.quantile**2
        if not estimate.stderr or estimate.interval95 is None or not is_compatible.any():
            return estimate
        lower, upper = estimate.interval95
        half = estimate.stderr * np.sqrt(self.quantile**2 - self.ratios[is_compatible])
        middle = self.values[is_compatible]
        low, high = float((middle - half).min()), float((middle + half).max())
        return replace(estimate, interval95=(min(lower, low), max(upper, high)))


@dataclass(frozen=True, slots=True)
class IntegrationError:
    """The error of the integration, in a record without noise.

    Attributes
    ----------
    move : float
        By half the integration step, in the parameter's unit.
    """

    move: float

    def apply(self, estimate: Estimate) -> Estimate:
        """Add the move to the standard error, and widen the interval by as much."""
        if not estimate.stderr or estimate.interval95 is None:
            return estimate
        stderr, value = hypot(estimate.stderr, self.move), estimate.value
        factor = stderr / estimate.stderr
        lower, upper = (value + factor * (end - value) for end in estimate.interval95)
        reason = (
            f"its error is that of the integration: half the step moves it by {self.move:.1g}"
            f"{format_unit(estimate.unit)}, and the record has no noise"
        )
        return replace(estimate, stderr=stderr, interval95=(lower, upper), reason=reason)


@dataclass(frozen=True, slots=True)
class ProfileEnds:
    """Ends by the profile likelihood (`sysid.uncertainty.profile_ends`).

    Attributes
    ----------
    interval : tuple of float
        In the parameter's unit.
    limits : mapping of IntervalEnd to str
        For each open end the parameter whose bound stops it: no data do. Mostly it is its own.
    is_closed : bool
        Whether the data end it on both sides.
    is_set : bool
        Whether values around the estimate all give the same output.
    meets_limit : bool
        Whether a parameter is at a physical limit where an end is.
    """

    interval: Interval
    limits: Mapping[IntervalEnd, str] = field(default_factory=dict)
    is_closed: bool = True
    is_set: bool = False
    meets_limit: bool = False

    def apply(self, estimate: Estimate) -> Estimate:
        """Replace the interval, and the status if that of the linear model does not hold.

        A parameter is practically identifiable if its profile is closed, and not if an end is open
        (Raue et al., Bioinformatics 25 (2009) 1923). If that end is towards 0, it is still known
        how large the parameter may be, as of any interval that holds 0.

        A physical limit may be a mirror, as 1 is for the ratio of two time constants: beyond it the
        same outputs come again. There the slopes along a direction vanish, and the linear model
        sees a combination alone. A profile that is closed shows that there is none.
        """
        found = replace(estimate, interval95=self.interval, open_ends=tuple(self.limits))
        is_mirrored = self.meets_limit and estimate.status == "group"
        is_flat = self.is_closed and (estimate.status == "unidentifiable" or is_mirrored)
        if self.is_set or is_flat:  # in the worst case all values are as likely
            stderr = (self.interval[1] - self.interval[0]) / sqrt(12.0)
            found = replace(found, stderr=stderr)
        if is_flat:
            reason = AT_LIMIT if estimate.value in self.interval else ""
            found = replace(found, status="identified", reason=reason)
        if found.status != "identified":
            return found
        if self.limits:
            ends = dict(zip(_ENDS, self.interval, strict=True))
            is_unlimited = any(abs(ends[name]) > abs(estimate.value) for name in self.limits)
            status: EstimateStatus = "unidentifiable" if is_unlimited else "identified"
            return replace(found, status=status, reason=self._describe_limits(estimate))
        if self.is_set:
            low, high = (split_estimate(end, found.stderr)[0] for end in self.interval)
            unit = format_unit(estimate.unit)
            reason = f"it lies between {low}{unit} and {high}{unit}, where all values fit alike"
            return replace(found, reason=reason)
        return found

    def _describe_limits(self, estimate: Estimate) -> str:
        low, high = (f"{end:.4g}{format_unit(estimate.unit)}" for end in self.interval)
        if len(self.limits) > 1:
            return f"open below and above: all values from {low} to {high} fit"
        ((end, name),) = self.limits.items()
        side, start, stop = ("above", low, high) if end == "upper" else ("below", high, low)
        way = "up" if end == "upper" else "down"
        if name == estimate.name:
            return f"open {side}: all values from {start} {way} to its bound {stop} fit"
        values = f"all values from {start} {way} to {stop} fit"
        return f"open {side}: {values}, where {name} meets its bound"


@dataclass(frozen=True, slots=True)
class Alternative:
    """One of several estimates of a parameter: Student's t distribution around a value.

    Attributes
    ----------
    weight : float
        Share of the probability, in any unit that all alternatives have in common.
    value, stderr : float
        In the parameter's unit.
    degrees : float
        Degrees of freedom; infinite: the normal distribution.
    """

    weight: float
    value: float
    stderr: float
    degrees: float = inf

    def compute_tail(self, value: float) -> float:
        """Compute the probability that the parameter exceeds a value."""
        if self.stderr > 0.0:
            return student_tail(self.degrees, (value - self.value) / self.stderr)
        return float(self.value > value)


@dataclass(frozen=True, slots=True)
class Mixture:
    """Estimates by alternatives that the data leave open, such as explanations of residuals."""

    alternatives: tuple[Alternative, ...]

    def apply(self, estimate: Estimate) -> Estimate:
        """Extend the interval by that of the mixture; it holds the estimate that is reported."""
        if estimate.interval95 is None:
            return estimate
        pairs = (estimate.interval95, compute_mixture_interval(self.alternatives))
        lower, upper = zip(*pairs, strict=True)
        return replace(estimate, interval95=(min(lower), max(upper)))


@dataclass(frozen=True, slots=True)
class AverageOverNoise:
    """Estimates by sizes of the noise inside the plant, which are never known exactly."""

    alternatives: tuple[Alternative, ...]

    def apply(self, estimate: Estimate) -> Estimate:
        """Extend the interval by that of the average, and the standard error to its deviation."""
        if estimate.stderr is None or estimate.interval95 is None:
            return estimate
        total = sum(one.weight for one in self.alternatives)
        mean = sum(one.weight * one.value for one in self.alternatives) / total
        variance = sum(
            one.weight * (one.stderr**2 + (one.value - mean) ** 2) for one in self.alternatives
        )
        stderr = max(estimate.stderr, sqrt(variance / total))
        return Mixture(self.alternatives).apply(replace(estimate, stderr=stderr))


def compute_mixture_interval(alternatives: Sequence[Alternative]) -> Interval:
    """Compute the 2.5 and 97.5 % quantiles of a mixture of t distributions.

    The posterior of a parameter under several models is the mixture of those under each of them,
    by the models' probabilities (Hoeting et al. 1999, eq. 1). Only relative weights count.

    Raises
    ------
    ValueError
        If no alternative has a positive, finite weight, or if one has a negative weight or error.

    Examples
    --------
    >>> one, other = Alternative(0.75, 1.0, 0.1), Alternative(0.25, 2.0, 0.1)
    >>> low, high = compute_mixture_interval([one, other])
    >>> round(low, 3), round(high, 3)
    (0.817, 2.128)
    """
    total = sum(one.weight for one in alternatives)
    if not 0.0 < total < inf or any(one.weight < 0.0 or one.stderr < 0.0 for one in alternatives):
        raise ValueError("a mixture needs weights and errors of 0 or more, and a weight above 0")
    open_ones = [one for one in alternatives if one.weight > 0.0]
    low, high = (_find_quantile(open_ones, total, tail) for tail in (1.0 - _TAIL, _TAIL))
    return low, high


def _find_quantile(alternatives: Sequence[Alternative], total: float, tail: float) -> float:
    """Find the value that the mixture exceeds with a probability, by bisection.

    It lies between the least and the largest of those of the alternatives.
    """
    ends = [
        one.value + one.stderr * student_limit(one.degrees, tail) if one.stderr else one.value
        for one in alternatives
    ]
    low, high = min(ends), max(ends)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if sum(one.weight * one.compute_tail(middle) for one in alternatives) > tail * total:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def mark_poor_intervals(
    parameters: Sequence[Parameter], estimates: Sequence[Estimate]
) -> tuple[Estimate, ...]:
    """Mark the identified estimates whose 95 % interval says little more than their bounds.

    It is wider than the range, or it contains 0 and more than a third of the range. What lies
    beyond a physical limit does not count.
    """
    by_name = {parameter.name: parameter for parameter in parameters}
    marked = []
    for estimate in estimates:
        if estimate.status == "identified" and estimate.interval95 is not None:
            reason = _explain_poor_interval(by_name[estimate.name], estimate.interval95)
            if reason:
                estimate = replace(estimate, status="unidentifiable", reason=reason)
        marked.append(estimate)
    return tuple(marked)


def keep_in_bounds(estimates: Sequence[Estimate]) -> tuple[Estimate, ...]:
    """Cut the intervals of free parameters at their bounds, and say so in the reason."""
    return tuple(_keep_in_bounds(one) for one in estimates)


def _keep_in_bounds(estimate: Estimate) -> Estimate:
    if not estimate.is_free or estimate.interval95 is None:
        return estimate
    lower, upper = (min(max(end, estimate.lower), estimate.upper) for end in estimate.interval95)
    if (lower, upper) == estimate.interval95:
        return estimate
    pairs = zip(("lower", "upper"), (lower, upper), estimate.interval95, strict=True)
    cut = [f"{name} bound {end:.6g}" for name, end, uncut in pairs if end != uncut]
    reason = estimate.reason or f"its 95 % interval is cut at the {' and the '.join(cut)}"
    return replace(estimate, interval95=(lower, upper), reason=reason)


def _explain_poor_interval(parameter: Parameter, interval: Interval) -> str:
    """Explain how an interval says too little; empty if it says enough."""
    lower, upper = parameter.lower, parameter.upper
    interval = (
        max(interval[0], lower) if parameter.is_physical("lower") else interval[0],
        min(interval[1], upper) if parameter.is_physical("upper") else interval[1],
    )
    poorly = "these data determine it poorly: its 95 % interval"
    if interval[1] - interval[0] >= (1.0 - _ROUNDING) * (upper - lower):
        return f"{poorly} is wider than its range"
    low, high = max(interval[0], lower), min(interval[1], upper)
    if parameter.scale == "log":
        share = log(high / low) / log(upper / lower)
    else:
        share = (high - low) / (upper - lower)
    if interval[0] <= 0.0 <= interval[1] and share > _POOR_SHARE:
        return f"{poorly} contains 0, and {100 * share:.0f} % of its range"
    return ""
