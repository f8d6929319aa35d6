"""What a dataset tells of its recording, and the inputs that a simulation is given."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy.orm import Session

from service.core.errors import TooLarge
from service.core.settings import Settings
from service.datasets.dataset_schemas import BinaryInput, StepInput, WaveInput
from service.datasets.datasets import check_upload_size, describe_recording
from service.datasets.signal_channels import map_channels
from service.datasets.waveforms import InputSignals, interpolate_channel
from service.storage.objects import FolderStore, StoredObject
from sysid.data.records import Channel, History, Recording
from tests.support.library.small_models import difference

TIMES = np.arange(100) * 0.1


def describe_channels(*channels: Channel) -> Any:
    content = StoredObject(sha256="", size=0)
    return describe_recording(
        Recording(channels),
        name="a",
        kind="upload",
        key="k",
        details={"warnings": []},
        content=content,
    )


def make_channel(period: float, name: str = "u", **fields: Any) -> Channel:
    times = np.arange(20) * period
    return Channel(name, times, np.ones(20), **fields)


def test_a_dataset_has_a_sampling_period_if_all_channels_share_it() -> None:
    assert describe_channels(
        make_channel(0.1), make_channel(0.1, "y")
    ).sample_time == pytest.approx(0.1)
    two = describe_channels(make_channel(0.1), make_channel(0.2, "y"))
    assert two.sample_time is None
    assert [entry["sample_time"] for entry in two.channels] == pytest.approx([0.1, 0.2])


def test_a_channel_tells_its_missing_values_and_its_history() -> None:
    values = np.array([1.0, np.nan, 2.0])
    one = Channel(
        "u", np.arange(3.0), values, "V", "zero", History(np.array([-2.0, -1.0]), np.ones(2))
    )
    [entry] = describe_channels(one).channels
    assert (entry["missing"], entry["history_samples"], entry["history_start"]) == (1, 2, -2.0)
    assert (entry["start"], entry["stop"], entry["hold"]) == (0.0, 2.0, "zero")


def test_an_upload_of_just_the_largest_size_is_taken(tmp_path: Path) -> None:
    settings = Settings.model_validate({"data_dir": tmp_path, "max_upload_bytes": 1000})
    check_upload_size(1000, settings)
    with pytest.raises(TooLarge, match="at most 1000"):
        check_upload_size(1001, settings)


def make_inputs(tmp_path: Path) -> InputSignals:
    return InputSignals(Session(), FolderStore(tmp_path), TIMES)


def test_random_inputs_of_other_seeds_are_others(tmp_path: Path) -> None:
    def draw(**fields: Any) -> Any:
        signal = BinaryInput(kind="binary", period=0.3, **fields)
        return make_inputs(tmp_path).evaluate_input("/inputs/u", signal)

    assert len({draw(seed=seed).tobytes() for seed in range(5)}) == 5
    np.testing.assert_array_equal(draw(seed=2), draw(seed=2))
    assert set(draw(seed=1, amplitude=2.0, offset=5.0)) == {3.0, 7.0}


def test_a_wave_has_its_phase_and_offset_and_a_step_its_time(tmp_path: Path) -> None:
    made = make_inputs(tmp_path)
    wave = WaveInput(kind="cosine", amplitude=2, frequency=0.5, phase=0.3, offset=1)
    np.testing.assert_allclose(
        made.evaluate_input("", wave), 1 + 2 * np.cos(np.pi * TIMES + 0.3), atol=1e-12
    )
    step = StepInput(kind="step", amplitude=2, time=0.5, offset=1)
    expected = np.where(np.arange(100) >= 5, 3.0, 1.0)
    np.testing.assert_array_equal(made.evaluate_input("", step), expected)


def test_a_held_channel_has_the_new_value_at_the_time_of_its_jump() -> None:
    held = Channel("u", np.array([0.0, 1.0, 2.0]), np.array([5.0, 6.0, 7.0]), hold="zero")
    at = np.array([-1.0, 0.0, 0.99, 1.0, 2.0, 9.0])
    np.testing.assert_array_equal(interpolate_channel(held, at), [5, 5, 5, 6, 7, 7])


def test_channels_and_holds_of_a_job_are_those_of_its_signals() -> None:
    model = difference(
        {"x": "c*x(k-1) + b*u(k-1) + w"}, "x", inputs={"u": "V", "w": "V"}, initial={"x": 0}
    )
    channels = map_channels(model, {"u": "P1", "y": "P2"}, {"u": "zero"})
    assert channels.by_signal == {"u": "P1", "w": "w", "y": "P2"}
    assert channels.holds == (("P1", "zero"),)
    recording = Recording(tuple(Channel(name, TIMES, TIMES) for name in ("u", "P1", "w", "P2")))
    [record] = channels.cut_records(recording, "a")
    assert [(item.name, item.hold) for item in record.inputs] == [("u", "zero"), ("w", "auto")]
