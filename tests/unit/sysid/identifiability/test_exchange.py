"""Parameters that can change places: found, told, given in one order, and never counted twice."""

from typing import Any

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identifiability import subsystems
from sysid.identifiability.exchange import (
    ExchangeGroups,
    describe_exchanges,
    find_exchanges,
    order_exchangeable,
)
from sysid.identification.identify import identify
from sysid.language.tree import Expression
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from sysid.uncertainty.profile_likelihood import compute_profile

TIMES = 0.1 * np.arange(300.0)
U = Channel("u", TIMES, np.repeat(np.random.default_rng(3).normal(size=30), 10), hold="zero")
SPAN = {"lower": 0.1, "upper": 5, "unit": "s"}
FORMS: dict[str, dict[str, Any]] = {
    "in series": {
        "states": {"x": "m", "y": "m"},
        "equations": {"x": "(K*u(t-L) - x)/T1", "y": "(x - y)/T2"},
        "outputs": {"z": "y"},
        "initial": {"x": 0, "y": 0},
    },
    "symmetric": {
        "states": {"x": "m", "v": "m/s"},
        "equations": {"x": "v", "v": "(K*u(t-L) - x - (T1 + T2)*v)/(T1*T2)"},
        "outputs": {"z": "x"},
        "initial": {"x": 0, "v": 0},
    },
    "unlike": {
        "states": {"x": "m", "y": "m"},
        "equations": {"x": "(K*u(t-L) - x)/T1", "y": "(x + y*0.2 - y)/T2"},
        "outputs": {"z": "y + 0.1*x"},
        "initial": {"x": 0, "y": 0},
    },
}
TRUTH = {"K": 2.0, "L": 0.3, "T1": 1.5, "T2": 0.5}
THETA = np.array(list(TRUTH.values()))


def build_model(form: str, **bounds: dict[str, float]) -> Model:
    parameters = {
        "K": {"lower": 0.1, "upper": 5, "unit": "m"},
        "L": {**SPAN, "upper": 1},
        "T1": SPAN,
        "T2": SPAN,
    }
    changed = {name: {**one, **bounds.get(name, {})} for name, one in parameters.items()}
    return parse_model(
        {
            "name": "two",
            "form": "differential",
            "inputs": {"u": "V"},
            "parameters": changed,
            **FORMS[form],
        }
    )


def make_record(form: str) -> Record:
    clean = simulate(build_model(form), [U], TRUTH, times=TIMES).channels[0]
    noise = np.random.default_rng(4).normal(0, 0.05, TIMES.size)
    return Record((U,), (Channel("z", TIMES, clean.values + noise, "m"),))


def build_problem(form: str, **bounds: dict[str, float]) -> Problem:
    return Problem.build(build_model(form, **bounds), [make_record(form)])


@pytest.mark.parametrize(
    ("form", "expected"),
    [("in series", (((2,), (3,)),)), ("symmetric", (((2,), (3,)),)), ("unlike", ())],
)
def test_an_exchange_is_found_whether_or_not_the_equations_show_it(
    form: str, expected: ExchangeGroups
) -> None:
    found, spent = find_exchanges(build_problem(form), THETA)
    assert found == expected
    # The lag is no candidate, and the gain has another unit; what is found is looked at twice.
    assert spent == (5 if expected else 3)


@pytest.mark.parametrize("form", ["(K*u(t-L) - x)/(T1*T2)", "(K*u(t-L) - x)/(T1 + T2)"])
def test_what_is_known_as_a_product_or_a_sum_only_is_no_exchange(form: str) -> None:
    made = parse_model(
        {
            **(build_model("symmetric").document or {}),
            "states": {"x": "m"},
            "equations": {"x": form},
            "outputs": {"z": "x"},
            "initial": {"x": 0},
        }
    )
    assert find_exchanges(Problem.build(made, [make_record("symmetric")]), THETA)[0] == ()


def test_it_is_found_at_a_double_pole_too() -> None:
    assert find_exchanges(build_problem("in series"), np.array([2.0, 0.3, 1.0, 1.0]))[0] == (
        ((2,), (3,)),
    )


PARALLEL = {"equations": {"x": "(K*u - x)/T1", "y": "(M*u - y)/T2"}, "outputs": {"z": "x + y"}}
BESIDE = {"equations": {"x": "(K*u - x)/T1", "y": "(x - y)/T2"}, "outputs": {"z": "y + M*x"}}


@pytest.mark.parametrize(
    ("form", "theta", "expected"),
    [
        # Both gains at their bound: not the time constants alone, but with the gains.
        (PARALLEL, [5.0, 5.0, 1.5, 0.5], (((0, 2), (1, 3)),)),
        (BESIDE, [2.0, 0.0, 1.5, 0.5], ()),  # the way past the second one is closed
    ],
)
def test_what_can_be_exchanged_at_this_estimate_only_is_none(
    form: dict[str, Any], theta: list[float], expected: ExchangeGroups
) -> None:
    gain = {"lower": -5, "upper": 5, "unit": "m"}
    made = parse_model(
        {
            **(build_model("in series").document or {}),
            **form,
            "parameters": {"K": gain, "M": gain, "T1": SPAN, "T2": SPAN},
        }
    )
    found = find_exchanges(Problem.build(made, [make_record("in series")]), np.array(theta))[0]
    assert found == expected


@pytest.mark.parametrize("scale", ["linear", "log"])
@pytest.mark.parametrize("second", [0.5, 1.5])
def test_it_is_found_in_wide_bounds_where_the_middle_of_the_range_diverges(
    scale: str, second: float
) -> None:
    wide: dict[str, Any] = {"lower": 1e-3, "upper": 1e3, "scale": scale}
    posed = build_problem("in series", T1=wide, T2=wide)
    assert find_exchanges(posed, np.array([2.0, 0.3, 1.5, second]))[0] == (((2,), (3,)),)


def test_bounds_that_tell_which_is_which_leave_nothing_to_be_exchanged() -> None:
    posed = build_problem("in series", T1={"lower": 1.0}, T2={"upper": 0.9})
    assert find_exchanges(posed, THETA) == ((), 0)


def test_a_budget_is_kept() -> None:
    assert find_exchanges(build_problem("in series"), THETA, 4) == ((), 0)


def test_three_in_a_row_are_one_group() -> None:
    made = parse_model(
        {
            "name": "three",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "V", "y": "V", "w": "V"},
            "parameters": dict.fromkeys(("T1", "T2", "T3"), SPAN),
            "equations": {"x": "(u - x)/T1", "y": "(x - y)/T2", "w": "(y - w)/T3"},
            "outputs": {"z": "w"},
            "initial": {"x": 0, "y": 0, "w": 0},
        }
    )
    posed = Problem.build(made, [Record((U,), (Channel("z", TIMES, np.sin(TIMES), "V"),))])
    groups, _ = find_exchanges(posed, np.array([0.4, 1.0, 2.0]))
    assert groups == (((0,), (1,), (2,)),)
    assert order_exchangeable(posed, np.array([[0.4, 2.0, 1.0]]), groups).tolist() == [
        [2.0, 1.0, 0.4]
    ]
    [note] = describe_exchanges(posed, groups, {"T1", "T2", "T3"})
    assert note.startswith("T1 and T2 and T3 can be exchanged")
    assert describe_exchanges(posed, groups, {"T1", "T2"}) == ()


GAIN = {"lower": 0, "upper": 5, "unit": "m"}
START = {"lower": -2, "upper": 2}


def beside(
    subsystems: str = "xy", records: int = 1, written: dict[str, str] | None = None, **changed: Any
) -> Problem:
    """First orders side by side, each with its own gain, time constant and start."""
    document = {
        "name": "beside",
        "form": "differential",
        "inputs": {"u": "V"},
        "states": dict.fromkeys(subsystems, "m"),
        "parameters": {f"K{s}": GAIN for s in subsystems} | {f"T{s}": SPAN for s in subsystems},
        "equations": {s: f"(K{s}*u - {s})/T{s}" for s in subsystems} | (written or {}),
        "outputs": {"z": "0 + " + " + ".join(subsystems)},
        "initial": dict.fromkeys(subsystems, START),
    }
    document["parameters"] |= changed
    return Problem.build(parse_model(document), [make_record("in series")] * records)


def name_units(posed: Problem, found: ExchangeGroups) -> list[list[str]]:
    return [
        [" ".join(posed.free_parameters[d].name for d in unit) for unit in one] for one in found
    ]


def drawn(posed: Problem, seed: int = 1) -> FloatArray:
    lower, upper = posed.evaluator.lower, posed.evaluator.upper
    place = np.random.default_rng(seed).uniform(0.1, 0.4, lower.size)
    return np.asarray(lower + place * (upper - lower))


@pytest.mark.parametrize(
    "written",
    [
        {},
        {"x": "(-x + Kx*u)/Tx", "y": "(u*Ky + -y)/Ty"},
        {"x": "(Kx*u - x)/Tx*cos(x)", "y": "cos(y)*((Ky*u - y)/Ty)"},
    ],
)
def test_sections_side_by_side_change_places_with_gains_and_starts(written: dict[str, str]) -> None:
    posed = beside(written=written)
    found, spent = find_exchanges(posed, drawn(posed))
    assert name_units(posed, found) == [["Kx Tx x(0)", "Ky Ty y(0)"]]
    assert spent == 2 * 3 + 5  # a pair of gains, one of time constants; the sections
    [note] = describe_exchanges(posed, found, {"Tx", "Ty"})
    assert note.startswith("(Kx, Tx, x(0)) and (Ky, Ty, y(0)) can be exchanged as a whole")
    assert describe_exchanges(posed, found, {"Tx", "Ky"}) == ()


@pytest.mark.parametrize(
    ("written", "changed"),
    [
        ({"y": "(Ky*u - y*1.01)/Ty"}, {}),  # another form
        ({"y": "(Ky*u(t - 0.1) - y)/Ty"}, {}),
        ({"y": "(Ky*u - y - 0.1*x)/Ty"}, {}),  # the same, with what the other does not read
        ({}, {"Ty": SPAN | {"unit": "min"}}),
        (
            {},
            {"Ty": SPAN | {"lower": 2}, "Tx": SPAN | {"upper": 1.9}},
        ),  # bounds tell which is which
        ({}, {"Ty": SPAN | {"fixed": 1.0}}),
        ({"y": "(Ky*u - y)/Tx"}, {}),  # the sum of the gains is all that shows
    ],
)
def test_sections_that_are_not_alike_are_not_exchanged(
    written: dict[str, str], changed: dict[str, Any]
) -> None:
    if "Tx" in written.get("y", ""):
        changed = {**changed, "Ty": SPAN | {"fixed": 1.0}}
    posed = beside(written=written, **changed)
    assert find_exchanges(posed, drawn(posed))[0] == ()


def test_sums_of_names_that_fit_either_way_round_are_not_all_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of ten factors 1024 ways; that the last one has another number is seen in each of them."""
    letters = "abcdefghij"

    def product(state: str, last: int) -> str:
        factors = [f"({one}{state} + {one}{one}{state})" for one in letters]
        return f"{'*'.join(factors)}*({last}*u - {state})"

    names = [
        f"{one}{state}" for letter in letters for one in (letter, 2 * letter) for state in "xy"
    ]
    written = {"x": product("x", 1), "y": product("y", 2)}
    posed = beside(written=written, **dict.fromkeys(names, SPAN))
    apart, looked_at = subsystems._split_expression, []

    def count_and_part(tree: Expression) -> Any:
        looked_at.append(tree)
        return apart(tree)

    monkeypatch.setattr(subsystems, "_split_expression", count_and_part)
    assert list(subsystems.find_equivalent_subsystems(posed)) == []
    assert len(looked_at) < 10_000


def test_three_sections_side_by_side_are_one_group_and_are_given_in_order() -> None:
    posed = beside("xyw")
    theta = drawn(posed)
    found, spent = find_exchanges(posed, theta)
    assert name_units(posed, found) == [["Kx Tx x(0)", "Ky Ty y(0)", "Kw Tw w(0)"]]
    assert spent <= 2 * 9 + 2 * 5
    after = order_exchangeable(posed, theta[None], found)[0]
    assert after[0] > after[1] > after[2]
    np.testing.assert_allclose(posed.predict(after[None]), posed.predict(theta[None]), rtol=1e-12)
    assert find_exchanges(posed, theta, spent - 5)[1] <= spent - 5


def test_each_experiment_has_starts_of_its_own() -> None:
    posed = beside(records=2)
    found, _ = find_exchanges(posed, drawn(posed))
    assert name_units(posed, found) == [["Kx Tx x(0) x(0)[2]", "Ky Ty y(0) y(0)[2]"]]


def test_sections_of_two_states_change_places_with_all_their_parameters() -> None:
    made = parse_model(
        {
            "name": "modes",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"a": "m", "v": "m/s", "b": "m", "w": "m/s"},
            "parameters": {name: {"lower": 0.1, "upper": 5} for name in ("ka", "ca", "kb", "cb")},
            "equations": {"a": "v", "v": "u - ka*a - ca*v", "b": "w", "w": "u - kb*b - cb*w"},
            "outputs": {"z": "a + b"},
            "initial": {"a": 0, "v": START, "b": 0, "w": START},
        }
    )
    posed = Problem.build(made, [make_record("in series")])
    found, _ = find_exchanges(posed, np.array([3.0, 0.5, 1.0, 0.2, 0.4, -0.3]))
    assert name_units(posed, found) == [["ka ca v(0)", "kb cb w(0)"]]


def test_sections_that_begin_unlike_are_told_apart() -> None:
    document = dict(beside().model.document or {})
    made = parse_model({**document, "initial": {"x": 0, "y": 1}})
    posed = Problem.build(made, [make_record("in series")])
    assert find_exchanges(posed, drawn(posed))[0] == ()


def test_whatever_the_seed_sections_are_given_in_one_order() -> None:
    posed = beside()
    theta = np.array([4.0, 1.0, 3.0, 0.4, 0.5, -0.5])
    clean = posed.predict(theta[None])[0]
    noise = np.random.default_rng(4).normal(0, 0.02, clean.size)
    data = Record((U,), (Channel("z", TIMES, clean + noise, "m"),))
    for seed in range(3):
        found = identify(posed.model, data, GeneticAlgorithm(islands=2), seed=seed)
        values = {e.name: e.value for e in found.parameters}
        assert values["Kx"] == pytest.approx(4.0, abs=0.3)
        assert values["Ty"] == pytest.approx(0.4, abs=0.1)
        assert values["x(0)"] > values["y(0)"]
        assert any("can be exchanged as a whole" in text for text in found.warnings)
        assert all(island.parameters[0] >= island.parameters[1] for island in found.islands)


@pytest.mark.parametrize("name", ["Kx", "Ty"])
def test_a_profile_stays_with_one_order_of_sections(name: str) -> None:
    posed = beside()
    theta = np.array([4.0, 1.0, 3.0, 0.4, 0.5, -0.5])
    clean = posed.predict(theta[None])[0]
    noise = np.random.default_rng(4).normal(0, 0.02, clean.size)
    data = Record((U,), (Channel("z", TIMES, clean + noise, "m"),))
    again = Problem.build(posed.model, [data])
    places = [one.name for one in again.free_parameters]
    swapped = theta[[1, 0, 3, 2, 5, 4]]
    found = compute_profile(again, swapped, name, points=21)
    partner = places.index({"Kx": "Ky", "Ty": "Tx"}[name])
    own = found.others[:, partner - (partner > places.index(name))]
    larger, smaller = (found.values, own) if name == "Kx" else (own, found.values)
    assert np.all(larger >= smaller - 1e-5)


def test_what_no_bounds_let_be_put_in_order_is_not_said_to_be() -> None:
    spans = {"T1": (0.1, 1.2), "T2": (0.1, 5.0), "T3": (0.9, 5.0)}
    made = parse_model(
        {
            "name": "three",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "V", "y": "V", "w": "V"},
            "parameters": {
                k: {"lower": low, "upper": up, "unit": "s"} for k, (low, up) in spans.items()
            },
            "equations": {"x": "(u - x)/T1", "y": "(x - y)/T2", "w": "(y - w)/T3"},
            "outputs": {"z": "w"},
            "initial": {"x": 0, "y": 0, "w": 0},
        }
    )
    posed = Problem.build(made, [Record((U,), (Channel("z", TIMES, np.sin(TIMES), "V"),))])
    assert find_exchanges(posed, np.array([1.0, 1.1, 3.0]))[0] == ()  # T1 cannot be 3
    assert find_exchanges(posed, np.array([1.15, 1.1, 1.0]))[0] == (((0,), (1,), (2,)),)


def test_of_many_parameters_most_pairs_are_ruled_out_by_one_simulation_of_each() -> None:
    gains = [f"g{i}" for i in range(12)]
    made = parse_model(
        {
            "name": "many",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "V", "y": "V"},
            "parameters": dict.fromkeys(("T1", "T2"), SPAN)
            | {name: {"lower": -1, "upper": 1} for name in gains},
            "equations": {
                "x": f"({' + '.join(f'g{i}*tanh({i + 1}*u)' for i in range(12))} - x)/T1",
                "y": "(x - y)/T2",
            },
            "outputs": {"z": "y"},
            "initial": {"x": 0, "y": 0},
        }
    )
    posed = Problem.build(made, [Record((U,), (Channel("z", TIMES, np.sin(TIMES), "V"),))])
    values = {"T1": 1.5, "T2": 0.5} | dict(zip(gains, np.linspace(-0.5, 0.6, 12), strict=True))
    theta = np.array([values[one.name] for one in posed.free_parameters])
    found, spent = find_exchanges(posed, theta)
    assert [[posed.free_parameters[d].name for (d,) in group] for group in found] == [["T1", "T2"]]
    assert spent == 12 + 5  # of three for each of 67 pairs


def test_four_in_a_row_are_one_group_though_looked_at_together_first() -> None:
    names = ["T1", "T2", "T3", "T4"]
    made = parse_model(
        {
            "name": "four",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": dict.fromkeys("abcd", "V"),
            "parameters": dict.fromkeys(names, SPAN),
            "equations": {
                "a": "(u - a)/T1",
                "b": "(a - b)/T2",
                "c": "(b - c)/T3",
                "d": "(c - d)/T4",
            },
            "outputs": {"z": "d"},
            "initial": dict.fromkeys("abcd", 0),
        }
    )
    posed = Problem.build(made, [Record((U,), (Channel("z", TIMES, np.sin(TIMES), "V"),))])
    found, spent = find_exchanges(posed, np.array([0.4, 1.0, 2.0, 0.7]))
    assert found == (((0,), (1,), (2,), (3,)),)
    assert spent == 4 + 3 * 5
    assert find_exchanges(posed, np.array([0.4, 1.0, 2.0, 0.7]), 8)[1] <= 8


def test_whatever_the_seed_the_larger_comes_first_and_it_is_told() -> None:
    found = [
        identify(
            build_model("in series"),
            make_record("in series"),
            GeneticAlgorithm(islands=2),
            seed=seed,
        )
        for seed in range(4)
    ]
    for one in found:
        values = {e.name: e.value for e in one.parameters}
        assert values["T1"] == pytest.approx(1.5, abs=0.2)
        assert values["T2"] == pytest.approx(0.5, abs=0.2)
        assert any("T1 and T2 can be exchanged" in text for text in one.warnings)
        assert all(island.parameters[2] >= island.parameters[3] for island in one.islands)
        for e in one.parameters:
            assert e.interval95 is not None
            assert e.interval95[1] - e.interval95[0] < 0.8


@pytest.mark.parametrize("name", ["T1", "T2"])
def test_a_profile_stays_with_one_copy(name: str) -> None:
    posed = build_problem("in series")
    found = compute_profile(posed, THETA, name, points=41)
    own = found.others[:, 2]  # the other time constant
    larger, smaller = (found.values, own) if name == "T1" else (own, found.values)
    assert np.all(larger >= smaller - 1e-5)
    low, high = found.interval
    assert low is not None
    assert high is not None
    assert low < TRUTH[name] < high
    assert high - low < 0.8


@pytest.mark.parametrize("name", ["T1", "T2"])
def test_a_profile_that_reaches_a_double_pole_does_not_go_on_in_the_other_copy(name: str) -> None:
    near = TRUTH | {"T1": 1.1, "T2": 0.9}
    clean = simulate(build_model("in series"), [U], near, times=TIMES).channels[0]
    noise = np.random.default_rng(4).normal(0, 0.2, TIMES.size)
    data = Record((U,), (Channel("z", TIMES, clean.values + noise, "m"),))
    posed = Problem.build(build_model("in series"), [data])
    found = compute_profile(posed, np.array(list(near.values())), name, points=7)
    own = found.others[:, 2]
    larger, smaller = (found.values, own) if name == "T1" else (own, found.values)
    assert np.all(larger >= smaller - 1e-5)
    assert np.min(larger - smaller) < 1e-3
