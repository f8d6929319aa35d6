"""The object store: a folder and a bucket keep the same contract."""

import hashlib
import os
import threading
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import obstore
import pytest

from service.storage import objects
from service.storage.objects import open_store
from service.storage.storage_errors import (
    InvalidStoreUrl,
    ObjectDamaged,
    ObjectMissing,
    ObjectStoreFailed,
)
from tests.support.storage.object_stores import open_s3_client

FUTURE = datetime.now(UTC) + timedelta(days=1)
ABSENT = "0" * 64


def sha256(data):
    return hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize("data", [b"", b"x", bytes(range(256)) * 5000])
def test_bytes_come_back_under_their_hash(store, data):
    stored = store.put_stream([data])
    assert (stored.sha256, stored.size) == (sha256(data), len(data))
    assert store.get_bytes(stored.sha256) == data
    assert store.get_size(stored.sha256) == len(data)
    assert store.exists(stored.sha256)


def test_a_stream_and_a_file_give_what_their_bytes_give(store, tmp_path):
    blocks = [bytes([i]) * 3000 for i in range(5)]
    whole = b"".join(blocks)
    (tmp_path / "file").write_bytes(whole)
    assert store.put_stream(iter(blocks)).sha256 == sha256(whole)
    assert store.put_file(tmp_path / "file").sha256 == sha256(whole)
    assert store.get_bytes(sha256(whole)) == whole
    assert (tmp_path / "file").exists()


def test_storing_again_makes_an_old_object_young_and_changes_nothing_else(store, monkeypatch):
    monkeypatch.setattr(objects, "RENEWAL_AGE", timedelta(0))
    store.put_stream([b"same"])
    (before,) = store.list_objects()
    time.sleep(1.1 if isinstance(store, objects.BucketStore) else 0.02)  # its times are seconds
    store.put_stream([b"same"])
    (after,) = store.list_objects()
    assert replace(after, modified_at=before.modified_at) == before
    assert after.modified_at > before.modified_at
    assert not store.delete_older(after.sha256, after.modified_at)
    assert store.delete_older(after.sha256, after.modified_at + timedelta(seconds=1))
    assert not store.exists(after.sha256)


def test_a_young_object_of_a_bucket_is_not_sent_again(bucket, monkeypatch):
    store = open_store(bucket)
    monkeypatch.setattr(objects, "_SINGLE_PUT", 1)
    store.put_stream([b"large"])
    monkeypatch.setattr(obstore, "put", None)
    assert store.put_stream([b"large"]).size == 5


def test_many_writers_of_the_same_bytes_at_once_all_succeed(store):
    results = []
    threads = [
        threading.Thread(target=lambda: results.append(store.put_stream([b"y" * 100_000])))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 4
    assert store.get_bytes(results[0].sha256) == b"y" * 100_000


@pytest.mark.parametrize(
    ("start", "length"), [(0, 10), (5, 0), (5, 1), (0, 1000), (990, 100), (1000, 5), (5000, 5)]
)
def test_a_range_is_that_part_of_the_bytes(store, start, length):
    data = os.urandom(1000)
    name = store.put_stream([data]).sha256
    assert store.get_range(name, start, length) == data[start : start + length]


def test_a_stream_gives_the_bytes_in_blocks(store, monkeypatch):
    monkeypatch.setattr(objects, "_BLOCK", 300)
    data = os.urandom(1000)
    name = store.put_stream([data]).sha256
    blocks = list(store.get_stream(name))
    assert b"".join(blocks) == data
    assert max(map(len, blocks)) == 300
    assert b"".join(store.get_stream(name, 10, 500)) == data[10:510]
    assert b"".join(store.get_stream(name, 900, 500)) == data[900:]


@pytest.mark.parametrize("name", [ABSENT, "", "../../etc/passwd", "A" * 64, "0" * 63])
def test_what_is_not_there_is_missing(store, name):
    assert not store.exists(name)
    assert not store.delete_older(name, FUTURE)
    reads = (store.get_bytes, store.get_size, lambda one: store.get_range(one, 0, 1))
    for read in reads:
        with pytest.raises(ObjectMissing):
            read(name)
    with pytest.raises(ObjectMissing):
        next(store.get_stream(name))


def test_a_deleted_object_is_gone_and_others_stay(store):
    one, two = store.put_stream([b"1"]).sha256, store.put_stream([b"2"]).sha256
    assert store.delete_older(one, FUTURE)
    assert not store.exists(one)
    assert [left.sha256 for left in store.list_objects()] == [two]


def test_all_objects_are_listed_and_nothing_else(store):
    store.check_writable()
    wanted = {store.put_stream([str(i).encode()]).sha256: len(str(i)) for i in range(60)}
    assert {one.sha256: one.size for one in store.list_objects()} == wanted


def test_a_writer_that_fails_half_way_leaves_nothing(store):
    def blocks():
        yield b"half"
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        store.put_stream(blocks())
    assert list(store.list_objects()) == []


def test_a_large_object_goes_to_a_bucket_in_parts(bucket, monkeypatch):
    monkeypatch.setattr(objects, "_SINGLE_PUT", 1000)
    store = open_store(bucket)
    data = os.urandom(6 << 20)
    for _ in range(2):
        assert store.get_bytes(store.put_stream([data]).sha256) == data


def test_a_bucket_replaces_no_object_that_is_whole_and_heals_a_damaged_one(bucket, monkeypatch):
    store = open_store(bucket)
    name = store.put_stream([b"first"]).sha256
    sent, put = [], obstore.put

    def count_and_put(*given, **options):
        sent.append(given)
        return put(*given, **options)

    monkeypatch.setattr(obstore, "put", count_and_put)
    store.put_stream([b"first"])
    assert len(sent) == 1  # the one that creates, and is refused
    client = open_s3_client()
    key = f"lagid/sha256/{name[:2]}/{name}.mcap"
    client.put_object(Bucket=bucket.split("/")[2], Key=key, Body=b"damage")
    client.close()
    store.put_stream([b"first"])
    assert store.get_bytes(name) == b"first"


def test_a_folder_replaces_no_object_that_is_whole_and_has_the_agreed_layout(tmp_path):
    store = open_store(f"file://{tmp_path}")
    name = store.put_stream([b"first"]).sha256
    path = tmp_path / "sha256" / name[:2] / f"{name}.mcap"
    before = path.stat().st_ino
    store.put_stream([b"first"])
    assert path.stat().st_ino == before
    assert list((tmp_path / "tmp").iterdir()) == []


DAMAGE = [b"fir\x73u", b"firs", b"", b"first and more"]


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_object_is_told_and_healed_by_its_own_bytes(tmp_path, damage, monkeypatch):
    monkeypatch.setattr(objects, "_BLOCK", 3)
    store = open_store(f"file://{tmp_path}")
    name = store.put_stream([b"first"]).sha256
    path = tmp_path / "sha256" / name[:2] / f"{name}.mcap"
    path.write_bytes(damage)
    for read in (store.get_bytes, store.check_object, lambda one: list(store.get_stream(one))):
        with pytest.raises(ObjectDamaged, match=name):
            read(name)
    with pytest.raises(ObjectDamaged):
        store.put_stream([b"other"], expected=name)
    assert [one.sha256 for one in store.list_objects()] == [name]
    store.put_stream([b"first"])
    assert store.get_bytes(name) == b"first"
    assert list((tmp_path / "tmp").iterdir()) == []


def test_the_last_block_of_a_damaged_object_is_not_sent(store, tmp_path, monkeypatch):
    monkeypatch.setattr(objects, "_BLOCK", 4)
    name = store.put_stream([b"0123456789"]).sha256
    monkeypatch.setattr(store, "_read_range", lambda sha256, start, length: b"x" * length)
    got = []
    with pytest.raises(ObjectDamaged):
        got.extend(store.get_stream(name))
    assert b"".join(got) == b"x" * 8
    assert b"".join(store.get_stream(name, 1, 3)) == b"xxx"  # a part has no checksum


def test_a_folder_forgets_what_a_crash_left_half_written_long_ago(tmp_path):
    (tmp_path / "tmp").mkdir()
    old, new = tmp_path / "tmp" / "old", tmp_path / "tmp" / "new"
    old.write_bytes(b"half")
    new.write_bytes(b"half")
    os.utime(old, (1, 1))
    open_store(f"file://{tmp_path}")
    assert not old.exists()
    assert new.exists()


def test_a_folder_that_cannot_be_made_or_written_is_told_in_one_line(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(ObjectStoreFailed, match="cannot create its folder"):
        open_store(f"file://{tmp_path}/file/objects")
    store = open_store(f"file://{tmp_path}/objects")
    (tmp_path / "objects" / "tmp").rmdir()
    for act in (store.check_writable, lambda: store.put_stream([b"x"])):
        with pytest.raises(ObjectStoreFailed, match="cannot write") as caught:
            act()
        assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("bucket")
def test_a_bucket_that_is_not_there_is_told_in_one_line():
    store = open_store("s3://no-such-bucket-here/x")
    with pytest.raises(ObjectStoreFailed, match="the object store cannot write") as caught:
        store.check_writable()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("url", ["", "objects", "ftp://x/y", "file://host/x", "file:relative"])
def test_an_address_of_an_unknown_kind_is_refused(url):
    with pytest.raises(InvalidStoreUrl, match="is not the address of an object store"):
        open_store(url)


def test_spaces_in_a_folders_address_may_be_escaped(tmp_path):
    open_store(f"file://{tmp_path}/my%20objects").put_stream([b"x"])
    assert (tmp_path / "my objects" / "sha256").is_dir()
