"""Coefficients that depend on which terms were selected: status, reason and verdict."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.judgement.conclusions import conclude_estimates, conclude_verdict
from sysid.judgement.open_terms import find_open_terms
from sysid.models.model import Model, SelectedTerm, Selection
from sysid.models.parse import parse_model
from sysid.uncertainty.estimates import Estimate
from tests.support.library.polynomials import TRUTH, document, frols, record_of

SMALL = GeneticAlgorithm(generations=40)


def estimate(name: str, status: str = "identified") -> Estimate:
    return Estimate(name, "1", 0.5, -2.0, 2.0, 0.01, (0.48, 0.52), status)  # type: ignore[arg-type]


def select(*terms: SelectedTerm) -> Model:
    return replace(parse_model(document(["y(k-1)", "u(k-1)"])), selection=Selection(terms))


def judge(estimates: tuple[Estimate, ...], model: Model) -> tuple[Estimate, ...]:
    return conclude_estimates(estimates, list(find_open_terms(estimates, model)))


CERTAIN = SelectedTerm("y(k-1)", 0.9, 0.9, 0.5, 0.999, 0.95, "")
UNLIKELY = SelectedTerm("u(k-1)", 0.01, 0.91, 0.5, 0.2, 0.19, "without it")
MOVED = SelectedTerm("u(k-1)", 0.01, 0.91, 0.5, 0.99, 0.6, "with u(k-2) besides")


def test_a_term_that_may_not_belong_to_the_model_is_not_identified() -> None:
    before = (estimate("a[y(k-1)]"), estimate("a[u(k-1)]"), estimate("dk"))
    first, second, lag = judge(before, select(CERTAIN, UNLIKELY))
    assert (first, lag) == (before[0], before[2])
    assert second.status == "dependent"
    assert "probability of 20 %" in second.reason
    assert "without it" in second.reason


def test_a_coefficient_that_other_selections_move_is_not_identified() -> None:
    [one] = judge((estimate("a[u(k-1)]"),), select(MOVED))
    assert one.status == "dependent"
    assert "holds in 60 %" in one.reason
    assert "with u(k-2) besides" in one.reason


def test_what_is_not_identified_for_another_reason_keeps_it() -> None:
    before = (estimate("a[u(k-1)]", "at bound"),)
    assert judge(before, select(UNLIKELY)) == before
    assert judge(before, parse_model(document("all"))) == before


def test_the_verdict_counts_them_and_tells_why() -> None:
    before = (estimate("a[y(k-1)]"), estimate("a[u(k-1)]"))
    findings = list(find_open_terms(before, select(CERTAIN, UNLIKELY)))
    after = conclude_estimates(before, findings)
    verdict = conclude_verdict(after, findings, ["a[y(k-1)]", "a[u(k-1)]"])
    assert verdict.trust == "limited"
    assert "1 of 2 coefficients depends on the selection of terms" in verdict.text
    assert "without it" in findings[0].text


@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("rule", [{"criterion": "bic"}, {}, {"error": "one-step"}])
def test_no_spurious_term_is_identified_under_noise_of_the_output(
    seed: int, rule: dict[str, str]
) -> None:
    record = record_of(TRUTH, noise=0.02, samples=600, seed=seed)
    model = parse_model(document(frols(8, **rule), lags={"y": [1, 2, 3], "u": [1, 2, 3]}))
    found = identify(model, record, SMALL, seed=seed)
    identified = {one.name for one in found.parameters if one.status == "identified"}
    assert identified <= {f"a[{term}]" for term in TRUTH}
    if rule.get("error") != "one-step":
        assert set(TRUTH) <= {term.term for term in found.selection}
    if rule.get("criterion") == "bic":
        assert len(identified) >= 2
    else:
        assert found.verdict.trust != "trustworthy"


def test_noise_in_the_equation_is_explained_one_step_ahead() -> None:
    rng = np.random.default_rng(4)
    u, y = rng.uniform(-1.0, 1.0, 800), np.zeros(800)
    for k in range(2, 800):
        y[k] = 0.9 * y[k - 1] + 0.3 * u[k - 1] - 0.1 * u[k - 2] ** 2 + 0.1 * rng.standard_normal()
    times = 0.1 * np.arange(800)
    record = Record((Channel("u", times, u, "V"),), (Channel("y", times, y),))
    model = parse_model(document({"select": "frols", "criterion": "bic"}))
    found = identify(model, record, SMALL)
    assert {term.term for term in found.selection} == {"y(k-1)", "u(k-1)", "u(k-2)**2"}
