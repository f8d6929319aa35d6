"""The audit log: who did what in a project, written in the transaction of the change."""

from collections.abc import Sequence
from typing import Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.core.bodies.text_checks import MANY, parse_digits
from service.storage.sessions import find_owner
from service.storage.statements import RowPage, make_page
from service.storage.storage_errors import InvalidCursor
from service.storage.tables import AuditEntry

AuditAction = Literal[
    "dataset.add",
    "dataset.delete",
    "dataset.edit",
    "job.submit",
    "job.cancel",
    "job.resume",
    "job.delete",
    "job.edit",
    "key.create",
    "key.refuse",
    "key.revoke",
    "model.add",
    "model.delete",
    "model.edit",
    "project.create",
    "project.keep",
    "project.limit",
    "reference.accept",
    "reference.delete",
    "reference.edit",
    "run.delete",
    "run.edit",
    "session.sign-in",
    "session.sign-out",
]


def record_action(
    session: Session, action: AuditAction, object_id: str, project_id: str | None = None
) -> None:
    """Record an action of the session's owner; it is stored if the transaction commits.

    Parameters
    ----------
    project_id : str, optional
        Project of the changed object; by default that of the session.
    """
    owner = find_owner(session)
    session.add(
        AuditEntry(
            project_id=project_id or owner.project_id,
            actor=owner.actor,
            action=action,
            object_id=object_id,
            request_id=owner.request_id,
        )
    )


def list_actions(
    session: Session, project_id: str | None = None, *, cursor: str | None = None, limit: int = 50
) -> RowPage[AuditEntry]:
    """List the actions of a project, or of all if None, latest first.

    Raises
    ------
    InvalidCursor
        If the cursor is not the `next` of a page.
    """
    query = select(AuditEntry).order_by(AuditEntry.id.desc()).limit(limit + 1)
    if project_id is not None:
        query = query.where(AuditEntry.project_id == project_id)
    if cursor is not None:
        query = query.where(AuditEntry.id < _parse_cursor(cursor))
    rows: Sequence[AuditEntry] = session.scalars(query).all()
    return make_page(rows, limit, (row.id for row in rows))


def _parse_cursor(cursor: str) -> int:
    number = parse_digits(cursor) if cursor.isdecimal() else MANY
    if number == MANY:
        raise InvalidCursor(cursor)
    return number
