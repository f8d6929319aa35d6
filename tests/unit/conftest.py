"""Fixtures of unit tests."""

import pytest

from workers import scheduler


@pytest.fixture
def time_to_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step of a feeder reads all runs it wants, also when this process waits meanwhile."""
    monkeypatch.setattr(scheduler, "READ_SECONDS", float("inf"))
