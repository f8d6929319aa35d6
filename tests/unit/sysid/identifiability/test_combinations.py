"""Identifiability: what the form of a model hides, what the data hide, and how it is written."""

from typing import Any

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identifiability.combinations import IdentifiableCombination
from sysid.identifiability.scaling_symmetries import find_scalings
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from tests.support.library import catalogue_cases

STEP = 0.05


def build_document(
    equations: dict[str, str],
    parameters: tuple[str, ...],
    form: str = "differential",
    **fields: Any,
) -> dict[str, Any]:
    written = {
        "name": "test",
        "form": form,
        "inputs": {"u": "V"},
        "states": dict.fromkeys(equations, "m"),
        "parameters": {name: {"lower": 0.01, "upper": 20} for name in parameters},
        "equations": equations,
        "outputs": {"y": next(iter(equations))},
        "initial": dict.fromkeys(equations, 0),
    }
    return written | fields


def build_problem(
    written: dict[str, Any], truth: dict[str, float], sd: float = 0.01, n: int = 200, **options: Any
) -> tuple[Problem, FloatArray]:
    """A problem whose data are the model's at the truth, with noise."""
    times = STEP * np.arange(n)
    rng = np.random.default_rng(3)
    u = Channel("u", times, np.repeat(rng.standard_normal(n // 10), 10), "V", hold="zero")
    blank = Record((u,), (Channel("y", times, np.zeros(n), "m"),))
    model = parse_model(written)
    problem = Problem.build(model, [blank], **options)
    theta = np.array([truth[p.name] for p in problem.free_parameters])
    y = problem.predict(theta[None])[0] + sd * rng.standard_normal(n)
    data = Record((u,), (Channel("y", times, y, "m"),))
    return Problem.build(model, [data], **options), theta


def list_groups(analysis: Analysis) -> dict[str, IdentifiableCombination]:
    assert analysis.uncertainty is not None
    return {group.expression: group for group in analysis.uncertainty.groups}


def list_statuses(analysis: Analysis) -> dict[str, str]:
    return {estimate.name: estimate.status for estimate in analysis.estimates}


ARM = build_document({"x": "v", "v": "(A*k*u - B*v - c*x)/J"}, ("J", "A", "k", "B", "c"))
TRUTH = {"J": 2.0, "A": 3.0, "k": 1.5, "B": 4.0, "c": 5.0}


def test_products_of_powers_are_written_out_with_value_and_standard_error() -> None:
    problem, theta = build_problem(ARM, TRUTH)
    analysis = analyse_estimate(problem, theta)
    groups = list_groups(analysis)
    assert set(groups) == {"A*k/J", "B/J", "c/J"}
    assert groups["A*k/J"].members == ("J", "A", "k")
    assert groups["A*k/J"].value == pytest.approx(2.25)
    assert set(list_statuses(analysis).values()) == {"group"}
    assert all(e.stderr is None and "B/J" in e.reason for e in analysis.estimates if e.name == "B")


def test_the_standard_error_of_a_group_is_that_of_the_parameter_in_its_place() -> None:
    problem, theta = build_problem(ARM, TRUTH)
    groups = list_groups(analyse_estimate(problem, theta))
    given = {"J": {"fixed": 2.0}, "k": {"fixed": 1.5}}
    known, part = build_problem(ARM, TRUTH, parameters=given)
    alone = {e.name: e for e in analyse_estimate(known, part).estimates}
    for name, expression, factor in (("A", "A*k/J", 1.5 / 2), ("B", "B/J", 0.5), ("c", "c/J", 0.5)):
        assert alone[name].status == "identified"
        assert alone[name].stderr is not None
        # One free parameter less and one direction less: the same degrees of freedom but for 2.
        expected = alone[name].stderr * factor
        assert groups[expression].stderr == pytest.approx(expected, rel=0.01)


def test_a_sum_is_written_as_a_sum() -> None:
    written = build_document({"x": "(a + b)*u - 2*c*x"}, ("a", "b", "c"))
    problem, theta = build_problem(written, {"a": 0.7, "b": 2.3, "c": 1.1})
    analysis = analyse_estimate(problem, theta)
    assert list_statuses(analysis) == {"a": "group", "b": "group", "c": "identified"}
    assert [(g, v.value) for g, v in list_groups(analysis).items()] == [
        ("a + b", pytest.approx(3.0))
    ]


def test_a_combination_that_is_neither_is_told_with_numbers() -> None:
    written = build_document({"x": "(a + sin(b))*u - c*x"}, ("a", "b", "c"))
    problem, theta = build_problem(written, {"a": 0.7, "b": 0.3, "c": 1.1})
    analysis = analyse_estimate(problem, theta)
    [(text, group)] = list_groups(analysis).items()
    assert text == "a + 0.9553*b"  # cos(0.3)
    assert group.is_local
    assert analysis.estimates[0].reason.endswith(": a + 0.9553*b (near the estimate)")


def test_a_combination_that_holds_everywhere_is_not_said_to_hold_near_the_estimate() -> None:
    problem, theta = build_problem(ARM, TRUTH)
    analysis = analyse_estimate(problem, theta)
    assert not any(group.is_local for group in list_groups(analysis).values())
    assert not any("near the estimate" in estimate.reason for estimate in analysis.estimates)


def test_groups_that_have_no_parameter_in_common_are_told_apart() -> None:
    written = build_document({"x": "a*b*u - c*d*x"}, ("a", "b", "c", "d"))
    problem, theta = build_problem(written, {"a": 0.7, "b": 2.3, "c": 1.1, "d": 0.9})
    assert set(list_groups(analyse_estimate(problem, theta))) == {"a*b", "c*d"}


def test_powers_other_than_one_are_written() -> None:
    written = build_document({"x": "a*sqrt(b)*u - c*x"}, ("a", "b", "c"))
    problem, theta = build_problem(written, {"a": 0.7, "b": 2.3, "c": 1.1})
    assert set(list_groups(analyse_estimate(problem, theta))) == {"a**2*b"}


@pytest.mark.parametrize(
    ("form", "a", "text"),
    [
        ("a**3*b**2", 0.7, "a**1.5*b"),
        ("a**3*b**2", -0.7, "a - 0.2029*b"),  # a/1.5 per b: a fractional power would be no number
        ("a**2*b", -0.7, "a**2*b"),
        ("a*b", -0.7, "a*b"),
    ],
)
def test_a_power_of_a_negative_estimate_is_written_only_where_it_is_a_number(
    form: str, a: float, text: str
) -> None:
    written = build_document({"x": f"{form}*u - c*x"}, ("a", "b", "c"))
    written["parameters"]["a"] = {"lower": -2, "upper": 2}
    problem, theta = build_problem(written, {"a": a, "b": 2.3, "c": 1.1})
    ((found, group),) = list_groups(analyse_estimate(problem, theta)).items()
    assert found == text
    assert np.isfinite(group.value)
    assert group.stderr is not None
    assert np.isfinite(group.stderr)


def test_a_parameter_without_effect_belongs_to_no_group() -> None:
    written = build_document({"x": "a*u - c*x + 0*d"}, ("a", "c", "d"))
    problem, theta = build_problem(written, {"a": 0.7, "c": 1.1, "d": 2.0})
    analysis = analyse_estimate(problem, theta)
    assert list_statuses(analysis)["d"] == "unidentifiable"
    assert list_groups(analysis) == {}


def test_what_the_data_tell_little_of_is_a_group_with_a_standard_error() -> None:
    written = build_document({"x": "(a + b)*u + 0.0001*b - c*x"}, ("a", "b", "c"))
    problem, theta = build_problem(written, {"a": 0.7, "b": 2.3, "c": 1.1})
    analysis = analyse_estimate(problem, theta)
    assert list_statuses(analysis) == {"a": "group", "b": "group", "c": "identified"}
    (group,) = list_groups(analysis).values()
    assert group.value == pytest.approx(3.0, rel=0.01)
    assert group.stderr is not None
    assert group.stderr < 0.05
    assert all(e.stderr is not None and e.stderr > 5 for e in analysis.estimates[:2])


@pytest.mark.parametrize(
    ("equation", "names", "rank"),
    [
        ("a*u - b*x", "ab", 2),
        ("a*b*u - x", "ab", 1),
        ("a*(u - b*x)", "ab", 2),
        ("(a*u - b*x)/c", "abc", 2),
        ("sin(a*u)*b - x", "ab", 2),
        ("where(a*x > b, u, 0) - x", "ab", 1),
        ("where(a*x > 0, u, 0) - x", "a", 0),
        ("u*max(a*b, c) - x", "abc", 2),
        ("a**2*u/b**2 - x", "ab", 1),
        ("a*u + 1 - x", "a", 1),
        ("u(t - a*b/40) - x", "ab", 1),
        ("a*sign(b*u) - x", "ab", 1),
    ],
)
def test_the_rank_follows_from_the_form_of_the_equation(
    equation: str, names: str, rank: int
) -> None:
    written = build_document({"x": equation}, tuple(names))
    written["parameters"] = {name: {"lower": 0.1, "upper": 3} for name in names}
    model = parse_model(written)
    assert len(names) - find_scalings(model, model.parameters).shape[0] == rank


def test_a_scaling_leaves_the_output_as_it_is() -> None:
    problem, theta = build_problem(ARM, TRUTH)
    for powers in find_scalings(problem.model, problem.all_parameters):
        scaled = theta * 1.3**powers
        np.testing.assert_allclose(
            problem.predict(scaled[None]), problem.predict(theta[None]), rtol=1e-10
        )


def test_a_state_that_starts_elsewhere_than_at_zero_has_its_scale() -> None:
    equations = {"y": "a*z - y", "z": "b*u - z"}
    free = parse_model(build_document(equations, ("a", "b")))
    bound = parse_model(build_document(equations, ("a", "b"), initial={"y": 0, "z": 1}))
    assert find_scalings(free, free.parameters).tolist() == [[1.0, -1.0]]
    assert find_scalings(bound, bound.parameters).size == 0


def test_a_fixed_parameter_is_no_part_of_a_scaling() -> None:
    problem, _ = build_problem(ARM, TRUTH, parameters={"J": {"fixed": 2.0}})
    assert find_scalings(problem.model, problem.all_parameters).tolist() == [[1.0, -1.0, 0.0, 0.0]]


ACTUATOR = catalogue_cases.ARM | {"k_b": catalogue_cases.ARM["k_a"]}
FREE = {
    "k_b": {"lower": 5, "upper": 500},
    "A_m": {"lower": 1e-7, "upper": 1e-3},
    "B": {"lower": 1e-5, "upper": 0.1, "scale": "log"},
    "theta(0)": {"fixed": 0.0},
}


@pytest.mark.slow
def test_of_the_eight_parameters_of_the_actuator_six_combinations_can_be_found() -> None:
    times = 0.005 * np.arange(800)
    rng = np.random.default_rng(1)
    levels = np.repeat(rng.uniform(-3e4, 3e4, 40), 20)
    supply = Channel("P_a", times, levels, "Pa", hold="zero")
    model = load_model("actuator")
    blank = Record((supply,), (Channel("theta", times, np.zeros(800), "rad"),))
    problem = Problem.build(model, [blank], parameters=FREE)
    theta = np.array([ACTUATOR[p.name] for p in problem.free_parameters])
    y = problem.predict(theta[None])[0] + 1e-3 * rng.standard_normal(800)
    measured = replace_output(blank, np.concatenate([[0.0], y[1:]]))
    analysis = analyse_estimate(Problem.build(model, [measured], parameters=FREE), theta)
    groups = list_groups(analysis)
    assert set(groups) == {"B/J", "F_c/J", "F_max/J", "k_b*A_m/J", "k_c*A_m/J"}
    assert list_statuses(analysis)["k_a"] == "identified"
    assert analysis.uncertainty is not None
    assert np.sum(analysis.uncertainty.singular_values > 1e-10) == 6
    relative = {name: (g.stderr or 0.0) / g.value for name, g in groups.items()}
    assert relative["B/J"] > 0.2  # next to nothing, where the others are told to 1 %
    assert max(share for name, share in relative.items() if name != "B/J") < 0.02


def replace_output(record: Record, values: FloatArray) -> Record:
    old = record.outputs[0]
    return Record(record.inputs, (Channel(old.name, old.times, values, old.unit),))


def test_a_factor_of_a_sum_is_small_or_not_by_what_it_makes_of_it() -> None:
    """Of a parameter in the thousands a factor of 1/2000 counts."""
    written = build_document({"x": "(sin(a) + b/2000)*u - c*x"}, ("a", "b", "c"))
    written["parameters"]["b"] = {"lower": 1, "upper": 5000}
    problem, theta = build_problem(written, {"a": 0.3, "b": 1000.0, "c": 1.1})
    (group,) = list_groups(analyse_estimate(problem, theta)).values()
    assert group.members == ("a", "b")
    assert group.value == pytest.approx(0.3 + 1000 / 2000 / np.cos(0.3), rel=1e-3)


def test_where_a_factor_is_zero_the_other_has_no_effect_and_it_is_no_group() -> None:
    written = build_document({"x": "a*b*u + 1 - c*x"}, ("a", "b", "c"))
    written["parameters"]["a"] = {"lower": 0, "upper": 2}
    problem, theta = build_problem(written, {"a": 0.0, "b": 2.3, "c": 1.1})
    analysis = analyse_estimate(problem, theta)
    assert list_statuses(analysis) == {"a": "at bound", "b": "unidentifiable", "c": "identified"}
    assert list_groups(analysis) == {}
    assert analysis.estimates[0].stderr is not None
