"""Alembic environment: the code that runs around every command.

The service passes its own connection, in a transaction that holds the lock of
`service.storage.migrate`. On the command line the address is that of ``alembic.ini``, or of
``alembic -x url=…``.
"""

from typing import Any

from alembic import context
from sqlalchemy import Connection

from service.storage.sessions import Database
from service.storage.tables import Base


def run(connection: Connection) -> None:
    """Run the migrations of the command in the transaction of this connection."""
    options: dict[str, Any] = {"compare_type": True, "compare_server_default": True}
    context.configure(
        connection=connection,
        target_metadata=Base.metadata,
        # SQLite can alter most parts of a table only by copying it.
        render_as_batch=connection.dialect.name == "sqlite",
        transactional_ddl=True,
        **options,
    )
    with context.begin_transaction():
        context.run_migrations()


def main() -> None:
    """Use the connection that was passed, or open one."""
    passed = context.config.attributes.get("connection")
    if passed is not None:
        run(passed)
        return
    address = context.get_x_argument(as_dictionary=True).get("url")
    database = Database(str(address or context.config.get_main_option("sqlalchemy.url")))
    with database.engine.begin() as connection:
        run(connection)
    database.dispose()


main()
