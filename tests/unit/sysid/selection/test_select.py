"""Selecting a polynomial's terms on records: what is chosen, on which rows, at which lags."""

import re
from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest

from service.models.models import apply_result
from service.pages.render import template_environment
from sysid.core.errors import InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.model import SelectedTerm, TermRule
from sysid.models.parse import parse_model
from sysid.selection.frols import exchange_terms, rate_terms, select_forward, solve_coefficients
from sysid.selection.lag_search import search_lags
from sysid.selection.regression import Regression
from sysid.selection.select import select_model_terms
from sysid.simulation.problem import Problem
from tests.support.library.polynomials import (
    LAGGED,
    TRUTH,
    build_lagged,
    document,
    frols,
    record_of,
)
from tests.support.storage.run_results import conclude


def chosen(terms: object, *records: Record, **changes: object) -> dict[str, float]:
    model, _ = select_model_terms(parse_model(document(terms, **changes)), records)
    assert model.selection is not None
    return {one.term: one.coefficient for one in model.selection.terms}


def make_triangle(columns: FloatArray, target: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.qr(np.column_stack([columns, target]), mode="r"))


def left_over(columns: FloatArray, target: FloatArray) -> float:
    solution = np.linalg.lstsq(columns, target, rcond=None)[0]
    return float(np.sum(np.square(target - columns @ solution)))


def random_regression(seed: int, terms: int = 7) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((60, terms)) @ rng.standard_normal((terms, terms)), (
        rng.standard_normal(60)
    )


@pytest.mark.parametrize("seed", range(5))
def test_each_step_takes_the_term_that_leaves_least(seed: int) -> None:
    columns, target = random_regression(seed)
    found = select_forward(make_triangle(columns, target), 5)
    whole = float(target @ target)
    for step, term in enumerate(found.order):
        before = list(found.order[:step])
        least = min(
            (left_over(columns[:, [*before, i]], target), i) for i in range(7) if i not in before
        )
        assert least[1] == term
        assert found.unexplained_shares[step] == pytest.approx(least[0] / whole)


def test_error_reduction_ratios_and_what_is_left_make_one() -> None:
    columns, target = random_regression(1)
    found = select_forward(make_triangle(columns, target), 6)
    assert sum(found.ratios) + found.unexplained_shares[-1] == pytest.approx(1.0)
    assert all(ratio >= 0 for ratio in found.ratios)


def test_the_scale_of_a_term_does_not_matter() -> None:
    columns, target = random_regression(2)
    scaled = columns * 10.0 ** np.arange(-6, 8, 2)
    one, other = (select_forward(make_triangle(c, target), 5) for c in (columns, scaled))
    assert one.order == other.order
    assert one.ratios == pytest.approx(other.ratios)


@pytest.mark.parametrize("seed", range(5))
def test_an_exchange_never_explains_less_and_no_single_one_would_explain_more(seed: int) -> None:
    columns, target = random_regression(seed, terms=9)
    found = select_forward(make_triangle(columns, target), 4)
    better = exchange_terms(make_triangle(columns, target), found.order)
    least = left_over(columns[:, list(better)], target)
    assert least <= left_over(columns[:, list(found.order)], target) * (1 + 1e-12)
    for place, term in product(range(4), set(range(9)) - set(better)):
        other = [*better[:place], term, *better[place + 1 :]]
        assert left_over(columns[:, other], target) > least * (1 - 1e-5)


def test_what_a_forward_choice_hides_an_exchange_finds() -> None:
    rng = np.random.default_rng(1)
    true = rng.standard_normal((200, 2))
    target = true[:, 0] + true[:, 1]
    decoy = target + 0.3 * rng.standard_normal(200)  # nearer to the output than either true term
    noise = 0.3 * rng.standard_normal((200, 3))
    given = make_triangle(np.column_stack([true, decoy, noise]), target)
    assert select_forward(given, 2).order[0] == 2
    assert sorted(exchange_terms(given, select_forward(given, 2).order)) == [0, 1]


def test_terms_that_depend_on_each_other_are_taken_once() -> None:
    columns, target = random_regression(3, terms=3)
    doubled = np.column_stack([columns, columns @ [1.0, 2.0, 3.0], columns[:, 0]])
    found = select_forward(make_triangle(doubled, target), 5)
    assert len(found.order) == 3


def test_coefficients_solve_the_least_squares_problem() -> None:
    columns, target = random_regression(4)
    expected = np.linalg.lstsq(columns[:, [5, 1]], target, rcond=None)[0]
    found = solve_coefficients(make_triangle(columns, target), [5, 1])
    assert found[[5, 1]] == pytest.approx(expected)
    assert np.count_nonzero(found) == 2


def test_the_true_terms_are_found_with_their_coefficients() -> None:
    assert chosen(frols(5), record_of(TRUTH)) == pytest.approx(TRUTH)


def test_nothing_more_is_taken_when_nothing_is_left_to_explain() -> None:
    assert chosen(frols(9), record_of(TRUTH)) == pytest.approx(TRUTH)


def test_the_constant_is_a_candidate_as_any_other() -> None:
    truth = TRUTH | {"1": 0.4}
    assert chosen(frols(6), record_of(truth), constant=True) == pytest.approx(truth)
    few = chosen(frols(5), record_of(TRUTH, noise=0.01), constant=True)
    assert "1" not in few
    model, _ = select_model_terms(
        parse_model(document(frols(6), constant=True)), [record_of(truth)]
    )
    assert "a[1]" in {one.name for one in model.parameters}


def test_the_criterion_of_bayes_leaves_out_what_noise_alone_would_explain() -> None:
    record = record_of(TRUTH, samples=2000)
    rng = np.random.default_rng(2)
    errors = rng.standard_normal(2000)
    # Noise that enters the equation itself: then least squares one step ahead is unbiased.
    y, u = np.zeros(2000), record.inputs[0].values
    for k in range(2, 2000):
        y[k] = (
            0.6 * y[k - 1]
            - 0.3 * y[k - 2]
            + 0.8 * u[k - 1]
            + 0.3 * y[k - 1] * u[k - 2]
            - 0.2 * u[k - 1] ** 2
            + 0.05 * errors[k]
        )
    noisy = replace(record, outputs=(replace(record.outputs[0], values=y),))
    found = chosen({"select": "frols", "criterion": "bic"}, noisy)
    assert set(found) == set(TRUTH)
    assert found == pytest.approx(TRUTH, abs=0.02)


def test_a_share_that_may_stay_unexplained_ends_the_selection() -> None:
    record = record_of(TRUTH)
    model = parse_model(document({"select": "frols", "err": 0.05, "exchange": False}))
    found, _ = select_model_terms(model, [record])
    assert found.selection is not None
    shares = [1.0 - one.cumulated for one in found.selection.terms]
    assert shares[-1] < 0.05
    assert all(share >= 0.05 for share in shares[:-1])


def test_several_records_are_explained_together_without_rows_across_their_ends() -> None:
    model = parse_model(document("all"))
    records = [record_of(TRUTH, seed=seed, samples=50) for seed in (1, 2)]
    whole, count = Regression.from_records(model, records, model.parameters).factor_terms(
        model.terms, {}
    )
    parts = [Regression.from_records(model, [one], model.parameters) for one in records]
    single = [part.factor_terms(model.terms, {}) for part in parts]
    assert count == sum(rows for _, rows in single) == 2 * (50 - 2)
    assert whole.T @ whole == pytest.approx(sum(r.T @ r for r, _ in single))


def test_rows_with_a_missing_sample_and_those_not_scored_are_left_out() -> None:
    record = record_of(TRUTH, samples=80)
    values = record.outputs[0].values.copy()
    values[[30, 31, 50]] = np.nan
    gappy = replace(record, outputs=(replace(record.outputs[0], values=values),))
    model = parse_model(document(["y(k-1)", "y(k-2)", "u(k-1)"]))
    regression = Regression.from_records(model, [gappy], model.parameters, skip=10)
    folded, count = regression.factor_terms(model.terms, {})
    u = record.inputs[0].values
    rows = [
        [values[k - 1], values[k - 2], u[k - 1], values[k]]
        for k in range(10, 80)
        if np.isfinite(values[k - 2 : k + 1]).all()
    ]
    assert count == len(rows) == 70 - 7
    assert folded.T @ folded == pytest.approx(np.array(rows).T @ np.array(rows))


def test_a_selection_without_the_missing_samples_is_still_right() -> None:
    record = record_of(TRUTH)
    values = record.outputs[0].values.copy()
    values[::17] = np.nan
    gappy = replace(record, outputs=(replace(record.outputs[0], values=values),))
    assert chosen(frols(5), gappy) == pytest.approx(TRUTH)


@pytest.mark.parametrize("hold", ["first", "zero", "band-limited"])
def test_the_regression_reads_past_values_as_the_kernels_do(hold: str) -> None:
    lags = {"dh": 2.0, "dk": 3.4}
    record = record_of(LAGGED, lags=lags, hold=hold)  # type: ignore[arg-type]
    model = parse_model(build_lagged(list(LAGGED)))
    problem = Problem.build(model, [record])
    regression = Regression.from_experiments(model, [record], problem.experiments, model.parameters)
    folded, _ = regression.factor_terms(model.terms, lags)
    found = solve_coefficients(folded, range(len(model.terms)))
    assert found == pytest.approx(list(LAGGED.values()), abs=1e-9)


def test_unknown_lags_are_chosen_with_the_terms_and_stay_unknown() -> None:
    lags = {"dh": 2.0, "dk": 5.0}
    record = record_of(LAGGED, lags=lags)
    model, _ = select_model_terms(parse_model(build_lagged(frols(5))), [record])
    assert model.selection is not None
    assert {one.term for one in model.selection.terms} == set(LAGGED)
    assert model.selection.lags == pytest.approx(lags)
    assert {"dh", "dk"} <= {one.name for one in model.parameters if one.is_free}


def test_lags_are_tried_inside_the_bounds_of_the_request() -> None:
    record = record_of(LAGGED, lags={"dh": 2.0, "dk": 5.0})
    changes = {"dh": {"fixed": 2}, "dk": {"lower": 0, "upper": 3}}
    model, kept = select_model_terms(parse_model(build_lagged(frols(5))), [record], changes)
    assert model.selection is not None
    assert model.selection.lags["dh"] == 2.0
    assert model.selection.lags["dk"] <= 3.0
    assert kept == changes


def test_many_combinations_of_lags_are_searched_coarsely_and_then_finely() -> None:
    axes = {name: [float(i) for i in range(200)] for name in "abc"}
    truth = {"a": 117.0, "b": 3.0, "c": 158.0}
    tried = search_lags(axes, lambda lags: sum(abs(lags[name] - truth[name]) for name in axes))
    assert tried[0].lags == truth
    assert len(tried) < 5000


def test_a_change_of_a_term_that_was_not_selected_is_let_go() -> None:
    changes = {"a[y(k-1)]": {"lower": 0.0}, "a[y(k-2)**2]": {"upper": 1.0}}
    model, kept = select_model_terms(parse_model(document(frols(5))), [record_of(TRUTH)], changes)
    assert kept == {"a[y(k-1)]": {"lower": 0.0}}
    Problem.build(model, [record_of(TRUTH)], parameters=kept)


def test_terms_selected_by_the_free_run_explain_it_no_worse() -> None:
    record = record_of(TRUTH, noise=0.1, samples=600)
    reached = {}
    for error in ("one-step", "simulation"):
        rule = frols(4, error=error)
        model, _ = select_model_terms(parse_model(document(rule)), [record])
        assert model.selection is not None
        problem = Problem.build(model, [record])
        known = {f"a[{one.term}]": one.coefficient for one in model.selection.terms}
        theta = np.array([[known[one.name] for one in problem.free_parameters]])
        reached[error] = float(problem.evaluate_fitness(theta)[0])
    assert reached["simulation"] <= reached["one-step"]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_criterion_of_bayes_holds_for_the_free_run_too(seed: int) -> None:
    record = record_of(TRUTH, noise=0.05, samples=600, seed=seed)
    rule = {"select": "frols", "criterion": "bic", "error": "simulation"}
    assert set(chosen(rule, record)) == set(TRUTH)  # by RMS alone a round with more would win
    assert len(chosen(rule | {"error": "one-step"}, record)) > len(TRUTH)


def test_sets_of_terms_are_ranked_by_the_rule() -> None:
    bic = TermRule(9, criterion="bic")
    for factor, less in ((0.99, False), (0.90, True)):  # ln n / n is 0.046 at 100 samples
        assert (rate_terms(bic, factor * 0.1, 6, 100, 9) < rate_terms(bic, 0.1, 5, 100, 9)) is less
    kept = TermRule(9)
    assert rate_terms(kept, 0.099, 9, 100, 9) < rate_terms(kept, 0.1, 5, 100, 9)
    enough = TermRule(9, err=0.05)
    assert (
        rate_terms(enough, 0.049, 4, 100, 9)
        < rate_terms(enough, 0.01, 5, 100, 9)
        < rate_terms(enough, 0.06, 3, 100, 9)
    )


def test_the_resolved_model_can_be_built_again_from_its_document_and_from_a_result() -> None:
    asked = parse_model(build_lagged(frols(5)))
    model, _ = select_model_terms(asked, [record_of(LAGGED, lags={"dh": 2.0, "dk": 5.0})])
    assert parse_model(model.document) == model
    assert model.rule is None
    assert model.selection is not None
    result = {"selection": [one._asdict() for one in model.selection.terms]}
    assert apply_result(asked, result) == model
    assert apply_result(asked, None) == asked


def test_a_model_without_a_rule_stays_as_it_is() -> None:
    model = parse_model(document("all"))
    assert select_model_terms(model, [record_of(TRUTH)], {"a[y(k-1)]": {"fixed": 1}}) == (
        model,
        {"a[y(k-1)]": {"fixed": 1}},
    )


def test_more_candidates_than_samples_are_refused() -> None:
    with pytest.raises(
        InvalidSettings, match="14 candidates cannot be distinguished with 9 samples"
    ):
        select_model_terms(parse_model(document(frols(3))), [record_of(TRUTH, samples=11)])


def test_a_problem_needs_terms_that_are_selected() -> None:
    with pytest.raises(InvalidSettings, match="/model/terms"):
        Problem.build(parse_model(document(frols(3))), [record_of(TRUTH)])


def test_an_output_that_is_zero_everywhere_selects_nothing_and_says_so() -> None:
    record = record_of(TRUTH)
    flat = replace(record, outputs=(Channel("y", record.outputs[0].times, np.zeros(400)),))
    with pytest.raises(InvalidSettings, match="zero at all scored samples"):
        select_model_terms(parse_model(document(frols(3))), [flat])


def test_every_pair_of_terms_can_be_asked_for_as_candidates() -> None:
    for pair in combinations(["y(k-1)", "u(k-1)", "y(k-1)*u(k-1)"], 2):
        found = chosen(frols(1, candidates=list(pair)), record_of(TRUTH))
        assert set(found) <= set(pair)


def test_pages_show_the_selected_terms_in_their_order() -> None:
    first = SelectedTerm("y(k-1)", 0.583, 0.583, 1.5, 1.0, 0.0, "")
    second = SelectedTerm("u(k-1)", 0.417, 1.0 + 1e-16, 0.5, 0.75, 0.0, "without it")
    chosen = replace(conclude().identification, selection=(first, second))
    parts = template_environment().get_template("parts.html").module
    rows = re.findall(r'<tr><th scope="row">(.*?)</th>(.*?)</tr>', parts.evidence(chosen))  # type: ignore[attr-defined]
    assert [(term, re.findall(r">([^<]+)</td>", cells)) for term, cells in rows] == [
        ("y(k-1)", ["0.5830", "0.4170", "1.000"]),
        ("u(k-1)", ["0.4170", "0", "0.7500"]),
    ]
    assert "Selected term" not in parts.evidence(conclude().identification)  # type: ignore[attr-defined]
