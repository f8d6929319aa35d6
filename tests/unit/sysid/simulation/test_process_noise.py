"""Noise inside the plant, beside recursions and integrals written for it alone."""

import pickle
from typing import Any

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.data.noise import Noise
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.simulation.process_noise import add_noise

PERIOD, SAMPLES = 0.1, 2000


def make_record(missing: tuple[int, ...] = ()) -> Record:
    times = PERIOD * np.arange(SAMPLES)
    u, y = np.sin(times), np.zeros(SAMPLES)
    y[list(missing)] = np.nan
    return Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))


def write(form: str, equation: str, **fields: Any) -> Model:
    return parse_model(
        {
            "name": "noisy",
            "form": form,
            "inputs": {"u": "1"},
            "states": {"x": "1"},
            "parameters": {"a": {"lower": 0, "upper": 2}},
            "equations": {"x": equation},
            "outputs": {"y": "x"},
            "initial": {"x": 0.5},
            "noise": {"plant": {"x": "estimate"}},
            **fields,
        }
    )


def test_noise_of_a_recursion_is_what_its_equation_leaves() -> None:
    model = write("difference", "a*x(k-1) - 0.4*x(k-2)**3 + u(k-1)")
    noise = Noise(0.05, seed=7, place="plant", parameters={"a": 0.6})
    record = make_record(missing=(5, 6))
    noisy = add_noise(model, record, noise)
    assert noisy.inputs == record.inputs
    y, u = noisy.outputs[0].values, record.inputs[0].values
    assert np.flatnonzero(~np.isfinite(y)).tolist() == [5, 6]
    np.testing.assert_array_equal(y[:2], 0.5)
    left = y[2:] - (0.6 * y[1:-1] - 0.4 * y[:-2] ** 3 + u[1:-1])
    left = left[np.isfinite(left)]
    assert np.std(left) == pytest.approx(0.05, rel=0.05)
    assert abs(np.mean(left)) < 0.005
    assert abs(np.corrcoef(left[1:], left[:-1])[0, 1]) < 0.06


def test_draws_follow_seeds_and_experiments_and_none_is_none() -> None:
    model, record = write("difference", "a*x(k-1) + u(k-1)"), make_record()
    noise = Noise(0.05, seed=7, place="plant", parameters={"a": 0.6})
    first = add_noise(model, record, noise).outputs[0].values
    again = add_noise(model, record, pickle.loads(pickle.dumps(noise))).outputs[0].values
    np.testing.assert_array_equal(first, again)
    assert np.std(first - add_noise(model, record, noise, 1).outputs[0].values) > 0.01
    assert add_noise(model, record, Noise(0.0, place="plant", parameters={"a": 0.6})) is record


@pytest.mark.parametrize("substeps", [1, 4])
def test_diffusion_of_a_differential_model_does_not_depend_on_the_step(substeps: int) -> None:
    model = write("differential", "-a*x", solver={"substeps": substeps})
    noise = Noise(0.3, seed=2, place="plant", parameters={"a": 0.5})
    y = add_noise(model, make_record(), noise).outputs[0].values
    keep = np.exp(-0.5 * PERIOD)
    added = y[1:] - keep * y[:-1]
    expected = 0.3 * np.sqrt((1 - keep**2) / (2 * 0.5))
    assert np.std(added) == pytest.approx(expected, rel=0.06)


def test_noise_without_a_place_or_a_truth_is_refused() -> None:
    model, record = write("difference", "a*x(k-1) + u(k-1)"), make_record()
    for parameters, pointer in (({}, "a"), ({"a": 0.6, "b": 1.0}, "b")):
        with pytest.raises(InvalidSettings) as caught:
            add_noise(model, record, Noise(0.1, place="plant", parameters=parameters))
        assert caught.value.pointer == f"/noise/parameters/{pointer}"
    with pytest.raises(InvalidSettings, match="does not say where noise enters"):
        add_noise(load_model("tube"), record, Noise(0.1, place="plant"))
    with pytest.raises(InvalidSettings, match="need sensor or plant"):
        Noise(0.1, place="pipe")  # type: ignore[arg-type]
