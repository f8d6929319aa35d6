"""Determination: what the data do not tell of single parameters, and bounds that hold them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.findings import EstimateStatus, Finding
from sysid.identifiability.active_bounds import ActiveBound
from sysid.identifiability.combinations import IdentifiableCombination
from sysid.judgement.determination import find_ambiguous, find_undetermined
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis
from sysid.uncertainty.estimates import Criteria, Estimate, Uncertainty
from tests.support.library.judged_records import (
    FAST,
    NOISE,
    N,
    build_context,
    draw_levels,
    draw_noise,
    draw_record,
    make_record,
)
from tests.support.library.small_models import LINE

SOUND = Problem.build(load_model("fopdt"), [draw_record(FAST, 1)])


def make_estimate(
    name: str, status: EstimateStatus = "identified", *, value: float = 0.5, reason: str = ""
) -> Estimate:
    interval = (value - 0.02, value + 0.02)
    return Estimate(name, "s", value, 0.0, 5.0, 0.01, interval, status, reason)


def find(
    *estimates: Estimate,
    problem: Problem = SOUND,
    are_noise: bool = True,
    correlation: float = 0.0,
    groups: tuple[IdentifiableCombination, ...] = (),
    bounds: tuple[Any, ...] = (),
    limits: str = "",
) -> list[Finding]:
    d = len(estimates)
    matrix = np.full((d, d), correlation)
    np.fill_diagonal(matrix, 1.0)
    uncertainty = Uncertainty(
        tuple(one.name for one in estimates),
        np.zeros((d, d)),
        matrix,
        matrix,
        1.0,
        np.ones(d),
        0.0,
        groups,
    )
    analysis = Analysis(estimates, uncertainty, 0.0, 0, Criteria(0.0, 0.0, 0.0, 9, 1))
    analysis = replace(analysis, active_bounds=bounds, limits=frozenset(limits))
    return list(find_undetermined(problem, analysis, {"L"}, are_residuals_noise=are_noise))


K, T, L = (make_estimate(name) for name in "KTL")


def test_what_the_data_determine_is_no_finding() -> None:
    assert find(K, T, L) == []


def test_a_value_that_the_data_do_not_determine_is_named_with_its_reason() -> None:
    (found,) = find(K, replace(T, status="unidentifiable", reason="no effect"), L)
    assert found.parameters == ("T",)
    assert found.status == "unidentifiable"
    assert found.brief == "the data do not determine T"
    assert "T: no effect" in found.text
    assert "Fix it" in found.advice


def test_values_that_are_determined_together_are_named_with_the_combination() -> None:
    both = [make_estimate(name, "group", reason=f"of {name}") for name in "abc"]
    groups = [IdentifiableCombination(("a", "b"), "a*b", 1.0, 0.1)]
    groups += [IdentifiableCombination(("a", "c"), "a*c", 1.0, 0.1, is_local=True)]
    (found,) = find(K, *both, groups=tuple(groups))
    assert found.parameters == ("a", "b", "c")
    assert found.text.endswith(": a*b, a*c (near the estimate).")
    assert found.brief == "the data determine a, b and c only in combination"


@pytest.mark.parametrize(("are_noise", "severity"), [(True, "caution"), (False, "caution")])
def test_an_estimate_at_its_bound_is_a_caution(are_noise: bool, severity: str) -> None:
    (found,) = find(K, make_estimate("L", "at bound", value=5.0), are_noise=are_noise)
    assert (found.severity, found.parameters) == (severity, ("L",))
    assert found.brief == "L lies at its bound"
    assert "L lies at its upper bound 5 s" in found.text
    low = find(K, make_estimate("L", "at bound", value=0.0))[0]
    assert "L lies at its lower bound 0 s" in low.text


def test_a_bound_that_the_data_push_against_is_serious_beside_residuals_that_are_no_noise() -> None:
    pushed = ActiveBound("L", "upper", 5.0, "s", 0.5)
    bounded = make_estimate("L", "at bound", value=5.0)
    (quiet,) = find(K, bounded, bounds=(pushed,))
    (found,) = find(K, bounded, bounds=(pushed,), are_noise=False)
    assert (quiet.severity, found.severity) == ("caution", "serious")
    assert "raise the bound of L" in found.advice
    assert "which the bound may cause" in found.text


@pytest.mark.parametrize(("level", "followers"), [(3.0, ("b",)), (0.0, ())])
def test_what_moves_without_a_bound_that_is_pushed_follows_it(
    level: float, followers: tuple[str, ...]
) -> None:
    """Offset and slope share their effect where the input has a mean, and only there."""
    u = draw_levels(1)
    u = u - float(np.mean(u)) + level
    document = LINE | {"parameters": LINE["parameters"] | {"a": {"lower": -1.0, "upper": 2.0}}}
    record = make_record(u, 2.1 * u + 1.0 + NOISE * draw_noise(1))
    context = build_context([record], parse_model(document), {"a": 2.0, "b": 1.0})
    (found,) = (
        one
        for one in find_undetermined(
            context.problem, context.analysis, set(), are_residuals_noise=False
        )
        if one.explanation == "bound"
    )
    assert found.parameters == ("a", *followers)
    assert ("b follows it" in found.text) == bool(followers)


def test_of_two_at_their_bounds_none_follows_the_other() -> None:
    """Only one is listed by what the data push, and each is named once."""
    u = draw_levels(1)
    u = u - float(np.mean(u)) + 3.0
    bounds = {"a": {"lower": -1.0, "upper": 2.0}, "b": {"lower": -1.0, "upper": 1.2}}
    document = LINE | {"parameters": LINE["parameters"] | bounds}
    record = make_record(u, 2.1 * u + 1.0 + NOISE * draw_noise(1))
    context = build_context([record], parse_model(document), {"a": 2.0, "b": 1.2})
    pushed = ActiveBound("a", "upper", 2.0, "1", 0.5)
    analysis = replace(context.analysis, active_bounds=(pushed,))
    assert [one.status for one in analysis.estimates] == ["at bound", "at bound"]
    found = find_undetermined(context.problem, analysis, set(), are_residuals_noise=False)
    (bound,) = (one for one in found if one.explanation == "bound")
    assert sorted(bound.parameters) == ["a", "b"]
    assert "b follows" not in bound.text


def test_a_bound_that_may_be_a_physical_limit_is_told_with_the_setting_that_says_so() -> None:
    (low,) = find(K, make_estimate("L", "at bound", value=0.0))
    assert low.advice.endswith(
        "or set parameters: {L: {physical: lower}} if it is a physical limit."
    )
    (high,) = find(K, make_estimate("L", "at bound", value=5.0))
    assert "set parameters: {L: {upper: 5, physical: upper}} if" in high.advice
    both = find(*(make_estimate(name, "at bound", value=5.0) for name in "KL"))[0]
    assert "{K: {upper: 5, physical: upper}} and parameters: {L: {upper" in both.advice
    assert both.advice.endswith("if they are physical limits.")


def test_an_estimate_at_a_physical_limit_is_a_note_unless_the_data_pull_it_over() -> None:
    (held,) = find(K, make_estimate("T", value=5.0), limits="T")
    assert (held.severity, held.parameters) == ("note", ("T",))
    assert held.sentences == "T lies at its upper bound 5 s, a limit of the quantity"
    pulled = make_estimate("T", "at bound", value=5.0)
    (quiet,) = find(K, pulled, limits="T")
    (found,) = find(K, pulled, limits="T", are_noise=False)
    assert (quiet.severity, found.severity) == ("caution", "serious")
    assert found.brief == "the data pull T over its physical limit"
    assert "idden" not in found.sentences
    grouped = make_estimate("T", "group", value=5.0)
    assert "bound" not in [one.explanation for one in find(K, grouped, limits="T")]


def test_a_lag_within_two_errors_of_0_may_be_0() -> None:
    (found,) = find(K, T, replace(make_estimate("L", value=0.015)))
    assert (found.severity, found.brief) == ("caution", "L may be 0")
    assert find(K, T, make_estimate("L", value=0.025)) == []


def test_other_values_no_larger_than_their_error_are_a_note_if_they_have_one_sign() -> None:
    (found,) = find(make_estimate("K", value=0.008), T, L)
    assert found.severity == "note"
    assert "the standard error of K" in found.text
    either = replace(make_estimate("K", value=0.008), lower=-5.0)
    assert find(either, T, L) == []


def test_a_lag_near_0_on_a_ridge_is_said_to_share_its_effect() -> None:
    near = make_estimate("L", value=0.015)
    explanations = [one.explanation for one in find(K, T, near, correlation=0.95)]
    assert explanations.count("ridge") == 2
    assert "ridge" not in [one.explanation for one in find(K, T, near, correlation=0.5)]
    assert find(K, T, L, correlation=0.95) == []


def test_a_constant_input_names_what_it_leaves_open() -> None:
    still = make_record(np.full(N, 2.0), np.linspace(0.0, 1.0, N))
    problem = Problem.build(load_model("fopdt"), [still])
    open_ones = (K, replace(T, status="unidentifiable"), replace(L, status="group"))
    found = [one for one in find(*open_ones, problem=problem) if one.family == "record"]
    assert [one.brief for one in found] == ["u is constant"]
    assert found[0].text.endswith("unidentified: T, L.")
    assert not any(one.family == "record" for one in find(K, T, L, problem=problem))
    assert not any(one.family == "record" for one in find(*open_ones))
    moving = Problem.build(load_model("fopdt"), [still, draw_record(FAST, 1)])
    assert not any(one.family == "record" for one in find(*open_ones, problem=moving))


def test_values_of_other_minima_are_ambiguous() -> None:
    assert list(find_ambiguous([K, T, L])) == []
    (found,) = find_ambiguous([K, make_estimate("L", "ambiguous", reason="0.9 s fits as well")])
    assert (found.status, found.parameters) == ("ambiguous", ("L",))
    assert "L: 0.9 s fits as well" in found.text
    assert found.brief == "another value of L fits as well"


def test_fixed_parameters_are_never_doubtful() -> None:
    fixed = make_estimate("T", "fixed", value=0.0)
    assert find(K, fixed, L) == []
