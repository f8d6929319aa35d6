"""Delay the answers to wrong keys."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from service.core.errors import ServiceBusy, Unauthorized

FAILURE_SECONDS = 0.5
"""How long the answer to a wrong key waits."""
MAX_WAITING_FAILURES = 50
"""Answers to wrong keys that wait at once; further ones are answered by 503."""


class FailureDelay:
    """Delays the answers to wrong keys: whoever guesses waits, and others do not."""

    def __init__(self, seconds: float = FAILURE_SECONDS, most: int = MAX_WAITING_FAILURES) -> None:
        self._seconds, self._most, self._waiting = seconds, most, 0

    @asynccontextmanager
    async def delay_failures(self) -> AsyncIterator[None]:
        """Delay the block's error if it is a wrong key.

        Raises
        ------
        ServiceBusy
            Instead, if too many others wait.
        """
        try:
            yield
        except Unauthorized as error:
            if error.is_wrong:
                await self._wait()
            raise

    async def _wait(self) -> None:
        if self._waiting >= self._most:
            raise ServiceBusy("too many requests with wrong API keys; try again") from None
        self._waiting += 1
        try:
            await asyncio.sleep(self._seconds)
        finally:
            self._waiting -= 1
