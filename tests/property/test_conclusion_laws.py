"""Laws of conclusions: more findings never make a verdict or a status milder."""

from dataclasses import replace
from typing import get_args

from hypothesis import given
from hypothesis import strategies as st

from sysid.core.findings import EstimateStatus, Finding, Move, Severity
from sysid.judgement.conclusions import (
    conclude_estimates,
    conclude_verdict,
    list_warnings,
    order_findings,
)
from sysid.judgement.levels import DEFECT_GAIN
from sysid.results.verdict import Trust, Verdict
from sysid.uncertainty.estimates import Estimate

NAMES = ("K", "T", "L")
TRUSTS: tuple[Trust, ...] = get_args(Trust)
"""The mildest first."""
SEVERITIES: tuple[Severity, ...] = ("serious", "caution", "note")
STATUSES: tuple[EstimateStatus, ...] = get_args(EstimateStatus)
GIVEN: tuple[EstimateStatus, ...] = (
    "identified",
    "dependent",
    "ambiguous",
    "not settled",
    "refuted",
)
"""Statuses that findings give, the mildest first."""

GAIN = st.none() | st.floats(-50, 500)
MOVE = st.builds(Move, st.sampled_from(NAMES), st.floats(0, 5), st.just(0.01), st.floats(-9, 9))


@st.composite
def draw_findings(draw: st.DrawFn, least: int = 0) -> list[Finding]:
    """Draw findings of distinct words."""
    count = draw(st.integers(least, 6))
    return [
        Finding(
            f"explanation {number}",
            "structure",
            draw(st.sampled_from(SEVERITIES)),
            f"brief {number}",
            f"text {number}.",
            "",
            draw(GAIN),
            tuple(draw(st.lists(MOVE, max_size=3))),
            tuple(draw(st.sets(st.sampled_from(NAMES)))),
            draw(st.sampled_from(STATUSES)),
            draw(st.sampled_from(("", f"reason {number}"))),
        )
        for number in range(count)
    ]


ESTIMATES = st.tuples(*(st.sampled_from(STATUSES) for _ in NAMES)).map(
    lambda statuses: [
        Estimate(name, "s", 0.5, 0.0, 5.0, 0.01, (0.48, 0.52), status)
        for name, status in zip(NAMES, statuses, strict=True)
    ]
)


def conclude(
    estimates: list[Estimate], findings: list[Finding]
) -> tuple[tuple[Estimate, ...], Verdict]:
    ordered = order_findings(findings)
    concluded = conclude_estimates(estimates, ordered)
    return concluded, conclude_verdict(concluded, ordered, NAMES)


def rank(estimate: Estimate) -> int:
    return GIVEN.index(estimate.status) if estimate.status in GIVEN else -1


@given(ESTIMATES, draw_findings(least=1), st.data())
def test_no_finding_makes_a_verdict_or_a_status_milder(
    estimates: list[Estimate], findings: list[Finding], data: st.DataObject
) -> None:
    fewer = [one for one in findings if data.draw(st.booleans())]
    before, milder = conclude(estimates, fewer)
    after, verdict = conclude(estimates, findings)
    assert TRUSTS.index(verdict.trust) >= TRUSTS.index(milder.trust)
    for old, new in zip(before, after, strict=True):
        assert rank(new) >= rank(old)


@given(ESTIMATES, draw_findings(), st.data())
def test_the_order_of_findings_does_not_matter(
    estimates: list[Estimate], findings: list[Finding], data: st.DataObject
) -> None:
    shuffled = data.draw(st.permutations(findings))
    one, other = conclude(estimates, findings), conclude(estimates, shuffled)
    assert one[1].trust == other[1].trust
    assert [e.status for e in one[0]] == [e.status for e in other[0]]
    gains = [(finding.severity, finding.gain) for finding in findings]
    if len({*gains}) == len(gains):
        assert one == other


@given(ESTIMATES, draw_findings(least=1))
def test_a_verdict_names_the_largest_clear_gain_and_the_most_severe_doubt(
    estimates: list[Estimate], findings: list[Finding]
) -> None:
    _, verdict = conclude(estimates, findings)
    severe = [one for one in findings if one.severity != "note"]
    if not severe:
        assert verdict == Verdict("trustworthy", "trustworthy")
        return
    briefs = verdict.text.rpartition(": ")[2].rpartition("but ")[2].split(", and ")
    named = [one for brief in briefs for one in findings if one.brief == brief]
    assert len(named) == len(briefs) == min(len(severe) + has_clear_note(findings), 2)
    clear = [one for one in severe if (one.gain or 0.0) > DEFECT_GAIN]
    worst = min((one.severity for one in severe), key=SEVERITIES.index)
    first = max(
        clear or [one for one in severe if one.severity == worst],
        key=lambda one: float("-inf") if one.gain is None else one.gain,
    )
    assert named[0].gain == first.gain
    assert worst in {one.severity for one in named}
    assert (verdict.trust == "not trustworthy") >= (worst == "serious")


def has_clear_note(findings: list[Finding]) -> bool:
    """Whether a note explains the data better than all else."""
    clear = [one for one in findings if (one.gain or 0.0) > DEFECT_GAIN]
    return bool(clear) and max(clear, key=lambda one: one.gain or 0.0).severity == "note"


@given(ESTIMATES, draw_findings())
def test_statuses_and_verdict_do_not_contradict_each_other(
    estimates: list[Estimate], findings: list[Finding]
) -> None:
    concluded, verdict = conclude(estimates, findings)
    for old, new in zip(estimates, concluded, strict=True):
        assert old.status in GIVEN or new == old  # what the data alone say stays
        if new != old:
            assert verdict.trust != "trustworthy"
            assert old.status != "identified" or new.reason
            kept = replace(new, status=old.status, reason=old.reason, interval95=old.interval95)
            assert kept == old
            assert old.interval95 is not None
            assert new.interval95 is not None
            assert new.interval95[0] <= old.interval95[0] < old.interval95[1] <= new.interval95[1]
    if verdict.trust == "limited":
        doubtful = [one for one in concluded if one.is_free and one.status != "identified"]
        assert all(one.name in verdict.text.split(":")[0] for one in doubtful)
    if any(one.severity == "serious" and not one.parameters for one in findings):
        given_status = {one.status for one in findings if one.severity == "serious"}
        if given_status <= {*GIVEN[1:]}:
            assert not any(one.status == "identified" for one in concluded)


@given(draw_findings())
def test_every_finding_is_told_once(findings: list[Finding]) -> None:
    told = list_warnings(order_findings(findings))
    assert sorted(told) == sorted(one.sentences for one in findings)
