"""Model documents: what a good one gives, and that every fault of a bad one is told at once."""

from typing import Any

import pytest

from sysid.core.errors import InvalidModel
from sysid.language.checker import MAX_NODES
from sysid.language.tree import PastValue
from sysid.models.document_reader import MAX_EXPRESSION_CHARACTERS, parse_yaml
from sysid.models.model import EstimatedInitial, FixedInitial, MeasuredInitial, ModelSignal, Solver
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.parse import parse_model

CONTINUOUS: dict[str, Any] = {
    "name": "delayed-duffing",
    "form": "differential",
    "inputs": {"q": "N"},
    "states": {"x": "m", "v": "m/s"},
    "parameters": {
        "c": {"lower": 0, "upper": 1, "unit": "N·s/m"},
        "L": {"lower": 0, "upper": 1, "unit": "s"},
    },
    "constants": {"m": 2},
    "equations": {"x": "v", "v": "(q(t) - c*v(t - L) - x)/m"},
    "outputs": {"y": "x"},
    "initial": {"x": "measured", "v": {"lower": -1, "upper": 1}},
    "solver": {"method": "semi-implicit", "step": 0.01, "substeps": 2, "history": "zero"},
}
DISCRETE: dict[str, Any] = {
    "name": "recursion",
    "form": "difference",
    "states": {"x": None, "w": 1},
    "parameters": {"d": {"lower": 1, "upper": 9, "fixed": 3}},
    "equations": {"x": "0.5*w + w(k-3)", "w": "x(k-d)"},
    "outputs": {"y": {"expression": "2*x", "unit": "mm"}},
}


def list_faults(base: dict[str, Any], **changes: Any) -> dict[str, str]:
    with pytest.raises(InvalidModel) as caught:
        parse_model(base | changes)
    return {fault.pointer: fault.detail for fault in caught.value.faults}


def test_a_differential_document_becomes_a_model() -> None:
    model = parse_model(CONTINUOUS)
    assert (model.name, model.title, model.form) == (
        "delayed-duffing",
        "delayed-duffing",
        "differential",
    )
    assert model.inputs == (ModelSignal("q", "N"),)
    assert model.states == (ModelSignal("x", "m"), ModelSignal("v", "m/s"))
    assert model.parameters[1] == Parameter("L", 0.0, 1.0, "s")
    assert model.equations[0] == PastValue("v", "state")
    assert model.initial == (MeasuredInitial(), EstimatedInitial(-1.0, 1.0))
    assert model.solver == Solver("semi-implicit", 0.01, 2, "zero", "linear")
    assert (model.order, model.memory) == ((0, 1), 0)


def test_a_difference_document_orders_its_states_and_counts_its_memory() -> None:
    model = parse_model(DISCRETE)
    assert model.order == (1, 0)
    assert model.memory == 3
    assert model.initial == (FixedInitial(0.0), FixedInitial(0.0))
    assert model.states == (ModelSignal("x", "1"), ModelSignal("w", "1"))
    assert model.parameters[0].fixed == 3.0


def test_an_output_that_is_a_state_has_its_unit_and_another_its_own() -> None:
    assert parse_model(CONTINUOUS).outputs[0].unit == "m"
    assert parse_model(DISCRETE).outputs[0].unit == "mm"
    squared = CONTINUOUS | {"outputs": {"y": "x", "z": "x**2"}}
    assert parse_model(squared).outputs[1].unit == "1"


def test_the_rate_of_a_measured_state_may_start_measured() -> None:
    both = CONTINUOUS | {"initial": {"x": "measured", "v": "measured"}}
    assert parse_model(both).initial == (MeasuredInitial(), MeasuredInitial())


RICH = CONTINUOUS | {
    "parameters": {
        "c": {"lower": 0.1, "upper": 1, "unit": "N·s/m", "scale": "log", "bounds": "gain"},
        "L": {"lower": 0, "upper": 1, "unit": "s", "fixed": 0.5, "description": "a  pure delay"},
        "k": {"lower": 0, "upper": 2, "tied": "2*c"},
        "r": {"lower": 0, "upper": 1, "physical": "both"},
    },
    "equations": {"x": "v", "v": "(q(t) - c*v(t - L) - k*x)/(r*m)"},
    "initial": {"x": {"lower": 0, "upper": 1, "bounds": "state"}, "v": "c"},
}
"""With all that a parameter or an initial state may say."""


@pytest.mark.parametrize("document", [CONTINUOUS, DISCRETE, RICH])
def test_the_normal_form_gives_the_same_model_and_is_its_own(document: dict[str, Any]) -> None:
    model = parse_model(document)
    assert parse_model(model.document) == model


def test_a_document_is_not_changed_by_reading_it() -> None:
    before = repr(CONTINUOUS)
    parse_model(CONTINUOUS)
    assert repr(CONTINUOUS) == before


@pytest.mark.parametrize("base", [CONTINUOUS, DISCRETE])
def test_a_wrong_form_does_not_hide_the_other_faults(base: dict[str, Any]) -> None:
    told = list_faults(base, form="ode", equations=base["equations"] | {"x": "x^2"})
    assert set(told) == {"/form", "/equations/x"}
    assert "^" in told["/equations/x"]


@pytest.mark.parametrize(
    ("changes", "pointer", "part"),
    [
        ({"form": "diference"}, "/form", "did you mean 'difference'?"),
        ({"form": None}, "/form", "is missing"),
        ({"name": None}, "/name", "is missing"),
        ({"name": "two words"}, "/name", "cannot be a model's name"),
        ({"name": "a/b"}, "/name", "cannot be a model's name"),
        ({"name": ".hidden"}, "/name", "starting with a letter or a digit"),
        ({"name": "a" * 65}, "/name", "up to 64"),
        ({"name": "a@2"}, "/name", "cannot be a model's name"),
        ({"name": "a:check"}, "/name", "cannot be a model's name"),
        ({"equation": {}}, "/equation", "did you mean 'equations'?"),
        ({"title": 3}, "/title", "3 is not a text"),
        ({"constants": {"m": 0, 2: None}}, "/constants", "write 0.2 where 0,2 was meant"),
        ({"inputs": ["q"]}, "/inputs", "is not a mapping"),
        ({"inputs": {"q": 7}}, "/inputs/q", "7 is not a text"),
        ({"inputs": {"x": "N", "q": "N"}}, "/inputs/x", "already declared in /states"),
        ({"inputs": {"q": "N", "sin": "N"}}, "/inputs/sin", "word of the language"),
        ({"inputs": {"q": "N", "2a": "N"}}, "/inputs/2a", "cannot be a name"),
        ({"inputs": {"q": "N", "a/b": "N"}}, "/inputs/a~1b", "cannot be a name"),
        ({"inputs": {"q": "N", "y": "N"}}, "/outputs/y", "is also an input"),
        ({"states": {}}, "/states", "is missing"),
        ({"constants": {"m": "2"}}, "/constants/m", "'2' is not a number"),
        ({"constants": {"m": float("nan")}}, "/constants/m", "nan is not a finite number"),
        ({"constants": {"m": True}}, "/constants/m", "True is not a number"),
        ({"equations": {"x": "v"}}, "/equations/v", "is missing"),
        ({"equations": {"x": "v", "v": "0", "u": "1"}}, "/equations/u", "no such state"),
        ({"equations": {"x": "v", "v": ["x"]}}, "/equations/v", "is not an expression"),
        ({"equations": {"x": "v", "v": "q - C*v"}}, "/equations/v", "'C' is not declared"),
        ({"outputs": {}}, "/outputs", "name the measured channel"),
        ({"outputs": {"y": "z"}}, "/outputs/y", "'z' is not declared"),
        ({"outputs": {"y": {"expression": "z"}}}, "/outputs/y/expression", "is not declared"),
        ({"outputs": {"y": {"unit": "m"}}}, "/outputs/y/expression", "is missing"),
        ({"initial": {"z": 0}}, "/initial/z", "no such state"),
        ({"initial": {"x": "mesured"}}, "/initial/x", "is not an initial state"),
        ({"initial": {"x": {"lower": 0}}}, "/initial/x/upper", "is missing"),
        ({"initial": {"x": {"lower": 1, "upper": 1}}}, "/initial/x", "need lower < upper"),
        ({"outputs": {"y": "2*x"}, "initial": {"x": "measured"}}, "/initial/x", "not measured"),
        ({"solver": {"method": "rk5"}}, "/solver/method", "did you mean 'rk4'?"),
        ({"solver": {"step": 0}}, "/solver/step", "need more than 0"),
        ({"solver": {"step": "smple"}}, "/solver/step", "is not 'sample'"),
        ({"solver": {"substeps": 1.5}}, "/solver/substeps", "whole number from 1"),
        ({"solver": {"substeps": 1001}}, "/solver/substeps", "whole number from 1 to 1000"),
        ({"solver": {"substep": 2}}, "/solver/substep", "did you mean 'substeps'?"),
    ],
)
def test_a_fault_of_a_differential_document_is_told_where_it_is(
    changes: dict[str, Any], pointer: str, part: str
) -> None:
    found = list_faults(CONTINUOUS, **changes)
    assert next(iter(found)) == pointer
    assert part in found[pointer]


@pytest.mark.parametrize(
    ("entry", "pointer", "part"),
    [
        ({"lower": 1, "upper": 0}, "/parameters/L", "need finite lower < upper"),
        ({"lower": 1, "upper": 1}, "/parameters/L", "need finite lower < upper"),
        ({"lower": 0}, "/parameters/L/upper", "is missing"),
        ({"lower": 0, "upper": "1"}, "/parameters/L/upper", "'1' is not a number"),
        ({"lower": 0, "upper": float("inf")}, "/parameters/L/upper", "not a finite number"),
        ({"lower": 0, "upper": 10**400}, "/parameters/L/upper", "not a finite number"),
        ({"lower": 0, "upper": 1, "scale": "log"}, "/parameters/L", "needs lower > 0"),
        ({"lower": 0, "upper": 1, "scale": "lin"}, "/parameters/L/scale", "'linear', 'log'"),
        ({"lower": 0, "upper": 1, "fixed": 2}, "/parameters/L", "outside them"),
        ({"lower": 0, "upper": 1, "uper": 2}, "/parameters/L/uper", "did you mean 'upper'?"),
        (3, "/parameters/L", "is not a mapping"),
    ],
)
def test_a_fault_of_a_parameter_does_not_make_its_name_unknown(
    entry: object, pointer: str, part: str
) -> None:
    found = list_faults(CONTINUOUS, parameters={"c": {"lower": 0, "upper": 1}, "L": entry})
    assert list(found) == [pointer]
    assert part in found[pointer]


@pytest.mark.parametrize(
    ("changes", "pointer", "part"),
    [
        ({"equations": {"x": "x + w", "w": "1"}}, "/equations/x", "the present x(k)"),
        ({"equations": {"x": "w", "w": "x"}}, "/equations", "depend on each other"),
        ({"equations": {"x": "w(k - 1 + d/4)", "w": "x"}}, "/equations", "depend on each other"),
        ({"equations": {"x": "x(k - (d-1)/4)", "w": "1"}}, "/equations/x", "may reach the present"),
        ({"solver": {"method": "rk4"}}, "/solver/method", "belongs to the differential form"),
        ({"solver": {"substeps": 0}}, "/solver/substeps", "whole number from 1"),
        ({"states": {"x": "1", "w": "1", "h": "m"}}, "/states/h", "word of the language"),
    ],
)
def test_a_fault_of_a_difference_document_is_told_where_it_is(
    changes: dict[str, Any], pointer: str, part: str
) -> None:
    free = {"parameters": {"d": {"lower": 1, "upper": 3}}}
    found = list_faults(DISCRETE | free, **changes)
    assert pointer in found
    assert part in found[pointer]


@pytest.mark.parametrize(
    ("entry", "pointer", "part"),
    [
        ({"tied": "2*q"}, "/parameters/L/tied", "'q' is not declared"),
        ({"tied": "L + 1"}, "/parameters/L/tied", "circular"),
        ({"tied": 3}, "/parameters/L/tied", "3 is not a text"),
        ({"tied": "c", "fixed": 0.5}, "/parameters/L/tied", "either fixed or tied"),
    ],
)
def test_a_tie_that_cannot_be_is_told_where_it_is(
    entry: dict[str, Any], pointer: str, part: str
) -> None:
    both = {"lower": 0, "upper": 1}
    found = list_faults(CONTINUOUS, parameters={"c": both, "L": both | entry})
    assert part in found[pointer]


@pytest.mark.parametrize(
    ("entry", "part"),
    [
        ({"physical": "above"}, "'above' is not"),
        ({"physical": True}, "True is not"),
        ({"physical": "upper", "bounds": "delay"}, "the upper bound follows the data"),
        ({"physical": "lower", "bounds": "time"}, "the lower bound follows the data"),
    ],
)
def test_a_physical_limit_that_cannot_be_is_told_where_it_is(
    entry: dict[str, Any], part: str
) -> None:
    both = {"lower": 0, "upper": 1}
    found = list_faults(CONTINUOUS, parameters={"c": both, "L": both | entry})
    assert part in found["/parameters/L/physical"]


def test_a_delay_that_the_data_bound_is_physically_not_below_0() -> None:
    lag = {"lower": 0, "upper": 1, "bounds": "delay", "physical": "lower"}
    model = parse_model(CONTINUOUS | {"parameters": {"c": {"lower": 0, "upper": 1}, "L": lag}})
    assert model.parameters[1].is_physical("lower")
    assert model.document["parameters"]["L"]["physical"] == "lower"
    assert "physical" not in model.document["parameters"]["c"]


def test_a_parameter_tied_in_its_document_is_not_free_until_something_else_is_said_of_it() -> None:
    both = {"lower": 0, "upper": 1}
    model = parse_model(CONTINUOUS | {"parameters": {"c": both, "L": both | {"tied": "c / 2"}}})
    assert [p.name for p in model.parameters if p.is_free] == ["c"]
    assert parse_model(model.document) == model
    for change in ({"lower": 0, "upper": 0.5}, {"fixed": 0.25}):
        _, lag = override_parameters(model.parameters, {"L": change})
        assert lag.tied is None
        assert lag.is_free == ("upper" in change)


def test_all_faults_of_a_document_are_told_together_with_their_columns() -> None:
    document = CONTINUOUS | {
        "colour": "red",
        "parameters": {"c": {"lower": 1, "upper": 0}, "L": {"lower": -1, "upper": 1}},
        "equations": {"x": "vv", "v": "q - c*v(t - L) + __import__('os')"},
        "solver": {"step": -1},
    }
    with pytest.raises(InvalidModel) as caught:
        parse_model(document)
    found = {(fault.pointer, fault.column) for fault in caught.value.faults}
    assert found == {
        ("/colour", None),
        ("/parameters/c", None),
        ("/equations/x", 1),
        ("/equations/v", 7),
        ("/equations/v", 18),
        ("/equations/v", 29),
        ("/solver/step", None),
    }


@pytest.mark.parametrize("document", [None, 3, "tube", [CONTINUOUS], {}, {3: 4}])
def test_what_is_no_document_is_refused_in_one_line(document: object) -> None:
    with pytest.raises(InvalidModel) as caught:
        parse_model(document)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "pointer"),
    [
        ({"states": {f"x{i}": "1" for i in range(65)}}, "/states"),
        ({"parameters": {f"p{i}": {"lower": 0, "upper": 1} for i in range(257)}}, "/parameters"),
        ({"equations": {"x": "v", "v": "1+" * 2000 + "1"}}, "/equations/v"),
        ({"description": "a" * 4001}, "/description"),
    ],
)
def test_documents_beyond_the_limits_are_refused(changes: dict[str, Any], pointer: str) -> None:
    found = list_faults(CONTINUOUS, **changes)
    assert "at most" in found[pointer]


@pytest.mark.parametrize(
    ("unit", "index", "right"),
    [
        ("min", "t - L", "this delay is in seconds: give it in s, or write t - 60*L"),
        ("ms", "t - 0.1 - L", "this delay is in seconds: give it in s, or write t - 0.001*L"),
    ],
)
def test_a_lag_in_minutes_is_not_read_in_seconds(unit: str, index: str, right: str) -> None:
    lag = {"L": {"lower": 0, "upper": 1, "unit": unit}, "c": {"lower": 0, "upper": 1}}
    changed = {"parameters": lag, "equations": {"x": "v", "v": f"q(t) - c*v({index}) - x"}}
    assert list_faults(CONTINUOUS, **changed) == {
        "/parameters/L/unit": f"found {unit!r}, but {right}"
    }
    factored = index.replace("L", f"{right.rpartition('- ')[2]}")
    parse_model(CONTINUOUS | changed | {"equations": {"x": "v", "v": f"q - c*v({factored}) - x"}})


@pytest.mark.parametrize(
    ("unit", "index", "right"),
    [
        ("s", "k-1-d", "samples: write d/h, or the unit samples"),
        ("min", "k-1-d", "samples: write k - 60*d/h, or the unit samples"),
        ("min", "k-1-d/h", "seconds: give it in s, or write k - 60*d/h"),
    ],
)
def test_a_recursions_lag_in_seconds_is_not_read_in_samples(
    unit: str, index: str, right: str
) -> None:
    changed = {
        "parameters": {"d": {"lower": 1, "upper": 9, "unit": unit}},
        "equations": {"x": "0.5*w + w(k-3)", "w": f"x({index})"},
    }
    told = list_faults(DISCRETE, **changed)
    assert told == {"/parameters/d/unit": f"found {unit!r}, but this delay is in {right}"}
    fits = {"s": "k-1-d/h", "min": "k-1-60*d/h"}[unit]
    parse_model(DISCRETE | changed | {"equations": {"x": "w", "w": f"x({fits})"}})


def test_a_tab_that_indents_is_called_that() -> None:
    with pytest.raises(InvalidModel, match=r"line 2, column 1: .* indent with spaces, not tabs"):
        parse_yaml("parameters:\n\tK: {lower: 0, upper: 1}\n")


@pytest.mark.parametrize("part", ["equations", "outputs", "initial"])
def test_all_expressions_of_a_model_count_together(part: str) -> None:
    """Each is within the limits of one expression, but all are compiled into one kernel."""
    states = [f"x{n}" for n in range(1 + MAX_NODES // 2000)]
    document: dict[str, Any] = {
        "name": "wide",
        "form": "differential",
        "states": dict.fromkeys(states, "m"),
        "parameters": {"c": {"lower": 0, "upper": 1}},
        "equations": dict.fromkeys(states, "c"),
        "outputs": dict.fromkeys([f"y{n}" for n in range(len(states))], "c"),
        "initial": dict.fromkeys(states, "c"),
    }
    parse_model(document)
    told = list_faults(document, **{part: dict.fromkeys(document[part], "+".join(["c"] * 1000))})
    assert list(told) == ["/equations"]
    assert f"at most {MAX_NODES} are compiled" in told["/equations"]


def test_the_terms_of_a_polynomial_count_too() -> None:
    terms = ["*".join(f"y(k-{n + j})" for j in range(27)) for n in range(1, 250)]
    fields = {"form": "polynomial", "output": "y", "terms": terms}
    told = list_faults({"name": "many", **fields, "coefficients": {"lower": -1, "upper": 1}})
    assert list(told) == ["/terms"]
    assert "are compiled" in told["/terms"]


def test_the_texts_of_all_expressions_are_bounded_before_they_are_parsed() -> None:
    texts = {f"x{n}": "c" + " " * 3000 for n in range(60)}
    told = list_faults(
        {"name": "long", "form": "differential", "states": dict.fromkeys(texts, "m")},
        parameters={"c": {"lower": 0, "upper": 1}},
        equations=texts,
        outputs={"y": "x0"},
    )
    assert list(told) == [f"/equations/x{MAX_EXPRESSION_CHARACTERS // 3001}"]
    (detail,) = told.values()
    assert f"more than {MAX_EXPRESSION_CHARACTERS} characters together" in detail


@pytest.mark.parametrize("sign", ["%", "@"])
def test_a_text_that_needs_quotes_is_told_so(sign: str) -> None:
    part = f"cannot begin with {sign}; put it in quotes, such as '{sign}'"
    for text in (f"inputs: {{u: {sign}}}", f"inputs:\n  u: {sign}/s"):
        with pytest.raises(InvalidModel, match=part):
            parse_yaml(text)
    assert parse_yaml(f"inputs: {{u: '{sign}'}}") == {"inputs": {"u": sign}}


@pytest.mark.parametrize("name", ["x'", "dx", "dx/dt", "der(x)", "x_dot", "x(t)"])
def test_an_equation_with_the_name_of_a_derivative_is_told_its_state(name: str) -> None:
    found = list_faults(CONTINUOUS, equations={name: "v", "v": "-x"})
    assert "write x: …, which is dx/dt" in next(iter(found.values()))


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("equations: {x: max(v, 1), v: 0}", "the comma before '1\\)' ends a value in braces"),
        ("let: {a: min(x, v)}", "/let: the comma before 'v\\)' .* in quotes"),
        ("equations: {x: table(v, [0, 1], [0, 1])}", "commas or brackets in quotes"),
    ],
)
def test_an_expression_in_braces_is_told_to_need_quotes(text: str, part: str) -> None:
    with pytest.raises(InvalidModel, match=part):
        parse_model(CONTINUOUS | parse_yaml(text))
