"""Views of diagnostics for the pages: residual tests, onset delays, information criteria."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sysid.core.text import (
    DASH,
    format_criterion,
    format_estimate,
    format_number,
    format_p_value,
    join_estimate,
    plain_unit,
)
from sysid.figures.plotly import Figure
from sysid.figures.residuals import plot_residuals
from sysid.results.figures import to_correlation_trace

if TYPE_CHECKING:  # a report without a database has diagnostics too
    from service.runs.residuals import ResidualAnalysis

Document = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class ResidualTestView:
    """One residual test as a row of a table."""

    experiment: int
    output: str
    hypothesis: str
    inside95: str
    inside99: str
    p: str
    outcome: str
    reason: str


@dataclass(frozen=True, slots=True)
class OnsetView:
    """The onset delay between one input and one output."""

    pair: str
    text: str
    reason: str


@dataclass(frozen=True, slots=True)
class SelectedTermView:
    """One selected term of a polynomial."""

    term: str
    err: str
    unexplained: str


@dataclass(frozen=True, slots=True)
class OrderView:
    """One order of a process as a row of a table; BIC is less the lowest of all orders."""

    model: str
    order: int
    delay: str
    delay_text: str
    bic_text: str
    evidence: str


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """Diagnostics of one run; fields are empty if the result has none.

    `verdict` is ``passed``, ``failed`` or ``not tested``, or empty without tests.
    """

    verdict: str
    data: str
    tests: Sequence[ResidualTestView]
    n_figures: int
    onsets: Sequence[OnsetView]
    groups: Sequence[str]
    criteria: Mapping[str, float | None]
    search: str
    orders: Sequence[OrderView] = ()
    selection: Sequence[SelectedTermView] = ()


def to_diagnostics(result: Document) -> Diagnostics:
    """Build the diagnostics from a result document; it is empty until the run ends."""
    tested = result.get("residual_tests", {})
    tests = tested.get("tests", [])
    onsets = result.get("onset_delays", [])
    groups = result.get("identifiability", {}).get("groups", [])
    several = len({onset["experiment"] for onset in onsets}) > 1
    verdicts = {True: "passed", False: "failed", None: "not tested"}
    return Diagnostics(
        verdict=verdicts[tested["passed"]] if tests else "",
        data=tested.get("data", ""),
        tests=[_to_test_view(test) for test in tests],
        n_figures=sum(
            test["experiment"] == 0 and test["outcome"] != "not tested" for test in tests
        ),
        onsets=[_to_onset_view(onset, several) for onset in onsets],
        groups=[_format_group(group) for group in groups],
        criteria=result.get("criteria", {}),
        search=_describe_search(result.get("search", {})),
        orders=_list_orders(result.get("order_comparison")),
        selection=[
            SelectedTermView(
                term["term"],
                format_number(term["err"]),
                format_number(max(1.0 - term["cumulated"], 0.0)),
            )
            for term in result.get("selection", ())
        ],
    )


def _list_orders(comparison: Document | None) -> list[OrderView]:
    """List the orders of a process; none if they were not compared."""
    if not comparison:
        return []
    unit = plain_unit(comparison["unit"])
    lowest = min((fit["bic"] for fit in comparison["fits"] if fit["bic"] is not None), default=0.0)
    return [
        OrderView(
            fit["model"],
            fit["order"],
            comparison["delay"],
            join_estimate(fit["delay"], fit["delay_stderr"]) + unit,
            format_criterion(None if fit["bic"] is None else fit["bic"] - lowest),
            "preferred"
            if fit["model"] == comparison["preferred_model"]
            else "possible"
            if fit["is_open"]
            else "strong evidence against",
        )
        for fit in comparison["fits"]
    ]


def plot_residual_tests(tested: "ResidualAnalysis", experiment: int, columns: int = 2) -> Figure:
    """Draw the residual correlations of one experiment; empty if none was tested."""
    functions = [
        to_correlation_trace(correlation)
        for correlation in tested.correlations
        if correlation.test.experiment == experiment and correlation.values.size
    ]
    return plot_residuals(functions, columns, tested.experiments)


def _to_test_view(test: Document) -> ResidualTestView:
    what = "white" if test["test"] == "whiteness" else f"independent of {test['input']}"
    return ResidualTestView(
        experiment=test["experiment"] + 1,
        output=test["output"],
        hypothesis=what,
        inside95=_format_percent(test.get("inside95")),
        inside99=_format_percent(test.get("inside99")),
        p=format_p_value(test.get("p")),
        outcome=test["outcome"],
        reason=test.get("reason") or "",
    )


def _format_percent(part: float | None) -> str:
    return DASH if part is None else f"{100 * part:.0f}\u202f%"


def _to_onset_view(onset: Document, several: bool) -> OnsetView:
    where = f", experiment {onset['experiment'] + 1}" if several else ""
    pair = f"{onset['output']} behind {onset['input']}{where}"
    if onset["delay"] is None:
        return OnsetView(pair, "", onset.get("reason") or "")
    value, spread = format_estimate(onset["delay"], onset.get("spread"))
    value = value if spread else format_number(onset["delay"])
    steps = "one step" if onset["events"] == 1 else f"{onset['events']} steps"
    scatter = f", spread {spread}\u202fs" if spread else ""
    return OnsetView(pair, f"{value}\u202fs", f"{steps}{scatter}")


def _describe_search(search: Document) -> str:
    """Describe how far the search is to be trusted; empty for a result that does not say."""
    if not search:
        return ""
    starts = f"{search['agreeing_starts']} of {search['independent_starts']}"
    verdict = {
        "starts": "settled",
        "residuals": "settled, as nothing but noise is left",
        None: "not settled",
    }[search["because"]]
    return f"{verdict}; {starts} independent starts ended here"


def _format_group(group: Document) -> str:
    where = " near the estimate" if group.get("is_local") else ""
    return f"{group['expression']} = {join_estimate(group['value'], group.get('stderr'))}{where}"
