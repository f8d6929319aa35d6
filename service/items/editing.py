"""Use case: change name, note and tags of an item."""

from collections.abc import Mapping

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from service.core.errors import Conflict, InvalidRequest
from service.items.item_schemas import EditIn
from service.items.items import Item, ItemRow, check_version, lock_item
from service.items.reference_names import check_reference_name
from service.repositories.audit_rows import AuditAction, record_action
from service.repositories.search_conditions import ItemKind, replace_tags
from service.storage.sessions import find_project
from service.storage.tables import AcceptedReference, Dataset, Job, SearchTerm

_ACTIONS: Mapping[ItemKind, AuditAction] = {
    "job": "job.edit",
    "run": "run.edit",
    "dataset": "dataset.edit",
    "model": "model.edit",
    "reference": "reference.edit",
}


def edit_item(
    session: Session,
    kind: ItemKind,
    reference: str,
    body: EditIn,
    if_match: str | None = None,
) -> ItemRow:
    """Change what the body names, and return the row.

    Parameters
    ----------
    if_match : str, optional
        Value of the header: versions (`compute_etag`) of which the present one must be one.

    Raises
    ------
    StaleVersion
        If the item has changed since it was read.
    InvalidRequest
        If the item has no name of its own.
    Conflict
        If another reference has the new name.
    """
    item = lock_item(session, kind, reference)
    check_version(item.row, if_match)
    changes = body.model_dump(include=body.model_fields_set)
    if "name" in changes:
        item = _rename(session, item, changes["name"])
    if "note" in changes:
        item.row.note = changes["note"]
    if "tags" in changes:
        tags = list(dict.fromkeys(changes["tags"]))
        item.row.tags = tags
        replace_tags(session, kind, _find_term_owner(item), tags)
    record_action(session, _ACTIONS[kind], _find_term_owner(item))
    session.flush()
    return item.row


def _find_term_owner(item: Item) -> str:
    row = item.row
    return row.name if isinstance(row, AcceptedReference) else row.id


def _rename(session: Session, item: Item, name: str) -> Item:
    row = item.row
    if isinstance(row, Job | Dataset):
        row.name = name
        return item
    if isinstance(row, AcceptedReference):
        check_reference_name(name, "/name")
        _rename_reference(session, row.name, name)
        return lock_item(session, item.kind, name)
    advice = "store the document under the new name" if item.kind == "model" else "use a note"
    raise InvalidRequest.from_fault(
        "/name", f"the name of a {item.kind} cannot be changed; {advice}"
    )


def _rename_reference(session: Session, old: str, new: str) -> None:
    """Rename all acceptances; jobs name the accepted run, so they are not affected."""
    project_id = find_project(session)
    of_project = AcceptedReference.project_id == project_id
    taken = select(func.count()).where(of_project, AcceptedReference.name == new)
    if new != old and session.scalar(taken):
        raise Conflict(f"there is a reference {new!r} already; delete it, or choose another name")
    session.flush()
    session.expire_all()
    for table, column in (
        (AcceptedReference, AcceptedReference.name),
        (SearchTerm, SearchTerm.item_id),
    ):
        of_table = table.project_id == project_id
        change = update(table).where(of_table, column == old).values({column: new})
        if table is SearchTerm:
            change = change.where(SearchTerm.kind.like("reference:%"))
        session.execute(change, execution_options={"synchronize_session": False})
