"""Use cases of keys: create one, and describe what is stored of it."""

from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy.orm import Session

from service.access.scopes import SCOPES, Scope, include_scopes
from service.access.tokens import hash_secret, make_secret, write_token
from service.core.errors import InvalidRequest
from service.repositories.key_rows import KeyRepository, NewKey
from service.storage.columns import utc_now
from service.storage.tables import ApiKey

MAX_NAME_CHARACTERS = 100
MAX_DAYS = 3650


@dataclass(frozen=True, slots=True)
class CreatedKey:
    """A new key, and its text: nothing stored tells it again."""

    row: ApiKey
    token: str


def create_key(
    session: Session, project_id: str, name: str, scope: Scope, days: int | None = None
) -> CreatedKey:
    """Create a key of a project.

    Parameters
    ----------
    scope : str
        The highest one; it includes the lower ones.
    days : int, optional
        How long it is valid; by default until it is revoked.

    Raises
    ------
    InvalidRequest
        If the name, the scope or the days are not valid.
    """
    name = name.strip()
    if not 1 <= len(name) <= MAX_NAME_CHARACTERS or not name.isprintable():
        raise InvalidRequest.from_fault(
            "/name", f"found {name!r:.120}; need 1 to {MAX_NAME_CHARACTERS} printable characters"
        )
    if scope not in SCOPES:
        raise InvalidRequest.from_fault("/scope", f"found {scope!r:.50}; need {', '.join(SCOPES)}")
    if days is not None and not 1 <= days <= MAX_DAYS:
        raise InvalidRequest.from_fault("/days", f"found {days}; need 1 to {MAX_DAYS}")
    secret = make_secret()
    expires_at = None if days is None else utc_now() + timedelta(days=days)
    new = NewKey(name, hash_secret(secret), include_scopes(scope), expires_at)
    row = KeyRepository(session, project_id).add(new, project_id)
    return CreatedKey(row, write_token(row.id, secret))


def describe_state(key: ApiKey, now: datetime) -> str:
    """Say in a word whether a key is valid."""
    if key.revoked_at is not None:
        return "revoked"
    return "expired" if key.expires_at is not None and key.expires_at <= now else "valid"
