"""Summaries of ended jobs, and indexes that do not grow with them.

Nothing is computed here: the summary of a job that ended earlier is stored at its first request.
"""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

PARTIAL_INDEXES = (
    ("ix_jobs_by_state", "jobs", ["project_id", "state", "id"], "deleted_at IS NULL"),
    (
        "ix_jobs_open",
        "jobs",
        ["state", "priority", "id", "project_id", "n_runs", "n_done"],
        "state IN ('queued', 'running')",
    ),
    (
        "ix_jobs_owned",
        "jobs",
        ["lease_owner", "state", "cancel_requested", "id"],
        "lease_owner IS NOT NULL",
    ),
    ("ix_runs_job_id_best_rms", "runs", ["job_id", "best_rms", "number"], "best_rms IS NOT NULL"),
    ("ix_events_told", "events", ["job_id", "id"], "kind <> 'progress'"),
)


def upgrade() -> None:
    op.drop_index("ix_jobs_queue", "jobs")
    op.drop_index("ix_jobs_owned", "jobs")
    op.add_column(
        "jobs", sa.Column("n_done_at_claim", sa.Integer(), nullable=False, server_default="0")
    )
    for name, table, columns, condition in PARTIAL_INDEXES:
        where = sa.text(condition)
        op.create_index(name, table, columns, sqlite_where=where, postgresql_where=where)
    op.create_table(
        "job_summaries",
        _column("job_id", sa.String()),
        _column("attempt", sa.Integer()),
        _column("document", sa.JSON()),
        _column("created_at", sa.DateTime(timezone=True)),
        sa.PrimaryKeyConstraint("job_id", name="pk_job_summaries"),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name="fk_job_summaries_job_id"),
    )


def downgrade() -> None:
    op.drop_table("job_summaries")
    for name, table, _, _ in PARTIAL_INDEXES:
        op.drop_index(name, table)
    op.drop_column("jobs", "n_done_at_claim")
    op.create_index("ix_jobs_queue", "jobs", ["state", "priority", "id", "project_id", "n_runs"])
    op.create_index("ix_jobs_owned", "jobs", ["lease_owner", "state", "cancel_requested", "id"])


def _column(name: str, kind: Any) -> sa.Column[Any]:
    return sa.Column(name, kind, nullable=False)
