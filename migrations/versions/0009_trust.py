"""Trust in the result of each ended job, by which lists are sorted."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

INDEX = "ix_jobs_sorted"
BEFORE = ["project_id", "deleted_at", "fit_estimation", "best_rms", "name", "state", "id"]
SORTED = ["project_id", "deleted_at", "fit_estimation", "best_rms", "name", "state", "trust", "id"]
TRUST_OF_THE_BEST_RUN = """
UPDATE jobs SET trust = (
  SELECT runs.result -> 'verdict' ->> 'trust' FROM runs
  WHERE job_id = jobs.id AND best_rms IS NOT NULL
  ORDER BY best_rms, number LIMIT 1
)
WHERE fit_estimation IS NOT NULL
"""
"""A batch has no fit, and no run that stands for all. A result of an early version has no trust."""


def upgrade() -> None:
    op.add_column("jobs", sa.Column("trust", sa.String()))
    op.execute(TRUST_OF_THE_BEST_RUN)
    op.drop_index(INDEX, "jobs")
    op.create_index(INDEX, "jobs", SORTED)


def downgrade() -> None:
    op.drop_index(INDEX, "jobs")
    op.create_index(INDEX, "jobs", BEFORE)
    op.drop_column("jobs", "trust")
