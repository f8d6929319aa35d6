"""Laws of scalings: what the form of the equations is said to hide, no simulation shows."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.data.records import Channel
from sysid.identifiability.scaling_symmetries import find_scalings
from sysid.models.catalogue.load import load_model
from sysid.models.model import EstimatedInitial, Model, build_initial_parameters, name_initial_state
from sysid.models.parameters import Parameter
from sysid.models.parse import parse_model
from sysid.simulation.simulate import simulate
from tests.support.library.catalogue_cases import CASES

FACTOR = 2.0


def as_it_is(model: Model) -> Model:
    """The model of the catalogue."""
    return model


def all_free(model: Model) -> Model:
    """The model with nothing given: no parameter is fixed or tied."""
    free = (replace(one, fixed=None, tied=None) for one in model.parameters)
    return replace(model, parameters=tuple(free))


def free_every_start(model: Model) -> Model:
    """The same, and every initial state is to be estimated too."""
    anywhere = (EstimatedInitial(-10.0, 10.0),) * len(model.states)
    return replace(all_free(model), initial=anywhere)


def check_scalings(
    model: Model, values: dict[str, float], inputs: tuple[Channel, ...], times: FloatArray
) -> int:
    """Check every scaling of a model at some values; gives how many there are."""
    parameters: list[Parameter] = [*model.parameters, *build_initial_parameters(model, 1)]
    free = [one.name for one in parameters if one.is_free]
    found = find_scalings(model, parameters)
    before = simulate(model, inputs, values, times=times).channels
    for powers in found:
        factors = dict(zip(free, FACTOR**powers, strict=True))
        moved = {name: factors.get(name, 1.0) * value for name, value in values.items()}
        after = simulate(model, inputs, moved, times=times).channels
        for one, other in zip(before, after, strict=True):
            assert np.isfinite(one.values).any()
            size = float(np.nanmax(np.abs(one.values)))
            np.testing.assert_allclose(other.values, one.values, rtol=1e-7, atol=1e-9 * size)
    return len(found)


def values_of(model: Model, name: str) -> dict[str, float]:
    """Every value that a simulation needs, of a case of the catalogue."""
    case = CASES[name]
    ties = {p.name: case.truth[p.tied] for p in load_model(name).parameters if p.tied}
    starts = {name_initial_state(s.name, 0): 0.0 for s in model.states}
    needed = {
        name_initial_state(s.name, 0)
        for s, start in zip(model.states, model.initial, strict=True)
        if isinstance(start, EstimatedInitial)
    }
    given = {**ties, **case.truth, **case.initial}
    return {n: v for n, v in starts.items() if n in needed} | given


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("freed", [as_it_is, all_free, free_every_start])
def test_a_scaling_of_a_model_of_the_catalogue_leaves_its_outputs(
    name: str, freed: Callable[[Model], Model]
) -> None:
    model, case = freed(load_model(name)), CASES[name]
    times: FloatArray = case.period * np.arange(min(case.samples, 400), dtype=np.float64)
    inputs = tuple(
        Channel(one.name, times, case.signal(times), one.unit, case.hold)
        for one in model.inputs
        if case.signal is not None
    )
    check_scalings(model, values_of(model, name), inputs, times)


@pytest.mark.parametrize(
    ("equation", "count"),
    [
        ("u*a/(1 + z**b)", 0),
        ("a*z*u**b", 1),
        ("a*u*2**b - z*c", 1),
        ("a*u*c**b - z", 1),
        ("a*u/c**2*sqrt(b) - z", 3),
        ("a*(b*u - c*z)", 2),
        ("where(a*z > b, u, c) - z", 1),
        ("sign(a*z)*u*b - max(c*z, -z)", 2),
        ("a*u*atan(b*c) - z", 2),
        ("u(t - a*b/40) - c*z", 1),
        ("a*u - b*abs(z)**c", 0),
        ("a*u - b*abs(z)**(1/3)", 1),
        ("a*u - b*abs(z)**-(2/3 - 1)", 1),
        ("a*u - b*abs(z)**0.123456789", 1),
        ("a*u - b*abs(z)**(2*0.25/(1 + 1/5))", 1),
        ("a*u - b*abs(z)**(1/(2 - 2*1))", 0),
    ],
)
def test_scalings_of_an_equation_of_a_hidden_state(equation: str, count: int) -> None:
    names = [one for one in "abcd" if one == "d" or re.search(rf"\b{one}\b", equation)]
    model = parse_model(
        {
            "name": "test",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"z": "m", "y": "m"},
            "parameters": {one: {"lower": 0.1, "upper": 4} for one in names},
            "equations": {"z": equation, "y": "d*z - y"},
            "outputs": {"y": "y"},
            "initial": {"z": {"lower": 0, "upper": 2}, "y": 0},
        }
    )
    times: FloatArray = 0.05 * np.arange(60, dtype=np.float64)
    u = Channel("u", times, 1.5 + np.sin(times), "V", "first")
    truth = {"a": 0.7, "b": 1.3, "c": 0.4, "d": 1.1}
    values = {one: truth[one] for one in names} | {"z(0)": 0.5}
    assert check_scalings(model, values, (u,), times) == count


def test_a_fixed_exponent_hides_the_scaling_no_more_than_a_number_does() -> None:
    model = parse_model(
        {
            "name": "test",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"z": "m", "y": "m"},
            "parameters": {one: {"lower": 0.1, "upper": 4} for one in "abd"}
            | {"n": {"lower": 0.1, "upper": 4, "fixed": 0.37}},
            "equations": {"z": "a*u - b*abs(z)**n", "y": "d*z - y"},
            "outputs": {"y": "y"},
            "initial": {"z": {"lower": 0, "upper": 2}, "y": 0},
        }
    )
    times: FloatArray = 0.05 * np.arange(60, dtype=np.float64)
    u = Channel("u", times, 1.5 + np.sin(times), "V", "first")
    values = {"a": 0.7, "b": 1.3, "d": 1.1, "n": 0.37, "z(0)": 0.5}
    assert check_scalings(model, values, (u,), times) == 1
    free = replace(model, parameters=tuple(replace(p, fixed=None) for p in model.parameters))
    assert check_scalings(free, values, (u,), times) == 0
