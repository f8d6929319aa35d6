"""Conclusions from findings: the statuses of estimates, the verdict, and the warnings.

All that is said of a result follows from its findings here, and from nothing else. More findings
never make a verdict milder, nor a status.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import exp, log
from typing import TYPE_CHECKING

from sysid.core.findings import EstimateStatus, Finding, Severity, note
from sysid.core.text import join_names, plain_estimate, plain_unit
from sysid.judgement.levels import DEFECT_GAIN, NOTABLE_MOVE
from sysid.results.verdict import Verdict
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.intervals import (
    Alternative,
    Mixture,
    compose_interval,
    keep_in_bounds,
)

if TYPE_CHECKING:
    from sysid.results.identification import Identification

_MOST_GAIN = 100.0  # that tells from a larger one: the odds are beyond any doubt
_MOST_REASONS = 2  # of an estimate, and in a verdict

_SEVERITIES: tuple[Severity, ...] = ("serious", "caution", "note")
_OF_RECORD = (
    "constant output",
    "constant input",
    "change of a unit",
    "exchanged channels",
    "feedback",
)  # then nothing else says anything
_FAILURES = ("constant", "little fit", "straight line")
_LACKS = ("no information", "combination", "bound", "other minimum", "no time lag")
"""What the data do not tell. What is known of the record, and of its noise, may be why."""
_RANKS: tuple[EstimateStatus, ...] = (
    "identified",
    "dependent",
    "ambiguous",
    "not settled",
    "refuted",
)
"""Statuses that findings give, the mildest first; others come from the analysis of the data."""


def order_findings(findings: Iterable[Finding], samples: float = 0.0) -> tuple[Finding, ...]:
    """Order findings: explanations with a clear gain, then what is severe, then notes.

    Explanations of what the model leaves come before those of its noise. A cause comes before what
    follows from it: how the record was made and what its noise is like before what it does not
    tell. If the model fails, an explanation that takes less than half of the residuals' variance,
    of so many samples, is not why. Within each group the largest gain is first; what is not
    compared follows in its order.
    """
    listed = list(findings)
    fails = any(one.severity == "serious" and one.explanation in _FAILURES for one in listed)
    least = max(DEFECT_GAIN, log(2.0) * samples if fails else 0.0)
    return tuple(
        sorted(
            listed, key=lambda one: (_find_group(one, least), one.gain is None, -(one.gain or 0.0))
        )
    )


def _find_group(finding: Finding, least: float) -> int:
    """Find the group of a finding: its place in this list."""
    is_clear = finding.gain is not None and finding.gain > least
    is_lack = finding.explanation in _LACKS and finding.severity == "caution"
    groups = (
        finding.explanation in _OF_RECORD,
        is_clear and not finding.is_of_noise,
        finding.severity == "serious",
        finding.severity == "caution" and not is_lack,
        is_clear,
        is_lack,
        True,
    )
    return groups.index(True)


def conclude_estimates(
    estimates: Sequence[Estimate], findings: Sequence[Finding]
) -> tuple[Estimate, ...]:
    """Conclude the status of each estimate from the findings that make it doubtful."""
    return tuple(_conclude_estimate(estimate, findings) for estimate in estimates)


def _conclude_estimate(estimate: Estimate, findings: Sequence[Finding]) -> Estimate:
    against = [one for one in findings if _is_against(one, estimate)]
    if not against or estimate.status not in _RANKS:
        return estimate
    statuses = (estimate.status, *(one.status for one in against))
    known = "" if estimate.status == "identified" else estimate.reason
    found = [_explain(estimate, one) for one in against if one.status != estimate.status]
    reasons = dict.fromkeys(reason for reason in (known, *found) if reason)
    marked = replace(
        estimate,
        status=max(statuses, key=_RANKS.index),
        reason="; ".join(list(reasons)[:_MOST_REASONS]),
    )
    return marked if marked.status == "identified" else _average(marked, against)


def _average(estimate: Estimate, against: Sequence[Finding]) -> Estimate:
    """Extend the interval to the mixture over the explanations that move an estimate.

    Each has the weight of its odds against the model alone (Hoeting et al. 1999). A value beyond
    the bounds is too far for a linear step, and says no more than that it is elsewhere.
    """
    others = [
        Alternative(exp(0.5 * min(one.gain, _MOST_GAIN)), move.value, move.stderr)
        for one in against
        for move in one.moves
        if move.parameter == estimate.name
        and one.gain is not None
        and move.stderr
        and estimate.lower <= move.value <= estimate.upper
    ]
    if not others or not estimate.stderr:
        return estimate
    own = Alternative(1.0, estimate.value, estimate.stderr)
    return keep_in_bounds([compose_interval(estimate, Mixture((own, *others)))])[0]


def _is_against(finding: Finding, estimate: Estimate) -> bool:
    """Whether a finding makes an estimate doubtful; a serious one without names does all."""
    if finding.severity == "note" or finding.status not in _RANKS:
        return False
    is_for_all = finding.severity == "serious" and not finding.parameters
    return estimate.name in finding.parameters or (is_for_all and estimate.is_free)


def _explain(estimate: Estimate, finding: Finding) -> str:
    if finding.reason:
        return finding.reason
    move = next((one for one in finding.moves if one.parameter == estimate.name), None)
    if move is None or abs(move.stderrs) <= NOTABLE_MOVE or not estimate.may_be(move.value):
        return finding.brief
    value = f"{plain_estimate(move.value, move.stderr)}{plain_unit(estimate.unit)}"
    return f"it is {value} if {finding.brief}"


def conclude_verdict(
    estimates: Sequence[Estimate], findings: Sequence[Finding], declared: Iterable[str]
) -> Verdict:
    """Conclude the verdict from findings in their order, and from the statuses that they gave.

    A result is not trustworthy if a finding says so, or if findings leave none of the parameters
    that the model declares identified. The text names the first two causes of doubt.

    Examples
    --------
    >>> lag = Estimate("L", "s", 0.52, 0.0, 5.0, 0.01, (0.50, 0.54), "identified")
    >>> conclude_verdict([lag], [], ["L"]).text
    'trustworthy'
    >>> moved = Finding("order", "structure", "caution", "the data prefer sopdt", "", "", 30.0, (),
    ...                 ("L",))
    >>> gain = replace(lag, name="K")
    >>> conclude_verdict([gain, replace(lag, status="dependent")], [moved], ["K", "L"]).text
    'trustworthy but for L: the data prefer sopdt'
    """
    severe = [one for one in findings if one.severity != "note"]
    if not severe:
        return Verdict("trustworthy", "trustworthy")
    cause = ", and ".join(_list_causes(findings[0], severe))
    is_serious = any(one.severity == "serious" for one in severe)
    names = set(declared)
    free = [one for one in estimates if one.is_free and one.name in names]
    doubtful = [one.name for one in free if one.status != "identified"]
    if is_serious or (free and len(doubtful) == len(free)):
        text = cause if cause.startswith("not ") else f"not trustworthy: {cause}"
        return Verdict("not trustworthy", text)
    but = f" but for {join_names(doubtful)}:" if doubtful else ", but"
    return Verdict("limited", f"trustworthy{but} {cause}")


def _list_causes(first: Finding, severe: Sequence[Finding]) -> list[str]:
    """List the briefs that a verdict names: the likeliest cause of doubt, and one more.

    That is the most severe one, then a note that explains the data better, then the next. That the
    model fails is named once.
    """
    failures = [one for one in severe if one.explanation in _FAILURES]
    told = [one for one in severe if one not in failures[1:]]
    worst = min(told, key=lambda one: _SEVERITIES.index(one.severity))
    notes = [first] if first.severity == "note" else []
    return list(dict.fromkeys(one.brief for one in (told[0], worst, *notes, *told)))[:_MOST_REASONS]


def add_reading_notes(found: "Identification", texts: Sequence[str]) -> "Identification":
    """Add to a result what was noted when its recording was read, after what was found."""
    notes = [note("recording", "record", text) for text in texts]
    return replace(found, findings=(*found.findings, *notes), warnings=(*found.warnings, *texts))


def list_warnings(findings: Sequence[Finding]) -> tuple[str, ...]:
    """List the sentences of all findings, in their order."""
    return tuple(dict.fromkeys(one.sentences for one in findings))
