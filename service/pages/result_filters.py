"""Texts of a result, as filters of the templates: `estimate | value_text`."""

from math import isfinite

from sysid.core.text import (
    DASH,
    format_criterion,
    format_estimate,
    format_interval,
    format_number,
    format_p_value,
    join_estimate,
    plain_unit,
)
from sysid.identifiability.combinations import IdentifiableCombination
from sysid.models.equation_display import format_equations
from sysid.models.model import Model
from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import ResidualTest
from sysid.results.parts import OrderComparison, OrderFit
from sysid.results.summary import describe_search
from sysid.uncertainty.estimates import Estimate, PosteriorParameter


def format_value_text(estimate: Estimate) -> str:
    """Format the value of an estimate with as many digits as its error leaves."""
    return format_estimate(estimate.value, estimate.stderr, status=estimate.status)[0]


def format_stderr_text(estimate: Estimate) -> str:
    """Format the standard error of an estimate; empty without one."""
    return format_estimate(estimate.value, estimate.stderr, status=estimate.status)[1]


def format_interval_text(estimate: Estimate) -> str:
    """Format the 95 % interval of an estimate; empty without one."""
    status, open_ends = estimate.status, estimate.open_ends
    return format_interval(estimate.interval95, estimate.stderr, status=status, open_ends=open_ends)


def format_bounds_text(estimate: Estimate) -> str:
    """Format the bounds of an estimate that are finite."""
    bounds = [bound for bound in (estimate.lower, estimate.upper) if isfinite(bound)]
    return " … ".join(f"{bound:.6g}".replace("-", "−") for bound in bounds)


def format_median_text(parameter: PosteriorParameter) -> str:
    """Format the median of a posterior."""
    return format_estimate(parameter.median, _estimate_spread(parameter))[0]


def format_quantiles_text(parameter: PosteriorParameter) -> str:
    """Format the 95 % interval of a posterior."""
    return format_interval(parameter.interval95, _estimate_spread(parameter))


def _estimate_spread(parameter: PosteriorParameter) -> float:
    low, high = parameter.interval95
    return (high - low) / 4.0  # about a standard deviation, which gives the digits


def describe_hypothesis(test: ResidualTest) -> str:
    """Describe what residuals are if they pass a test."""
    return "white" if test.test == "whiteness" else f"independent of {test.input}"


def format_share(share: float | None) -> str:
    """Format a share in percent."""
    return DASH if share is None or not isfinite(share) else f"{100 * share:.0f}\u202f%"


def format_onset_text(onset: OnsetDelay) -> str:
    """Format an onset delay; empty if there is none."""
    if onset.delay is None:
        return ""
    value, spread = format_estimate(onset.delay, onset.spread)
    return f"{value if spread else format_number(onset.delay)}\u202fs"


def describe_onset(onset: OnsetDelay) -> str:
    """Describe from how many steps an onset delay comes, or why there is none."""
    if onset.delay is None:
        return onset.reason
    _, spread = format_estimate(onset.delay, onset.spread)
    steps = "one step" if onset.events == 1 else f"{onset.events} steps"
    return steps + (f", spread {spread}\u202fs" if spread else "")


def describe_group(group: IdentifiableCombination) -> str:
    """Describe a combination with its value."""
    where = " near the estimate" if group.is_local else ""
    return f"{group.expression} = {join_estimate(group.value, group.stderr)}{where}"


def format_delay_text(fit: OrderFit, unit: str) -> str:
    """Format the dead time of an order with its unit."""
    text = join_estimate(fit.delay, fit.delay_stderr)
    return text if text == DASH else text + plain_unit(unit)


def format_excess_bic(fit: OrderFit, comparison: OrderComparison) -> str:
    """Format the BIC of an order, less the lowest of all orders."""
    lowest = min((one.bic for one in comparison.fits if isfinite(one.bic)), default=0.0)
    return format_criterion(fit.bic - lowest if isfinite(fit.bic) else None)


def list_equations(model: Model) -> list[str]:
    """List the equations of a model as MathML."""
    return [equation.mathml for equation in format_equations(model)]


RESULT_FILTERS = {
    "value_text": format_value_text,
    "stderr_text": format_stderr_text,
    "interval_text": format_interval_text,
    "bounds_text": format_bounds_text,
    "median_text": format_median_text,
    "quantiles_text": format_quantiles_text,
    "hypothesis": describe_hypothesis,
    "share": format_share,
    "p_value": format_p_value,
    "onset_text": format_onset_text,
    "onset_note": describe_onset,
    "group_text": describe_group,
    "search_text": describe_search,
    "delay_text": format_delay_text,
    "excess_bic": format_excess_bic,
    "equations": list_equations,
}
