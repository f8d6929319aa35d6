"""Texts of a result, as filters of the templates: `estimate | value_text`."""

from collections.abc import Sequence
from math import isfinite
from typing import NamedTuple

from service.pages.forms.choices import write_choice
from sysid.core.findings import Finding
from sysid.core.text import (
    DASH,
    append_unit,
    format_criterion,
    format_estimate,
    format_interval,
    format_number,
    format_p_value,
    join_estimate,
    plain_unit,
    rewrite_settings,
)
from sysid.identifiability.combinations import IdentifiableCombination
from sysid.judgement.levels import NOTABLE_MOVE
from sysid.models.equation_display import format_equations
from sysid.models.model import Model
from sysid.residuals.onset_delay import OnsetDelay
from sysid.residuals.residual_tests import ResidualTest
from sysid.results.findings import list_untold_reasons
from sysid.results.parts import NoiseSource, OrderComparison, OrderFit
from sysid.results.result import Result
from sysid.results.summary import describe_search
from sysid.uncertainty.estimates import Estimate, PosteriorParameter


class ExplainedValue(NamedTuple):
    """Value of a parameter under an explanation."""

    text: str
    is_notable: bool


class ExplanationRow(NamedTuple):
    """An explanation, how much lower its BIC is, and its value of each parameter."""

    brief: str
    gain: str
    cells: Sequence[ExplainedValue]


class ExplanationTable(NamedTuple):
    """Open explanations of a result; `headings` are parameters that one of them moves."""

    headings: Sequence[str]
    rows: Sequence[ExplanationRow]


def tabulate_explanations(result: Result) -> ExplanationTable | None:
    """Tabulate what moves an estimate, below the estimates themselves; None if nothing does."""
    explanations = [one for one in result.findings if one.severity != "note" and one.moves]
    moved = {
        move.parameter
        for one in explanations
        for move in one.moves
        if abs(move.stderrs) > NOTABLE_MOVE
    }
    estimates = [one for one in result.parameters if one.name in moved]
    if not estimates:
        return None
    values = [
        ExplainedValue(join_estimate(one.value, one.stderr, status=one.status), is_notable=False)
        for one in estimates
    ]
    return ExplanationTable(
        [append_unit(one.name, one.unit) for one in estimates],
        [
            ExplanationRow("the model holds", "", values),
            *(_tabulate_explanation(one, estimates) for one in explanations),
        ],
    )


def _tabulate_explanation(finding: Finding, estimates: Sequence[Estimate]) -> ExplanationRow:
    moves = {move.parameter: move for move in reversed(finding.moves)}
    cells = [
        ExplainedValue(
            join_estimate(move.value, move.stderr), is_notable=abs(move.stderrs) > NOTABLE_MOVE
        )
        if (move := moves.get(one.name)) and one.may_be(move.value)
        else ExplainedValue(DASH, is_notable=False)
        for one in estimates
    ]
    return ExplanationRow(finding.brief, format_criterion(finding.gain), cells)


def describe_soundness(result: Result) -> str:
    """Describe the evidence for a result that no finding speaks against."""
    passed = result.residual_tests.passed
    if passed is None:
        residuals = "residuals were not tested"
    elif passed:
        residuals = "the residuals pass their tests"
    elif result.explained:
        residuals = "the residuals are no white noise, but no explanation of that moves an estimate"
    else:
        residuals = "the residuals fail a test, but weakly"
    free = [one for one in result.parameters if one.is_free]
    is_determined = all(one.status == "identified" for one in free)
    known = ", and the data determine every parameter" if is_determined else ""
    return f"The search settled, {residuals}{known}."


def list_note_texts(result: Result) -> list[str]:
    """List what is noted of a result, and reasons of statuses that no finding tells."""
    notes = [one.sentences for one in result.findings if one.severity == "note"]
    untold = list_untold_reasons(result.parameters, result.findings)
    return [write_choices(text) for text in dict.fromkeys([*notes, *untold])]


def write_choices(text: str) -> str:
    """Write settings in a text as the form has them."""
    return rewrite_settings(text, write_choice)


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


def select_told_orders(result: Result) -> OrderComparison | None:
    """Select the comparison of orders, unless it would reassure beside another doubt."""
    doubts = [one for one in result.findings if one.severity != "note"]
    is_told = not doubts or any(one.explanation == "order" for one in doubts)
    return result.order_comparison if is_told else None


def format_excess_bic(fit: OrderFit, comparison: OrderComparison) -> str:
    """Format the BIC of an order, less the lowest of all orders."""
    lowest = min((one.bic for one in comparison.fits if isfinite(one.bic)), default=0.0)
    return format_criterion(fit.bic - lowest if isfinite(fit.bic) else None)


def describe_noise_kind(source: NoiseSource) -> str:
    """Describe what a source of noise is."""
    return {"sensor": "sensor", "load": "slow load", "plant": "diffusion of a state"}[source.kind]


def list_equations(model: Model) -> list[str]:
    """List the equations of a model as MathML."""
    return [equation.mathml for equation in format_equations(model)]


RESULT_FILTERS = {
    "explanation_table": tabulate_explanations,
    "soundness": describe_soundness,
    "note_texts": list_note_texts,
    "choices": write_choices,
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
    "told_orders": select_told_orders,
    "delay_text": format_delay_text,
    "excess_bic": format_excess_bic,
    "noise_text": describe_noise_kind,
    "equations": list_equations,
}
