"""Parts that the routes of all stored items share: filters of lists, ETags, edits, deletions."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Annotated, Any, cast

from fastapi import Depends, Header, Query, Response
from pydantic import TypeAdapter, ValidationError
from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest
from service.core.states import JobState
from service.datasets.datasets import resolve_dataset
from service.items.deletion import delete_item, describe_item
from service.items.editing import edit_item
from service.items.item_schemas import DeletedOut, EditIn, ItemOut
from service.items.items import ItemRow, compute_etag
from service.repositories.job_rows import JOB_ORDERS, JobOrder
from service.repositories.search_conditions import ItemKind, ListFilter, Term, list_label_terms

MAX_TERMS = 10
EARLIEST, LATEST = datetime(1971, 1, 1, tzinfo=UTC), datetime(9000, 1, 1, tzinfo=UTC)
"""Times of a filter are moved between these; nothing is stored outside them."""

IfMatch = Annotated[
    str | None,
    Header(max_length=1000, description="ETag that was read; 412 if name, note or tags changed"),
]
Cascade = Annotated[bool, Query(description="also delete everything that was made from it")]
NamePart = Annotated[
    str | None, Query(max_length=200, description="part of the name, in upper or lower case")
]
Tags = Annotated[
    list[str] | None,
    Query(max_length=MAX_TERMS, description="tag of the item; several must all be there"),
]
Labels = Annotated[
    list[str] | None,
    Query(
        max_length=MAX_TERMS,
        description="`length_m=5` selects what has this label; several must all be there",
    ),
]
Moment = Annotated[
    datetime | None, Query(description="date or time, ISO 8601; without a zone it is UTC")
]


def read_filter(
    name: NamePart = None, tag: Tags = None, since: Moment = None, until: Moment = None
) -> ListFilter:
    """Read the filter of a list: part of the name, tags, and when the item was stored."""
    return _build_filter([("tag", value) for value in tag or ()], name, since, until)


def read_dataset_filter(
    common: Annotated[ListFilter, Depends(read_filter)], label: Labels = None
) -> ListFilter:
    """Read the filter of the list of datasets, which also have labels."""
    return replace(common, terms=(*common.terms, *_list_labels(label)))


def read_job_filter(
    common: Annotated[ListFilter, Depends(read_dataset_filter)],
    model: Annotated[
        str | None, Query(max_length=200, description="name of the model, without version")
    ] = None,
    dataset: Annotated[
        list[str] | None,
        Query(max_length=MAX_TERMS, description="id of a dataset that the job uses"),
    ] = None,
) -> ListFilter:
    """Read the filter of the list of jobs, which also have a model and datasets.

    The first term selects the rows: those come first that few items have.
    """
    terms: list[Term] = [("dataset", value) for value in dataset or ()]
    terms += [] if model is None else [("model", model)]
    return replace(common, terms=(*common.terms, *terms))


FilterDep = Annotated[ListFilter, Depends(read_filter)]
DatasetFilterDep = Annotated[ListFilter, Depends(read_dataset_filter)]
JobFilterDep = Annotated[ListFilter, Depends(read_job_filter)]


FormText = Annotated[str, Query(max_length=200)]


def read_dataset_form(
    name: FormText = "",
    tag: FormText = "",
    label: FormText = "",
    since: FormText = "",
    until: FormText = "",
) -> dict[str, str]:
    """Read the filled fields of the form that filters recordings; a form sends empty ones too."""
    fields = {"name": name, "tag": tag, "label": label, "since": since, "until": until}
    return {field: text.strip() for field, text in fields.items() if text.strip()}


def read_job_form(
    fields: Annotated[dict[str, str], Depends(read_dataset_form)],
    model: FormText = "",
    recording: FormText = "",
    state: FormText = "",
    sort: FormText = "",
) -> dict[str, str]:
    """Read the filled fields of the form that filters and sorts jobs."""
    texts = {"model": model, "recording": recording, "state": state, "sort": sort}
    more = {field: text.strip() for field, text in texts.items()}
    return {**fields, **{field: text for field, text in more.items() if text}}


JobFormDep = Annotated[dict[str, str], Depends(read_job_form)]
DatasetFormDep = Annotated[dict[str, str], Depends(read_dataset_form)]
_parse_moment = TypeAdapter(datetime).validate_python


def parse_form(session: Session, form: Mapping[str, str]) -> ListFilter:
    """Build the filter of a form.

    Raises
    ------
    InvalidRequest
        If a field makes no sense, or names no recording.
    """
    terms: list[Term] = [("tag", form["tag"])] if "tag" in form else []
    terms += _list_labels([form["label"]] if "label" in form else None)
    if "recording" in form:
        dataset = resolve_dataset(session, form["recording"])
        if isinstance(dataset, str):
            raise InvalidRequest.from_fault("?recording", dataset)
        terms.append(("dataset", dataset.id))
    if "model" in form:
        terms.append(("model", form["model"]))
    moments: dict[str, datetime] = {}
    for field in ("since", "until"):
        if field in form:
            try:
                moments[field] = _parse_moment(form[field])
            except ValidationError:
                raise InvalidRequest.from_fault(
                    f"?{field}", f"found {form[field]!r:.80}; need a date, such as 2026-01-31"
                ) from None
    return _build_filter(terms, form.get("name"), moments.get("since"), moments.get("until"))


def parse_states(form: Mapping[str, str]) -> list[JobState]:
    """Return the state that a form selects, if it selects one.

    Raises
    ------
    InvalidRequest
        If there is no such state.
    """
    return [JobState(_choose(form, "state", tuple(JobState)))] if "state" in form else []


def parse_order(form: Mapping[str, str]) -> JobOrder:
    """Return the order of a list of jobs that a form selects.

    Raises
    ------
    InvalidRequest
        If there is no such order.
    """
    return cast(JobOrder, _choose(form, "sort", JOB_ORDERS)) if "sort" in form else "newest"


def _choose(form: Mapping[str, str], field: str, choices: Sequence[str]) -> str:
    if form[field] not in choices:
        found, listed = f"{form[field]!r:.80}", ", ".join(choices)
        raise InvalidRequest.from_fault(f"?{field}", f"found {found}; need one of {listed}")
    return form[field]


def set_etag(response: Response, row: ItemRow) -> None:
    """Send the version of name, note and tags, which `If-Match` names."""
    response.headers["ETag"] = compute_etag(row)


def edit(
    session: Session,
    kind: ItemKind,
    reference: str,
    body: EditIn,
    if_match: str | None,
    response: Response,
) -> ItemRow:
    """Change name, note and tags of an item, and send its new version."""
    row = edit_item(session, kind, reference, body, if_match)
    set_etag(response, row)
    return row


def delete(
    session: Session, kind: ItemKind, reference: str, cascade: bool, if_match: str | None
) -> DeletedOut:
    """Delete an item, with everything made from it if `cascade`."""
    deleted = delete_item(session, kind, reference, cascade=cascade, if_match=if_match)
    return DeletedOut(deleted=[ItemOut.model_validate(describe_item(item)) for item in deleted])


def _build_filter(
    terms: list[Term], name: str | None, since: datetime | None, until: datetime | None
) -> ListFilter:
    return ListFilter(
        name=name or None, terms=tuple(terms), since=_clamp(since), until=_clamp(until)
    )


def _clamp(moment: datetime | None) -> datetime | None:
    if moment is None:
        return None
    aware = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment
    return min(max(aware, EARLIEST), LATEST)


def _list_labels(labels: list[str] | None) -> Iterator[Term]:
    for text in labels or ():
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise InvalidRequest.from_fault("?label", f"found {text!r:.80}; need name=value")
        yield from list_label_terms({name: _parse_number(value)})


def _parse_number(text: str) -> Any:
    """Return the number that a text is, so that 5 and 5.0 are the same label."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return text
    return value if isinstance(value, int | float) and not isinstance(value, bool) else text
