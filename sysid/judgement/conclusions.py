"""Conclusions from findings: the statuses of estimates, the verdict, and the warnings.

All that is said of a result follows from its findings here, and from nothing else. More findings
never make a verdict milder, nor a status.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

from sysid.core.text import join_names, plain_estimate, plain_unit
from sysid.judgement.levels import NOTABLE_MOVE
from sysid.results.findings import Finding, Severity
from sysid.results.verdict import Verdict
from sysid.uncertainty.estimates import Estimate, EstimateStatus

_MOST_REASONS = 2  # of an estimate, and in a verdict

_SEVERITIES: tuple[Severity, ...] = ("serious", "caution", "note")
_RANKS: tuple[EstimateStatus, ...] = (
    "identified",
    "dependent",
    "ambiguous",
    "not settled",
    "refuted",
)
"""Statuses that findings give, the mildest first; others come from the analysis of the data."""


def order_findings(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Order findings: the most severe first, and among these the largest gain.

    Findings that nothing is compared for follow those with a gain, in their order.
    """
    return tuple(
        sorted(
            findings,
            key=lambda one: (
                _SEVERITIES.index(one.severity),
                one.gain is None,
                -(one.gain or 0.0),
            ),
        )
    )


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
    return replace(
        estimate,
        status=max(statuses, key=_RANKS.index),
        reason="; ".join(list(reasons)[:_MOST_REASONS]),
    )


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
    if move is None or abs(move.stderrs) <= NOTABLE_MOVE:
        return finding.brief
    value = f"{plain_estimate(move.value, move.stderr)}{plain_unit(estimate.unit)}"
    return f"it is {value} if {finding.brief}"


def conclude_verdict(
    estimates: Sequence[Estimate], findings: Sequence[Finding], declared: Iterable[str]
) -> Verdict:
    """Conclude the verdict from findings in their order, and from the statuses that they gave.

    A result is not trustworthy if a finding says so, or if findings leave none of the parameters
    that the model declares identified. The text names the first of the most severe findings.

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
    first = findings[0] if findings else None
    if first is None or first.severity == "note":
        return Verdict("trustworthy", "trustworthy")
    briefs = dict.fromkeys(one.brief for one in findings if one.severity == first.severity)
    brief = "; ".join(list(briefs)[:_MOST_REASONS])
    names = set(declared)
    free = [one for one in estimates if one.is_free and one.name in names]
    doubtful = [one.name for one in free if one.status != "identified"]
    if first.severity == "serious" or (free and len(doubtful) == len(free)):
        is_told = brief.startswith("not ")
        return Verdict("not trustworthy", brief if is_told else f"not trustworthy: {brief}")
    but = f" but for {join_names(doubtful)}:" if doubtful else ", but"
    return Verdict("limited", f"trustworthy{but} {brief}")


def list_warnings(findings: Sequence[Finding]) -> tuple[str, ...]:
    """List the sentences of all findings, in their order."""
    return tuple(dict.fromkeys(one.sentences for one in findings))
