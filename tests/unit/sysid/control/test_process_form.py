"""A process with dead time is recognised however its equations are written, and nothing else is."""

from collections.abc import Mapping
from typing import Any

import pytest

from sysid.control.linear_form import IdentifiedModel
from sysid.control.process_form import recognise_process
from sysid.models.catalogue.load import load_model
from sysid.models.catalogue.process_family import Process, list_neighbouring_orders
from sysid.models.model import Model
from sysid.models.parse import parse_model


def write_model(
    equations: Mapping[str, str],
    parameters: Mapping[str, float],
    output: str,
    inputs: tuple[str, ...] = ("u",),
    form: str = "differential",
) -> Model:
    return parse_model(
        {
            "name": "own",
            "form": form,
            "inputs": dict.fromkeys(inputs, "1"),
            "states": dict.fromkeys(equations, "1"),
            "parameters": {
                name: {"lower": min(2 * value, 0), "upper": max(2 * value, 1), "unit": "s"}
                for name, value in parameters.items()
            },
            "equations": dict(equations),
            "outputs": {"y": output},
        }
    )


def recognise(model: Model, values: Mapping[str, float]) -> Process | None:
    return recognise_process(IdentifiedModel.from_numbers(model, values))


FOPDT = {"K": 2.0, "T": 1.5, "L": 0.4, "y0": 20.0}
CATALOGUE: dict[str, tuple[dict[str, float], Process]] = {
    "fopdt": (FOPDT, Process(2.0, (1.5,), 0.4, 20.0)),
    "sopdt": ({**FOPDT, "T1": 1.5, "r": 0.2}, Process(2.0, (1.5, 0.3), 0.4, 20.0)),
    "topdt": (
        {**FOPDT, "T1": 1.5, "r2": 0.4, "r3": 0.5},
        Process(2.0, (1.5, 0.6, 0.3), 0.4, 20.0),
    ),
    "ipdt": ({"K": 2.0, "L": 0.4}, Process(2.0, (), 0.4, 0.0, 1)),
    "foipdt": ({"K": 2.0, "T": 1.5, "L": 0.4}, Process(2.0, (1.5,), 0.4, 0.0, 1)),
    "tube": ({"K": 0.98, "T": 0.3, "L": 0.2}, Process(0.98, (0.3,), 0.2)),
    "tube-second-order": (
        {"K": 1.0, "w": 2.0, "z": 1.25, "L": 0.2},
        Process(1.0, (1.0, 0.25), 0.2),
    ),
}


def assert_same(found: Process | None, expected: Process) -> None:
    assert found is not None
    assert found.time_constants == pytest.approx(expected.time_constants)
    assert found[0] == pytest.approx(expected.gain)
    assert found[2:] == pytest.approx(expected[2:])


@pytest.mark.parametrize("name", CATALOGUE)
def test_the_processes_of_the_catalogue_are_recognised(name: str) -> None:
    values, expected = CATALOGUE[name]
    assert_same(recognise(load_model(name), values), expected)


@pytest.mark.parametrize("name", ["fopdt", "sopdt", "topdt", "ipdt", "foipdt"])
def test_an_entry_of_the_family_returns_the_parameters_it_was_recognised_from(name: str) -> None:
    values, process = CATALOGUE[name]
    [entry] = [one for one in list_neighbouring_orders(process) if one.model == name]
    names = [parameter.name for parameter in load_model(name).parameters]
    assert entry.to_parameters(process) == pytest.approx({key: values[key] for key in names})
    assert entry.order == len(load_model(name).states)


def test_neighbours_differ_by_one_part_and_have_the_same_integrators() -> None:
    def names(parts: int, integrators: int) -> list[str]:
        process = Process(1.0, (1.0,) * parts, 0.1, 0.0, integrators)
        return [entry.model for entry in list_neighbouring_orders(process)]

    assert names(1, 0) == ["fopdt", "sopdt"]
    assert names(2, 0) == ["fopdt", "sopdt", "topdt"]
    assert names(3, 0) == ["sopdt", "topdt"]
    assert names(0, 1) == names(1, 1) == ["ipdt", "foipdt"]
    assert names(4, 0) == names(2, 1) == names(0, 0) == []


@pytest.mark.parametrize(
    ("equations", "values", "output", "expected"),
    [
        ({"x": "b*u(t - L) - a*x"}, {"a": 0.5, "b": 3.0, "L": 0.4}, "x", Process(6.0, (2.0,), 0.4)),
        (
            {"T": "(Q*u(t - L) - c*(T - Ta))/m"},
            {"Q": 4.0, "c": 2.0, "m": 6.0, "Ta": 21.0, "L": 3.0},
            "T",
            Process(2.0, (3.0,), 3.0, 21.0),
        ),
        (
            {"y": "v", "v": "k*u(t - L) - d*v"},
            {"k": 3.0, "d": 2.0, "L": 0.1},
            "10*y",
            Process(15.0, (0.5,), 0.1, 0.0, 1),
        ),
    ],
)
def test_other_ways_to_write_a_process_are_recognised(
    equations: dict[str, str], values: dict[str, float], output: str, expected: Process
) -> None:
    assert_same(recognise(write_model(equations, values, output), values), expected)


@pytest.mark.parametrize(
    ("equations", "values", "output", "changes"),
    [
        ({"x": "u(t - L) - a*x**3"}, {"a": 1.0, "L": 0.2}, "x", {}),  # not linear
        ({"x": "u(t - L) - a*x(t - 1)"}, {"a": 1.0, "L": 0.2}, "x", {}),  # delayed feedback
        ({"x": "u(t - L) + a*x"}, {"a": 1.0, "L": 0.2}, "x", {}),  # unstable
        ({"x": "v", "v": "u(t - L) - v - 4*x"}, {"L": 0.2}, "x", {}),  # rings
        ({"x": "v", "v": "u(t - L)"}, {"L": 0.2}, "x", {}),  # two integrators
        ({"x": "u(t - L) + 0.1"}, {"L": 0.2}, "x", {}),  # drifts at u = 0
        ({"x": "u(t - L) - x"}, {"L": 0.2}, "x + u", {}),  # passes the input on
        ({"x": "u(t - L) - x", "v": "x - 3*v"}, {"L": 0.2}, "v + x", {}),  # a zero
        ({"x": "u(t - L) + u - x"}, {"L": 0.2}, "x", {}),  # two ways
        ({"x": "q + u(t - L) - x"}, {"L": 0.2}, "x", {"inputs": ("u", "q")}),
        ({"x": "0.5*x(k-1) + u(k-1-L/h)"}, {"L": 0.2}, "x", {"form": "difference"}),
    ],
)
def test_what_is_no_process_with_one_dead_time_is_not_recognised(
    equations: dict[str, str], values: dict[str, float], output: str, changes: dict[str, Any]
) -> None:
    assert recognise(write_model(equations, values, output, **changes), values) is None
