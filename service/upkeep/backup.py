"""Backup of database and objects in one file, while the service runs, and its restoration.

The file is a ZIP archive. ``tables/<name>.jsonl`` has a table, a row a line. ``objects/<sha256>``
has an object. ``manifest.json`` has format, version, revision of the database, and for each table
its columns, number of rows and SHA-256. Rows are plain values. So a backup of SQLite can be
restored into PostgreSQL, and the other way round.

All rows are read from one snapshot. Objects never change and are not removed within `MINIMUM_AGE`
of their deletion, so those that the snapshot names are still there.
"""

import base64
import hashlib
import json
import os
import zipfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import Connection
from sqlalchemy.orm import Session

from service.queue.dispatchers import DispatcherRepository
from service.storage import migrate
from service.storage.columns import DocumentType, OrderedJsonType, UtcDateTime, utc_now
from service.storage.garbage import select_hashes
from service.storage.objects import ObjectStore
from service.storage.sessions import BUSY_SECONDS, Database
from service.storage.statements import split_chunks
from service.storage.storage_errors import ObjectDamaged, ObjectMissing, StorageError
from service.storage.tables import Base, DispatcherHeartbeat, WebSession

FORMAT = 1
MANIFEST = "manifest.json"
READ_ROWS = 500
_BLOCK = 1 << 20
_SKIPPED_TABLES = (DispatcherHeartbeat.__tablename__, WebSession.__tablename__)
"""What lives only as long as its process, and sessions of browsers: users sign in again."""
_KINDS: Mapping[str, Any] = {
    "text": sa.String(),
    "integer": sa.BigInteger(),
    "real": sa.Double(),
    "boolean": sa.Boolean(),
    "time": UtcDateTime(),
    "bytes": sa.LargeBinary(),
    "json": DocumentType,
    "ordered_json": OrderedJsonType,
}
"""Kinds of columns in a backup, and the types that they are inserted with."""


class InvalidBackup(StorageError, ValueError):
    """The file is no backup, is damaged, or comes from a version that this one does not know."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path} cannot be restored: {reason}")


class TargetInUse(StorageError):
    """The place to restore into has data already, or dispatchers work on it."""


@dataclass(frozen=True, slots=True)
class BackupReport:
    """Contents of a backup that was written or restored.

    Attributes
    ----------
    rows : dict
        Number of rows of each table.
    objects, object_bytes : int
    missing : tuple of str
        Objects that rows refer to, but that the store did not have.
    damaged : tuple of str
        Objects whose checksum was another: they are not restored.
    """

    rows: dict[str, int]
    objects: int
    object_bytes: int
    missing: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()


def write_backup(database: Database, store: ObjectStore, path: Path) -> BackupReport:
    """Write all rows and objects into a file that only this user can read.

    The file appears when it is complete. Each object is checked. One that is missing or damaged is
    reported, and all others are written.

    Raises
    ------
    DatabaseNotAtHead
        If the tables are those of another version.
    OSError
        If the file cannot be written.
    """
    migrate.check_revision(database)
    part = path.with_name(f"{path.name}.part")
    try:
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
                report = _write_content(archive, database, store)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return report


def restore_backup(
    database: Database, store: ObjectStore, path: Path, *, force: bool = False
) -> BackupReport:
    """Restore a backup into an empty database and store, and upgrade the tables to this version.

    All tables are checked before the first row is written. All rows are one transaction. Objects
    that are damaged in the file are left out and reported.

    Parameters
    ----------
    force : bool
        Whether the rows of a database that is not empty are replaced. Its objects stay until
        ``lagid db check --fix``.

    Raises
    ------
    InvalidBackup
        If the file is damaged, or of a version that this one does not know.
    TargetInUse
        If the database or the store is not empty, or a dispatcher works on it.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            manifest = _read_manifest(archive, path)
            for name, table in manifest["tables"].items():
                _check_table(archive, path, name, table)
            _check_target(database, store, force)
            objects, size, damaged = _restore_objects(archive, store)
            _restore_rows(archive, database, manifest)
    except (zipfile.BadZipFile, zipfile.LargeZipFile, EOFError) as error:
        raise InvalidBackup(path, f"it is no complete ZIP archive ({error})") from None
    migrate.upgrade_database(database)
    rows = {name: table["rows"] for name, table in manifest["tables"].items()}
    return BackupReport(rows, objects, size, tuple(manifest["missing"]), damaged)


def _write_content(
    archive: zipfile.ZipFile, database: Database, store: ObjectStore
) -> BackupReport:
    tables: dict[str, dict[str, Any]] = {}
    with database.read_snapshot() as connection:
        taken_at = utc_now()
        revision = migrate.read_revision(connection)
        for table in Base.metadata.sorted_tables:
            if table.name not in _SKIPPED_TABLES:
                tables[table.name] = _write_table(archive, connection, table)
        hashes = sorted(
            {str(row[0]) for query in select_hashes() for row in connection.execute(query)}
        )
    size, missing, damaged = 0, list[str](), list[str]()
    for sha256 in hashes:
        try:
            size += _write_object(archive, store, sha256)
        except ObjectMissing:
            missing.append(sha256)
        except ObjectDamaged:
            damaged.append(sha256)
    n_objects = len(hashes) - len(missing) - len(damaged)
    manifest = {
        "format": FORMAT,
        "version": version("lagid"),
        "revision": revision,
        "taken_at": taken_at.isoformat(),
        "database": "sqlite" if database.is_sqlite else "postgresql",
        "tables": tables,
        "objects": n_objects,
        "missing": missing,
    }
    archive.writestr(MANIFEST, json.dumps(manifest, indent=1))
    rows = {name: table["rows"] for name, table in tables.items()}
    return BackupReport(rows, n_objects, size, tuple(missing), tuple(damaged))


def _write_table(
    archive: zipfile.ZipFile, connection: Connection, table: sa.Table
) -> dict[str, Any]:
    kinds = [_find_kind(column.type) for column in table.columns]
    digest, n_rows = hashlib.sha256(), 0
    query = sa.select(table).order_by(*table.primary_key).execution_options(yield_per=READ_ROWS)
    with archive.open(f"tables/{table.name}.jsonl", "w", force_zip64=True) as member:
        for row in connection.execute(query):
            values = [_encode(kind, value) for kind, value in zip(kinds, row, strict=True)]
            line = json.dumps(values, ensure_ascii=False, separators=(",", ":")).encode() + b"\n"
            digest.update(line)
            member.write(line)
            n_rows += 1
    columns = [[column.name, kind] for column, kind in zip(table.columns, kinds, strict=True)]
    return {"columns": columns, "rows": n_rows, "sha256": digest.hexdigest()}


def _write_object(archive: zipfile.ZipFile, store: ObjectStore, sha256: str) -> int:
    total = store.get_size(sha256)  # before a member is begun
    entry = zipfile.ZipInfo(f"objects/{sha256}")  # stored as it is: recordings are compressed
    with archive.open(entry, "w", force_zip64=True) as member:
        for block in store.get_stream(sha256, 0, total):
            member.write(block)
    return total


def _find_kind(kind: Any) -> str:
    if isinstance(kind, sa.JSON):
        return "json" if kind is DocumentType else "ordered_json"
    kinds: tuple[tuple[Any, str], ...] = (
        (UtcDateTime, "time"),
        (sa.LargeBinary, "bytes"),
        (sa.Boolean, "boolean"),
        (sa.Integer, "integer"),
        ((sa.Float, sa.Numeric), "real"),
    )
    return next((name for one, name in kinds if isinstance(kind, one)), "text")


def _encode(kind: str, value: Any) -> Any:
    if value is None:
        return None
    if kind == "time":
        return value.isoformat()
    if kind == "bytes":
        return base64.b64encode(value).decode()
    return value.value if isinstance(value, Enum) else value


def _decode(kind: str, value: Any) -> Any:
    if value is None:
        return None
    if kind == "time":
        return datetime.fromisoformat(value)
    return base64.b64decode(value) if kind == "bytes" else value


def _read_manifest(archive: zipfile.ZipFile, path: Path) -> dict[str, Any]:
    try:
        manifest: dict[str, Any] = json.loads(archive.read(MANIFEST))
    except (KeyError, ValueError):
        raise InvalidBackup(
            path, f"it has no {MANIFEST}, so `lagid backup` did not write it"
        ) from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InvalidBackup(
            path, f"it is not of format {FORMAT}; install the version that wrote it"
        )
    if manifest["revision"] not in migrate.list_revisions():
        raise InvalidBackup(
            path,
            f"lagid {manifest['version']} wrote it, with tables of revision "
            f"{manifest['revision']}; this program knows revisions up to "
            f"{migrate.find_head_revision()}. Restore it with the version that wrote it",
        )
    return manifest


def _check_table(archive: zipfile.ZipFile, path: Path, name: str, table: Mapping[str, Any]) -> None:
    digest, n_rows = hashlib.sha256(), 0
    try:
        for line in _read_lines(archive, name):
            digest.update(line)
            n_rows += 1
    except KeyError:
        raise InvalidBackup(path, f"it has no table {name}") from None
    if digest.hexdigest() != table["sha256"] or n_rows != table["rows"]:
        raise InvalidBackup(path, f"its table {name} is damaged: the checksum is another")


def _check_target(database: Database, store: ObjectStore, force: bool) -> None:
    if migrate.read_current_revision(database) is None:
        filled = []
    else:
        migrate.check_revision(database)
        with database.read_session() as session:
            if alive := [row.owner for row in DispatcherRepository(session).list_alive()]:
                raise TargetInUse(
                    f"the dispatcher {alive[0]} works on this database; stop all processes of "
                    "lagid first"
                )
            if others := _list_other_processes(database, session):
                raise TargetInUse(
                    f"another process ({others[0]}) uses this database; stop all processes of "
                    "lagid first"
                )
            filled = [
                table.name
                for table in Base.metadata.sorted_tables
                if table.name not in (*_SKIPPED_TABLES, "projects")
                and session.execute(sa.select(sa.literal(1)).select_from(table).limit(1)).first()
            ]
    if force:
        return
    if filled:
        raise TargetInUse(
            f"the database is not empty: it has rows in {', '.join(filled)}. Restore into another, "
            "or replace all of its rows with --force"
        )
    if next(store.list_objects(), None) is not None:
        raise TargetInUse(
            "the object store is not empty. Restore into another, or add to it with --force"
        )


def _list_other_processes(database: Database, session: Session) -> list[str]:
    """List who else uses a database of PostgreSQL; that of a file is locked by its folder."""
    if database.is_sqlite:
        return []
    from service.storage.postgresql import list_other_processes  # its driver may be absent

    return list_other_processes(session)


def _restore_objects(
    archive: zipfile.ZipFile, store: ObjectStore
) -> tuple[int, int, tuple[str, ...]]:
    """Store the objects; return their number and bytes, and the names of damaged ones."""
    n_objects, size, damaged = 0, 0, []
    for entry in archive.infolist():
        folder, _, sha256 = entry.filename.partition("/")
        if folder != "objects":
            continue
        try:
            with archive.open(entry) as member:
                blocks = iter(partial(member.read, _BLOCK), b"")
                stored = store.put_stream(blocks, expected=sha256)
        except (ObjectDamaged, zipfile.BadZipFile, EOFError):
            damaged.append(sha256)
            continue
        n_objects, size = n_objects + 1, size + stored.size
    return n_objects, size, tuple(damaged)


def _restore_rows(
    archive: zipfile.ZipFile, database: Database, manifest: Mapping[str, Any]
) -> None:
    """Replace all rows, in the tables of the revision that the backup has."""
    revision, current = manifest["revision"], migrate.read_current_revision(database)
    if current not in (None, revision):
        migrate.downgrade_database(database)
        current = None
    if current is None:
        migrate.upgrade_database(database, revision)
    with database.get_waiting_engine(BUSY_SECONDS).begin() as connection:
        existing = set(sa.inspect(connection).get_table_names())
        for table in reversed(Base.metadata.sorted_tables):
            if table.name in existing:
                connection.execute(sa.delete(table))
        for name, table in manifest["tables"].items():
            _insert_rows(connection, name, table["columns"], _read_lines(archive, name))
        if not database.is_sqlite:
            _continue_numbers(connection, existing)


def _insert_rows(
    connection: Connection, name: str, columns: Sequence[tuple[str, str]], lines: Iterable[bytes]
) -> None:
    target = sa.table(name, *(sa.column(column, _KINDS[kind]) for column, kind in columns))
    for chunk in split_chunks(lines, READ_ROWS):
        rows = [
            {
                column: _decode(kind, value)
                for (column, kind), value in zip(columns, json.loads(line), strict=True)
            }
            for line in chunk
        ]
        connection.execute(sa.insert(target), rows)


def _continue_numbers(connection: Connection, existing: Collection[str]) -> None:
    """Let PostgreSQL number further rows after those that were restored."""
    for table in Base.metadata.sorted_tables:
        column = table.autoincrement_column
        if column is not None and table.name in existing:
            last = sa.select(sa.func.coalesce(sa.func.max(column), 0) + 1).scalar_subquery()
            sequence = sa.func.pg_get_serial_sequence(table.name, column.name)
            connection.execute(sa.select(sa.func.setval(sequence, last, sa.false())))


def _read_lines(archive: zipfile.ZipFile, name: str) -> Iterator[bytes]:
    with archive.open(f"tables/{name}.jsonl") as member:
        yield from member
