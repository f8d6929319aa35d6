"""Views of diagnostics for the pages: residual tests, onset delays, information criteria."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from service.core.text import DASH, format_estimate, format_number, format_p_value, join_estimate
from service.figures.data import CorrelationTrace
from service.figures.plotly import Figure
from service.figures.residuals import plot_residuals
from service.runs.residuals import ResidualAnalysis
from sysid.residuals.residual_tests import CorrelationFunction

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
    selection: Sequence[SelectedTermView] = ()


def to_diagnostics(result: Document) -> Diagnostics:
    """Build the diagnostics from a result document; it is empty until the run ends."""
    tested = result.get("residual_tests", {})
    tests = tested.get("tests", [])
    onsets = result.get("onset_delays", [])
    groups = result.get("identifiability", {}).get("groups", [])
    several = len({one["experiment"] for one in onsets}) > 1
    verdicts = {True: "passed", False: "failed", None: "not tested"}
    return Diagnostics(
        verdict=verdicts[tested["passed"]] if tests else "",
        data=tested.get("data", ""),
        tests=[_to_test_view(one) for one in tests],
        n_figures=sum(one["experiment"] == 0 and one["outcome"] != "not tested" for one in tests),
        onsets=[_to_onset_view(one, several) for one in onsets],
        groups=[_format_group(one) for one in groups],
        criteria=result.get("criteria", {}),
        selection=[
            SelectedTermView(
                one["term"],
                format_number(one["err"]),
                format_number(max(1.0 - one["cumulated"], 0.0)),
            )
            for one in result.get("selection", ())
        ],
    )


def to_correlation_trace(one: CorrelationFunction) -> CorrelationTrace:
    """Convert a correlation function to the data of its figure."""
    test = one.test
    of = "" if test.input is None else f" with {test.input}"
    kind = "autocorrelation" if test.input is None else "correlation"
    title = f"{kind} of the residual of {test.output}{of}: {test.outcome}"
    return CorrelationTrace(
        title, test.input is None, one.period, one.lags, one.values, one.band95, one.band99
    )


def plot_residual_tests(tested: ResidualAnalysis, experiment: int, columns: int = 2) -> Figure:
    """Draw the residual correlations of one experiment; empty if none was tested."""
    functions = [
        to_correlation_trace(one)
        for one in tested.correlations
        if one.test.experiment == experiment and one.values.size
    ]
    return plot_residuals(functions, columns, tested.experiments)


def _to_test_view(one: Document) -> ResidualTestView:
    what = "white" if one["test"] == "whiteness" else f"independent of {one['input']}"
    return ResidualTestView(
        experiment=one["experiment"] + 1,
        output=one["output"],
        hypothesis=what,
        inside95=_format_percent(one.get("inside95")),
        inside99=_format_percent(one.get("inside99")),
        p=format_p_value(one.get("p")),
        outcome=one["outcome"],
        reason=one.get("reason") or "",
    )


def _format_percent(part: float | None) -> str:
    return DASH if part is None else f"{100 * part:.0f}\u202f%"


def _to_onset_view(one: Document, several: bool) -> OnsetView:
    where = f", experiment {one['experiment'] + 1}" if several else ""
    pair = f"{one['output']} behind {one['input']}{where}"
    if one["delay"] is None:
        return OnsetView(pair, "", one.get("reason") or "")
    value, spread = format_estimate(one["delay"], one.get("spread"))
    steps = "one step" if one["events"] == 1 else f"{one['events']} steps"
    scatter = f", spread {spread}\u202fs" if spread else ""
    return OnsetView(pair, f"{value}\u202fs", f"{steps}{scatter}")


def _format_group(one: Document) -> str:
    return f"{one['expression']} = {join_estimate(one['value'], one.get('stderr'))}"
