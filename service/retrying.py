"""Whether a call that a server could not serve just now is sent again, and after what pause."""

from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http import HTTPStatus
from typing import TYPE_CHECKING

from service.calls import IDEMPOTENCY, Call

if TYPE_CHECKING:
    from collections.abc import Iterator

    import httpx

RETRIES = 4
FIRST_S = 0.5
"""Pause before the second try, where the server names none; each one after is twice as long."""
LONGEST_S = 30.0
"""No pause is longer: a server that asks for more is away for longer than a call should hang."""
REPEATABLE = frozenset({"GET", "HEAD", "PUT"})


def pauses(call: Call, retries: int) -> "Iterator[float]":
    """Seconds to wait before each further try of a call, where the server names none.

    There are none for a request that might be carried out twice: a POST without idempotency key.
    """
    if call.method in REPEATABLE or IDEMPOTENCY in call.headers:
        for number in range(retries):
            yield FIRST_S * 2**number


def pause_after(answer: "httpx.Response", left: "Iterator[float]") -> float | None:
    """Seconds until a call is sent again; None if its answer stands.

    Parameters
    ----------
    answer : httpx.Response
        Only 503 is temporary by its meaning; its ``Retry-After`` is waited for, in seconds or as
        a date (RFC 9110, section 10.2.3).
    left : iterator of float
        The pauses of this call that are left, of which one is taken.
    """
    if answer.status_code != HTTPStatus.SERVICE_UNAVAILABLE:
        return None
    pause = next(left, None)
    if pause is None:
        return None
    asked = _asked(answer.headers.get("Retry-After"))
    pause = pause if asked is None else asked
    return pause if pause <= LONGEST_S else None


def _asked(header: str | None) -> float | None:
    """Seconds that a ``Retry-After`` asks for; None if it is missing or neither of its forms."""
    if header is None:
        return None
    if header.strip().isdecimal():
        return float(header)
    try:
        until = parsedate_to_datetime(header)
    except (ValueError, OverflowError):  # the latter of a zone that no integer holds
        return None
    if until.tzinfo is None:  # RFC 5322's -0000; HTTP's dates are of GMT
        until = until.replace(tzinfo=UTC)
    return max(0.0, (until - datetime.now(UTC)).total_seconds())
