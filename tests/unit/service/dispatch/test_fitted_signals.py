"""Files of fitted signals, stored with those of other runs: each comes back as it was."""

from hashlib import sha256

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.dispatch import fitted_signals
from service.dispatch.fitted_signals import SignalsBatch, SignalsLocation
from service.storage.errors import ObjectStoreFailed
from service.storage.objects import StoredObject


class FullStore:
    """A store that takes nothing, and counts how often it was asked."""

    def __init__(self):
        self.asked = 0

    def put_stream(self, blocks):
        self.asked += 1
        raise ObjectStoreFailed("the disk is full")


@pytest.fixture(autouse=True)
def no_patience(monkeypatch):
    monkeypatch.setattr(fitted_signals, "RETRY_SECONDS", -1.0)
    monkeypatch.setattr(fitted_signals, "RETRY_PAUSE_SECONDS", 0.0)


class MemoryStore:
    """A store that forgets everything."""

    def __init__(self):
        self.objects = {}

    def put_stream(self, blocks):
        data = b"".join(blocks)
        name = sha256(data).hexdigest()
        self.objects[name] = data
        return StoredObject(name, len(data))

    def get(self, name):
        return self.objects[name]

    def get_range(self, name, start, length):
        return self.objects[name][start : start + length]


@pytest.fixture
def store():
    return MemoryStore()


def read(store, place):
    if place.start is None:
        return store.get(place.sha256)
    return store.get_range(place.sha256, place.start, place.size)


@given(st.lists(st.tuples(st.binary(min_size=1, max_size=50), st.booleans()), max_size=12))
def test_files_come_back_whatever_they_were_stored_with(files):
    store = MemoryStore()
    shelf, shelved = SignalsBatch(store), []
    for file, is_asked_for in files:
        shelved.append(shelf.add_file(file))
        if is_asked_for:
            shelved[-1].store_file()
    assert [read(store, one.store_file()) for one in shelved] == [file for file, _ in files]


def test_a_file_by_itself_is_the_whole_object(store):
    place = SignalsBatch(store).add_file(b"alone").store_file()
    assert place == SignalsLocation(place.sha256, None, None)
    assert store.get(place.sha256) == b"alone"


def test_files_that_wait_together_are_one_object(store):
    shelf = SignalsBatch(store)
    first, second = shelf.add_file(b"first"), shelf.add_file(b"second one")
    assert (first.store_file().start, second.store_file()) == (
        0,
        SignalsLocation(first.store_file().sha256, 5, 10),
    )
    assert shelf.add_file(b"late").store_file().sha256 != first.store_file().sha256


def test_no_more_is_kept_in_memory_than_a_parcel(store, monkeypatch):
    monkeypatch.setattr(fitted_signals, "UPLOAD_BYTES", 10)
    shelf = SignalsBatch(store)
    small, large = shelf.add_file(b"12345"), shelf.add_file(b"1234567890")
    assert store.get(small.store_file().sha256) == b"123451234567890"
    assert large.upload is small.upload
    assert shelf.add_file(b"x").upload is not small.upload


def test_what_cannot_be_stored_is_tried_once_for_all_files_of_a_parcel():
    full = FullStore()
    shelf = SignalsBatch(full)
    shelved = [shelf.add_file(b"a"), shelf.add_file(b"b")]
    told = []
    for one in shelved:
        with pytest.raises(ObjectStoreFailed) as caught:
            one.store_file()
        told.append(caught.value)
    assert told[0] is told[1]
    assert full.asked == 1
    with pytest.raises(ObjectStoreFailed):
        shelf.add_file(b"c").store_file()
    assert full.asked == 2


class RecoveringStore(MemoryStore):
    """A store that is full for so many times."""

    def __init__(self, times):
        super().__init__()
        self.left = times

    def put_stream(self, blocks):
        if self.left > 0:
            self.left -= 1
            raise ObjectStoreFailed("the disk is full")
        return super().put_stream(blocks)


def test_a_store_that_is_full_for_a_while_is_waited_for(monkeypatch):
    monkeypatch.setattr(fitted_signals, "RETRY_SECONDS", 60.0)
    store = RecoveringStore(5)
    shelf = SignalsBatch(store)
    first, second = shelf.add_file(b"first"), shelf.add_file(b"second")
    assert [read(store, one.store_file()) for one in (first, second)] == [b"first", b"second"]


def test_a_store_that_stays_full_is_waited_for_once_until_it_takes_something(
    monkeypatch,
):
    store = RecoveringStore(4)
    shelf = SignalsBatch(store)
    with pytest.raises(ObjectStoreFailed):
        shelf.add_file(b"lost").store_file()
    monkeypatch.setattr(fitted_signals, "RETRY_SECONDS", 60.0)
    before = store.left
    with pytest.raises(ObjectStoreFailed):
        shelf.add_file(b"lost too").store_file()
    assert store.left == before - 1
    store.left = 0
    assert read(store, shelf.add_file(b"kept").store_file()) == b"kept"


def test_a_store_that_stays_full_is_waited_for_by_one_job_of_many(monkeypatch):
    full = FullStore()
    for place in range(1, 5):
        monkeypatch.setattr(fitted_signals, "RETRY_SECONDS", -1.0 if place == 1 else 0.2)
        with pytest.raises(ObjectStoreFailed):
            SignalsBatch(full).add_file(b"of another job").store_file()
        assert full.asked == place
