"""Fitted signals meet a store that is full, for a while or for good."""

from hashlib import sha256

import pytest

from service.dispatch import fitted_signals
from service.dispatch.fitted_signals import store_signals
from service.storage.objects import StoredObject
from service.storage.storage_errors import ObjectStoreFailed


class RecoveringStore:
    """A store that is full for so many times, and counts how often it was asked."""

    def __init__(self, times):
        self.left, self.asked = times, 0

    def put_stream(self, blocks):
        self.asked += 1
        if self.asked <= self.left:
            raise ObjectStoreFailed("the disk is full")
        data = b"".join(blocks)
        return StoredObject(sha256(data).hexdigest(), len(data))


@pytest.fixture(autouse=True)
def no_patience(monkeypatch):
    monkeypatch.setattr(fitted_signals, "RETRY_SECONDS", -1.0)
    monkeypatch.setattr(fitted_signals, "RETRY_PAUSE_SECONDS", 0.0)


def test_a_store_that_is_full_for_a_while_is_waited_for(monkeypatch):
    monkeypatch.setattr(fitted_signals, "RETRY_SECONDS", 60.0)
    store = RecoveringStore(5)
    assert store_signals(store, b"kept") == sha256(b"kept").hexdigest()
    assert store.asked == 6


def test_a_store_that_stays_full_is_waited_for_once_until_it_takes_something(monkeypatch):
    store = RecoveringStore(4)
    with pytest.raises(ObjectStoreFailed):
        store_signals(store, b"lost")
    monkeypatch.setattr(fitted_signals, "RETRY_SECONDS", 60.0)
    for asked in (2, 3, 4):
        with pytest.raises(ObjectStoreFailed):
            store_signals(store, b"lost too")
        assert store.asked == asked
    store_signals(store, b"kept")
    store.left = 8
    store_signals(store, b"waited for again")
    assert store.asked == 9
