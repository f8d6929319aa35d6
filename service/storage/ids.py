"""Sortable, prefixed identifiers: ``job_`` and 26 characters of Crockford's base 32.

48 bits of milliseconds since 1970 and 80 random bits, as in a ULID. Within a process each
identifier is greater than the one before, also when the clock stands still or goes back.
"""

import secrets
import threading
import time
from typing import Literal

IdPrefix = Literal["proj", "key", "ds", "mdl", "job", "run"]

_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"
_RANDOM_BITS = 80
_LENGTH = 26


class _Sequence:
    """Strictly increasing 128-bit numbers, led by the time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last = 0

    def take(self, n: int) -> range:
        """The next `n` numbers, consecutive from the second on."""
        with self._lock:
            fresh = time.time_ns() // 1_000_000 << _RANDOM_BITS | secrets.randbits(_RANDOM_BITS)
            first = max(fresh, self._last + 1)
            self._last = first + n - 1
            return range(first, first + n)


_sequence = _Sequence()


def new_id(prefix: IdPrefix) -> str:
    """A new identifier, greater than every one this process made before."""
    return new_ids(prefix, 1)[0]


def new_ids(prefix: IdPrefix, n: int) -> list[str]:
    """`n` new identifiers, ascending."""
    return [f"{prefix}_{_encode(number)}" for number in _sequence.take(n)]


def _encode(number: int) -> str:
    shifts = range(5 * (_LENGTH - 1), -1, -5)
    return "".join(_ALPHABET[number >> shift & 31] for shift in shifts)
