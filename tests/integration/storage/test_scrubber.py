"""Stored objects are read at a settable pace, and damage is told before it is met."""

import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from service.storage.objects import open_store
from service.upkeep.scrubber import Scrubber

START = datetime(2026, 11, 28, tzinfo=UTC)


def test_each_object_is_read_once_in_its_days_and_damage_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = open_store(f"file://{tmp_path}")
    names = [store.put_stream([str(number).encode()]).sha256 for number in range(40)]
    bad = names[7]
    path = tmp_path / "sha256" / bad[:2] / f"{bad}.mcap"
    path.write_bytes(b"x")
    scrubber, never = Scrubber(store, 8.0), threading.Event()
    for hour in range(8 * 24):
        for minute in (0, 20, 40):
            scrubber.read_due(never, START + timedelta(hours=hour, minutes=minute))
    assert (scrubber.n_read, scrubber.damaged) == (40, {bad})
    assert scrubber.describe() == f"40 read since the start, damaged: {bad}"
    assert caplog.text.count(bad) == 1
    store.put_stream([b"7"])
    for hour in range(8 * 24):
        scrubber.read_due(never, START + timedelta(days=8, hours=hour))
    assert scrubber.describe() == "80 read since the start, none damaged"


def test_nothing_is_read_if_it_is_switched_off_or_told_to_stop(tmp_path: Path) -> None:
    store, stop = open_store(f"file://{tmp_path}"), threading.Event()
    for number in range(300):
        store.put_stream([str(number).encode()])
    off = Scrubber(store, 0)
    off.read_due(stop)
    assert (off.n_read, off.describe()) == (0, "not read (LAGID_SCRUB_DAYS)")
    stop.set()
    stopped = Scrubber(store, 30)
    for day in range(31):
        stopped.read_due(stop, START + timedelta(days=day))
    assert stopped.n_read == 0
