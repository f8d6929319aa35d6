"""Content-addressed objects in a local folder or in an S3 bucket.

The name of an object is the SHA-256 of its bytes: ``sha256/ab/<hash>.mcap``. So it never changes,
may be written twice without harm, and its hash is its ETag. Objects are written before the row that
refers to them. Objects without a row are garbage (`service.storage.garbage`), once they are old. So
storing the bytes of an old object again makes it young.
"""

import hashlib
import logging
import os
import re
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, final
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError, NotFoundError
from obstore.store import LocalStore, S3Store

from service.core.process import service_metrics, temporary_files
from service.storage.storage_errors import (
    InvalidStoreUrl,
    ObjectDamaged,
    ObjectMissing,
    ObjectStoreFailed,
)

if TYPE_CHECKING:
    from obstore.store import RetryConfig


_log = logging.getLogger(__name__)

_ROOT = "sha256"
_HASH = re.compile(r"[0-9a-f]{64}")
_BLOCK = 1 << 20
_SINGLE_PUT = 64 << 20
"""Largest object in bytes that is sent in one request and thus held in memory."""
RENEWAL_AGE = timedelta(minutes=30)
"""An object of a bucket that is stored again after this time is written anew."""
_RETRIES: "RetryConfig" = {"max_retries": 3, "retry_timeout": timedelta(seconds=10)}


@dataclass(frozen=True, slots=True)
class StoredObject:
    """An object in the store; `size` in bytes."""

    sha256: str
    size: int
    modified_at: datetime | None = None


class ObjectStore(ABC):
    """Base class of the stores: everything but the last step of a write."""

    def __init__(self, backend: Any, temporary_files: Path) -> None:
        self._backend, self._temporary = backend, temporary_files

    def put_file(self, path: Path) -> StoredObject:
        """Store a copy of a file."""
        with path.open("rb") as file:
            return self.put_stream(_read_blocks(file))

    def put_stream(self, blocks: Iterable[bytes], expected: str | None = None) -> StoredObject:
        """Store blocks of bytes as they arrive; they are never in memory all at once.

        An object that is there is renewed, or healed if it is damaged.

        Raises
        ------
        ObjectDamaged
            If the bytes do not have the `expected` hash. Nothing is stored.
        """
        digest, size = hashlib.sha256(), 0
        with _translate_errors("write an object"), self._open_temporary_file() as file:
            for block in blocks:
                digest.update(block)
                size += file.write(block)
            file.flush()
            os.fsync(file.fileno())
            sha256 = digest.hexdigest()
            if expected not in (None, sha256):
                raise ObjectDamaged(str(expected))
            self._publish(Path(file.name), sha256, size)
        return StoredObject(sha256, size)

    def get_bytes(self, sha256: str) -> bytes:
        """Return a whole object.

        Raises
        ------
        ObjectMissing
            If it does not exist.
        ObjectDamaged
            If its bytes are not those that were stored.
        """
        with _translate_errors("read an object", sha256):
            data = bytes(obstore.get(self._backend, _build_object_name(sha256)).bytes())
        _check_digest(sha256, hashlib.sha256(data))
        return data

    def get_range(self, sha256: str, start: int, length: int) -> bytes:
        """Return `length` bytes from `start`; fewer at the end of the object."""
        length = min(length, self.get_size(sha256) - start)
        return self._read_range(sha256, start, length) if length > 0 else b""

    def _read_range(self, sha256: str, start: int, length: int) -> bytes:
        with _translate_errors("read an object", sha256):
            name = _build_object_name(sha256)
            return bytes(obstore.get_range(self._backend, name, start=start, length=length))

    def get_stream(self, sha256: str, start: int = 0, length: int | None = None) -> Iterator[bytes]:
        """Yield the bytes of an object from `start`, in blocks.

        A whole object is checked: its last block comes only if all of its bytes are right.

        Raises
        ------
        ObjectMissing
            If it does not exist.
        ObjectDamaged
            If its bytes are not those that were stored.
        """
        size = self.get_size(sha256)
        end = size if length is None else min(size, start + length)
        is_whole, digest, held = (start == 0 and end == size), hashlib.sha256(), b""
        while start < end:
            block = self._read_range(sha256, start, min(_BLOCK, end - start))
            digest.update(block)
            start += len(block)
            if held:
                yield held
            held = block
        if is_whole:
            _check_digest(sha256, digest)
        if held:
            yield held

    def check_object(self, sha256: str) -> None:
        """Read an object; raise `ObjectMissing` or `ObjectDamaged` unless it is whole."""
        for _ in self.get_stream(sha256):
            pass

    def get_size(self, sha256: str) -> int:
        """Return the size in bytes; `ObjectMissing` if the object does not exist."""
        with _translate_errors("look up an object", sha256):
            return int(obstore.head(self._backend, _build_object_name(sha256))["size"])

    def exists(self, sha256: str) -> bool:
        """Return whether an object exists."""
        try:
            self.get_size(sha256)
        except ObjectMissing:
            return False
        return True

    @abstractmethod
    def delete_older(self, sha256: str, limit: datetime) -> bool:
        """Delete an object that was last written before `limit`; return whether it was."""

    def list_objects(self, prefix: str = "") -> Iterator[StoredObject]:
        """Yield every object, or those whose hash begins with two digits; in no certain order."""
        folder = f"{_ROOT}/{prefix}" if prefix else _ROOT
        with _translate_errors("list the objects"):
            for chunk in obstore.list(self._backend, prefix=folder):
                for entry in chunk:
                    sha256 = Path(entry["path"]).stem
                    if _HASH.fullmatch(sha256):
                        yield StoredObject(sha256, entry["size"], entry["last_modified"])

    @abstractmethod
    def check_writable(self) -> None:
        """Raise `ObjectStoreFailed` unless an object could be written now."""

    @abstractmethod
    def _publish(self, source: Path, sha256: str, size: int) -> None:
        """Turn a finished, synced file into an object; replace one only if it is damaged."""

    def _is_whole(self, sha256: str) -> bool:
        try:
            self.check_object(sha256)
        except ObjectDamaged:
            _log.warning("the stored object %s is damaged. It is healed by the same bytes", sha256)
            return False
        except ObjectMissing:
            return False
        return True

    @contextmanager
    def _open_temporary_file(self) -> Iterator[BinaryIO]:
        with tempfile.NamedTemporaryFile(
            dir=self._temporary, prefix=temporary_files.make_temporary_prefix()
        ) as file:
            yield file  # type: ignore[misc]  # the wrapper has all methods of BinaryIO


@final
class FolderStore(ObjectStore):
    """Objects as files of a folder.

    A power cut leaves whole objects or none: a file is synced before it is linked into place, and
    then its folders are synced.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder.absolute()
        self._synced: set[Path] = set()  # folders that this process has synced
        unfinished = self._folder / "tmp"
        with _translate_errors("create its folder"):
            unfinished.mkdir(parents=True, exist_ok=True)
            temporary_files.remove_leftovers(unfinished, "*")
            super().__init__(LocalStore(self._folder), unfinished)

    def check_writable(self) -> None:
        """Raise `ObjectStoreFailed` unless an object could be written now."""
        with _translate_errors("write"), self._open_temporary_file() as file:
            file.write(b"probe")

    def _publish(self, source: Path, sha256: str, size: int) -> None:
        target = self._folder / _build_object_name(sha256)
        target.parent.mkdir(parents=True, exist_ok=True)
        while not _link(source, target):
            with suppress(FileNotFoundError):  # it has just gone
                os.utime(target)  # from now on it stays
                if not self._is_whole(sha256):
                    healthy = source.with_name(f"{source.name}-{sha256}")
                    os.link(source, healthy)
                    os.replace(healthy, target)
                break
        _sync_folder(target.parent)
        if target.parent not in self._synced:  # its creator may not have synced its parents
            for folder in (target.parent.parent, self._folder):
                _sync_folder(folder)
            self._synced.add(target.parent)

    def delete_older(self, sha256: str, limit: datetime) -> bool:
        """Delete an object that was last written before `limit`; return whether it was.

        It is first moved aside. So a writer of the same bytes has renewed it before, which is
        seen here, or writes it anew.
        """
        with suppress(ObjectMissing), _translate_errors("delete an object", sha256):
            target = self._folder / _build_object_name(sha256)
            aside = self._temporary / f"{temporary_files.make_temporary_prefix()}{sha256}"
            os.rename(target, aside)
            is_older = aside.stat().st_mtime < limit.timestamp()
            if not is_older:
                with suppress(FileExistsError):
                    os.link(aside, target)
            aside.unlink()
            return is_older
        return False


def _link(source: Path, target: Path) -> bool:
    """Link a file into place; False if there is one already."""
    try:
        os.link(source, target)
    except FileExistsError:
        return False
    return True


@final
class BucketStore(ObjectStore):
    """Objects in an S3-compatible bucket; `options` go to `obstore.store.S3Store`.

    Credentials, region and endpoint come from the usual ``AWS_…`` variables.
    """

    def __init__(self, url: str, **options: Any) -> None:
        try:
            backend = S3Store.from_url(url, retry_config=_RETRIES, **options)
        except (BaseError, ValueError) as error:
            raise InvalidStoreUrl(url, _take_first_line(error)) from error
        super().__init__(backend, Path(tempfile.gettempdir()))

    def check_writable(self) -> None:
        """Raise `ObjectStoreFailed` unless an object could be written now."""
        with _translate_errors("write"):
            obstore.put(self._backend, "probe", b"probe")
            obstore.delete(self._backend, "probe")

    def _publish(self, source: Path, sha256: str, size: int) -> None:
        name = _build_object_name(sha256)
        if size <= _SINGLE_PUT:
            with suppress(AlreadyExistsError):  # another writer stored the same bytes
                obstore.put(self._backend, name, source, mode="create", use_multipart=False)
                return
        if self._is_young(name) and self._is_whole(sha256):
            return
        # Written anew, an object is young. A multipart put cannot be create-only; a rival writes
        # the same bytes to this name.
        obstore.put(self._backend, name, source, use_multipart=size > _SINGLE_PUT)

    def _is_young(self, name: str) -> bool:
        limit = datetime.now(UTC) - RENEWAL_AGE
        with suppress(NotFoundError, FileNotFoundError):
            return bool(obstore.head(self._backend, name)["last_modified"] > limit)
        return False

    def delete_older(self, sha256: str, limit: datetime) -> bool:
        """Delete an object that was last written before `limit`; return whether it was."""
        with suppress(ObjectMissing), _translate_errors("delete an object", sha256):
            name = _build_object_name(sha256)
            if obstore.head(self._backend, name)["last_modified"] < limit:
                obstore.delete(self._backend, name)
                return True
        return False


def open_store(url: str, **options: Any) -> ObjectStore:
    """Open the store at ``file:///folder`` or ``s3://bucket/prefix``."""
    parts = urlsplit(url)
    if parts.scheme == "file":
        if parts.netloc not in ("", "localhost") or not parts.path.startswith("/"):
            raise InvalidStoreUrl(url, "use file:// and an absolute path, such as file:///data")
        return FolderStore(Path(unquote(parts.path)))
    if parts.scheme == "s3":
        return BucketStore(url, **options)
    raise InvalidStoreUrl(url, "use file:///folder or s3://bucket/prefix")


def _check_digest(sha256: str, digest: Any) -> None:
    """Raise `ObjectDamaged` unless the bytes that were read have the right hash."""
    if digest.hexdigest() != sha256:
        service_metrics.damaged_objects.inc()
        raise ObjectDamaged(sha256)


def _build_object_name(sha256: str) -> str:
    if not _HASH.fullmatch(sha256):
        raise ObjectMissing(sha256)
    return f"{_ROOT}/{sha256[:2]}/{sha256}.mcap"


def _read_blocks(file: BinaryIO) -> Iterator[bytes]:
    while block := file.read(_BLOCK):
        yield block


@contextmanager
def _translate_errors(action: str, sha256: str = "") -> Iterator[None]:
    try:
        yield
    except (NotFoundError, FileNotFoundError) as error:
        if not sha256:
            raise _report_failure(action, error) from error
        raise ObjectMissing(sha256) from error
    except (BaseError, OSError) as error:
        raise _report_failure(action, error) from error


def _report_failure(action: str, error: Exception) -> ObjectStoreFailed:
    service_metrics.store_errors.labels("objects").inc()
    return ObjectStoreFailed(f"the object store cannot {action}: {_take_first_line(error)}")


def _take_first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].strip()


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
