"""Transactions beside the main thread of the dispatcher, where that gains time.

While PostgreSQL carries out a transaction, the dispatcher can go on. SQLite works in the process
itself, and a thread would only compete with the main thread for the interpreter.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from service.storage.sessions import Database

THREADS = 5
"""Transactions at a time: the writes of some parcels, and the read of the next runs."""

RunBeside = Callable[[Callable[[], Any]], "Future[Any]"]
"""Begins to carry out a function in a thread."""


def run_at_once(work: Callable[[], Any]) -> "Future[Any]":
    """Carry out a function now; its error is raised where its result is asked for."""
    done: Future[Any] = Future()
    try:
        done.set_result(work())
    except BaseException as error:  # noqa: BLE001 - raised by the future
        done.set_exception(error)
    return done


class Overlap:
    """Threads for the transactions of a dispatcher; none on SQLite."""

    def __init__(self, database: Database) -> None:
        self._pool = None if database.is_sqlite else ThreadPoolExecutor(THREADS, "database")

    @property
    def run_beside(self) -> RunBeside | None:
        """Carry out a function in a thread; None on SQLite."""
        return None if self._pool is None else self._pool.submit

    def close(self) -> None:
        """Wait for what is being carried out, and end the threads."""
        if self._pool is not None:
            self._pool.shutdown()
