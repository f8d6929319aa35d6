"""Every error that the storage raises on purpose.

* StorageError
    - RowNotFound          the row does not exist, or belongs to another project
    - RowConflict          the state of the row does not allow the change
        - KeyReused        an idempotency key was used before with another request
    - InvalidCursor        the cursor does not belong to this list
    - UnstorableValue      a text or document contains a value that no database can store
    - LeaseLost            a dispatcher writes for a job whose lease it no longer holds
    - InvalidStoreUrl      the address of an object store is of an unknown kind
    - ObjectMissing        the object store has no object of that hash
    - ObjectDamaged        the bytes of an object are not those that were stored
    - ObjectStoreFailed    the object store did not answer, refused, or is not writable
    - DatabaseNotAtHead    the tables belong to another version of the program
        - DatabaseUnknown  this program does not know that version
    - UnknownRevision      there is no migration of that name below the present one

`status` is the HTTP status of the error when it reaches a client.
"""

from collections.abc import Sequence
from typing import ClassVar

from sqlalchemy.exc import DontWrapMixin


class StorageError(Exception):
    """Base class of the errors that the storage raises on purpose."""

    status: ClassVar[int] = 500


class RowNotFound(StorageError, LookupError):
    """The row does not exist, belongs to another project, or was deleted."""

    status = 404

    def __init__(self, kind: str, identity: object) -> None:
        super().__init__(f"there is no {kind} {identity!s}")
        self.kind, self.identity = kind, identity


class RowConflict(StorageError):
    """The state of the row does not allow the change."""

    status = 409


class KeyReused(RowConflict):
    """An idempotency key was used before with another request."""

    status = 422

    def __init__(self, key: str) -> None:
        super().__init__(
            f"the Idempotency-Key {key!r} was used before with another request body. "
            "Send the same body, or a new key."
        )
        self.key = key


class InvalidCursor(StorageError, ValueError):
    """The cursor does not belong to this list."""

    status = 422

    def __init__(self, cursor: str) -> None:
        super().__init__(f"{cursor!r} is not a cursor; use the `next` of the previous page")
        self.cursor = cursor


class UnstorableValue(StorageError, ValueError, DontWrapMixin):
    """A text or document contains NUL, half a surrogate or NaN, which no database can store."""

    status = 422


class LeaseLost(StorageError):
    """A dispatcher writes for a job whose lease it no longer holds; it must stop at once."""

    status = 409

    def __init__(self, job_id: str, attempt: int) -> None:
        super().__init__(
            f"attempt {attempt} of {job_id} no longer holds the lease: "
            "it expired, or the job was cancelled or finished"
        )
        self.job_id, self.attempt = job_id, attempt


class InvalidStoreUrl(StorageError, ValueError):
    """The address of an object store is of an unknown kind."""

    def __init__(self, url: str, detail: str) -> None:
        super().__init__(f"{url!r} is not the address of an object store: {detail}")
        self.url = url


class ObjectMissing(StorageError, LookupError):
    """The object store has no object of that hash."""

    status = 404

    def __init__(self, sha256: str) -> None:
        super().__init__(f"the object store has no object {sha256}")
        self.sha256 = sha256


class ObjectDamaged(StorageError):
    """The bytes of an object are not those that were stored under its name."""

    def __init__(self, sha256: str) -> None:
        super().__init__(
            f"the stored object {sha256} is damaged: its checksum is another. Store the same "
            "recording again, or restore it from a backup"
        )
        self.sha256 = sha256


class ObjectStoreFailed(StorageError):
    """The object store did not answer, refused, or is not writable."""

    status = 503


class DatabaseNotAtHead(StorageError):
    """The tables belong to another version of the program."""

    status = 503

    def __init__(self, current: str | None, head: str | None) -> None:
        super().__init__(
            f"the database is at revision {current or 'none'}, but this program needs {head}; "
            "run `lagid db upgrade`"
        )
        self.current, self.head = current, head


class DatabaseUnknown(DatabaseNotAtHead):
    """The tables belong to a version of the program that this one does not know.

    That is a later one, or a build from before the first release.
    """

    def __init__(self, current: str, head: str | None) -> None:
        StorageError.__init__(
            self,
            f"the database is at revision {current}, and this lagid knows revisions up to {head}. "
            "If a newer lagid has upgraded it, install that version, or run its "
            f"`lagid db downgrade {head}` first. Tables of a build before 0.1.0 are not read: name "
            "a new folder with --data-dir, or another database.",
        )
        self.current, self.head = current, head


class UnknownRevision(StorageError, LookupError):
    """There is no migration of that name below the present revision of the database."""

    def __init__(self, revision: str, known: Sequence[str]) -> None:
        super().__init__(
            f"{revision!r} is not an earlier revision of the database. Earlier ones, the latest "
            f"first: {', '.join(known)}"
        )
        self.revision = revision
