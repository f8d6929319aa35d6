"""Intermediate names: they stand for their expressions, and faults have places."""

from typing import Any

import numpy as np
import pytest

from sysid.core.errors import InvalidModel
from sysid.kernels.compilation.compile_task import CompileTask, decode_task, encode_task
from sysid.kernels.compilation.machine_code import optimize_assembly
from sysid.kernels.kernel import emit_kernel
from sysid.kernels.layout import KernelVariant
from sysid.models.parse import parse_model
from sysid.models.unused import find_unused_names
from sysid.simulation.problem import Problem
from tests.support.library import plain_twins
from tests.support.library.small_models import individuals, record

DOCUMENT: dict[str, Any] = {
    "name": "names",
    "form": "differential",
    "inputs": {"u": "V"},
    "states": {"x": "m", "w": "m"},
    "parameters": {
        "K": {"lower": 0, "upper": 2},
        "T": {"lower": 0.5, "upper": 2, "unit": "s"},
        "L": {"lower": 0, "upper": 0.3, "unit": "s"},
    },
    "let": {"drive": "rate + u(t - late)", "rate": "K*exp(-x/T)", "late": "L/2 + 0.01"},
    "equations": {"x": "drive - rate*x", "w": "rate(t - late) - w"},
    "outputs": {"y": "w + rate"},
    "initial": {"x": "late*u0", "w": 0},
}
WRITTEN_OUT: dict[str, Any] = DOCUMENT | {
    "let": {},
    "equations": {
        "x": "K*exp(-x/T) + u(t - (L/2 + 0.01)) - K*exp(-x/T)*x",
        "w": "K*exp(-x(t - (L/2 + 0.01))/T) - w",
    },
    "outputs": {"y": "w + K*exp(-x/T)"},
    "initial": {"x": "(L/2 + 0.01)*u0", "w": 0},
}


def test_a_model_of_names_is_the_model_that_is_written_out() -> None:
    model, plain = parse_model(DOCUMENT), parse_model(WRITTEN_OUT)
    assert model.equations == plain.equations
    assert model.outputs == plain.outputs
    assert "let" not in plain.document
    assert parse_model(model.document) == model
    problem = Problem.build(model, [record(24)])
    theta = individuals(problem, 3)
    expected = [plain_twins.predictions(problem, one) for one in theta]
    np.testing.assert_allclose(problem.predict(theta), expected, rtol=1e-9, atol=1e-11)


def test_what_a_name_stands_for_is_computed_once_a_stage() -> None:
    """Calls of exp: one in each of four stages, and one of the output."""

    def count_calls(document: dict[str, Any]) -> int:
        task = CompileTask(parse_model(document), KernelVariant(), 60.0, 1 << 31)
        sent = decode_task(encode_task(task))  # what the compiling child is given
        module = optimize_assembly(emit_kernel(sent.model, sent.variant))
        lines = str(module).splitlines()
        return sum("call" in line and "exp" in line for line in lines)

    once = DOCUMENT | {"equations": {"x": "u - rate", "w": "u(t - late) + drive*0"}}
    once |= {"outputs": {"y": "w"}, "initial": {"x": 0, "w": 0}}
    often = once | {"equations": {"x": "u - rate*x + rate", "w": "rate/(1 + rate)"}}
    assert count_calls(often) == count_calls(once) > 0


@pytest.mark.parametrize("form", ["difference", "polynomial"])
def test_names_serve_recursions_and_lags_of_polynomials(form: str) -> None:
    parameters = {"a": {"lower": 0, "upper": 1}, "d": {"lower": 0, "upper": 3}}
    head = {"name": "n", "form": form, "inputs": {"u": "V"}, "parameters": parameters}
    let = {"lag": "1 + d", "both": "y(k-1)*u(k - lag)"}
    if form == "difference":
        rest: Any = {"states": {"y": "V"}, "equations": {"y": "a*both(k-1) + u(k - lag)"}}
        plain = {**rest, "equations": {"y": "a*(y(k-2)*u(k-1 - (1 + d))) + u(k - (1 + d))"}}
        rest |= {"outputs": {"y": "y"}}
        plain |= {"outputs": {"y": "y"}}
    else:
        rest = {"output": "y", "coefficients": {"lower": -1, "upper": 1}}
        rest |= {"degree": 1, "lags": {"y": [1], "u": ["lag"]}, "terms": ["both", "u(k - lag)"]}
        plain = rest | {"lags": {"y": [1], "u": ["1 + d"]}}
        plain |= {"terms": ["y(k-1)*u(k - (1 + d))", "u(k-1-d)"]}
    model = parse_model({**head, **rest, "let": let})
    assert model.equations == parse_model({**head, **plain}).equations
    assert parse_model(model.document) == model


def faults_of(**changes: Any) -> list[tuple[str, int | None, str]]:
    with pytest.raises(InvalidModel) as caught:
        parse_model(DOCUMENT | changes)
    return [(fault.pointer, fault.column, fault.detail) for fault in caught.value.faults]


@pytest.mark.parametrize(
    ("let", "pointer", "part"),
    [
        ({"drive": "rate", "rate": "1 + late", "late": "drive"}, "/let/drive", "drive → rate"),
        ({"drive": "1", "rate": "rate + 1", "late": "1"}, "/let/rate", "rate → rate"),
        ({"drive": "1", "rate": "2*foo", "late": "1"}, "/let/rate", "'foo' is not declared"),
        ({"drive": "1", "rate": [1], "late": "1"}, "/let/rate", "not an expression"),
        (DOCUMENT["let"] | {"K": "1"}, "/let/K", "already declared in /parameters"),
        (DOCUMENT["let"] | {"exp": "1"}, "/let/exp", "a word of the language"),
        (DOCUMENT["let"] | {"2": "1"}, "/let/2", "cannot be a name"),
        (DOCUMENT["let"] | {"late": "x"}, "/let/drive", "the delay depends on 'x'"),
        (DOCUMENT["let"] | {"late": "L - 1"}, "/let/drive", "may be negative"),
        (DOCUMENT["let"] | {"late": "u(t - L)"}, "/initial/x", "a start has no past"),
    ],
)
def test_a_fault_of_a_name_has_its_place(let: dict[str, Any], pointer: str, part: str) -> None:
    found = faults_of(let=let)
    assert any(place == pointer and part in detail for place, _, detail in found)


def test_a_start_reads_no_states_by_names() -> None:
    [(pointer, column, detail)] = faults_of(initial={"x": "2*rate"})
    assert (pointer, column) == ("/initial/x", 3)
    assert "does not depend on a state such as 'x'" in detail


def test_units_of_lags_are_checked_through_names() -> None:
    minutes = DOCUMENT["parameters"] | {"L": {"lower": 0, "upper": 1, "unit": "min"}}
    assert parse_model(DOCUMENT | {"parameters": minutes}).name == "names"  # L/2: converted
    [(pointer, _, detail)] = faults_of(parameters=minutes, let=DOCUMENT["let"] | {"late": "L"})
    assert pointer == "/parameters/L/unit"
    assert "write t - 60*L" in detail


@pytest.mark.parametrize(
    ("factor", "part"), [("a{0} + a{0}", "more than 10000"), ("sin(a{0})", "deeper than 64")]
)
def test_names_of_names_cannot_grow_without_limit(factor: str, part: str) -> None:
    chain = {f"a{i}": factor.format(i + 1) for i in range(70)} | {"a70": "x"}
    found = faults_of(let=DOCUMENT["let"] | chain, outputs={"y": "a0"})
    assert any(part in detail for _, _, detail in found)


def test_unused_names_are_found_also_those_of_other_unused_ones() -> None:
    let = DOCUMENT["let"] | {"spare": "other + 1", "other": "2*late"}
    model = parse_model(DOCUMENT | {"let": let})
    assert [fault.pointer for fault in find_unused_names(model)] == [
        "/let/spare",
        "/let/other",
    ]
    assert find_unused_names(parse_model(DOCUMENT)) == []
