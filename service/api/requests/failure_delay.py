"""Delay the answers to wrong keys, and record them."""

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from starlette.concurrency import run_in_threadpool

from service.core.errors import ServiceBusy, Unauthorized

FAILURE_SECONDS = 0.5
"""How long the answer to a wrong key waits."""
MAX_WAITING_FAILURES = 50
"""Answers to wrong keys that wait at once; further ones are answered by 503."""
RECORD_SECONDS = 10.0
"""Pause between two records: whoever guesses must not fill log and database."""
_log = logging.getLogger(__name__)


class FailureDelay:
    """Delays the answers to wrong keys: whoever guesses waits, and others do not."""

    def __init__(self, seconds: float = FAILURE_SECONDS, most: int = MAX_WAITING_FAILURES) -> None:
        self._seconds, self._most, self._waiting = seconds, most, 0
        self._n_unrecorded, self._recorded_at = 0, -RECORD_SECONDS

    @asynccontextmanager
    async def delay_failures(
        self, address: str, record: Callable[[str], None]
    ) -> AsyncIterator[None]:
        """Delay the block's error if it is a wrong key, and record it.

        Parameters
        ----------
        address : str
            From where the key came, for the log.
        record : callable
            Takes the identifier of the refused key.

        Raises
        ------
        ServiceBusy
            Instead, if too many others wait.
        """
        try:
            yield
        except Unauthorized as error:
            if error.is_wrong:
                await self._record(error.key_id, address, record)
                await self._wait()
            raise

    async def _record(
        self, key_id: str | None, address: str, record: Callable[[str], None]
    ) -> None:
        self._n_unrecorded += 1
        if time.monotonic() - self._recorded_at < RECORD_SECONDS:
            return
        what = "it has not the form of a key" if key_id is None else f"it names {key_id}"
        count = f"{self._n_unrecorded} wrong keys" if self._n_unrecorded > 1 else "a wrong key"
        _log.warning("refused %s, the last from %s; %s", count, address or "no address", what)
        self._n_unrecorded, self._recorded_at = 0, time.monotonic()
        if key_id is not None:
            await run_in_threadpool(record, key_id)

    async def _wait(self) -> None:
        if self._waiting >= self._most:
            raise ServiceBusy("too many requests with wrong API keys; try again") from None
        self._waiting += 1
        try:
            await asyncio.sleep(self._seconds)
        finally:
            self._waiting -= 1
