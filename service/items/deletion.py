"""Use case: delete an item, alone or with everything that was made from it.

Rows are marked as deleted, and lineage keeps their edges. The runs of a deleted job, and objects
without a row, are removed later (`service.upkeep`).
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, cast

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from service.core.errors import Conflict
from service.core.states import OPEN_STATES, JobState
from service.items.items import Item, check_version, lock_item
from service.repositories.audit_rows import record_action
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.job_rows import JobRepository
from service.repositories.lineage_rows import LineageRepository
from service.repositories.model_rows import ModelRepository
from service.repositories.outcome_rows import record_best_run
from service.repositories.search_conditions import ItemKind, delete_terms
from service.storage.columns import utc_now
from service.storage.sessions import find_project
from service.storage.storage_errors import RowNotFound
from service.storage.tables import (
    AcceptedReference,
    Dataset,
    Job,
    ModelVersion,
    Run,
    StoredSummary,
)

LISTED_ITEMS = 20
"""Dependent items that the text of a refusal names; its document has all of them."""
PREFIX_KINDS: Mapping[str, ItemKind] = {"ds": "dataset", "job": "job", "run": "run", "mdl": "model"}


class HasDependents(Conflict):
    """Other items were made from the one that should be deleted."""

    title = "Other items depend on it"

    def __init__(self, item: Item, dependents: list[Item]) -> None:
        listed = [f"{one.kind} {one.id} ({one.name})" for one in dependents[:LISTED_ITEMS]]
        more = len(dependents) - len(listed)
        rest = f" and {more} more" if more else ""
        super().__init__(
            f"{item.kind} {item.id} was not deleted, because others were made from it: "
            f"{', '.join(listed)}{rest}. Delete them first, or all with ?cascade=true"
        )
        self.dependents = dependents

    @property
    def members(self) -> Mapping[str, Any]:
        """The dependent items."""
        return {"dependents": [describe_item(item) for item in self.dependents]}


def describe_item(item: Item) -> dict[str, str]:
    """Describe an item in answers."""
    return {"kind": item.kind, "id": item.id, "name": item.name}


def delete_item(
    session: Session,
    kind: ItemKind,
    reference: str,
    *,
    cascade: bool = False,
    if_match: str | None = None,
) -> list[Item]:
    """Delete an item; return what was deleted, the item first.

    Parameters
    ----------
    cascade : bool
        Whether everything that was made from it is deleted too.

    Raises
    ------
    HasDependents
        If others were made from it, without `cascade`.
    Conflict
        If a job of them is queued or running.
    StaleVersion
        If the item has changed since it was read.
    """
    item = lock_item(session, kind, reference, is_deleted=True)
    check_version(item.row, if_match)
    dependents = find_dependents(session, item)
    if dependents and not cascade:
        raise HasDependents(item, dependents)
    doomed = [item, *dependents]
    _refuse_open_jobs(session, doomed)
    for one in reversed(doomed):
        _DELETIONS[one.kind](session, one)
    session.flush()
    return doomed


def find_dependents(session: Session, item: Item) -> list[Item]:
    """Find everything that was made from an item, and lock it. The nearest comes first."""
    found: dict[tuple[str, str], Item] = {}
    waiting = [item]
    while waiting:
        for kind, identity in _list_children(session, waiting.pop(0)):
            if (kind, identity) in found or identity == item.id:
                continue
            try:
                child = lock_item(session, kind, identity, is_deleted=True)
            except RowNotFound:  # deleted before
                continue
            found[kind, identity] = child
            waiting.append(child)
    return list(found.values())


def _list_children(session: Session, item: Item) -> Iterator[tuple[ItemKind, str]]:
    if item.kind == "reference":
        return
    lineage = LineageRepository(session)
    parents = [row.id for row in cast(tuple[Dataset, ...], item.rows)]
    children = lineage.list_children(parents)
    if item.kind == "job":  # what was made from its runs, which are edges of lineage then
        children = lineage.list_children(children)
    for child in children:
        yield PREFIX_KINDS[child.partition("_")[0]], child
    if item.kind in ("job", "run"):
        runs = [item.id] if item.kind == "run" else _select_runs(item.id)
        names = select(AcceptedReference.name).where(
            AcceptedReference.project_id == find_project(session),
            AcceptedReference.run_id.in_(runs),
        )
        for name in session.scalars(names.distinct().order_by(AcceptedReference.name)):
            yield "reference", name


def _refuse_open_jobs(session: Session, doomed: list[Item]) -> None:
    """Refuse to delete a job that is queued or running, or a run of it."""
    is_open = []
    for item in doomed:
        row = item.row
        job = session.get(Job, row.job_id) if isinstance(row, Run) else row
        if isinstance(job, Job) and job.state in OPEN_STATES:
            is_open.append(f"{job.id} is {job.state}")
    if is_open:
        raise Conflict(f"{'; '.join(dict.fromkeys(is_open))}. Cancel it before deleting it")


def _delete_job(session: Session, item: Item) -> None:
    JobRepository(session).delete(item.id)
    delete_terms(session, item.id)
    _delete_acceptances(session, AcceptedReference.run_id.in_(_select_runs(item.id)))


def _delete_run(session: Session, item: Item) -> None:
    """Hide a run. Its job counts it as done, so that resuming the job does not compute it again."""
    run = cast(Run, item.row)
    run.deleted_at, run.best_rms = utc_now(), None
    job = session.get_one(Job, run.job_id)
    if run.state is JobState.FAILED:
        job.n_failed -= 1
        if job.state is JobState.INCOMPLETE and not job.n_failed:
            job.state = JobState.SUCCEEDED
    elif run.state is JobState.CANCELLED:
        job.n_done += 1
    session.flush()
    job.best_rms = None
    record_best_run(session, job)
    session.execute(delete(StoredSummary).where(StoredSummary.job_id == run.job_id))
    delete_terms(session, run.id)
    record_action(session, "run.delete", run.id)
    _delete_acceptances(session, AcceptedReference.run_id == run.id)


def _delete_dataset(session: Session, item: Item) -> None:
    DatasetRepository(session).delete(item.id)
    delete_terms(session, item.id)


def _delete_model(session: Session, item: Item) -> None:
    for version in cast(tuple[ModelVersion, ...], item.rows):
        ModelRepository(session).delete(f"{version.name}@{version.version}")
        delete_terms(session, version.id)


def _delete_reference(session: Session, item: Item) -> None:
    _delete_acceptances(session, AcceptedReference.name == item.id)
    delete_terms(session, item.id)
    record_action(session, "reference.delete", item.id)


def _delete_acceptances(session: Session, condition: Any) -> None:
    session.execute(
        delete(AcceptedReference).where(
            AcceptedReference.project_id == find_project(session), condition
        ),
        execution_options={"synchronize_session": False},
    )


def _select_runs(job_id: str) -> Any:
    return select(Run.id).where(Run.job_id == job_id)


_DELETIONS: Mapping[ItemKind, Callable[[Session, Item], None]] = {
    "job": _delete_job,
    "run": _delete_run,
    "dataset": _delete_dataset,
    "model": _delete_model,
    "reference": _delete_reference,
}
