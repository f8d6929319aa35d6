"""Long derivations: a child does them, with the same values, within its memory."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.core.errors import InvalidRequest, ServiceBusy
from service.core.process.concurrency import FairPlaces, ReaderPlaces
from service.datasets import large_derivation
from service.datasets.large_derivation import count_samples, derive
from service.formats.mcap.mcap_files import write_recording
from service.storage.objects import ObjectStore, open_store
from service.storage.tables import Dataset
from sysid.core.errors import InvalidSettings
from sysid.data import derivations
from sysid.data.records import Channel, Recording

TIMES = np.arange(200) * 0.1
READERS = ReaderPlaces(FairPlaces(1, 1, seconds=0.05), 2 * 1024**3)
STEPS = [{"detrend": {"kind": "linear", "channels": ["y"]}}, {"resample": {"sample_time": 0.03}}]


class Stored:
    """A store with one recording, and its row."""

    def __init__(self, folder: Path) -> None:
        channels = (Channel("u", TIMES, np.sin(TIMES)), Channel("y", TIMES, np.cos(TIMES) + TIMES))
        write_recording(Recording(channels), folder / "file.mcap")
        self.store: ObjectStore = open_store(f"file://{folder}/objects")
        sha256 = self.store.put_file(folder / "file.mcap").sha256
        self.row = Dataset(sha256=sha256, n_samples=200, n_channels=2, duration=19.9)

    def derive(self, steps: Any = STEPS, readers: ReaderPlaces = READERS) -> Any:
        recording, subtracted = derive(self.store, self.row, steps, readers, "p")
        values = [(c.name, c.times.tobytes(), c.values.tobytes()) for c in recording.channels]
        return values, subtracted


@pytest.fixture
def place(tmp_path: Path) -> Stored:
    return Stored(tmp_path)


def test_samples_are_those_of_the_largest_step(place: Stored) -> None:
    assert count_samples(place.row, STEPS) == pytest.approx(19.9 / 0.03)
    assert count_samples(place.row, [{"resample": {"sample_time": 5}}]) == 200
    assert count_samples(place.row, [{"resample": {"sample_time": "x"}}, {"resample": 1}]) == 200
    assert count_samples(place.row, ["no step"]) == 200  # type: ignore[list-item]


def test_more_samples_than_a_file_may_have_are_refused_at_once(place: Stored) -> None:
    with pytest.raises(InvalidRequest, match="4e\\+07 samples; at most 20000000 are stored"):
        place.derive([{"resample": {"sample_time": 19.9 / 4e7}}])


def test_a_child_derives_the_same(place: Stored, monkeypatch: pytest.MonkeyPatch) -> None:
    here = place.derive()
    assert here[1][0]["channel"] == "y"
    monkeypatch.setattr(large_derivation, "LARGE_VALUES", 1)
    monkeypatch.setattr(derivations, "apply_steps", None)  # not in this process
    assert place.derive() == here


def test_faults_of_a_child_are_those_of_the_request(
    place: Stored, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InvalidSettings) as here:
        place.derive([{"resampel": {}}])
    monkeypatch.setattr(large_derivation, "LARGE_VALUES", 1)
    with pytest.raises(InvalidRequest) as there:
        place.derive([{"resampel": {}}])
    [fault] = there.value.errors
    assert (fault.pointer, fault.detail) == (here.value.pointer, here.value.detail)
    little = ReaderPlaces(READERS.places, 40 * 1024**2)
    with pytest.raises(InvalidRequest, match=r"40 MiB of memory .LAGID_READER_MEMORY_MB"):
        place.derive(readers=little)
    with READERS.places.hold("another"), pytest.raises(ServiceBusy):
        place.derive()
