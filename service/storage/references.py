"""Accepted references: which run stands for a name now, and which ones did before."""

from collections.abc import Sequence

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.storage.errors import Conflict, NotFound
from service.storage.tables import DEFAULT_PROJECT, AcceptedReference

_RIVALS = 20


class ReferenceRepository:
    """One project's references in one session. Whoever opened the session commits."""

    def __init__(self, session: Session, project_id: str = DEFAULT_PROJECT) -> None:
        self._session, self._project_id = session, project_id

    def accept(
        self, name: str, run_id: str, accepted_by: str | None = None, note: str | None = None
    ) -> AcceptedReference:
        """Make a run the reference of a name; the one in use again changes nothing."""
        for _ in range(_RIVALS):
            latest = self._latest(name)
            if latest is not None and latest.run_id == run_id:
                return latest
            new = AcceptedReference(
                project_id=self._project_id, name=name, run_id=run_id, accepted_by=accepted_by,
                note=note, number=1 if latest is None else latest.number + 1,
            )  # fmt: skip
            try:
                # Two requests may want the same number: the later one tries again.
                with self._session.begin_nested():
                    self._session.add(new)
                    self._session.flush()
            except IntegrityError:
                continue
            return new
        raise Conflict(f"reference {name!r} is being accepted by others; try again")

    def history(self, name: str) -> Sequence[AcceptedReference]:
        """All that was accepted under a name, the one in use first; `NotFound` if nothing was."""
        query = select(AcceptedReference).where(*self._named(name))
        found = self._session.scalars(query.order_by(AcceptedReference.number.desc())).all()
        if not found:
            raise NotFound("reference", name)
        return found

    def all(self) -> Sequence[AcceptedReference]:
        """The reference in use of every name, by name."""
        last = (
            select(AcceptedReference.name, func.max(AcceptedReference.number).label("number"))
            .where(AcceptedReference.project_id == self._project_id)
            .group_by(AcceptedReference.name).subquery()
        )  # fmt: skip
        query = (
            select(AcceptedReference)
            .join(last, (AcceptedReference.name == last.c.name)
                  & (AcceptedReference.number == last.c.number))
            .where(AcceptedReference.project_id == self._project_id)
            .order_by(AcceptedReference.name)
        )  # fmt: skip
        return self._session.scalars(query).all()

    def _latest(self, name: str) -> AcceptedReference | None:
        query = select(AcceptedReference).where(*self._named(name))
        return self._session.scalars(
            query.order_by(AcceptedReference.number.desc()).limit(1)
        ).first()

    def _named(self, name: str) -> tuple[ColumnElement[bool], ColumnElement[bool]]:
        mine = AcceptedReference.project_id == self._project_id
        return mine, AcceptedReference.name == name
