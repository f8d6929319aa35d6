"""Settling: whether something shows that no better minimum was missed."""

from dataclasses import replace

import pytest

from sysid.core.findings import Finding
from sysid.core.settings import GeneticAlgorithm
from sysid.identifiability.active_bounds import ActiveBound
from sysid.judgement.settling import find_rough_end, find_unsettled
from sysid.results.parts import SearchEvidence
from sysid.uncertainty.estimates import Estimate

LAG = Estimate("L", "s", 0.5, 0.0, 5.0, 0.01, (0.48, 0.52), "identified")
GAIN, FIXED = replace(LAG, name="K"), replace(LAG, name="T", status="fixed")


def find_end(
    gain: float = 0.0,
    algorithm: GeneticAlgorithm | None = None,
    *,
    cut: bool = False,
    lacks: bool = False,
) -> list[Finding]:
    settings = algorithm or GeneticAlgorithm()
    return list(find_rough_end(settings, gain, is_cut_short=cut, lacks_neighbours=lacks))


def test_a_search_that_settled_is_no_finding() -> None:
    assert list(find_unsettled(SearchEvidence(True, "starts", 8, 8), [LAG])) == []
    assert list(find_unsettled(SearchEvidence(True, "residuals", 0, 0), [LAG])) == []


def test_a_search_that_did_not_settle_leaves_no_free_estimate_settled() -> None:
    (found,) = find_unsettled(SearchEvidence(False, None, 6, 1), [GAIN, FIXED, LAG])
    assert (found.brief, found.severity, found.status) == (
        "not settled",
        "serious",
        "not settled",
    )
    assert found.parameters == ("K", "L")
    assert "1 of 6 independent starts ended in the best minimum" in found.text
    assert "bound" not in found.text
    assert found.reason
    assert "another seed" in found.advice


def test_a_search_without_independent_starts_says_so() -> None:
    (found,) = find_unsettled(SearchEvidence(False, None, 0, 0), [LAG])
    assert "it made no independent starts" in found.text


def test_bounds_that_are_the_cause_are_named_and_looked_for_only_then() -> None:
    bound = ActiveBound("L", "upper", 5.0, "s", 0.5)
    (found,) = find_unsettled(SearchEvidence(False, None, 6, 1), [GAIN, LAG], lambda: [bound])
    assert "Bounds are the cause: L is at its upper bound 5 s." in found.text

    def refuse() -> tuple[ActiveBound, ...]:
        raise AssertionError

    assert list(find_unsettled(SearchEvidence(True, "starts", 8, 8), [LAG], refuse)) == []


def test_an_optimum_is_no_finding() -> None:
    assert find_end() == []
    assert find_end(0.009) == []


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (find_end(cut=True), "the time limit ended least squares"),
        (find_end(lacks=True), "no search for minima near the estimate"),
        (find_end(0.4), "would remove 40 % of the squared error"),
        (find_end(0.4, GeneticAlgorithm(method="simple")), "(simple: as found)"),
    ],
)
def test_what_is_no_optimum_is_a_note(found: list[Finding], words: str) -> None:
    (one,) = found
    assert one.severity == "note"
    assert words in one.text


def test_an_improved_search_is_not_said_to_be_as_found() -> None:
    (one,) = find_end(0.4)
    assert "as found" not in one.text
