"""Open the database and the object store for the web process; imports no web framework."""

import tempfile
from pathlib import Path

from service.core.process import temporary_files
from service.core.settings import Settings
from service.storage import migrate
from service.storage.objects import ObjectStore, open_store
from service.storage.sessions import Database


def open_storage(settings: Settings) -> tuple[Database, ObjectStore]:
    """Open the database and the object store.

    The data folder and the tables are created if needed. Temporary files of ended processes are
    removed.

    Raises
    ------
    Misconfigured, StorageError
        If the data folder is not writable, or the address of the store is of an unknown kind.
    SQLAlchemyError
        If the database cannot be opened.
    """
    settings.prepare_data_folder()
    temporary_files.remove_leftovers(Path(tempfile.gettempdir()))
    # What a request has been told survives a power cut.
    database = Database(settings.database_location, is_durable=True)
    migrate.upgrade_database(database)
    database.update_statistics()
    return database, open_store(settings.store_location)
