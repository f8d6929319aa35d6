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
    if estimate.status not in _RANKS:
        return estimate
    against = [one for one in findings if estimate.name in one.parameters and one.status in _RANKS]
    if not against:
        return estimate
    status = max((one.status for one in against), key=_RANKS.index)
    if _RANKS.index(status) <= _RANKS.index(estimate.status):
        return estimate
    first = next(one for one in against if one.status == status)
    return replace(estimate, status=status, reason=_explain(estimate, first))


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
    that the model declares identified.

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
    names = set(declared)
    free = [one for one in estimates if one.is_free and one.name in names]
    doubtful = [one.name for one in free if one.status != "identified"]
    if first.severity == "serious" or (free and len(doubtful) == len(free)):
        brief = first.brief
        text = brief if brief.startswith("not ") else f"not trustworthy: {brief}"
        return Verdict("not trustworthy", text)
    but = f" but for {join_names(doubtful)}:" if doubtful else ", but"
    return Verdict("limited", f"trustworthy{but} {first.brief}")


def list_warnings(findings: Sequence[Finding]) -> tuple[str, ...]:
    """List the sentences of all findings, in their order."""
    return tuple(dict.fromkeys(one.sentences for one in findings))
