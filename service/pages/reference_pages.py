"""Pages of accepted references: their list, and what is compared with each."""

from collections.abc import Iterable, Mapping
from urllib.parse import urlencode

from sqlalchemy.orm import Session

from service.core.label_text import format_labels
from service.items.items import compute_etag
from service.jobs.outcomes import read_outcomes
from service.jobs.references import get_reference, list_references
from service.jobs.stored_run import load_run
from service.pages.render import render_template
from service.pages.trend_views import count_trend_flags
from service.pages.views import to_job_view
from service.repositories.job_rows import JobRepository
from service.repositories.lineage_rows import LineageLink, LineageRepository
from service.repositories.outcome_rows import read_estimates
from service.repositories.reference_rows import ReferenceRepository
from service.repositories.search_conditions import ListFilter
from sysid.core.text import format_unit, join_estimate
from sysid.uncertainty.estimates import Estimate

REFERENCES_PER_PAGE, JOBS_SHOWN = 50, 50
LISTED_ESTIMATES = 4
FILTER_FIELDS = (
    ("name", "Name", "part of it"),
    ("tag", "Tag", ""),
    ("since", "Since", ""),
    ("until", "Until", ""),
)
"""Fields of the filter of references: name, label and hint."""
USES = {"reference": "compared with it", "warm-start": "started from it"}
"""What a job does with a run that is a reference, by the relation of its lineage."""


def references_page(
    session: Session, cursor: str | None, chosen: ListFilter, form: Mapping[str, str]
) -> str:
    """Render the references in use, by name; `form` is the filter as typed."""
    page = list_references(session, cursor, REFERENCES_PER_PAGE, chosen)
    estimates = read_estimates(session, [one.run for one in page.items])
    query = {"cursor": page.next, **form}
    return render_template(
        "references.html",
        references=[
            {
                "name": one.name,
                "tags": one.tags,
                "by": one.by,
                "at": one.at,
                "labels": format_labels(one.labels),
                "estimates": _summarise(estimates.get(one.run, ())),
            }
            for one in page.items
        ],
        form=form,
        filter_fields=FILTER_FIELDS,
        filter_query=f"?{urlencode(form)}" if form else "",
        cursor=cursor,
        next=f"?{urlencode(query)}" if page.next else "",
    )


def reference_page(session: Session, name: str) -> str:
    """Render one reference: its estimates, what is compared with it, and the runs before it.

    Raises
    ------
    RowNotFound
        With the most similar name.
    """
    reference = get_reference(session, name)
    row = ReferenceRepository(session).get_latest(name)
    stored = load_run(session, reference.run)
    runs = [reference.run, *(one.run for one in reference.history)]
    uses = _list_uses(LineageRepository(session).list_links_to_children(runs))
    ids = sorted(uses, reverse=True)
    jobs = JobRepository(session).list_some(ids[:JOBS_SHOWN])
    outcomes = read_outcomes(session, jobs)
    return render_template(
        "accepted_reference.html",
        reference=reference,
        row=row,
        etag=compute_etag(row),
        title=f"{stored.model.name}, {stored.job.name}",
        labels=format_labels(reference.labels),
        estimates=stored.estimates,
        jobs=[to_job_view(session, job, outcomes.get(job.id)) for job in jobs],
        uses=uses,
        flags=count_trend_flags(session, jobs),
        unlisted=len(ids) - len(ids[:JOBS_SHOWN]),
    )


def _list_uses(links: Iterable[LineageLink]) -> dict[str, str]:
    """List what each job does with the runs, by its identifier."""
    uses: dict[str, list[str]] = {}
    for link in links:
        if link.relation in USES:
            uses.setdefault(link.child, []).append(USES[link.relation])
    return {job: ", ".join(dict.fromkeys(texts)) for job, texts in uses.items()}


def _summarise(estimates: Iterable[Estimate]) -> str:
    """Write the first estimates with errors and units in one line."""
    texts = [
        f"{one.name} = {join_estimate(one.value, one.stderr, status=one.status)}"
        f"{format_unit(one.unit)}"
        for one in estimates
    ]
    more = ["…"] if len(texts) > LISTED_ESTIMATES else []
    return ", ".join(texts[:LISTED_ESTIMATES] + more)
