"""Whatever JSON stands somewhere in a body: an answer with a sentence, never an error inside."""

import json
from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient

from tests.support.profiles import scale_examples

TRUTH = {
    "parameters": {"K": 2, "T": 1, "L": 0.5, "y0": 0},
    "samples": 90,
    "sample_time": 0.1,
    "inputs": {"u": {"kind": "step"}},
}
OWN = {
    "name": "own",
    "form": "differential",
    "inputs": {"u": "V"},
    "states": {"x": "m"},
    "parameters": {"T": {"lower": 1, "upper": 9}, "L": {"lower": 0, "upper": 2}},
    "equations": {"x": "(u@L - x)/T"},
    "outputs": {"y": "x"},
}
AXES = [
    {"path": "/noise/sigma", "values": [0, 0.1]},
    {"path": "/seed", "range": [0, 3]},
    {"path": "/datasets", "values": [["steps"], ["x"]], "labels": [{"n": 1}, {"n": 2}]},
]
STEPS = [
    {"trim": {"start": 1, "stop": 20}},
    {"clip": {"channels": ["y"], "lower": -1, "upper": 3}},
    {"noise": {"sigma": 0.1, "channels": ["y"], "seed": 1}},
    {"resample": {"sample_time": 0.2}},
    {"select": {"segments": [0, 1]}},
]
BODIES: list[tuple[str, dict[str, Any]]] = [
    (
        "/v1/jobs",
        {
            "model": "fopdt",
            "datasets": ["steps"],
            "channels": {"u": "u"},
            "skip": 3,
            "seed": 1,
            "validation": {"fraction": 0.3},
            "parameters": {"K": {"lower": 0, "upper": 5}},
            "algorithm": {"population": 20, "stop": {"settled": 3}},
            "hold": {"u": "zero"},
        },
    ),
    (
        "/v1/jobs",
        {
            "model": OWN,
            "datasets": ["steps"],
            "sweep": {"axes": AXES},
            "trend": {"x": "n", "parameters": ["L"]},
        },
    ),
    ("/v1/recipes/noise-sweep", {"model": "fopdt", "truth": TRUTH, "sigma": [0.1]}),
    (
        "/v1/recipes/reidentify",
        {
            "model": "fopdt",
            "label": "n",
            "trend_parameters": ["L"],
            "batch": [{"x": 1, "datasets": ["steps"]}],
        },
    ),
    ("/v1/models:check", OWN),
    ("/v1/datasets/{dataset}:derive", {"steps": STEPS}),
    ("/v1/datasets:simulate", {"model": "fopdt", **TRUTH}),
]
NAMES = [
    "K",
    "L",
    "x(0)",
    "x(0)[2]",
    "u",
    "y",
    "steps",
    "fopdt",
    "/seed",
    "/model/name",
    "1/0",
    "x**x",
    "\ud800",
    "\x00",
    "",
    "é",
    "=1",
    "run_x",
    "previous",
]
NUMBERS = [0, -1, 0.5, 1e308, -1e308, 5e-324, 2**63, 10**30, 10**400, float("nan"), float("inf")]
LEAVES = st.sampled_from([None, True, *NAMES, *NUMBERS]) | st.text(max_size=5) | st.floats()
VALUES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(NAMES) | st.text(max_size=3), inner, max_size=3)
    ),
    max_leaves=6,
)


def places(node: Any, here: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The places of all values below a node."""
    inside = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in inside:
        yield (*here, key)
        if isinstance(value, dict | list):
            yield from places(value, (*here, key))


def change_value(body: dict[str, Any], place: tuple[Any, ...], value: Any) -> dict[str, Any]:
    """The body with another value at a place."""
    made = deepcopy(body)
    holder: Any = made
    for key in place[:-1]:
        holder = holder[key]
    holder[place[-1]] = value
    return made


@pytest.mark.parametrize(("path", "body"), BODIES)
@settings(max_examples=scale_examples(30))
@given(st.data())
def test_any_value_anywhere_is_taken_or_refused_with_a_sentence(
    server: TestClient, dataset: str, path: str, body: dict[str, Any], data: st.DataObject
) -> None:
    made = body
    for _ in range(data.draw(st.integers(1, 2))):
        known = [*places(made), ("another",)]
        made = change_value(made, data.draw(st.sampled_from(known)), data.draw(VALUES))
    answer = server.post(
        path.format(dataset=dataset),
        content=json.dumps(made),
        headers={"content-type": "application/json"},
    )
    assert answer.status_code < 500, answer.text
    if answer.is_error:
        assert answer.json()["detail"]
    assert len(answer.content) < 50_000
