"""Noise of Eq. 19 and 20 in the corrected reading."""

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.data.noise import Noise, add_output_noise, draw_noise
from sysid.data.records import Channel, Record
from tests.support.library.search_problems import clean, record


@pytest.mark.parametrize("kind", ["gaussian", "uniform-sum"])
def test_sigma_is_a_standard_deviation(kind: str) -> None:
    values = draw_noise(Noise(0.3, seed=2, kind=kind, mean=1.0), 100_000)  # type: ignore[arg-type]
    assert np.mean(values) == pytest.approx(1.0, abs=0.005)
    assert np.std(values) == pytest.approx(0.3, rel=0.01)


@pytest.mark.parametrize("terms", [3, 12])
def test_a_sum_of_uniforms_has_its_excess_kurtosis(terms: int) -> None:
    values = draw_noise(Noise(1.0, kind="uniform-sum", terms=terms), 400_000)
    assert np.mean(values**4) / np.var(values) ** 2 - 3 == pytest.approx(-1.2 / terms, abs=0.03)
    assert np.max(np.abs(values)) <= terms / 2 / np.sqrt(terms / 12)


def test_noise_repeats_by_its_seed_and_differs_between_channels_and_experiments() -> None:
    noise = Noise(0.1, seed=5)
    given = record(clean())
    once, again = add_output_noise(given, noise), add_output_noise(given, noise)
    other = add_output_noise(given, noise, experiment=1)
    assert np.array_equal(once.outputs[0].values, again.outputs[0].values)
    assert not np.array_equal(once.outputs[0].values, other.outputs[0].values)
    assert not np.array_equal(draw_noise(noise, 9, 0), draw_noise(noise, 9, 1))


def test_no_stream_of_a_seed_is_a_stream_of_another() -> None:
    drawn = {
        draw_noise(Noise(1.0, seed=seed), 4, stream).tobytes()
        for seed in range(4)
        for stream in range(4)
    }
    assert len(drawn) == 16


def test_every_output_of_every_experiment_has_noise_of_its_own() -> None:
    times = np.arange(4.0)
    zero = Record((), tuple(Channel(name, times, np.zeros(4)) for name in ("y", "z", "w")))
    drawn = {
        output.values.tobytes()
        for experiment in range(4)
        for output in add_output_noise(zero, Noise(1.0, seed=3), experiment).outputs
    }
    assert len(drawn) == 12


def test_noise_leaves_the_inputs_and_zero_sigma_leaves_all() -> None:
    given = record(clean())
    assert add_output_noise(given, Noise(0.1)).inputs == given.inputs
    assert add_output_noise(given, Noise()) is given


@pytest.mark.parametrize(
    "fields", [{"sigma": -1.0}, {"sigma": float("nan")}, {"terms": 2}, {"seed": -1}, {"kind": "x"}]
)
def test_noise_that_cannot_be_drawn_is_refused(fields: dict[str, float]) -> None:
    with pytest.raises(InvalidSettings, match=f"/noise/{next(iter(fields))}"):
        Noise(**fields)  # type: ignore[arg-type]
