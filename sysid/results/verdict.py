"""Judge a result: whether its estimates can be relied on, and what speaks against it.

A result is judged once, when it is concluded; every page and command says what it says. A new kind
of reason is a function of the evidence in `_FINDERS`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import isfinite, isnan
from typing import TYPE_CHECKING, Literal, TypeGuard

from sysid.core.text import plain_estimate, plain_unit
from sysid.results.open_terms import find_open_terms

if TYPE_CHECKING:  # the client's types name `Trust`, and load no numerics
    from sysid.residuals.residual_tests import ResidualTest
    from sysid.results.parts import OrderComparison, SearchEvidence
    from sysid.simulation.fit_metrics import ChannelMetrics
    from sysid.uncertainty.estimates import Estimate

Trust = Literal["trustworthy", "limited", "not trustworthy"]
Severity = Literal["note", "caution", "serious"]

_SEVERITIES: tuple[Severity, ...] = ("serious", "caution", "note")
_UNLIKELY = 1e-3  # probability of such residuals under a true model
_SEPARABLE_STDERRS = 2.0  # a smaller time lag is not distinguishable from 0
_DEPENDENT = "order-dependent", "prediction-dependent", "hold-dependent", "selection-dependent"
_LITTLE = 30.0  # %: a smaller fit is serious if the residuals are not noise
_NOTABLE_LOSS = 20.0  # percentage points of fit, from estimation to validation


@dataclass(frozen=True, slots=True)
class Reason:
    """One finding about a result.

    Attributes
    ----------
    severity : {"serious", "caution", "note"}
        Serious: do not rely on the estimates. Caution: they hold under a condition. Note: worth
        knowing.
    brief : str
        A few words, as they follow “trustworthy, but” or “not trustworthy:”.
    text : str
        Whole sentences: what was found, and what helps.
    """

    severity: Severity
    brief: str
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the estimates of a result can be relied on.

    Attributes
    ----------
    trust : {"trustworthy", "limited", "not trustworthy"}
        Limited: the estimates hold under the condition that the text names.
    text : str
        The verdict in words, such as “trustworthy, but L depends on the model's order”.
    reasons : tuple of Reason
        The most severe first; empty if nothing speaks against the result.

    Examples
    --------
    >>> slow = Reason("caution", "L depends on the model's order", "The residuals are not white.")
    >>> conclude_verdict([slow]).text
    "trustworthy, but L depends on the model's order"
    """

    trust: Trust
    text: str
    reasons: tuple[Reason, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What a verdict is based on.

    Attributes
    ----------
    estimates : sequence of Estimate
    valid : bool
        Whether the RMS is below the safe limit.
    fit_percent, fit_percent_validation : float or None
        ``nan`` for a constant output. None in results that do not say.
    search : SearchEvidence or None
        None in results that do not say.
    tests : sequence of ResidualTest
        Of the residuals, on the data that the result was tested on.
    delays : tuple of str
        Free parameters that time lags depend on.
    orders : OrderComparison or None
        Orders of a process, if they were compared.
    channels : sequence of ChannelMetrics
        Agreement with the estimation data.
    """

    estimates: "Sequence[Estimate]"
    valid: bool = True
    fit_percent: float | None = None
    fit_percent_validation: float | None = None
    search: "SearchEvidence | None" = None
    tests: "Sequence[ResidualTest]" = ()
    delays: tuple[str, ...] = ()
    orders: "OrderComparison | None" = None
    channels: "Sequence[ChannelMetrics]" = ()

    @property
    def free(self) -> "list[Estimate]":
        """Estimates of the free parameters."""
        return [estimate for estimate in self.estimates if estimate.is_free]

    def list_names(self, *statuses: str) -> list[str]:
        """List the free parameters that have one of these statuses."""
        return [estimate.name for estimate in self.free if estimate.status in statuses]

    def describe_reasons(self, status: str) -> str:
        """Tell each free parameter of this status with its value, and the reason, as sentences."""
        return " ".join(
            f"{one.name} = {plain_estimate(one.value, one.stderr, status=one.status)}"
            f"{plain_unit(one.unit)}"
            f"{f'; {one.reason}' if one.reason else ''}."
            for one in self.free
            if one.status == status
        )

    def has_failed(self, kind: str) -> bool:
        """Whether a residual test of this kind failed clearly: true models seldom do so."""
        return any(
            test.test == kind and test.outcome == "failed" and (test.p or 0.0) <= _UNLIKELY
            for test in self.tests
        )


def judge_result(evidence: Evidence) -> Verdict:
    """Judge a result by its evidence.

    Examples
    --------
    >>> lag = Estimate("L", "s", 0.52, 0.0, 5.0, 0.01, (0.50, 0.54), "identified")
    >>> judge_result(Evidence(estimates=[lag], fit_percent=97.0)).text
    'trustworthy'
    """
    return conclude_verdict([reason for find in _FINDERS for reason in find(evidence)])


def conclude_verdict(reasons: Sequence[Reason]) -> Verdict:
    """Conclude from all reasons, in the order of their importance within a severity."""
    ordered = tuple(sorted(reasons, key=lambda reason: _SEVERITIES.index(reason.severity)))
    first = ordered[0] if ordered else None
    if first is None or first.severity == "note":
        return Verdict("trustworthy", "trustworthy", ordered)
    if first.severity == "caution":
        return Verdict("limited", f"trustworthy, but {first.brief}", ordered)
    text = first.brief if first.brief.startswith("not ") else f"not trustworthy: {first.brief}"
    return Verdict("not trustworthy", text, ordered)


def _find_invalid(evidence: Evidence) -> Iterator[Reason]:
    if not evidence.valid:
        yield Reason("serious", "the model is invalid", "The RMS error is above the safe limit.")


def _find_constant_output(evidence: Evidence) -> Iterator[Reason]:
    if evidence.fit_percent is not None and isnan(evidence.fit_percent):
        yield Reason(
            "serious",
            "the output is constant",
            "The output does not move, so it tells nothing of the model. Choose another channel, "
            "or a recording in which it moves.",
        )


def _find_unsettled(evidence: Evidence) -> Iterator[Reason]:
    search = evidence.search
    if search is None or search.settled:
        return
    started = (
        "The search made no independent starts"
        if search.independent_starts == 0
        else f"{search.agreeing_starts} of {search.independent_starts} independent starts ended "
        "in the best minimum"
    )
    yield Reason(
        "serious",
        "not settled",
        f"{started}, and the residuals are not noise. A better minimum may have been missed, or "
        "the model is wrong. Repeat the search with another seed or more generations.",
    )


def _find_refuted(evidence: Evidence) -> Iterator[Reason]:
    if evidence.list_names("not validated"):
        yield Reason(
            "serious",
            "the validation data contradict the model",
            "The model predicts the validation data worse than their mean.",
        )
        return
    fit, validated = evidence.fit_percent, evidence.fit_percent_validation
    if _is_number(fit) and _is_number(validated) and fit - validated > _NOTABLE_LOSS:
        yield Reason(
            "caution",
            "it fits the validation data worse",
            f"The fit is {fit:.1f} % in estimation, and {validated:.1f} % in validation. The "
            "model does not hold for both.",
        )


def _find_misled_run(evidence: Evidence) -> Iterator[Reason]:
    """Find values that disturbances mislead, by those of one step ahead."""
    if names := evidence.list_names("prediction-dependent"):
        yield Reason(
            "serious",
            f"{_join(names)} {'differ' if len(names) > 1 else 'differs'} one step ahead",
            "A free run attributes disturbances to the parameters. "
            f"{evidence.describe_reasons('prediction-dependent')} Use prediction: one-step.",
        )


def _find_other_hold(evidence: Evidence) -> Iterator[Reason]:
    """Find values that depend on how an input moves between its samples, which is in doubt."""
    if names := evidence.list_names("hold-dependent"):
        depend = "depend" if len(names) > 1 else "depends"
        yield Reason(
            "caution",
            f"{_join(names)} {depend} on how an input is read between its samples",
            f"{evidence.describe_reasons('hold-dependent')} Say how the input moves between its "
            "samples: a warning names the option.",
        )


def _find_no_fit(evidence: Evidence) -> Iterator[Reason]:
    fit = evidence.fit_percent
    if _is_number(fit) and fit <= 0:
        yield Reason(
            "serious",
            "the model does not explain the output",
            f"The fit is {fit:.1f} %: a constant fits as well. Choose another model, or look at "
            "channels and bounds.",
        )


def _find_straight_line(evidence: Evidence) -> Iterator[Reason]:
    """Find outputs that a straight line explains better, over all experiments or in one."""
    outputs = dict.fromkeys(one.output for one in evidence.channels if one.is_worse_than_line)
    failed = [name for name in outputs if _is_worse_than_line(evidence.channels, name)]
    if failed:
        yield Reason(
            "serious",
            f"a straight line explains {_join(failed)} better",
            f"A straight line fits {_join(failed)} better than the model, which has failed. Choose "
            "another model, or look at channels, bounds, and a change during the recording.",
        )
    elif outputs:
        yield Reason(
            "caution",
            f"a straight line explains a part of {_join(list(outputs))} better",
            f"In some experiments a straight line fits {_join(list(outputs))} better than the "
            "model: they tell little of it, or it does not hold there.",
        )


def _is_worse_than_line(channels: "Sequence[ChannelMetrics]", output: str) -> bool:
    """Whether straight lines fit an output better than the model, over all experiments."""
    own = [one for one in channels if one.output == output and isfinite(one.line_rms)]
    return sum(one.samples * (one.rms**2 - one.line_rms**2) for one in own) > 0


def _find_little_fit(evidence: Evidence) -> Iterator[Reason]:
    """Find a model that explains little of what is not noise, perhaps because of a bound."""
    fit = evidence.fit_percent
    if _is_number(fit) and 0 < fit < _LITTLE and evidence.has_failed("whiteness"):
        yield Reason(
            "serious",
            "the model explains little of the output",
            f"The fit is {fit:.1f} %, and what is left is not noise. Choose another model, or look "
            "at channels and bounds.",
        )


def _find_undetermined(evidence: Evidence) -> Iterator[Reason]:
    """Find parameters that the data do not determine; serious if they determine none."""
    known = evidence.list_names("identified", "not settled", "not validated", *_DEPENDENT)
    severity: Severity = "caution" if known else "serious"
    if names := evidence.list_names("ambiguous"):
        yield Reason(
            severity,
            f"another value of {_join(names)} fits as well",
            f"Another minimum fits as well, with other values of {_join(names)}. Use an input "
            "that tells them apart.",
        )
    if names := evidence.list_names("unidentifiable"):
        yield Reason(
            severity,
            f"the data do not determine {_join(names)}",
            f"The data do not determine {_join(names)}. Fix {_them(names)}, or excite the system "
            "differently.",
        )
    if names := evidence.list_names("group"):
        yield Reason(
            severity,
            f"the data determine {_join(names)} only in combination",
            f"The data do not determine {_join(names)} alone, only in combination. Use the "
            "combinations, or fix a parameter that you know.",
        )


def _find_bounds(evidence: Evidence) -> Iterator[Reason]:
    """Find estimates at a bound; with missing dynamics they are no physical limit."""
    names, is_coloured = evidence.list_names("at bound"), evidence.has_failed("whiteness")
    if names:
        lies = "lies at its bound" if len(names) == 1 else "lie at their bounds"
        coloured = " The residuals are not white, which the bound may cause." * is_coloured
        yield Reason(
            "serious" if is_coloured else "caution",
            f"{_join(names)} {lies}",
            f"{_join(names)} {lies}, so the best value may be outside, and other estimates follow "
            f"it.{coloured} Widen the range, unless it is a physical limit.",
        )


def _find_other_order(evidence: Evidence) -> Iterator[Reason]:
    """Find orders of a process that the data do not rule out, and that move its dead time."""
    orders = evidence.orders
    if orders is None or orders.preferred_model == orders.model:
        return
    if orders.delay in evidence.list_names("at bound"):
        return  # the bound speaks against every order
    own, unit = orders.own_fit, "" if orders.unit == "1" else f" {orders.unit}"
    lower, upper = orders.delay_range
    if orders.preferred_model is not None:
        yield Reason(
            "caution",
            f"{orders.delay} depends on the model's order",
            f"The data prefer {orders.preferred_model}, with {orders.delay} = {lower:.4g}{unit} "
            f"instead of {own.delay:.4g}{unit}. Use that model.",
        )
    elif own.delay_stderr and upper - lower > _SEPARABLE_STDERRS * own.delay_stderr:
        yield Reason(
            "caution",
            f"{orders.delay} depends on the model's order",
            f"The data do not tell {_join([fit.model for fit in orders.open_fits])} apart. With "
            f"them {orders.delay} is from {lower:.4g} to {upper:.4g}{unit}.",
        )


def _find_missing_dynamics(evidence: Evidence) -> Iterator[Reason]:
    if _is_explained(evidence):
        return
    orders, bounded = evidence.orders, evidence.list_names("at bound")
    if evidence.has_failed("whiteness") and set(bounded) & set(evidence.delays):
        return  # what is missing may be the time lag that the bound excludes
    if evidence.has_failed("whiteness") and orders and orders.preferred_model == orders.model:
        yield Reason(
            "caution",
            "the residuals are not noise",
            "The residuals are not white, and a model of another order does not explain them. Look "
            "for a disturbance, slow noise, or a system that changed during the recording.",
        )
    elif evidence.has_failed("whiteness"):
        names = evidence.delays
        what = _join(names) if names else "each estimate"
        depends = "depend" if len(names) > 1 else "depends"
        yield Reason(
            "caution",
            f"{what} {depends} on the model's order",
            "The residuals are not white: dynamics are missing from the model, or the noise is "
            f"slow. With another order {what} may differ by more than the error. Compare with a "
            "model of higher order.",
        )
    elif evidence.has_failed("independence"):
        inputs = dict.fromkeys(
            test.input for test in evidence.tests if test.outcome == "failed" and test.input
        )
        yield Reason(
            "caution",
            f"the residuals depend on {_join(list(inputs))}",
            f"The residuals depend on {_join(list(inputs))}: a part of the response is missing "
            "from the model.",
        )
    elif any(test.outcome == "failed" for test in evidence.tests):
        yield Reason(
            "note",
            "a residual test fails",
            "A residual test fails at the level of 5 %, as it does for one true model in twenty.",
        )


def _find_insignificant_delays(evidence: Evidence) -> Iterator[Reason]:
    names = [
        estimate.name
        for estimate in evidence.free
        if estimate.name in evidence.delays
        and estimate.status == "identified"
        and estimate.stderr is not None
        and abs(estimate.value) < _SEPARABLE_STDERRS * estimate.stderr
    ]
    if names:
        yield Reason(
            "caution",
            f"{_join(names)} may be 0",
            f"{_join(names)}: less than two standard errors. The data show no time lag.",
        )


_FINDERS: tuple[Callable[[Evidence], Iterator[Reason]], ...] = (
    _find_invalid,
    _find_constant_output,
    _find_unsettled,
    _find_no_fit,
    _find_straight_line,
    _find_misled_run,
    _find_refuted,
    _find_bounds,
    _find_little_fit,
    _find_undetermined,
    _find_other_order,
    _find_other_hold,
    find_open_terms,
    _find_missing_dynamics,
    _find_insignificant_delays,
)
"""What finds the reasons; within a severity, the first found makes the verdict's text."""


def _is_explained(evidence: Evidence) -> bool:
    # This imports NumPy, which the client's types do without.
    from sysid.simulation.fit_metrics import EXPLAINED_PERCENT

    return _is_number(evidence.fit_percent) and evidence.fit_percent >= EXPLAINED_PERCENT


def _join(names: Sequence[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def _them(names: Sequence[str]) -> str:
    return "it" if len(names) == 1 else "them"


def _is_number(value: float | None) -> TypeGuard[float]:
    return value is not None and isfinite(value)
