"""Backups hold every row and object, and are restored bit for bit: both databases, both stores."""

import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from service.access.keys import create_key
from service.core.states import JobState
from service.queue.dispatchers import LEASE_SECONDS_KEY, DispatcherRepository
from service.queue.leases import LeaseQueue
from service.repositories.history_rows import HistoryPoint, pack_history
from service.repositories.job_rows import JobRepository
from service.repositories.reference_rows import ReferenceRepository
from service.storage import migrate
from service.storage.columns import utc_now
from service.storage.objects import ObjectStore, open_store
from service.storage.sessions import Database
from service.storage.statements import insert_missing
from service.storage.storage_errors import LeaseLost
from service.storage.tables import (
    DEFAULT_PROJECT,
    ApiKey,
    AuditEntry,
    Base,
    Checkpoint,
    Event,
    RunHistory,
    WebSession,
)
from service.upkeep import backup
from service.upkeep.backup import InvalidBackup, TargetInUse, restore_backup, write_backup
from tests.contract.test_items import add_dataset, edit, end_job
from tests.support.storage.databases import KINDS, empty_postgres, empty_sqlite
from tests.support.storage.job_rows import Clock, claim, new_job, parcels_of, submit

Rows = dict[str, list[tuple[Any, ...]]]


def read_rows(database: Database) -> Rows:
    """All rows of all tables that a backup holds."""
    with database.engine.connect() as connection:
        return {
            table.name: sorted(map(tuple, connection.execute(select(table))), key=repr)
            for table in Base.metadata.sorted_tables
            if table.name not in backup._SKIPPED_TABLES
        }


def read_objects(store: ObjectStore) -> dict[str, bytes]:
    return {one.sha256: store.get_bytes(one.sha256) for one in store.list_objects()}


@pytest.fixture
def store(tmp_path: Path) -> ObjectStore:
    return open_store(f"file://{tmp_path}/objects")


@pytest.fixture
def database_with_rows(database: Database, store: ObjectStore) -> Database:
    """A database with rows of many tables, and the objects that they name."""
    sha256 = store.put_stream([b"recording" * 1000]).sha256
    data = add_dataset(database, name="größe [m³]", sha256=sha256)
    job, (run, _) = end_job(
        database, (JobState.SUCCEEDED, JobState.FAILED), dataset=data, model={"z": 1, "name": "a"}
    )
    edit(database, "job", job, tags=["good"], note="two\nlines, “quoted”")
    point = HistoryPoint(run, 0, 0, 1, 10, 0.1 + 0.2, "genetic", (1e-300,))
    with database.write_session() as session:
        ReferenceRepository(session).accept_run("tube", run)
        insert_missing(session, RunHistory, pack_history([point]))
        state = {"job_id": job, "attempt": 1, "evaluations": 2**40, "state": bytes(range(256))}
        session.add(Checkpoint(run_id=run, **state))
        JobRepository(session).submit(new_job("open", {}), key="k")
        DispatcherRepository(session).add_dispatcher("d1", {LEASE_SECONDS_KEY: 30.0})
    return database


@pytest.fixture(params=KINDS)
def target(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """An empty database without tables, of both kinds."""
    folder = tmp_path / "target"
    folder.mkdir()
    with empty_sqlite(folder) if request.param == "sqlite" else empty_postgres() as database:
        yield database


def test_a_restored_place_has_the_same_rows_and_objects(
    database_with_rows: Database, store: ObjectStore, target: Database, tmp_path: Path
) -> None:
    """Also from one kind of database into the other."""
    file, other = tmp_path / "b.zip", open_store(f"file://{tmp_path}/other")
    written = write_backup(database_with_rows, store, file)
    assert file.stat().st_mode & 0o777 == 0o600
    assert restore_backup(target, other, file) == written
    assert read_rows(target) == read_rows(database_with_rows)
    assert read_objects(other) == read_objects(store)
    assert migrate.list_differences(target) == []
    with target.read_session() as session:
        job = JobRepository(session).list_page().items[1]
        assert list(job.spec["model"]) == ["z", "name"]  # the order of keys is kept
    with target.write_session() as session:  # further rows are numbered after the restored ones
        last = max(session.scalars(select(Event.id)))
        JobRepository(session).submit(new_job("next", {}))
        assert max(session.scalars(select(Event.id))) > last


def test_leased_parcels_of_a_backup_are_claimed_again(
    database: Database, target: Database, tmp_path: Path
) -> None:
    store, clock = open_store(f"file://{tmp_path}/objects"), Clock()
    job = submit(database, n_runs=6)
    with database.write_session() as session:
        held = LeaseQueue(session, clock).claim_job("d1", choose_size=lambda _: 4)
        assert held is not None
    write_backup(database, store, tmp_path / "b.zip")
    restore_backup(target, open_store(f"file://{tmp_path}/other"), tmp_path / "b.zip")
    assert [parcel.lease_owner for parcel in parcels_of(target, job)] == ["d1", None]
    clock.advance(3600)
    with target.write_session() as session:
        LeaseQueue(session, clock).reap_expired()
    claims = [claim(target, "d2", clock), claim(target, "d3", clock)]
    assert [one and one.runs for one in claims] == [range(4), range(4, 6)]
    with target.write_session() as session, pytest.raises(LeaseLost):
        LeaseQueue(session, clock).append_event(held.lease, "log", {"message": "late"})


def test_keys_and_the_audit_log_are_restored_and_sessions_of_browsers_are_not(
    database: Database, target: Database, tmp_path: Path
) -> None:
    store = open_store(f"file://{tmp_path}/objects")
    with database.write_session() as session:
        key = create_key(session, DEFAULT_PROJECT, "laptop", "write")
        expires_at = utc_now() + timedelta(days=1)
        session.add(WebSession(digest="d", key_id=key.row.id, expires_at=expires_at))
    write_backup(database, store, tmp_path / "b.zip")
    for force in (False, True):
        other = open_store(f"file://{tmp_path}/other")
        restore_backup(target, other, tmp_path / "b.zip", force=force)
        with target.write_session() as session:
            assert session.scalars(select(ApiKey.digest)).all() == [key.row.digest]
            assert [row.action for row in session.scalars(select(AuditEntry))] == ["key.create"]
            assert session.scalars(select(WebSession)).all() == []
            session.add(WebSession(digest="e", key_id=key.row.id, expires_at=expires_at))


def test_a_backup_goes_from_a_folder_into_a_bucket_and_back(
    sqlite_database: Database, tmp_path: Path, bucket: str
) -> None:
    folder, remote = open_store(f"file://{tmp_path}/objects"), open_store(bucket)
    sha256 = folder.put_stream([b"x" * 100_000]).sha256
    add_dataset(sqlite_database, sha256=sha256)
    for number, (source, sink) in enumerate(
        ((folder, remote), (remote, open_store(f"file://{tmp_path}/again")))
    ):
        file, place = tmp_path / f"{number}.zip", tmp_path / str(number)
        place.mkdir()
        write_backup(sqlite_database, source, file)
        with empty_sqlite(place) as restored:
            assert restore_backup(restored, sink, file).objects == 1
            assert read_rows(restored) == read_rows(sqlite_database)
        assert sink.get_bytes(sha256) == b"x" * 100_000


def test_a_backup_is_one_state_although_others_write_meanwhile(
    database_with_rows: Database,
    store: ObjectStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before, write_table = read_rows(database_with_rows), backup._write_table

    def write_and_let_others_submit(*parts: Any) -> dict[str, Any]:
        def submit() -> None:
            with database_with_rows.write_session() as session:
                JobRepository(session).submit(new_job("late", {}))

        thread = threading.Thread(target=submit)
        thread.start()
        thread.join()
        return write_table(*parts)

    monkeypatch.setattr(backup, "_write_table", write_and_let_others_submit)
    report = write_backup(database_with_rows, store, tmp_path / "b.zip")
    monkeypatch.undo()
    assert read_rows(database_with_rows) != before
    assert report.rows == {name: len(rows) for name, rows in before.items()}


def test_a_place_with_rows_or_objects_is_refused_without_force(
    database_with_rows: Database, store: ObjectStore, target: Database, tmp_path: Path
) -> None:
    file = tmp_path / "b.zip"
    write_backup(database_with_rows, store, file)
    with pytest.raises(TargetInUse, match=r"store is not empty.*--force"):
        restore_backup(target, store, file)
    other = open_store(f"file://{tmp_path}/other")
    restore_backup(target, other, file)
    with target.write_session() as session:
        JobRepository(session).submit(new_job("mine", {}))
    with pytest.raises(TargetInUse, match=r"rows in .*jobs.*--force"):
        restore_backup(target, open_store(f"file://{tmp_path}/empty"), file)
    restore_backup(target, other, file, force=True)
    assert read_rows(target) == read_rows(database_with_rows)
    with target.write_session() as session:
        DispatcherRepository(session).add_dispatcher("d2", {LEASE_SECONDS_KEY: 30.0})
    with pytest.raises(TargetInUse, match="dispatcher d2"):
        restore_backup(target, other, file, force=True)


@pytest.mark.postgres
def test_a_database_that_another_process_uses_is_not_restored_into(
    sqlite_database: Database, tmp_path: Path
) -> None:
    store = open_store(f"file://{tmp_path}/objects")
    write_backup(sqlite_database, store, tmp_path / "b.zip")
    code = "\n".join(
        (
            "import sys; from service.storage.sessions import Database",
            "database = Database(sys.argv[1])",
            "with database.engine.connect(): print('ready', flush=True); sys.stdin.read()",
        )
    )
    with empty_postgres() as target:
        migrate.upgrade_database(target)
        url = target.engine.url.render_as_string(hide_password=False)
        with subprocess.Popen(
            [sys.executable, "-c", code, url], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as other:
            assert other.stdout is not None
            assert other.stdout.readline() == b"ready\n"
            with pytest.raises(TargetInUse, match=f"another process .lagid {other.pid} of"):
                restore_backup(target, store, tmp_path / "b.zip", force=True)
            other.communicate(b"")
        restore_backup(target, store, tmp_path / "b.zip", force=True)


def test_a_backup_of_an_earlier_revision_is_upgraded(
    database_with_rows: Database,
    store: ObjectStore,
    target: Database,
    tmp_path: Path,
    add_revision: Callable[..., None],
) -> None:
    file, other = tmp_path / "b.zip", open_store(f"file://{tmp_path}/other")
    write_backup(database_with_rows, store, file)
    add_revision()
    restore_backup(target, other, file)
    migrate.check_revision(target)
    assert read_rows(target) == read_rows(database_with_rows)
    restore_backup(target, other, file, force=True)  # the place has the later tables now
    migrate.check_revision(target)
    assert read_rows(target) == read_rows(database_with_rows)


def damage(file: Path, name: str, content: bytes | None) -> None:
    """Replace a member of an archive, or leave it out."""
    with zipfile.ZipFile(file) as archive:
        members = {one.filename: archive.read(one) for one in archive.infolist()}
    with zipfile.ZipFile(file, "w") as archive:
        for member, data in members.items():
            if member != name:
                archive.writestr(member, data)
            elif content is not None:
                archive.writestr(member, content)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("manifest.json", None, "no manifest.json"),
        ("manifest.json", b"{}", "format 1"),
        (
            "manifest.json",
            b'{"format": 1, "revision": "9999", "version": "9"}',
            "9 wrote it",
        ),
        ("tables/jobs.jsonl", b"[]\n", "table jobs is damaged"),
        ("tables/jobs.jsonl", None, "no table jobs"),
    ],
)
def test_a_damaged_backup_is_refused_and_changes_no_row(
    sqlite_database: Database, tmp_path: Path, name: str, content: bytes | None, reason: str
) -> None:
    source = open_store(f"file://{tmp_path}/objects")
    add_dataset(sqlite_database, sha256=source.put_stream([b"data"]).sha256)
    file = tmp_path / "b.zip"
    write_backup(sqlite_database, source, file)
    damage(file, name, content)
    place = tmp_path / "place"
    place.mkdir()
    with empty_sqlite(place) as restored:
        with pytest.raises(InvalidBackup, match=reason):
            restore_backup(restored, open_store(f"file://{place}/objects"), file)
        assert migrate.read_current_revision(restored) is None


@pytest.mark.parametrize("where", ["member", "bit"])
def test_what_is_whole_of_a_backup_with_a_damaged_object_is_restored(
    sqlite_database: Database, tmp_path: Path, where: str
) -> None:
    source, file = open_store(f"file://{tmp_path}/objects"), tmp_path / "b.zip"
    bad, good = (source.put_stream([text * 50]).sha256 for text in (b"bad", b"good"))
    for sha256 in (bad, good):
        add_dataset(sqlite_database, sha256=sha256, source_key=sha256)
    write_backup(sqlite_database, source, file)
    if where == "member":
        damage(file, f"objects/{bad}", b"other")
    else:
        file.write_bytes(file.read_bytes().replace(b"badbadbad", b"badbbdbad", 1))
    place = tmp_path / "place"
    place.mkdir()
    with empty_sqlite(place) as restored:
        target = open_store(f"file://{place}/objects")
        report = restore_backup(restored, target, file)
        assert (report.objects, report.damaged) == (1, (bad,))
        assert read_rows(restored) == read_rows(sqlite_database)
        assert read_objects(target) == {good: b"good" * 50}


def test_a_backup_has_all_but_the_damaged_objects_and_names_these(
    sqlite_database: Database, tmp_path: Path
) -> None:
    source, file = open_store(f"file://{tmp_path}/objects"), tmp_path / "b.zip"
    bad, good = (source.put_stream([text * 50]).sha256 for text in (b"bad", b"good"))
    for sha256 in (bad, good):
        add_dataset(sqlite_database, sha256=sha256, source_key=sha256)
    path = tmp_path / "objects" / "sha256" / bad[:2] / f"{bad}.mcap"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    report = write_backup(sqlite_database, source, file)
    assert (report.objects, report.damaged, report.missing) == (1, (bad,), ())
    place = tmp_path / "place"
    place.mkdir()
    with empty_sqlite(place) as restored:
        target = open_store(f"file://{place}/objects")
        assert restore_backup(restored, target, file).damaged == (bad,)
        assert read_objects(target) == {good: b"good" * 50}


@pytest.mark.parametrize("size", [0, 10, -1])
def test_a_truncated_backup_is_refused(
    sqlite_database: Database, tmp_path: Path, size: int
) -> None:
    store, file = open_store(f"file://{tmp_path}/objects"), tmp_path / "b.zip"
    write_backup(sqlite_database, store, file)
    file.write_bytes(file.read_bytes()[:size])
    with pytest.raises(InvalidBackup, match="no complete ZIP"):
        restore_backup(sqlite_database, store, file, force=True)


def test_an_object_that_the_store_has_lost_is_reported(
    sqlite_database: Database, tmp_path: Path
) -> None:
    add_dataset(sqlite_database, sha256="e" * 64)
    store = open_store(f"file://{tmp_path}/objects")
    report = write_backup(sqlite_database, store, tmp_path / "b.zip")
    assert (report.objects, report.missing) == (0, ("e" * 64,))


def test_a_backup_that_fails_leaves_the_earlier_file(
    sqlite_database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "b.zip"
    file.write_bytes(b"earlier")

    def fail(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(backup, "_write_table", fail)
    with pytest.raises(OSError, match="No space"):
        write_backup(sqlite_database, open_store(f"file://{tmp_path}/objects"), file)
    assert file.read_bytes() == b"earlier"
    assert not list(tmp_path.glob("*.part"))
