"""Content-addressed objects in a local folder or in an S3 bucket.

The name of an object is the SHA-256 of its bytes: ``sha256/ab/<hash>.mcap``. So it never changes,
may be written twice without harm, and its hash is its ETag. Objects are written before the row that
refers to them. Objects without a row are garbage (`service.storage.garbage`), once they are old. So
storing the bytes of an old object again makes it young.
"""

import hashlib
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
from service.storage.storage_errors import InvalidStoreUrl, ObjectMissing, ObjectStoreFailed

if TYPE_CHECKING:
    from obstore.store import RetryConfig


_ROOT = "sha256"
_HASH = re.compile(r"[0-9a-f]{64}")
_BLOCK = 1 << 20
_SINGLE_PUT = 64 << 20
"""Largest object in bytes that is sent in one request and thus held in memory."""
RENEWAL_AGE = timedelta(minutes=30)
"""An object of a bucket that is stored again after this time is written anew."""
_RETRIES: "RetryConfig" = {"max_retries": 3, "retry_timeout": timedelta(seconds=30)}


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

    def put_stream(self, blocks: Iterable[bytes]) -> StoredObject:
        """Store blocks of bytes as they arrive; they are never in memory all at once."""
        digest, size = hashlib.sha256(), 0
        with _translate_errors("write an object"), self._open_temporary_file() as file:
            for block in blocks:
                digest.update(block)
                size += file.write(block)
            file.flush()
            os.fsync(file.fileno())
            sha256 = digest.hexdigest()
            self._publish(Path(file.name), _build_object_name(sha256), size)
        return StoredObject(sha256, size)

    def get_bytes(self, sha256: str) -> bytes:
        """Return a whole object; `ObjectMissing` if it does not exist."""
        with _translate_errors("read an object", sha256):
            return bytes(obstore.get(self._backend, _build_object_name(sha256)).bytes())

    def get_range(self, sha256: str, start: int, length: int) -> bytes:
        """Return `length` bytes from `start`; fewer at the end of the object."""
        length = min(length, self.get_size(sha256) - start)
        if length <= 0:
            return b""
        with _translate_errors("read an object", sha256):
            name = _build_object_name(sha256)
            return bytes(obstore.get_range(self._backend, name, start=start, length=length))

    def get_stream(self, sha256: str, start: int = 0, length: int | None = None) -> Iterator[bytes]:
        """Yield the bytes of an object from `start`, in blocks."""
        end = self.get_size(sha256) if length is None else start + length
        while start < end and (block := self.get_range(sha256, start, min(_BLOCK, end - start))):
            yield block
            start += len(block)

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
    def _publish(self, source: Path, name: str, size: int) -> None:
        """Turn a finished, synced file into an object; never replace one of the same name."""

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

    def _publish(self, source: Path, name: str, size: int) -> None:
        target = self._folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        while not _link_or_touch(source, target):
            pass
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


def _link_or_touch(source: Path, target: Path) -> bool:
    """Link a file into place, or renew the one that is there; False if that has just gone."""
    try:
        os.link(source, target)
    except FileExistsError:  # another writer stored the same bytes
        try:
            os.utime(target)
        except FileNotFoundError:
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

    def _publish(self, source: Path, name: str, size: int) -> None:
        if size <= _SINGLE_PUT:
            with suppress(AlreadyExistsError):  # another writer stored the same bytes
                obstore.put(self._backend, name, source, mode="create", use_multipart=False)
                return
        if self._is_young(name):
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
