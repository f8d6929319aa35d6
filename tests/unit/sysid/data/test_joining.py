"""Recordings of several loggers on one clock: shifted, continued, renamed or refused."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from sysid.core.errors import InvalidRecord
from sysid.data.joining import join_recordings
from sysid.data.records import Channel, History, Recording, Segment

START = datetime(2026, 3, 14, 8, tzinfo=UTC)
TIMES = np.arange(10) * 1.0


def record(
    name: str, start: float | None = 0.0, times: object = TIMES, unit: str = "1"
) -> Recording:
    """A recording of one channel; it begins some s after `START`, or has no clock."""
    values = np.arange(np.size(times)) * 1.0  # type: ignore[arg-type]
    clock = None if start is None else START + timedelta(seconds=start)
    return Recording((Channel(name, times, values, unit),), started_at=clock)  # type: ignore[arg-type]


def test_clocks_shift_channels_which_keep_their_own_times() -> None:
    joined, notes = join_recordings({"b": record("y", 2.5), "a": record("u", 1.0, TIMES * 2)})
    assert joined.started_at == START + timedelta(seconds=1.0)
    np.testing.assert_allclose(joined.channel("u").times, TIMES * 2)
    np.testing.assert_allclose(joined.channel("y").times, TIMES + 1.5)
    assert "clocks are joined: a begins first, b begins 1.5 s later" in notes
    assert "nothing is resampled" in notes[-1]


def test_without_clocks_time_zero_is_the_same_moment_and_it_is_told() -> None:
    joined, notes = join_recordings({"a": record("u", None), "b": record("y", None, TIMES + 0.3)})
    assert joined.channel("y").times[0] == 0.3
    assert "a and b have no clock: time 0 s is taken for the same moment" in notes


def test_a_channel_goes_on_in_the_next_file() -> None:
    parts = {"tuesday": record("y", 86_400.0), "monday": record("y")}
    joined, notes = join_recordings(parts)
    assert joined.names == ("y",)
    assert joined.channel("y").times.tolist() == [*TIMES, *(TIMES + 86_400.0)]
    assert "channel 'y' of monday goes on in tuesday" in notes


def test_channels_of_one_name_at_one_time_are_named_after_their_files() -> None:
    joined, notes = join_recordings({"room": record("value"), "supply": record("value", 0.5)})
    assert joined.names == ("room.value", "supply.value")
    assert "channels called 'value' are now room.value and supply.value" in notes


def test_a_history_moves_with_its_channel() -> None:
    history = History(np.array([-2.0, -1.0]), np.array([0.0, 1.0]))
    channel = Channel("u", TIMES, TIMES, history=history)
    late = Recording((channel,), started_at=START + timedelta(seconds=3))
    joined, _ = join_recordings({"a": late, "b": record("y")})
    moved = joined.channel("u").history
    assert moved is not None
    assert moved.times.tolist() == [1.0, 2.0]


PAIR = Recording({"t": TIMES, "u": TIMES, "y": TIMES})
REFUSED = {
    "some clocks": ({"a": record("u"), "b": record("y", None)}, "a has dates and b none"),
    "experiments": ({"a": PAIR, "b": PAIR}, "so they are experiments. Fit them jointly"),
    "apart": ({"a": record("u"), "b": record("y", 60.0)}, "there is no time in common"),
    "segments": (
        {"a": Recording(PAIR.channels, (Segment(0.0, 9.0),)), "b": record("z", None)},
        "a has segments",
    ),
    "zones": (
        {
            "a": record("u"),
            "b": Recording(record("y", None).channels, started_at=START.replace(tzinfo=None)),
        },
        "some dates have a time zone and others have none",
    ),
}


@pytest.mark.parametrize(("parts", "words"), REFUSED.values(), ids=REFUSED)
def test_what_has_no_common_clock_is_refused(parts: dict[str, Recording], words: str) -> None:
    with pytest.raises(InvalidRecord, match=words):
        join_recordings(parts)
