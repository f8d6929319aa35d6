"""The records that the judge is measured on: each can be drawn, and is what its seed says."""

import json

import numpy as np
import pytest
import yaml

from benchmarks.judgement import identify_as_command, judge_case, read_settings, write_cases
from benchmarks.judgement_kinds import FAMILIES, KINDS, draw_case, write_record
from lagid import read_recording

SEED = 11


@pytest.mark.parametrize("name", KINDS)
def test_a_kind_gives_a_finite_record_with_a_truth(name):
    case = draw_case(name, SEED)
    assert {"t", "u", "y"} <= set(case.logged)
    for key, values in case.logged.items():
        assert np.all(np.isfinite(values)) or (name, key) == ("nan_blocks", "y")
        assert values.size == case.logged["t"].size > 30
    assert np.all(np.diff(case.logged["t"]) > 0)
    assert np.isfinite([one for values in case.truth.values() for one in values]).all()


@pytest.mark.parametrize(
    "name", ["sound_ar1", "lag_drift", "loop_relay", "block_means", "nan_blocks"]
)
def test_the_same_seed_gives_the_same_record(name):
    first, again = draw_case(name, SEED), draw_case(name, SEED)
    for key, values in first.logged.items():
        assert np.array_equal(values, again.logged[key], equal_nan=True)
    assert first.truth == again.truth


def test_another_seed_gives_another_record():
    first, other = (draw_case("lag_change", seed).logged["y"] for seed in (SEED, SEED + 7))
    assert first.size != other.size or not np.allclose(first, other)


def test_there_are_kinds_enough_and_each_defect_names_a_family():
    assert len(KINDS) >= 60
    assert {kind.group for kind in KINDS.values()} == {"defect", "dirty", "white", "coloured"}
    for kind in KINDS.values():
        is_sound = kind.group in ("white", "coloured")
        assert is_sound != bool(kind.reasons & FAMILIES), kind.name


@pytest.mark.parametrize("plant", ["fopdt", "sopdt", "ipdt", "tank", "feedback", "cooler"])
def test_without_noise_the_product_finds_the_truth_of_the_benchmarks_integrator(plant):
    case = draw_case(f"sound_{plant}", SEED, quiet=True)
    found = identify_as_command(case.model, case.recording)
    for name, (value,) in case.truth.items():
        assert found[name].value == pytest.approx(value, rel=2e-3)


def test_a_sound_record_is_identified_within_its_errors():
    answer = judge_case(("sound_fopdt", SEED))
    assert answer.crash == answer.refused == ""
    assert set(answer.estimates) == {"K", "T", "L", "y0"}
    assert all(abs(one.z) < 4 and not one.is_wrong for one in answer.estimates.values())


def test_a_written_record_is_the_drawn_one(tmp_path):
    write_cases([("gain_change", SEED)], tmp_path)
    model, recording, truth = write_record("gain_change", SEED)
    read = read_recording(tmp_path / f"gain_change-{SEED}.csv")
    for one, other in zip(read.channels, recording.channels, strict=True):
        assert np.allclose(one.values, other.values)
    told = json.loads((tmp_path / f"gain_change-{SEED}.json").read_text())
    assert {key: tuple(values) for key, values in told["truth"].items()} == truth
    if isinstance(model, dict):
        assert yaml.safe_load((tmp_path / f"gain_change-{SEED}.yaml").read_text()) == model


def test_advice_is_read_as_settings():
    text = "Use --model sopdt, or --set 'parameters.L.upper=2' and --noise-model ar1."
    assert read_settings(text) == ("model=sopdt", "parameters.L.upper=2", "loss.noise_model=ar1")
    assert read_settings("Leave that span out.") == ()
