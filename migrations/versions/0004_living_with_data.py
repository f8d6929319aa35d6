"""Notes, tags, search terms, origin of results, deletion of runs, and days to keep jobs.

The search terms and the edges to other runs of the stored jobs are derived from their requests.
"""

from collections.abc import Iterator
from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

JSON = sa.JSON().with_variant(postgresql.JSONB(), "postgresql")
ORDERED_JSON = sa.JSON()
TIME = sa.DateTime(timezone=True)
NEW_COLUMNS: dict[str, dict[str, Any]] = {
    "projects": {"keep_days": sa.Double()},
    "datasets": {"note": sa.String(), "tags": JSON},
    "models": {"note": sa.String(), "tags": JSON},
    "jobs": {
        "version": sa.String(),
        "fingerprint": sa.String(),
        "spec_hash": sa.String(),
        "note": sa.String(),
        "tags": JSON,
        "purged_at": TIME,
    },
    "runs": {"note": sa.String(), "tags": JSON, "deleted_at": TIME},
    "accepted_references": {"tags": JSON},
}
PARTIAL_INDEXES = (
    ("ix_datasets_named", "datasets", ["project_id", "id", "name"], "deleted_at IS NULL"),
    ("ix_jobs_named", "jobs", ["project_id", "id", "name"], "deleted_at IS NULL"),
    (
        "ix_jobs_ended",
        "jobs",
        ["project_id", "finished_at", "id"],
        "deleted_at IS NULL AND finished_at IS NOT NULL",
    ),
    ("ix_jobs_deleted", "jobs", ["deleted_at"], "deleted_at IS NOT NULL AND purged_at IS NULL"),
)
ROWS_AT_ONCE = 500
RUNS_OF_JOBS = """
INSERT INTO lineage_edges (child, parent, relation, project_id, created_at)
SELECT DISTINCT runs.id, runs.job_id, 'computed', runs.project_id, runs.created_at
FROM lineage_edges JOIN runs ON runs.id = lineage_edges.parent
"""
"""Edges of the runs from which something was made, to their jobs."""


def upgrade() -> None:
    for table, columns in NEW_COLUMNS.items():
        for name, kind in columns.items():
            op.add_column(table, sa.Column(name, kind))
    for name, table, columns_of_index, condition in PARTIAL_INDEXES:
        where = sa.text(condition)
        op.create_index(name, table, columns_of_index, sqlite_where=where, postgresql_where=where)
    op.create_table(
        "search_terms",
        *(
            sa.Column(name, sa.String(), nullable=False)
            for name in ("project_id", "kind", "value", "item_id")
        ),
        sa.PrimaryKeyConstraint("project_id", "kind", "value", "item_id", name="pk_search_terms"),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name="fk_search_terms_project_id"),
    )
    op.create_index("ix_search_terms_item_id", "search_terms", ["item_id"])
    op.create_index("ix_idempotency_keys_job_id", "idempotency_keys", ["job_id"])
    _derive_terms()
    op.execute(RUNS_OF_JOBS)


def downgrade() -> None:
    # A deleted run is a row without results, which earlier versions would show.
    deleted = "FROM runs WHERE deleted_at IS NOT NULL"
    for table in ("run_history", "migrations_log", "checkpoints"):
        op.execute(f"DELETE FROM {table} WHERE run_id IN (SELECT id {deleted})")
    op.execute(f"DELETE FROM job_summaries WHERE job_id IN (SELECT job_id {deleted})")
    # They counted as done. A job that may be resumed computes them again.
    op.execute(
        f"UPDATE jobs SET n_done = n_done - (SELECT count(*) {deleted} AND job_id = jobs.id) "
        f"WHERE state <> 'succeeded' AND id IN (SELECT job_id {deleted})"
    )
    op.execute("DELETE FROM runs WHERE deleted_at IS NOT NULL")
    op.execute("DELETE FROM lineage_edges WHERE relation IN ('computed', 'reference', 'model')")
    op.drop_index("ix_idempotency_keys_job_id", "idempotency_keys")
    op.drop_index("ix_search_terms_item_id", "search_terms")
    op.drop_table("search_terms")
    for name, table, _, _ in PARTIAL_INDEXES:
        op.drop_index(name, table)
    for table, columns in NEW_COLUMNS.items():
        for name in columns:
            op.drop_column(table, name)


def _derive_terms() -> None:
    jobs = sa.table(
        "jobs", sa.column("id"), sa.column("project_id"), sa.column("spec", ORDERED_JSON)
    )
    datasets = sa.table(
        "datasets", sa.column("id"), sa.column("project_id"), sa.column("details", JSON)
    )
    terms = sa.table(
        "search_terms", *(sa.column(n) for n in ("project_id", "kind", "value", "item_id"))
    )
    edges = sa.table(
        "lineage_edges",
        *(sa.column(name) for name in ("child", "parent", "relation", "project_id")),
        sa.column("created_at", TIME),
    )
    connection = op.get_bind()
    for item, project, spec in _read_rows(connection, jobs.c.id, jobs.c.project_id, jobs.c.spec):
        found = {("job:label", label) for axis in _list_axes(spec) for label in _list_labels(axis)}
        found |= {("job:dataset", dataset) for dataset in _list_datasets(spec)}
        if name := _find_model(spec):
            found.add(("job:model", name))
        _insert_terms(connection, terms, project, item, found)
        for run, relation in _list_runs(spec):
            _insert_edge(connection, edges, item, run, relation, project)
    columns = datasets.c.id, datasets.c.project_id, datasets.c.details
    for item, project, details in _read_rows(connection, *columns):
        segments = (details or {}).get("segments") or ()
        found = {("dataset:label", label) for one in segments for label in _list_labels(one)}
        _insert_terms(connection, terms, project, item, found)


def _read_rows(connection: sa.Connection, key: Any, *columns: Any) -> Iterator[Any]:
    """Read rows by their key, some at a time, so that others can be written meanwhile."""
    last = ""
    while True:
        query = sa.select(key, *columns).where(key > last).order_by(key).limit(ROWS_AT_ONCE)
        rows = connection.execute(query).all()
        yield from rows
        if len(rows) < ROWS_AT_ONCE:
            return
        last = rows[-1][0]


def _insert_terms(
    connection: sa.Connection, terms: Any, project: str, item: str, found: set[tuple[str, str]]
) -> None:
    rows = [
        {"project_id": project, "kind": kind, "value": value, "item_id": item}
        for kind, value in sorted(found)
    ]
    if rows:
        connection.execute(sa.insert(terms), rows)


def _insert_edge(
    connection: sa.Connection, edges: Any, child: str, parent: str, relation: str, project: str
) -> None:
    values = {"child": child, "parent": parent, "relation": relation, "project_id": project}
    connection.execute(sa.insert(edges).values(**values, created_at=sa.func.now()))


def _list_axes(spec: Any) -> list[Any]:
    return list(((spec or {}).get("sweep") or {}).get("axes") or ())


def _list_labels(part: Any) -> Iterator[str]:
    labels = part.get("labels") or ()
    for one in [labels] if isinstance(labels, dict) else labels:
        for name, value in (one or {}).items():
            whole = isinstance(value, float) and value.is_integer()
            yield f"{name}={int(value) if whole else value}"


def _list_datasets(spec: Any) -> Iterator[str]:
    yield from (spec or {}).get("datasets") or ()
    yield from ((spec or {}).get("validation") or {}).get("datasets") or ()
    for axis in _list_axes(spec):
        if str(axis.get("path", "")).startswith(("/datasets", "/validation/datasets")):
            for value in axis.get("values") or ():
                yield from [value] if isinstance(value, str) else value


def _list_runs(spec: Any) -> set[tuple[str, str]]:
    trend = (spec or {}).get("trend") or {}
    named = {((spec or {}).get("warm_start"), "warm-start"), (trend.get("reference"), "reference")}
    for axis in _list_axes(spec):
        if axis.get("path") == "/warm_start":
            named |= {(value, "warm-start") for value in axis.get("values") or ()}
    return {(str(run), relation) for run, relation in named if str(run).startswith("run_")}


def _find_model(spec: Any) -> str:
    model = (spec or {}).get("model")
    return str(model.get("name") or "") if isinstance(model, dict) else str(model or "")
