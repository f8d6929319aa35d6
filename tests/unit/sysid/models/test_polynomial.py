"""Polynomial documents: each monomial once, legible coefficients, lags as in Eq. 2–3."""

from typing import Any

import pytest

from sysid.core.errors import InvalidModel
from sysid.language.delays import collect_past_values
from sysid.language.tree import Binary, PastValue, Symbol
from sysid.models.model import FixedInitial, MeasuredInitial
from sysid.models.parse import parse_model

NARX: dict[str, Any] = {
    "name": "narx",
    "form": "polynomial",
    "output": "y",
    "inputs": {"u": "V"},
    "degree": 2,
    "lags": {"y": [1, "1 + dh"], "u": [1, "1 + dk"]},
    "parameters": {"dh": {"lower": 0, "upper": 20}, "dk": {"lower": 0, "upper": 40}},
    "coefficients": {"lower": -2, "upper": 2},
}


def list_faults(**changes: Any) -> dict[str, str]:
    with pytest.raises(InvalidModel) as caught:
        parse_model(NARX | changes)
    return {fault.pointer: fault.detail for fault in caught.value.faults}


def list_names(**changes: Any) -> list[str]:
    return [parameter.name for parameter in parse_model(NARX | changes).parameters]


@pytest.mark.parametrize(
    ("signals", "degree", "count"), [(1, 1, 1), (2, 2, 5), (4, 2, 14), (4, 3, 34), (3, 5, 55)]
)
def test_s_past_values_and_degree_m_give_c_of_s_plus_m_over_m_minus_one_coefficients(
    signals: int, degree: int, count: int
) -> None:
    document = NARX | {
        "lags": {"y": list(range(1, signals + 1))},
        "degree": degree,
        "parameters": {},
    }
    assert len(parse_model(document).parameters) == count


def test_coefficients_are_named_by_their_terms_and_lags_come_last() -> None:
    assert list_names(degree=1) == [
        "a[y(k-1)]",
        "a[y(k-1-dh)]",
        "a[u(k-1)]",
        "a[u(k-1-dk)]",
        "dh",
        "dk",
    ]
    assert "a[y(k-1)*u(k-1-dk)]" in list_names()
    assert "a[y(k-1-dh)**2]" in list_names()


def test_a_coefficient_multiplies_its_term() -> None:
    document = NARX | {"terms": ["y(k-1)*u(k-2)"], "parameters": {}}
    model = parse_model(document)
    coefficient = Symbol("a[y(k-1)*u(k-2)]", "parameter")
    past = Binary("*", coefficient, PastValue("y", "state", 1))
    assert model.equations == (Binary("*", past, PastValue("u", "input", 2)),)
    assert model.memory == 2


def test_a_list_of_terms_replaces_all_and_needs_neither_degree_nor_lags() -> None:
    document = NARX | {"terms": ["y(k-1)", "u(k-1-dk)**2*y(k-1)"], "degree": None, "lags": None}
    listed = [p.name for p in parse_model(document).parameters]
    assert listed == ["a[y(k-1)]", "a[y(k-1)*u(k-1-dk)**2]", "dh", "dk"]


def test_a_constant_term_is_added_on_request() -> None:
    assert list_names(constant=True, degree=1)[4] == "a[1]"
    model = parse_model(NARX | {"constant": True, "terms": ["y(k-1)"], "parameters": {}})
    linear = Binary("*", Symbol("a[y(k-1)]", "parameter"), PastValue("y", "state", 1))
    assert model.equations == (Binary("+", linear, Symbol("a[1]", "parameter")),)


def test_the_output_is_the_state_and_starts_as_measured() -> None:
    model = parse_model(NARX | {"output": {"y": "bar"}})
    assert model.form == "polynomial"
    assert model.outputs[0].expression == PastValue("y", "state")
    assert model.outputs[0].unit == "bar"
    assert model.initial == (MeasuredInitial(),)
    assert parse_model(NARX | {"initial": {"y": 2}}).initial == (FixedInitial(2.0),)


def test_an_unknown_lag_is_the_same_in_every_term_that_has_it() -> None:
    model = parse_model(NARX)
    lags = {
        value.delay for value in collect_past_values(model.equations[0]) if value.delay is not None
    }
    assert lags == {Symbol("dh", "parameter"), Symbol("dk", "parameter")}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"terms": ["y(k-1)", "u(k-1-dk)"]},
        {"constant": True},
        {"output": {"y": "m"}},
        {"terms": {"select": "frols", "keep": 3}},
        {"terms": {"select": "frols", "err": 0.001, "criterion": "bic"}, "constant": True},
        {"terms": {"select": "frols", "keep": 1, "candidates": ["y(k-1)", "u(k-1)*y(k-1)"]}},
    ],
)
def test_the_normal_form_gives_the_same_model(changes: dict[str, Any]) -> None:
    model = parse_model(NARX | changes)
    assert parse_model(model.document) == model


def test_hundreds_of_terms_make_a_shallow_sum() -> None:
    model = parse_model(NARX | {"lags": {"y": [1, 2, 3], "u": [1, 2, 3]}, "degree": 4})
    assert len(model.parameters) == 209 + 2
    assert _depth(model.equations[0]) <= 16


def _depth(tree: object) -> int:
    return 1 + max(_depth(tree.left), _depth(tree.right)) if isinstance(tree, Binary) else 1


@pytest.mark.parametrize(
    ("changes", "pointer", "part"),
    [
        ({"terms": {"keep": 8}}, "/terms/select", "is missing"),
        ({"terms": {"select": "lasso", "keep": 8}}, "/terms/select", "'lasso'"),
        ({"terms": {"select": "frols"}}, "/terms/keep", "is missing"),
        ({"terms": {"select": "frols", "keep": 0}}, "/terms/keep", "whole number from 1 to 14"),
        ({"terms": {"select": "frols", "keep": True}}, "/terms/keep", "whole number from 1 to 14"),
        ({"terms": {"select": "frols", "keep": 15}}, "/terms/keep", "has 14 candidate terms"),
        ({"terms": {"select": "frols", "keep": 2, "err": 1}}, "/terms/err", "share between 0 and"),
        ({"terms": {"select": "frols", "keep": 2, "criterion": "aic"}}, "/terms/criterion", "aic"),
        ({"terms": {"select": "frols", "keep": 2, "kept": 2}}, "/terms/kept", "unknown field"),
        ({"terms": {"select": "frols", "keep": 2}, "lags": None}, "/lags", "is missing"),
        ({"terms": {"select": "frols", "keep": 2}, "degree": None}, "/degree", "is missing"),
        (
            {"terms": {"select": "frols", "keep": 1, "candidates": ["y(k-1) +"]}},
            "/terms/candidates/0",
            "",
        ),
        (
            {"terms": {"select": "frols", "keep": 1, "candidates": []}},
            "/terms/candidates",
            "list is empty",
        ),
        ({"terms": "some"}, "/terms", "is not 'all', a list"),
        ({"terms": []}, "/terms", "the list is empty"),
        ({"terms": ["y(k-1)", "y(k-1)"]}, "/terms/1", "listed twice"),
        ({"terms": ["u(k-1)*y(k-1)", "y(k-1)*u(k-1)"]}, "/terms/1", "listed twice"),
        ({"terms": ["y(k-1)", "u(k-1)", "y(k-1)"]}, "/terms/2", "listed twice"),
        ({"terms": ["2*y(k-1)"]}, "/terms/0", "a product of past values"),
        ({"terms": ["sin(y(k-1))"]}, "/terms/0", "a product of past values"),
        ({"terms": ["y(k-1) + u"]}, "/terms/0", "a product of past values"),
        ({"terms": ["y*u(k-1)"]}, "/terms/0", "may reach the present"),
        ({"terms": [["y"]]}, "/terms/0", "is not an expression"),
        ({"terms": ["z(k-1)"]}, "/terms/0", "no function or signal 'z'"),
        ({"degree": 0}, "/degree", "whole number from 1"),
        ({"degree": None}, "/degree", "is missing"),
        ({"degree": 9}, "/degree", "gives 714 coefficients"),
        ({"lags": None}, "/lags", "is missing"),
        ({"lags": {"y": 1}}, "/lags/y", "is not a list"),
        ({"lags": {"y": [0]}}, "/lags/y/0", "may reach the present"),
        ({"lags": {"y": ["1 - dh"]}}, "/lags/y/0", "may be negative"),
        ({"lags": {"y": [1, 1]}}, "/lags/y", "listed twice"),
        ({"lags": {"y": ["1 + dq"]}}, "/lags/y/0", "'dq' is not declared"),
        ({"lags": {"w": [1]}}, "/lags/w", "no such signal"),
        ({"coefficients": None}, "/coefficients/lower", "is missing"),
        ({"coefficients": {"lower": 1, "upper": 0}}, "/coefficients", "need finite lower"),
        ({"constant": "yes"}, "/constant", "is not true or false"),
        ({"output": None}, "/output", "name of the one output"),
        ({"output": {"y": "1", "z": "1"}}, "/output", "name of the one output"),
        ({"output": "u"}, "/inputs/u", "already declared"),
        ({"states": {"x": "m"}}, "/states", "unknown field"),
        ({"solver": {"substeps": 2}}, "/solver/substeps", "whose terms are samples"),
    ],
)
def test_a_fault_of_a_polynomial_document_is_told_where_it_is(
    changes: dict[str, Any], pointer: str, part: str
) -> None:
    found = list_faults(**changes)
    assert part in found[pointer]


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"terms": {"select": "frols", "criterion": "aic"}}, "/terms/criterion"),
        ({"lags": {"y": [0, 1], "u": [1]}, "terms": {"select": "frols", "keep": 8}}, "/lags/y/0"),
        ({"degree": 12, "terms": {"select": "frols", "keep": 8}}, "/degree"),
    ],
)
def test_one_slip_is_not_told_as_a_fault_of_keep_besides(
    changes: dict[str, Any], place: str
) -> None:
    assert list(list_faults(**changes)) == [place]
