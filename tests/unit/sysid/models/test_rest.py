"""Starts that follow from parameters and first input values, and the state of rest."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.errors import InvalidModel
from sysid.core.settings import GeneticAlgorithm
from sysid.data.records import Channel, Record
from sysid.identifiability.scaling_symmetries import find_scalings
from sysid.identification.identify import identify
from sysid.models.model import DerivedInitial, Model
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from tests.support.library import plain_twins
from tests.support.library.small_models import ARX, differential

TIMES = 0.1 * np.arange(120)
NAMES = ("K", "T", "L", "a", "b", "g")
VALUES = {"K": 1.7, "T": 0.6, "L": 0.43, "a": 0.35, "b": 0.8, "g": 2.2}


def build_document(
    equations: dict[str, str], initial: Any = "steady", form: str = "differential", **other: Any
) -> dict[str, Any]:
    return {
        "name": "resting",
        "form": form,
        "inputs": {"u": "V", "q": "V"},
        "states": dict.fromkeys(equations, "1"),
        "parameters": {name: {"lower": 0.1, "upper": 5} for name in NAMES},
        "equations": equations,
        "outputs": {f"y{i}": name for i, name in enumerate(equations)},
        "initial": initial,
        **other,
    }


def make_channels(u: float, q: float, step: float = 0.0) -> list[Channel]:
    """Inputs that stand still, and may step in the middle."""
    late = np.where(TIMES > 6.0, step, 0.0)
    return [Channel("u", TIMES, u + late, "V", "zero"), Channel("q", TIMES, q + late, "V")]


def list_outputs(model: Model, inputs: list[Channel], **changes: float) -> np.ndarray:
    recording = simulate(model, inputs, VALUES | changes, times=TIMES)
    return np.array([channel.values for channel in recording.channels])


DIFFERENTIAL: dict[str, dict[str, str]] = {
    "first order": {"x": "(K*u(t - L) - x)/T"},
    "in series": {"w": "(K*u(t - L) - w)/T", "x": "(w(t - L/2) - x)*b + a*q"},
    "coupled": {"x": "g*(w - x) + u", "w": "a*(x - w) - b*w + q(t - L)"},
    "oscillator with friction": {"x": "v", "v": "(u - b*v - g*x - a*abs(v)*v - v**3)/T"},
    "a switch without states": {"x": "where(u > q, K*u, q) - g*x"},
}
DIFFERENCE: dict[str, dict[str, str]] = {
    "recursion": {"x": "a*x(k-1) + b*u(k-1 - L/h)"},
    "two recursions": {"x": "0.4*w(k-1) + 0.2*x(k-2) + K*u(k-1)", "w": "a*x + 0.1*q(k-1)"},
}
ALL = [(rows, "differential") for rows in DIFFERENTIAL.values()] + [
    (rows, "difference") for rows in DIFFERENCE.values()
]


@pytest.mark.parametrize(("equations", "form"), ALL, ids=[*DIFFERENTIAL, *DIFFERENCE])
def test_what_starts_steady_rests_until_an_input_moves(
    equations: dict[str, str], form: str
) -> None:
    model = parse_model(build_document(equations, form=form))
    y = list_outputs(model, make_channels(1.3, -0.4, step=0.5))
    assert np.all(np.ptp(y[:, :60], axis=1) <= 1e-12)
    assert np.all(np.ptp(y[:, 60:], axis=1) > 1e-3)
    assert np.any(np.abs(y[:, 0]) > 0.1)


@pytest.mark.parametrize(("equations", "form"), ALL, ids=[*DIFFERENTIAL, *DIFFERENCE])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_kernel_starts_where_its_twin_does(
    equations: dict[str, str], form: str, interpolation: str
) -> None:
    solver = {"interpolation": interpolation}
    model = parse_model(build_document(equations, form=form, solver=solver))
    inputs = tuple(make_channels(1.3, -0.4, step=0.5))
    blank = [Channel(output.name, TIMES, np.zeros(TIMES.size)) for output in model.outputs]
    weights = {output.name: 1.0 for output in model.outputs}
    problem = Problem.build(model, [Record(inputs, tuple(blank))], weights=weights)
    draw = np.random.default_rng(1).uniform(0.2, 0.9, (19, len(NAMES)))
    predicted = problem.predict(draw)
    for theta, row in zip(draw, predicted, strict=True):
        np.testing.assert_allclose(row, plain_twins.predictions(problem, theta), atol=1e-9)


def test_an_expression_is_that_of_parameters_and_first_input_values() -> None:
    equations = {"x": "(K*u(t - L) - x)/T"}
    for text in ("K*u0 + a", "K*u + a", "K*u(t) + a"):
        model = parse_model(build_document(equations, {"x": text}))
        assert list_outputs(model, make_channels(1.3, 0.0))[0, 0] == pytest.approx(1.7 * 1.3 + 0.35)
        assert parse_model(model.document) == model
    named = build_document(equations, {"x": "u0"})
    named["parameters"]["u0"] = {"lower": 0, "upper": 5}  # a parameter of that name goes first
    model = parse_model(named)
    assert list_outputs(model, make_channels(1.3, 0.0), u0=3.0)[0, 0] == 3.0


def test_the_first_value_of_an_input_is_that_at_the_start_of_the_simulation() -> None:
    """A recursion starts with its outputs; a held input then has its last sample before."""
    rows = {"x": "a*x(k-1) + b*u(k-1)"}
    model = parse_model(build_document(rows, {"x": "u0 + 10*q0"}, form="difference"))
    late = TIMES + 0.05
    moving = [Channel("u", late, late**2, "V", "zero"), Channel("q", late, late, "V", "first")]
    y = simulate(model, moving, VALUES, times=TIMES[20:60]).channels[0].values
    assert y[0] == pytest.approx(1.95**2 + 10 * 2.0)


def test_a_tied_parameter_is_replaced_in_a_start_too() -> None:
    written = build_document({"x": "(K*u(t - L) - x)/T"})
    written["parameters"]["K"]["tied"] = "2*a"
    others = {name: value for name, value in VALUES.items() if name != "K"}
    y = (
        simulate(parse_model(written), make_channels(1.3, 0.0), others, times=TIMES)
        .channels[0]
        .values
    )
    np.testing.assert_allclose(y, 0.7 * 1.3, rtol=1e-12)


def test_one_state_may_be_steady_while_others_start_elsewhere() -> None:
    rows = DIFFERENTIAL["in series"]
    model = parse_model(build_document(rows, {"w": 2, "x": "steady"}))
    assert list_outputs(model, make_channels(1.0, 0.0))[1, 0] == pytest.approx(2.0)
    both = parse_model(build_document(rows, {"w": "K*u0", "x": "steady"}))
    np.testing.assert_allclose(
        list_outputs(both, make_channels(1.0, 0.5)),
        list_outputs(parse_model(build_document(rows)), make_channels(1.0, 0.5)),
        rtol=1e-12,
    )


@pytest.mark.parametrize(
    ("equations", "initial", "fault"),
    [
        ({"x": "K*u"}, "steady", "the equation of x does not determine it at rest, as of an integ"),
        ({"x": "g*(w - x)", "w": "g*(x - w)"}, "steady", "does not determine it at rest"),
        ({"x": "u - g*x**3"}, "steady", "x**3 is not linear in the states"),
        ({"x": "(u - x)/(T + x)"}, "steady", "is not linear in the states"),
        ({"x": "sin(t) - x"}, "steady", "the equations change with t"),
        (
            {"w": "u - w", "x": "w - x"},
            {"w": {"lower": 0, "upper": 1}, "x": "steady"},
            "it depends on w, whose start is estimated or measured; write w: steady too",
        ),
        ({"x": "u - x"}, {"x": "K*z0"}, "'z0' is not declared"),
        ({"x": "u - x"}, {"x": "K*u(t - L)"}, "a start has no past; write u0, its first value"),
        ({"x": "u - x"}, {"x": "K*t"}, "a start does not depend on t"),
        ({"x": "u - x"}, {"x": True}, "need a number, {lower, upper} to estimate it, measured, st"),
    ],
)
def test_what_has_no_rest_and_what_is_no_start_is_refused(
    equations: dict[str, str], initial: Any, fault: str
) -> None:
    with pytest.raises(InvalidModel) as refused:
        parse_model(build_document(equations, initial))
    [only] = refused.value.faults
    assert fault in only.detail
    assert only.pointer.startswith("/initial")


def test_a_polynomial_of_first_degree_may_start_steady() -> None:
    model = parse_model(ARX | {"initial": "steady"})
    values = {"a[y(k-1)]": 0.8, "a[u(k-1)]": 0.5}
    y = simulate(model, make_channels(1.0, 0.0), values, times=TIMES).channels[0].values
    np.testing.assert_allclose(y, 2.5, rtol=1e-12)


def test_a_plant_at_rest_is_identified_without_a_start_to_estimate() -> None:
    model = parse_model(
        {
            **build_document(DIFFERENTIAL["first order"]),
            "parameters": {n: {"lower": 0.1, "upper": 5} for n in "KTL"},
            "solver": {"substeps": 8},
        }
    )
    rng = np.random.default_rng(3)
    u = Channel("u", TIMES, 2.0 + np.repeat(rng.uniform(-1, 1, 12), 10), "V", "zero")
    q = make_channels(0.0, 0.0)[1]
    y = simulate(model, [u, q], {"K": 1.7, "T": 0.6, "L": 0.43}, times=TIMES).channels[0]
    noisy = replace(y, values=y.values + 0.01 * rng.normal(size=TIMES.size))
    found = identify(model, Record((u, q), (noisy,)), GeneticAlgorithm(generations=60))
    assert found.warnings == ()
    for estimate, true in zip(found.parameters, (1.7, 0.6, 0.43), strict=True):
        assert estimate.stderr is not None
        assert abs(estimate.value - true) < 4 * estimate.stderr < 0.1


def test_a_start_takes_part_in_the_scaling_of_hidden_states() -> None:
    """Only a product K*b has an effect if w starts steady; a fixed start of 1 determines both."""
    rows = {"w": "(K*u - w)/T", "x": "b*w - x"}
    written = build_document(rows)
    written["outputs"] = {"y": "x"}
    written["parameters"] = {name: {"lower": 0.1, "upper": 5} for name in ("K", "T", "b")}
    steady = parse_model(written)
    assert isinstance(steady.initial[0], DerivedInitial)
    fixed = parse_model({**written, "initial": {"w": 1, "x": 1}})
    assert [find_scalings(m, m.parameters).shape[0] for m in (steady, fixed)] == [1, 0]


def test_a_rest_whose_expressions_grow_without_end_is_refused() -> None:
    """Each state is the square of the one before: 2⁶³ factors in the last."""
    squares = {f"x{n}": f"x{n - 1}*x{n - 1} - x{n}" for n in range(1, 64)}
    with pytest.raises(InvalidModel, match="the expressions that solve for it are too long"):
        differential(
            {"x0": "c - x0", **squares}, "x0", initial=dict.fromkeys(["x0", *squares], "steady")
        )
