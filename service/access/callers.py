"""Find who sends a request: by an API key, a browser's session, a proxy, or loopback alone."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address

from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from service.access.scopes import SCOPES, Scope, include_scopes
from service.access.tokens import hash_secret, is_secret, make_secret, parse_token
from service.core.errors import OutOfScope, Unauthorized
from service.core.settings import Settings, is_loopback
from service.repositories.audit_rows import record_action
from service.repositories.key_rows import (
    USE_INTERVAL,
    add_web_session,
    end_web_session,
    find_key,
    find_session_key,
    note_use,
)
from service.repositories.project_rows import ProjectRepository
from service.storage.columns import utc_now
from service.storage.sessions import Database, SessionOwner
from service.storage.tables import DEFAULT_PROJECT, ApiKey

MAX_USER_CHARACTERS = 100
MAX_ADDRESS_CHARACTERS = 100
"""More than any address; a proxy may pass on what its client calls one."""
NOTE_BUSY_SECONDS = 0.5
"""How long the note of a key's use waits for the lock of others; then a later one is written."""
_NO_DIGEST = hash_secret(make_secret())
"""Digest of no secret: an unknown key takes as long as a known one."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """What a request shows of its sender.

    Attributes
    ----------
    token : str or None
        API key of the header ``Authorization``.
    cookie : str or None
        Secret of a browser's session.
    users : tuple of str
        Values of the header that an authenticating proxy sets.
    address : str
        Address of the peer; empty if it has none.
    """

    token: str | None = None
    cookie: str | None = None
    users: tuple[str, ...] = ()
    address: str = ""


@dataclass(frozen=True, slots=True)
class Caller:
    """Who sends a request, in which project, and what it may do.

    Attributes
    ----------
    project_id, actor : str
        See `SessionOwner`.
    scopes : tuple of str
    name : str
        What a page shows; empty on loopback without keys.
    has_session : bool
        Whether a browser signed in, and can sign out.
    """

    project_id: str
    actor: str
    scopes: tuple[Scope, ...]
    name: str = ""
    has_session: bool = False

    def check_scope(self, needed: Scope) -> None:
        """Refuse a request that needs another scope.

        Raises
        ------
        OutOfScope
            With the scope that is needed.
        """
        if needed not in self.scopes:
            raise OutOfScope(
                f"this request needs the scope {needed!r}; {self.actor} has "
                f"{', '.join(self.scopes)}. Use a key with that scope."
            )

    def to_owner(self, request_id: str | None = None) -> SessionOwner:
        """Return the owner of the sessions that serve a request."""
        return SessionOwner(self.project_id, self.actor, request_id)


LOOPBACK = Caller(DEFAULT_PROJECT, "loopback", SCOPES)
ANYBODY = Caller(DEFAULT_PROJECT, "anybody", SCOPES)
"""Who reaches a service without keys: from this machine, or from others."""
NOBODY = Caller("", "nobody", ())
"""Who needs no key: sees the rows of no project."""


def find_caller(database: Database, settings: Settings, credentials: Credentials) -> Caller:
    """Find who sends a request, and note the use of a key.

    Raises
    ------
    Unauthorized
        If the request shows no valid key, session or user.
    """
    if settings.auth_mode == "off":
        return LOOPBACK if is_loopback(settings.host) else ANYBODY
    with database.read_session() as session:
        if credentials.token is not None:
            key = _check_token(session, credentials.token)
        elif settings.auth_mode == "proxy" and _is_trusted(settings, credentials.address):
            if credentials.users or credentials.cookie is None:
                return _find_user(session, settings, credentials.users)
            key = _check_cookie(session, credentials.cookie)
        else:
            key = _check_cookie(session, credentials.cookie)
    _note_use(database, key)
    has_session = credentials.token is None
    return Caller(key.project_id, key.id, _read_scopes(key), key.name, has_session)


def sign_in(
    database: Database,
    token: str,
    lifetime: timedelta,
    *,
    cookie: str | None = None,
    request_id: str | None = None,
) -> tuple[str, datetime]:
    """Start the session of a browser; return its secret and its end.

    The secret is always new, and the session of the browser's `cookie` ends.

    Raises
    ------
    Unauthorized
        If the key is not valid.
    """
    with database.read_session() as session:
        key = _check_token(session, token)
    secret, ends_at = make_secret(), datetime.now(UTC) + lifetime
    owner = SessionOwner(key.project_id, key.id, request_id)
    with database.open_for(owner).write_session() as session:
        if cookie is not None:
            end_web_session(session, hash_secret(cookie))
        end = min(filter(None, (ends_at, key.expires_at)))
        add_web_session(session, key, hash_secret(secret), end)
    _note_use(database, key)
    return secret, end


def sign_out(database: Database, cookie: str, request_id: str | None = None) -> None:
    """End the session of a browser, if there is one."""
    digest = hash_secret(cookie)
    with database.read_session() as session:
        key = find_session_key(session, digest)
    if key is not None:
        owner = SessionOwner(key.project_id, key.id, request_id)
        with database.open_for(owner).write_session() as session:
            end_web_session(session, digest)


def record_refusal(
    database: Database, key_id: str, address: str, request_id: str | None = None
) -> None:
    """Write into the audit log of a key's project that a request with it was refused."""
    with suppress(OperationalError):
        with database.read_session() as session:
            key = session.get(ApiKey, key_id)
        if key is None:
            return
        owner = SessionOwner(
            key.project_id, f"address:{address[:MAX_ADDRESS_CHARACTERS]}", request_id
        )
        with database.open_for(owner).write_session(NOTE_BUSY_SECONDS) as session:
            record_action(session, "key.refuse", key.id)


def _check_token(session: Session, token: str) -> ApiKey:
    parts = parse_token(token)
    key = None if parts is None else find_key(session, parts.key_id)
    is_right = is_secret("" if parts is None else parts.secret, key.digest if key else _NO_DIGEST)
    if key is None or not is_right:
        raise Unauthorized(
            "the API key is unknown, has expired, or was revoked. Need a key of the form "
            "lagid_…_…, made by `lagid key create`",
            is_wrong=True,
            key_id=parts.key_id if parts else None,
        )
    return key


def _check_cookie(session: Session, cookie: str | None) -> ApiKey:
    key = None if cookie is None else find_session_key(session, hash_secret(cookie))
    if key is None:
        what = "the request has no API key" if cookie is None else "the session has ended"
        raise Unauthorized(
            f"{what}. Send the header `Authorization: Bearer lagid_…` (commands: --key or "
            "LAGID_API_KEY), or sign in at /sign-in"
        )
    return key


def _find_user(session: Session, settings: Settings, users: tuple[str, ...]) -> Caller:
    """Find the user whom a proxy names; two names may mean that one is not the proxy's."""
    if len(users) != 1 or not _is_user_name(users[0]):
        raise Unauthorized(
            f"the proxy must name one user in {settings.proxy_header}, with 1 to "
            f"{MAX_USER_CHARACTERS} printable characters, without a comma or a space; found "
            f"{len(users)} values. Programs may send an API key instead"
        )
    user = users[0].strip()
    scope: Scope = "admin" if user.lower() in settings.proxy_admins else "write"
    project = ProjectRepository(session).get(settings.proxy_project)
    return Caller(project.id, f"user:{user}", include_scopes(scope), user)


def _is_user_name(text: str) -> bool:
    """Test a name; with a comma or a space it may be two, of a list or of a folded header."""
    name = text.strip()
    is_one = not any(character.isspace() or character == "," for character in name)
    return 1 <= len(name) <= MAX_USER_CHARACTERS and name.isprintable() and is_one


def _is_trusted(settings: Settings, address: str) -> bool:
    try:
        peer = ip_address(address)
    except ValueError:
        return False
    return any(peer in network for network in settings.proxy_networks)


def _note_use(database: Database, key: ApiKey) -> None:
    """Write the use of a key, at most once a minute; a busy database must not hold the request."""
    if key.last_used_at is not None and utc_now() - key.last_used_at < USE_INTERVAL:
        return
    with suppress(OperationalError), database.write_session(NOTE_BUSY_SECONDS) as session:
        note_use(session, key.id)


def _read_scopes(key: ApiKey) -> tuple[Scope, ...]:
    """Read the scopes of a key; what this version does not know gives no right."""
    return tuple(scope for scope in SCOPES if scope in key.scopes)


def describe_scopes(scopes: Iterable[str]) -> str:
    """Describe scopes by the highest one."""
    return [scope for scope in SCOPES if scope in scopes][-1]
