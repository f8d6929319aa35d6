"""Accepted references: the run that is the reference of a name, and the previous ones."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.repositories.audit_rows import record_action
from service.repositories.search_conditions import NO_FILTER, ListFilter, select_items_with
from service.storage.columns import Document
from service.storage.sessions import find_project
from service.storage.statements import RowPage, make_page
from service.storage.storage_errors import RowConflict, RowNotFound
from service.storage.tables import AcceptedReference, Run

MAX_HISTORY = 1000
"""Longest reported history of one name."""

_MAX_TRIES = 20
_MAX_NAMES = 10_000


class CurrentReference(NamedTuple):
    """The reference in use of a name, with details of its run."""

    accepted: AcceptedReference
    job_id: str
    labels: Document
    estimates: Document | None


class ReferenceRepository:
    """The references of one project in one session. The opener of the session commits."""

    def __init__(self, session: Session, project_id: str | None = None) -> None:
        self._session, self._project_id = session, project_id or find_project(session)

    def accept_run(
        self, name: str, run_id: str, accepted_by: str | None = None, note: str | None = None
    ) -> AcceptedReference:
        """Make a run the reference of a name.

        To accept the current reference again changes nothing, unless the person or the note is new.
        """
        for _ in range(_MAX_TRIES):
            latest = self._find_latest(name)
            if latest is not None and _is_same_acceptance(latest, run_id, accepted_by, note):
                return latest
            new = AcceptedReference(
                project_id=self._project_id,
                name=name,
                run_id=run_id,
                accepted_by=accepted_by,
                note=note,
                tags=None if latest is None else latest.tags,
                number=1 if latest is None else latest.number + 1,
            )
            try:
                # Two requests may want the same number: the later one tries again.
                with self._session.begin_nested():
                    self._session.add(new)
                    self._session.flush()
            except IntegrityError:
                continue
            record_action(self._session, "reference.accept", run_id, self._project_id)
            return new
        raise RowConflict(f"reference {name!r} is being accepted by others; try again")

    def get_latest(self, name: str) -> AcceptedReference:
        """Return the reference in use of a name; `RowNotFound` if there is none."""
        latest = self._find_latest(name)
        if latest is None:
            raise RowNotFound("reference", name)
        return latest

    def list_history(self, name: str) -> Sequence[AcceptedReference]:
        """List the acceptances of a name, the current one first, at most `MAX_HISTORY`.

        Raises
        ------
        RowNotFound
            If nothing was accepted.
        """
        query = select(AcceptedReference).where(*self._filter_name(name)).limit(MAX_HISTORY)
        acceptances = self._session.scalars(query.order_by(AcceptedReference.number.desc())).all()
        if not acceptances:
            raise RowNotFound("reference", name)
        return acceptances

    def list_page(
        self, *, cursor: str | None = None, limit: int = 50, chosen: ListFilter = NO_FILTER
    ) -> RowPage[CurrentReference]:
        """List the reference in use of every name that meets a filter, by name.

        Times are those of the latest acceptance.
        """
        of_project = AcceptedReference.project_id == self._project_id
        last = (
            select(AcceptedReference.name, func.max(AcceptedReference.number).label("number"))
            .where(of_project)
            .group_by(AcceptedReference.name)
            .order_by(AcceptedReference.name)
            .limit(limit + 1)
        )
        if cursor is not None:
            last = last.where(AcceptedReference.name > cursor)
        name, latest = AcceptedReference.name, func.max(AcceptedReference.accepted_at)
        if chosen.name:
            last = last.where(name.icontains(chosen.name, autoescape=True))
        for term in chosen.terms:
            last = last.where(name.in_(select_items_with("reference", self._project_id, term)))
        if chosen.since is not None:
            last = last.having(latest >= chosen.since)
        if chosen.until is not None:
            last = last.having(latest < chosen.until)
        current = last.subquery()
        query = (
            select(AcceptedReference, Run.job_id, Run.labels, Run.estimates)
            .join(
                current,
                (AcceptedReference.name == current.c.name)
                & (AcceptedReference.number == current.c.number),
            )
            .join(Run, Run.id == AcceptedReference.run_id)
            .where(of_project)
            .order_by(AcceptedReference.name)
        )
        references = [CurrentReference(*row) for row in self._session.execute(query)]
        return make_page(references, limit, (reference.accepted.name for reference in references))

    def list_of_jobs(self, jobs: Collection[str]) -> Sequence[CurrentReference]:
        """List the acceptances of runs of these jobs, latest last; earlier ones are among them."""
        query = (
            select(AcceptedReference, Run.job_id, Run.labels, Run.estimates)
            .join(Run, Run.id == AcceptedReference.run_id)
            .where(AcceptedReference.project_id == self._project_id, Run.job_id.in_(jobs))
            .order_by(AcceptedReference.number)
            .limit(_MAX_NAMES)
        )
        return [CurrentReference(*row) for row in self._session.execute(query)]

    def list_names(self) -> Sequence[str]:
        """List the names of references in use."""
        query = (
            select(AcceptedReference.name)
            .distinct()
            .where(AcceptedReference.project_id == self._project_id)
            .limit(_MAX_NAMES)
        )
        return self._session.scalars(query).all()

    def lock(self, name: str) -> Sequence[AcceptedReference]:
        """Return the acceptances of a name, latest first, until the session ends as they are."""
        query = select(AcceptedReference).where(*self._filter_name(name))
        lock = query.order_by(AcceptedReference.number.desc()).with_for_update()
        rows = self._session.scalars(lock, execution_options={"populate_existing": True}).all()
        if not rows:
            raise RowNotFound("reference", name)
        return rows

    def _find_latest(self, name: str) -> AcceptedReference | None:
        query = select(AcceptedReference).where(*self._filter_name(name))
        return self._session.scalars(
            query.order_by(AcceptedReference.number.desc()).limit(1)
        ).first()

    def _filter_name(self, name: str) -> tuple[ColumnElement[bool], ColumnElement[bool]]:
        of_project = AcceptedReference.project_id == self._project_id
        return of_project, AcceptedReference.name == name


def _is_same_acceptance(
    latest: AcceptedReference, run_id: str, by: str | None, note: str | None
) -> bool:
    has_new_details = by not in (None, latest.accepted_by) or note not in (None, latest.note)
    return latest.run_id == run_id and not has_new_details
