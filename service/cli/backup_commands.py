"""`lagid backup` and `lagid restore`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.common import AsJson, Force, err, fail, out, print_json, protect_file
from service.cli.server_processes import (
    DataDir,
    load_settings,
    lock_data_folder,
    open_database,
    require_database,
)

if TYPE_CHECKING:
    from service.upkeep.backup import BackupReport

BackupFile = Annotated[Path, typer.Argument(metavar="FILE", help="File of the backup.")]


def write_backup(
    file: BackupFile, data_dir: DataDir = None, force: Force = False, as_json: AsJson = False
) -> None:
    """Write database and objects into one file, while the service runs."""
    settings = load_settings(data_dir=data_dir)
    from service.storage.objects import open_store
    from service.upkeep import backup

    require_database(settings)
    protect_file(file, force, "FILE")
    with open_database(settings) as database:
        store = open_store(settings.store_location)
        try:
            report = backup.write_backup(database, store, file)
        except OSError as error:
            fail(f"{file} cannot be written: {error.strerror}")
    _print_report(file, "wrote", report, as_json)


def restore_backup(
    file: BackupFile,
    data_dir: DataDir = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Restore a backup into an empty database and store; --force replaces all rows there are."""
    settings = load_settings(data_dir=data_dir)
    from service.core.process.folder_lock import use_folder
    from service.storage.objects import open_store
    from service.upkeep import backup

    if not file.is_file():
        fail(f"there is no file {file}")
    settings.prepare_data_folder()
    with (
        lock_data_folder(settings, with_dispatcher=True),
        use_folder(settings.data_dir, alone=True),
        open_database(settings) as database,
    ):
        store = open_store(settings.store_location)
        report = backup.restore_backup(database, store, file, force=force)
    _print_report(file, "restored", report, as_json)


def _print_report(file: Path, verb: str, report: "BackupReport", as_json: bool) -> None:
    if as_json:
        print_json(
            {
                "file": str(file),
                "rows": report.rows,
                "objects": report.objects,
                "object_bytes": report.object_bytes,
                "missing": report.missing,
                "damaged": report.damaged,
            }
        )
    else:
        rows = sum(report.rows.values())
        out.print(
            f"{verb} {file}: {rows} rows of {len(report.rows)} tables, {report.objects} objects "
            f"with {report.object_bytes} bytes",
            markup=False,
            soft_wrap=True,
        )
    for sha256 in report.missing:
        err.print(f"the object store has lost {sha256}", markup=False)
    for sha256 in report.damaged:
        err.print(f"damaged, and not in this backup: {sha256}", markup=False)
    if report.missing or report.damaged:
        raise typer.Exit(1)
