"""API keys of projects, and the sessions of browsers that signed in with one."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy import ColumnElement, delete, or_, select, update
from sqlalchemy.orm import Session

from service.repositories.audit_rows import record_action
from service.storage.columns import utc_now
from service.storage.statements import new_id
from service.storage.storage_errors import RowNotFound
from service.storage.tables import ApiKey, Project, WebSession

USE_INTERVAL = timedelta(minutes=1)
"""How old the noted last use of a key may be."""


@dataclass(frozen=True, slots=True)
class NewKey:
    """A key to store: its name, the digest of its secret, and what it may do until when."""

    name: str
    digest: str
    scopes: tuple[str, ...]
    expires_at: datetime | None


class KeyRepository:
    """The keys of one project, or of all if None, in one session. The opener commits."""

    def __init__(self, session: Session, project_id: str | None) -> None:
        self._session, self._project_id = session, project_id

    def add(self, new: NewKey, project_id: str) -> ApiKey:
        """Store a key of a project."""
        key = ApiKey(
            id=new_id("key"),
            project_id=project_id,
            name=new.name,
            digest=new.digest,
            scopes=list(new.scopes),
            expires_at=new.expires_at,
        )
        self._session.add(key)
        self._session.flush()
        record_action(self._session, "key.create", key.id, project_id)
        return key

    def list_all(self) -> Sequence[ApiKey]:
        """List the keys, also those that have ended, the latest first."""
        query = select(ApiKey).order_by(ApiKey.id.desc())
        if self._project_id is not None:
            query = query.where(ApiKey.project_id == self._project_id)
        return self._session.scalars(query).all()

    def revoke(self, key_id: str) -> ApiKey:
        """End a key at once, and the sessions of browsers that signed in with it.

        Raises
        ------
        RowNotFound
            If there is no such key, or it is one of another project.
        """
        key = self._session.get(ApiKey, key_id, with_for_update=True)
        if key is None or self._project_id not in (None, key.project_id):
            raise RowNotFound("key", key_id)
        if key.revoked_at is None:
            key.revoked_at = utc_now()
            self._session.execute(delete(WebSession).where(WebSession.key_id == key_id))
            record_action(self._session, "key.revoke", key.id, key.project_id)
        self._session.flush()
        return key

    def has_valid(self) -> bool:
        """Return whether a key is valid now."""
        return self._session.scalar(select(ApiKey.id).where(*_is_valid()).limit(1)) is not None


def find_key(session: Session, key_id: str) -> ApiKey | None:
    """Return a key of any project; None if there is none, or it has ended."""
    return session.scalar(select(ApiKey).where(ApiKey.id == key_id, *_is_valid()))


def note_use(session: Session, key_id: str) -> None:
    """Write that a key is used now, unless its last use was written in the last minute."""
    now = utc_now()
    is_old = or_(ApiKey.last_used_at.is_(None), ApiKey.last_used_at < now - USE_INTERVAL)
    session.execute(update(ApiKey).where(ApiKey.id == key_id, is_old).values(last_used_at=now))


def add_web_session(session: Session, key: ApiKey, digest: str, expires_at: datetime) -> None:
    """Store the session of a browser, and remove those that have ended."""
    session.execute(delete(WebSession).where(WebSession.expires_at < utc_now()))
    session.add(WebSession(digest=digest, key_id=key.id, expires_at=expires_at))
    record_action(session, "session.sign-in", key.id, key.project_id)


def find_session_key(session: Session, digest: str) -> ApiKey | None:
    """Return the key of a browser's session; None if session or key have ended."""
    query = select(ApiKey).join(WebSession, WebSession.key_id == ApiKey.id)
    return session.scalar(
        query.where(WebSession.digest == digest, WebSession.expires_at > utc_now(), *_is_valid())
    )


def end_web_session(session: Session, digest: str) -> None:
    """End the session of a browser, if there is one."""
    row = session.get(WebSession, digest)
    if row is not None:
        key = session.get_one(ApiKey, row.key_id)
        record_action(session, "session.sign-out", key.id, key.project_id)
        session.delete(row)


def list_project_names(session: Session) -> dict[str, str]:
    """List the name of each project."""
    return dict(session.execute(select(Project.id, Project.name)).all())


def _is_valid() -> tuple[ColumnElement[bool], ...]:
    return (
        ApiKey.revoked_at.is_(None),
        or_(ApiKey.expires_at.is_(None), ApiKey.expires_at > utc_now()),
    )
