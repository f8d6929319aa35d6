"""Every recording comes back from its file bit for bit, times too."""

from io import BytesIO
from unittest import mock

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader

from service.formats.mcap import mcap_writer
from service.formats.mcap.mcap_files import read_mcap
from service.formats.mcap.topics import choose_clock
from sysid.data.records import HOLDS, Channel, History, Recording
from tests.support.files.mcap_files import write_mcap_bytes
from tests.support.profiles import scale_examples

NUMBERS = st.floats(allow_nan=True, allow_infinity=False)
TIMES = st.one_of(
    st.builds(lambda n, step: np.arange(n) * step, st.integers(1, 60), st.floats(1e-6, 10)),
    st.lists(st.integers(-(10**12), 10**12), min_size=1, max_size=60).map(
        lambda ns: np.sort(np.array(ns, dtype=float)) / 1e9
    ),
    st.lists(st.floats(-1e6, 1e9), min_size=1, max_size=60).map(
        lambda times: np.sort(np.array(times))
    ),
)
NAMES = st.lists(st.text(min_size=1, max_size=8), min_size=1, max_size=4, unique=True)


@st.composite
def make_recordings(draw: st.DrawFn) -> Recording:
    bases = draw(st.lists(TIMES, min_size=1, max_size=2))
    channels = []
    for name in draw(NAMES):
        times = draw(st.sampled_from(bases))
        values = draw(arrays(np.float64, times.size, elements=NUMBERS))
        unit, hold = draw(st.sampled_from(["V", "µm/s²", "1"])), draw(st.sampled_from(HOLDS))
        cut = draw(st.integers(0, times.size - 1))
        known = History(times[:cut], values[:cut]) if cut else None
        channels.append(Channel(name, times[cut:], values[cut:], unit, hold, known))
    return Recording(tuple(channels))


@given(make_recordings(), st.integers(1, 40))
@settings(max_examples=scale_examples(120))
def test_names_times_and_values_come_back_bit_for_bit(recording: Recording, chunk: int) -> None:
    with mock.patch.object(mcap_writer, "CHUNK_SAMPLES", chunk):
        content = write_mcap_bytes(recording)
    back = read_mcap(content)
    assert back.names == recording.names
    for before, after in zip(recording.channels, back.channels, strict=True):
        assert (after.unit, after.hold) == (before.unit, before.hold)
        assert after.values.tobytes() == before.values.tobytes()
        np.testing.assert_array_equal(after.times, before.times)
        assert (after.history is None) == (before.history is None)
        if before.history is not None and after.history is not None:
            assert after.history.values.tobytes() == before.history.values.tobytes()
            np.testing.assert_array_equal(after.history.times, before.history.times)


@given(make_recordings())
@settings(max_examples=scale_examples(25))
def test_the_plain_reader_counts_the_same_samples(recording: Recording) -> None:
    reader = make_reader(BytesIO(write_mcap_bytes(recording)), validate_crcs=True)
    counts: dict[str, int] = {}
    for _, channel, _ in reader.iter_messages():
        counts[channel.topic] = counts.get(channel.topic, 0) + 1
    samples = {one.times.tobytes(): one.times.size for one in recording.channels}
    known = [one.history.times for one in recording.channels if one.history is not None]
    before = {times.tobytes(): times.size for times in known}
    assert sorted(counts.values()) == sorted([*samples.values(), *before.values()])


@given(st.integers(2, 5000), st.sampled_from([0.01, 0.001, 1 / 610.35, 0.08, 1 / 3]))
@settings(max_examples=scale_examples(50))
def test_computed_and_printed_times_need_no_field_of_their_own(samples: int, step: float) -> None:
    computed = np.arange(samples) * step
    assert choose_clock(computed)[0].rule != "field"
    printed = np.array([float(f"{time:.9f}") for time in computed])
    assert choose_clock(printed)[0].rule == "nanoseconds"
